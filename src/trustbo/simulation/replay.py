"""Simulator that replays recorded missions."""

from collections.abc import Iterable, Sequence

from trustbo.data import Cell, Mission, path_text, require_map, split_path, stations_of
from trustbo.errors import TrustboError, require_switch, require_whole
from trustbo.simulation.protocol import DescribedSimulator
from trustbo.stacking import list_of_missions


class ReplaySimulator(DescribedSimulator):
    """Simulator that replays missions recorded by robots or by another simulator, in order.

    A campaign with the same workspace, settings and seed as the recorded campaign proposes the same
    paths.

    Attributes:
        missions: All missions, in the recorded order.

    Example:
        >>> replay = tb.simulation.ReplaySimulator(tb.logs.read_missions("missions.nc"))
        >>> again = tb.iterate(workspace, (9, 0), (0, 9), n_iterations=2, simulator=replay)
    """

    def __init__(self, missions: Iterable[Mission], *, any_path: bool = False) -> None:
        """Store the missions.

        Args:
            missions: Recorded missions, such as the result of `logs.read_missions`.
            any_path: If True, a mission is also replayed if `run` is called with another path.

        Raises:
            TrustboError: There are no missions, or they have no map.
        """
        require_switch("any_path", any_path)
        missions = list_of_missions(missions)
        if not missions:
            raise TrustboError("missions must contain at least one mission; got none.")
        require_map("a replay", missions)
        self.missions = tuple(missions)
        self.any_path = any_path

    def describe(self) -> dict[str, object]:
        """Return the number of missions and the value of `any_path`."""
        n = len(self.missions)
        return {"simulator": type(self).__name__, "missions": n, "any_path": self.any_path}

    def run(
        self,
        path: Sequence[Cell],
        *,
        seed: int,
        mission: int = 0,
        post_sets: Sequence[str] = (),
    ) -> Mission:
        """Return the recorded mission with the number `mission`; `seed` is not used.

        Raises:
            TrustboError: There is no mission with that number, or it has another path.
        """
        if require_whole("mission", mission, 0) >= len(self.missions):
            raise TrustboError(
                f"mission {mission} is not among the {len(self.missions)} recorded missions, which "
                "are counted from 0; run fewer missions."
            )

        recorded = self.missions[mission]
        asked = stations_of(*split_path(path, post_sets))
        if recorded.stations != asked and not self.any_path:
            raise TrustboError(
                f"mission {mission} was recorded on the path {path_text(recorded.path)}, not on "
                f"{path_text(asked)}; set any_path=True to replay the mission anyway."
            )
        return recorded
