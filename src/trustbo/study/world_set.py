"""The fixed set of worlds of the open benchmark."""

from dataclasses import replace

from trustbo.files import FilePath
from trustbo.study.world import REAL, World
from trustbo.workspace.sight import Sight

_WALL, _BARE = Sight("wall"), Sight("bare")
_DENSE, _THIN, _LOW = Sight(extinction=0.3), Sight(extinction=0.1 / 3.0), Sight(crown_base=0.0)
_SYNTHETIC = tuple(f"synthetic-{seed}" for seed in range(3))


def _all() -> list[World]:
    kinds: list[World] = [World(ground, "right", ground) for ground in (*_SYNTHETIC, *REAL)]
    for name, sight, grounds in (
        ("wall", _WALL, ("synthetic-0", "synthetic-1", "tahoe")),
        ("bare", _BARE, ("synthetic-2", "wellington", "bcts")),
    ):
        kinds += [World(f"{ground}-{name}", name, ground, sight) for ground in grounds]
    for ground in ("synthetic-0", "synthetic-1", *REAL):
        kinds.append(World(f"{ground}-aged", "aged", ground))
    for name, assumed, grounds in (
        ("dense", _DENSE, ("synthetic-1", "wellington")),
        ("thin", _THIN, ("synthetic-2", "tahoe")),
        ("low", _LOW, ("synthetic-0", "topography", "bcts")),
    ):
        kinds += [World(f"{g}-{name}", "canopy", g, assumed=assumed) for g in grounds]
    for ground, slope in (("synthetic-0", 14.0), ("tahoe", 18.0), ("topography", 18.0)):
        kinds.append(World(f"{ground}-slopes", "slopes", ground, max_slope=slope))
    return kinds


def worlds(data: FilePath | None = None) -> dict[str, World]:
    """Worlds of the benchmark by name; see docs/worlds.md.

    Args:
        data: Folder with the real terrains, `tahoe/dem.tif` and so on. Without it, their worlds are
            listed too, but those of wellington alone, which is in the package, can be used.

    Returns:
        29 worlds, of 3 synthetic terrains and 4 real ones.
    """
    folder = None if data is None else str(data)
    return {world.name: replace(world, data=folder) for world in _all()}
