"""Set of benchmark worlds, listed in docs/worlds.md."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from trustbo.files import FilePath
from trustbo.simulation import Degradation, Dust, Fouling, Jam, Season, Trees
from trustbo.team import Robot, Team
from trustbo.workspace.sight import Sight
from world_set.world import REAL, World, drawn

_SYNTHETIC = tuple(f"synthetic-{seed}" for seed in range(3))
_ALDER = "synthetic-alder"
_BIRCH = "synthetic-birch"
_CEDAR = "synthetic-cedar"
_OF_14 = ("synthetic-0", "synthetic-1", _BIRCH, _CEDAR)
"""Synthetic terrains on which robots with a slope limit of 14 degrees can complete both courses."""
_NAMES = (
    "ash", "aspen", "beech", "cherry", "elm", "fir", "hazel", "hemlock", "holly", "juniper",
    "larch", "linden", "maple", "oak", "pine", "poplar", "rowan", "spruce", "walnut", "willow",
)  # fmt: skip
"""Names of further synthetic terrains, over which the cases are dealt out; see `_dealt`."""
_AFTER = 6
"""Index of the first mission after a change of the world, the seventh mission."""
_DAYS = (1, 3, 4, 7)
"""Indices of the missions with bad weather."""

type _Case = tuple[str, str, tuple[str, ...], Mapping[str, Any] | Callable[[str], dict[str, Any]]]
"""Kind, case, terrain names, and settings of `World`, or a function of the terrain's name."""


def _team_of(degrees: float) -> Team:
    """Make a team of a lead and three robots with the given slope limit in degrees."""
    robot = Robot(max_slope=float(np.deg2rad(degrees)))
    return Team(robots=(robot,) * 3, lead=robot)


def _limit(true: float, assumed: float) -> dict[str, Any]:
    """Return settings with the given true and assumed slope limits in degrees."""
    return {"team": _team_of(true), "assumed_team": _team_of(assumed)}


def _is_drawn(ground: str) -> bool:
    """Return whether the events on a terrain are random, with a seed from the terrain's name."""
    return ground not in _SYNTHETIC


def _one_robot(ground: str) -> int:
    return int(drawn(ground, "robot").integers(3)) if _is_drawn(ground) else 1


def _days(ground: str) -> tuple[int, ...]:
    """Return the indices of four of the first nine missions, which have bad weather."""
    days = drawn(ground, "days").permutation(9)[:4] if _is_drawn(ground) else _DAYS
    return tuple(sorted(int(day) for day in days))


def _place(ground: str) -> tuple[float, float]:
    """Choose the centre of an event near the middle, as fractions of the terrain's size."""
    x, y = drawn(ground, "place").uniform(0.3, 0.7, 2) if _is_drawn(ground) else (0.5, 0.5)
    return float(x), float(y)


def _reach(ground: str) -> float:
    """Return the radius of a jammer, m; it is smaller on real terrains, which are smaller."""
    return 40.0 if ground in REAL else 90.0


def _one_poor(ground: str) -> dict[str, Any]:
    robots = [Robot()] * 3
    robots[_one_robot(ground)] = Robot(
        detection=0.4, lidar_range=50.0, sensor_height=0.5, target_height=0.5
    )
    return {"team": Team(robots=tuple(robots)), "assumed_team": Team()}


def _unlike(ground: str) -> dict[str, Any]:
    robots = [
        Robot(sensor_height=mast, target_height=mast, lidar_range=reach, detection=detection)
        for mast, reach, detection in ((0.6, 60.0, 0.9), (1.0, 100.0, 1.0), (1.6, 80.0, 0.7))
    ]
    order = drawn(ground, "robots").permutation(3)
    return {"team": Team(robots=tuple(robots[i] for i in order)), "assumed_team": Team()}


def _rain(ground: str) -> dict[str, Any]:
    robot = f"r{_one_robot(ground) + 1}"
    return {"events": tuple(Degradation(robot, 0.3, first=day, last=day) for day in _days(ground))}


def _dust(ground: str) -> dict[str, Any]:
    return {"events": tuple(Dust(0.5, first=day, last=day) for day in _days(ground))}


def _foul(ground: str) -> dict[str, Any]:
    seed = drawn(ground, "fouling").integers(2**31) if _is_drawn(ground) else 0
    return {"events": (Fouling(0.1, 0.95, seed=int(seed)),)}


def _worn(detection: float) -> Callable[[str], dict[str, Any]]:
    return lambda ground: {
        "events": (Degradation(f"r{_one_robot(ground) + 1}", detection, first=_AFTER),)
    }


def _trees(height: float, radius: float) -> Callable[[str], dict[str, Any]]:
    return lambda ground: {"events": (Trees(height, _place(ground), radius, first=_AFTER),)}


def _jam(first: int = 0, last: int | None = None) -> Callable[[str], dict[str, Any]]:
    return lambda ground: {
        "events": (Jam(_place(ground), _reach(ground), 0.8, first=first, last=last),)
    }


def _season(factor: float) -> dict[str, Any]:
    return {"events": (Season(factor, first=_AFTER),)}


# In the kind "limit", the assumed slope limit is wrong: 1, 2 or 4 degrees too high, or 3 too low.
# The true limit is the lowest of 14, 18, 22 and 26 degrees at which both diagonal courses have a
# path that arrives and at least 5 % of the bounds fail. Wellington and synthetic-2 have no such
# limit. Only the real terrains of "limit-1" have other limits: the assumed one is 18 degrees, as
# in the kind "slopes", or 45 degrees, the default, on wellington.
_CASES: tuple[_Case, ...] = (
    ("right", "", (*_SYNTHETIC, *REAL), {}),
    ("wall", "wall", ("synthetic-0", "synthetic-1", "tahoe"), {"sight": Sight(math.inf, 0.0)}),
    ("bare", "bare", ("synthetic-2", "wellington", "bcts"), {"sight": Sight(0.0)}),
    ("aged", "aged", ("synthetic-0", "synthetic-1", *REAL), {"aged": True}),
    ("canopy", "dense", ("synthetic-1", "wellington"), {"assumed": Sight(extinction=0.3)}),
    ("canopy", "thin", ("synthetic-2", "tahoe"), {"assumed": Sight(extinction=0.1 / 3.0)}),
    ("canopy", "low", ("synthetic-0", "topography", "bcts"), {"assumed": Sight(crown_base=0.0)}),
    ("slopes", "slopes", ("synthetic-0",), {"team": _team_of(14.0)}),
    ("slopes", "slopes", ("tahoe", "topography"), {"team": _team_of(18.0)}),
    ("canopy", "thin-canopy", (_ALDER, _CEDAR, "wellington"),
     {"sight": Sight(extinction=0.06, crown_base=0.4),
      "assumed": Sight(extinction=0.4, crown_base=0.0)}),
    ("robots", "one-poor", ("synthetic-1", _ALDER, "wellington"), _one_poor),
    ("robots", "unlike", ("tahoe",), _unlike),
    ("days", "rain", ("synthetic-0", _BIRCH, "tahoe"), _rain),
    ("days", "dust", ("synthetic-2", _CEDAR, "wellington"), _dust),
    ("foul", "foul", ("synthetic-2", _ALDER, "topography"), _foul),
    ("change", "dead-detector", ("synthetic-0", _CEDAR, "bcts"), _worn(0.0)),
    ("change", "half-detector", (_BIRCH,), _worn(0.5)),
    ("change", "felled", ("synthetic-1", "tahoe"), _trees(0.0, 40.0)),
    ("change", "grown", (_ALDER,), _trees(12.0, 30.0)),
    ("change", "leaves", (_BIRCH,), _season(3.0)),
    ("change", "leaf-fall", ("wellington",), _season(1.0 / 3.0)),
    ("jammer", "jammer", ("synthetic-2", _BIRCH), _jam()),
    ("jammer", "jammer-appears", (_ALDER, "wellington"), _jam(_AFTER)),
    ("jammer", "jammer-lifted", ("synthetic-0", _CEDAR, "tahoe"), _jam(last=_AFTER - 1)),
    ("physics", "radio", ("synthetic-1", _BIRCH, "topography"), {"radio": True}),
    ("shapes", "12x7", (_BIRCH, "tahoe"), {"shape": (12, 7)}),
    ("shapes", "20x20", (_CEDAR,), {"shape": (20, 20), "cell": 25.0}),
    ("teams", "team-of-2", ("synthetic-2", "bcts"), {"team": Team(2)}),
    ("teams", "team-of-5", (_CEDAR,), {"team": Team(5)}),
    ("limit", "limit-4", ("synthetic-0", "synthetic-1", _BIRCH, _CEDAR), _limit(14.0, 18.0)),
    ("limit", "limit-4", (_ALDER,), _limit(18.0, 22.0)),
    ("limit", "limit-4", ("tahoe", "topography"), _limit(22.0, 26.0)),
    ("limit", "limit-4", ("bcts",), _limit(26.0, 30.0)),
    ("limit", "limit-1", ("tahoe", "topography"), _limit(17.0, 18.0)),
    ("limit", "limit-1", ("wellington",), _limit(44.0, 45.0)),
    ("limit", "limit-1", _OF_14, _limit(14.0, 15.0)),
    ("limit", "limit-2", _OF_14, _limit(14.0, 16.0)),
    ("limit", "limit-2", ("tahoe", "topography"), _limit(22.0, 24.0)),
    ("limit", "limit-low-3", _OF_14, _limit(14.0, 11.0)),
    ("limit", "limit-low-3", ("tahoe", "topography"), _limit(22.0, 19.0)),
)  # fmt: skip


def _all() -> list[World]:
    every = []
    for kind, case, grounds, settings in _CASES:
        every += [_world(kind, case, ground, settings) for ground in grounds]
    return every + _dealt()


def _world(
    kind: str,
    case: str,
    ground: str,
    settings: Mapping[str, Any] | Callable[[str], dict[str, Any]],
) -> World:
    name = f"{ground}-{case}" if case else ground
    given = settings(ground) if callable(settings) else settings
    return World(name, kind, ground, **given)


def _dealt() -> list[World]:
    """Deal out the cases over further terrains, so that there are thirty in all.

    Each terrain gets one case with a right slope limit, and every second one a wrong limit as well.
    The order of the cases is drawn by name. The true limit is 14 degrees, at which both diagonals
    of all these terrains have a path.
    """
    grounds = [f"synthetic-{name}" for name in _NAMES]
    right = {case: (kind, settings) for kind, case, _, settings in _CASES if kind != "limit"}
    wrong = {"limit-4": 18.0, "limit-1": 15.0, "limit-2": 16.0, "limit-low-3": 11.0}

    order = drawn("cases", "right limit").permutation(list(right))[: len(grounds)]
    every = [_world(right[case][0], case, ground, right[case][1])
             for ground, case in zip(grounds, order.tolist(), strict=True)]  # fmt: skip
    order = drawn("cases", "wrong limit").permutation(list(wrong)).tolist()
    for k, ground in enumerate(grounds[::2]):
        case = order[k % len(order)]
        every.append(_world("limit", case, ground, _limit(14.0, wrong[case])))
    return every


def worlds(data: FilePath | None = None) -> dict[str, World]:
    """Return the benchmark worlds, keyed by name (see docs/worlds.md).

    Args:
        data: Folder with the real terrains, such as `tahoe/dem.tif`. Without this folder, the only
            real terrain that can be used is wellington, which is included in the package.

    Returns:
        Worlds on 26 synthetic and 4 real terrains.
    """
    folder = None if data is None else str(data)
    return {world.name: replace(world, data=folder) for world in _all()}


def available(data: FilePath | None = None) -> dict[str, World]:
    """Return the worlds whose terrains are available: all with `data`, else those packaged."""
    return {name: world for name, world in worlds(data).items() if data or world.is_packaged}
