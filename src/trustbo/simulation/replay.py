"""Recorded missions in the place of a simulator."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Self

from trustbo.data import Bound, Cell, Mission
from trustbo.errors import TrustboError, require_choice, require_pair
from trustbo.records import missions_from_tree, read_tree
from trustbo.simulation.tables import read_table

ON_MISSING = ("error", "next")
_NEAREST = 3


class ReplayBackend:
    """Replays missions that a robot, or another simulator, recorded.

    Each mission is replayed once: `run(path)` gives the first not yet replayed whose path is the
    one asked for. A campaign replays itself if workspace, settings and seed are those of the run
    that was recorded: then it asks for the same paths. With `on_missing="next"` a campaign learns
    from the missions in the order they were recorded, whatever paths it asks for.

    `reset`, `run_bound` and `close` replay a mission bound by bound; only missions on the path
    asked for, whatever `on_missing`.

    Attributes:
        missions: All, in the order recorded.
    """

    def __init__(self, missions: Sequence[Mission], *, on_missing: str = "error") -> None:
        """Nothing is replayed yet.

        Args:
            missions: The recorded missions.
            on_missing: What `run` does where no mission is left on the path asked for: `"error"`,
                or `"next"`, give the next one whatever its path (`Campaign.tell` learns from it).

        Raises:
            TrustboError: No missions, or an unknown `on_missing`.
        """
        if isinstance(missions, Mission) or not missions:
            raise TrustboError(f"give a list of at least one mission; got {missions!r}.")
        for j, mission in enumerate(missions):
            if not isinstance(mission, Mission):
                raise TrustboError(f"mission {j} must be a Mission; got {mission!r}.")
        self.missions = tuple(missions)
        self._on_missing = require_choice("on_missing", on_missing, ON_MISSING)
        self._left = list(range(len(self.missions)))
        self._start: Cell | None = None
        self._current: int | None = None
        self._n_run = 0

    @classmethod
    def from_table(
        cls,
        table: Any,
        *,
        start: Cell | None = None,
        features: Sequence[str] | None = None,
        robots: Sequence[str] | None = None,
        on_missing: str = "error",
    ) -> Self:
        """Replay a table in long form: a CSV file or a DataFrame; see `read_table`."""
        missions = read_table(table, start=start, features=features, robots=robots)
        return cls(missions, on_missing=on_missing)

    @classmethod
    def from_netcdf(cls, path: str | PathLike[str], *, on_missing: str = "error") -> Self:
        """Replay the `missions.nc` that `Result.save` wrote, ticks included.

        Args:
            path: The file, or the folder it is in.
            on_missing: As for `ReplayBackend`.

        Raises:
            TrustboError: There is no such file, or it holds no missions.
        """
        file = Path(path)
        file = file / "missions.nc" if file.is_dir() else file
        try:
            missions = missions_from_tree(read_tree(file))
        except (OSError, KeyError) as error:
            raise TrustboError(
                f"{str(file)!r} holds no missions ({error}); give the missions.nc of a result."
            ) from None
        return cls(missions, on_missing=on_missing)

    @property
    def remaining(self) -> tuple[Mission, ...]:
        """The missions not yet replayed, in the order recorded."""
        return tuple(self.missions[j] for j in self._left)

    def describe(self) -> dict[str, object]:
        """What was replayed, for the record."""
        return {
            "simulator": type(self).__name__,
            "recorded_missions": len(self.missions),
            "on_missing": self._on_missing,
        }

    def rewind(self) -> None:
        """Make all missions as if not yet replayed."""
        self.close()
        self._left = list(range(len(self.missions)))

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """The next recorded mission on a path.

        Args:
            path: Cells, start first.
            seed: Not used: what was recorded is not random.

        Raises:
            TrustboError: No mission on this path is left; the message names the nearest ones. With
                `on_missing="next"`: none is left at all.
        """
        cells = tuple(require_pair(f"path[{k}]", cell) for k, cell in enumerate(path))
        same = [j for j in self._left if self.missions[j].path == cells]
        if not same and self._on_missing == "next":
            same = self._left
        if not same:
            recorded = [j for j, mission in enumerate(self.missions) if mission.path == cells]
            raise TrustboError(self._missing(cells, recorded))
        j = same[0]
        self._left.remove(j)
        return self.missions[j]

    def reset(self, start: Cell, seed: int, next_cell: Cell | None = None) -> None:
        """Begin a mission at a cell.

        Args:
            start: The cell.
            seed: Not used.
            next_cell: Not used.
        """
        self.close()
        self._start = require_pair("start", start)

    def run_bound(self, k: int, cell: Cell, next_cell: Cell | None = None) -> Bound:
        """The next bound of the mission that is replayed.

        The first bound decides on the mission: the first not yet replayed that starts at the cell
        of `reset`, and goes on as asked for.

        Args:
            k: Number of the bound, 1 for the first.
            cell: The cell to enter.
            next_cell: The cell after it, if known; for the first bound, it tells missions apart.

        Raises:
            TrustboError: `reset` was not called, a bound is out of turn, no mission goes that way,
                or the mission that is replayed had ended, or went another way.
        """
        if self._start is None:
            raise TrustboError("call reset(start, seed) before run_bound.")
        if k != self._n_run + 1:
            raise TrustboError(f"bounds are replayed in turn: {self._n_run + 1} is next; got {k}.")
        cell = require_pair("cell", cell)
        if self._current is None:
            begin = (self._start, cell) if next_cell is None else (self._start, cell, next_cell)
            that_way = [j for j, m in enumerate(self.missions) if m.path[: len(begin)] == begin]
            same = [j for j in that_way if j in self._left]
            if not same:
                raise TrustboError(self._missing(begin, that_way))
            self._current = same[0]
            self._left.remove(same[0])
        j, mission = self._current, self.missions[self._current]
        if k > len(mission.bounds):
            raise TrustboError(
                f'recorded mission {j} ended as "{mission.status}" with bound {len(mission.bounds)}'
                f"; bound {k} was not run."
            )
        if mission.path[k] != cell:
            raise TrustboError(
                f"recorded mission {j}, begun to be replayed, enters {mission.path[k]} with bound "
                f"{k}, not {cell}. Give next_cell with bound 1, or replay whole missions with run."
            )
        self._n_run = k
        return mission.bounds[k - 1]

    def close(self) -> None:
        """End the mission that is replayed bound by bound."""
        self._start, self._current, self._n_run = None, None, 0

    def _missing(self, path: tuple[Cell, ...], recorded: Sequence[int]) -> str:
        """Why a path, or the beginning of one, cannot be replayed, and what comes nearest."""
        if not self._left:
            return f"all {len(self.missions)} missions are replayed; rewind() starts over."
        if recorded:
            which = ", ".join(map(str, recorded))
            return (
                f"path {_text(path)} was recorded, but as mission {which}, replayed by now; "
                "rewind() starts over."
            )

        def agreeing(j: int) -> int:
            pairs = zip(self.missions[j].path[1:], path[1:], strict=False)
            return sum(mine == asked for mine, asked in pairs)

        nearest = sorted(self._left, key=lambda j: (-agreeing(j), j))[:_NEAREST]
        lines = [
            f"mission {j}, {agreeing(j)} of {len(path) - 1} bounds agree: "
            f"{_text(self.missions[j].path)}"
            for j in nearest
        ]
        return (
            f"path {_text(path)} was never recorded. Nearest of {len(self._left)} left: "
            f'{"; ".join(lines)}. Or learn from whatever comes next: on_missing="next".'
        )


def _text(path: Sequence[Cell]) -> str:
    return " ".join(f"{row},{col}" for row, col in path)
