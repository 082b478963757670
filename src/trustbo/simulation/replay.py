"""Simulator that replays recorded missions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from trustbo.data import Cell, Mission, path_text, require_map
from trustbo.errors import TrustboError, require_choice, require_pair
from trustbo.files import FilePath
from trustbo.logs.netcdf import read_missions
from trustbo.logs.table import read_table
from trustbo.simulation.protocol import DescribedSimulator

ON_MISSING = ("error", "next")
_NEAREST = 3


class ReplaySimulator(DescribedSimulator):
    """Simulator that replays missions recorded by robots or another simulator.

    Each mission is replayed once: `run(path)` returns the first one left with that path. A campaign
    with the workspace, settings and seed of the recorded run asks for the same paths, and so
    replays it. With `on_missing="next"` a campaign learns from the missions in the order in which
    they were recorded, independent of the paths it asks for.

    Attributes:
        missions: All missions, in the order recorded.
    """

    def __init__(self, missions: Sequence[Mission], *, on_missing: str = "error") -> None:
        """Start with all missions left.

        Args:
            missions: Recorded missions.
            on_missing: `"error"` to replay the mission recorded on the path asked for, and to raise
                if none is left; `"next"` to replay all in their order, on any path
                (`Campaign.tell` learns from them).

        Raises:
            TrustboError: No missions, or an unknown `on_missing`.
        """
        if isinstance(missions, Mission) or not missions:
            raise TrustboError(f"give a list of at least one mission; got {missions!r}.")
        for j, mission in enumerate(missions):
            if not isinstance(mission, Mission):
                raise TrustboError(f"mission {j} must be a Mission; got {mission!r}.")
        require_map("a replay", missions)
        self.missions = tuple(missions)
        self._on_missing = require_choice("on_missing", on_missing, ON_MISSING)
        self._left = list(range(len(self.missions)))

    @classmethod
    def from_table(cls, table: Any, *, on_missing: str = "error", **options: Any) -> Self:
        """Replay a table in long form: a CSV file or a DataFrame; options as for `read_table`."""
        return cls(read_table(table, **options), on_missing=on_missing)

    @classmethod
    def from_netcdf(cls, path: FilePath, *, on_missing: str = "error") -> Self:
        """Replay the `missions.nc` that `Result.save` wrote, ticks included.

        Args:
            path: The file, or its folder.
            on_missing: See `ReplaySimulator`.

        Raises:
            DamagedFileError: There is no such file, or it holds no missions.
        """
        file = Path(path)
        file = file / "missions.nc" if file.is_dir() else file
        return cls(read_missions(file), on_missing=on_missing)

    @property
    def remaining(self) -> tuple[Mission, ...]:
        """Missions not yet replayed, in the order recorded."""
        return tuple(self.missions[j] for j in self._left)

    def describe(self) -> dict[str, object]:
        """Return the number of missions, and `on_missing`."""
        return {
            "simulator": type(self).__name__,
            "recorded_missions": len(self.missions),
            "on_missing": self._on_missing,
        }

    def rewind(self) -> None:
        """Start over with all missions left."""
        self._left = list(range(len(self.missions)))

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """Return the next recorded mission on a path; with `on_missing="next"`, on any.

        Args:
            path: Cells, start first.
            seed: Not used.

        Raises:
            TrustboError: No mission on this path is left; the message names the nearest ones. With
                `on_missing="next"`: none is left at all.
        """
        cells = tuple(require_pair(f"path[{k}]", cell) for k, cell in enumerate(path))
        if self._on_missing == "next":  # the order of missions carries what changed with time
            same = self._left
        else:
            same = [j for j in self._left if self.missions[j].path == cells]
        if not same:
            recorded = [j for j, mission in enumerate(self.missions) if mission.path == cells]
            raise TrustboError(self._missing(cells, recorded))
        j = same[0]
        self._left.remove(j)
        return self.missions[j]

    def _missing(self, path: tuple[Cell, ...], recorded: Sequence[int]) -> str:
        """Message for a path that cannot be replayed."""
        if not self._left:
            return f"all {len(self.missions)} missions are replayed; rewind() starts over."
        if recorded:
            which = ", ".join(map(str, recorded))
            return (
                f"path {path_text(path)} was recorded, but as mission {which}, replayed by now; "
                "rewind() starts over."
            )

        def agreeing(j: int) -> int:
            pairs = zip(self.missions[j].path[1:], path[1:], strict=False)
            return sum(mine == asked for mine, asked in pairs)

        nearest = sorted(self._left, key=lambda j: (-agreeing(j), j))[:_NEAREST]
        lines = [
            f"mission {j}, {agreeing(j)} of {len(path) - 1} bounds agree: "
            f"{path_text(self.missions[j].path)}"
            for j in nearest
        ]
        return (
            f"path {path_text(path)} was never recorded. Nearest of {len(self._left)} left: "
            f'{"; ".join(lines)}. Or take the next mission on any path: on_missing="next".'
        )
