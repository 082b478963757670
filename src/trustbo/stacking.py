"""Missions that are to be fitted together: the same robots and features, in one array each."""

from collections.abc import Iterable, Sequence

import numpy as np

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_kind, require_list, require_order, warn
from trustbo.workspace import Workspace


def prepare(
    missions: Iterable[Mission],
    workspace: Workspace | None = None,
    earlier: Sequence[Mission] = (),
) -> tuple[list[Mission], tuple[str, ...]]:
    """Prepare missions for a fit; see `trustbo.fit` for the arguments.

    Returns:
        All missions, with the same robots and features, starting with those of earlier campaigns;
        and the robots of the other missions.

    Raises:
        TrustboError: There are no missions, or their robots or features differ.
    """
    filled, known = fill(missions, workspace)
    own = [filled[j] for j in known]

    if not earlier:
        return require_same_team(own), own[0].robots

    if own:
        robots = require_same_team(own)[0].robots
    else:
        robots = earlier[0].robots if workspace is None else workspace.team.names
    return require_same_team(pooled(robots, [*earlier, *own])), robots


def fill(
    missions: Iterable[Mission], workspace: Workspace | None
) -> tuple[list[Mission], list[int]]:
    """Fill in the awareness of the map where missions have none; see `Workspace.fill`.

    Returns:
        The missions, and the indices of those whose awareness is known in all bounds. The others
        are named in a warning, as in `Campaign.tell`, which excludes them. Without a workspace,
        all missions are returned as they are.
    """
    missions = list_of_missions(missions)
    indices = list(range(len(missions)))

    if workspace is None:
        return missions, indices

    require_kind("workspace", workspace, Workspace, "give the workspace of the missions")
    filled = [workspace.fill(mission) for mission in missions]
    unknown = [j for j in indices if np.isnan(filled[j].awareness).any()]
    if unknown:
        warn(f"missions {unknown} are left out: the map has no awareness in some of their cells.")
    return filled, [j for j in indices if j not in unknown]


def padded(arrays: Sequence[np.ndarray], fill: float) -> np.ndarray:
    """Return arrays (bound, ...) of missions as one (mission, bound, ...), padded with `fill`."""
    n_bounds = max(len(values) for values in arrays)
    shape = (len(arrays), n_bounds, *arrays[0].shape[1:])
    whole = np.full(shape, fill, dtype=arrays[0].dtype)

    for values, of_mission in zip(arrays, whole, strict=True):
        of_mission[: len(values)] = values
    return whole


def names_of_all(robots: Sequence[str], missions: Sequence[Mission]) -> tuple[str, ...]:
    """Return names of robots, followed by those of other robots in missions, in order."""
    names = dict.fromkeys(robots)
    for mission in missions:
        names |= dict.fromkeys(mission.robots)
    return tuple(names)


def pooled(robots: Sequence[str], missions: Sequence[Mission]) -> list[Mission]:
    """Return missions with the same robots: these robots, followed by others in the missions."""
    every = names_of_all(robots, missions)
    return [mission.with_robots(every) for mission in missions]


def require_same_robots(what: str, missions: Sequence[Mission], robots: Sequence[str]) -> None:
    """Raise TrustboError if an earlier mission had other robots; see `Mission.with_robots`."""
    for mission in missions:
        absent = np.isnan(mission.contact_rate).all(0) & ~mission.awareness.any((0, 2))
        names = [n for n, is_absent in zip(mission.robots, absent, strict=True) if not is_absent]
        if sorted(names) != sorted(robots):
            raise TrustboError(
                f"{what} needs the same robots in all missions, {', '.join(robots)}; an earlier "
                f"mission was run by {', '.join(names)}."
            )


def list_of_missions(missions: Iterable[Mission], what: str = "missions") -> list[Mission]:
    """Return missions as a new list, which may be empty.

    Any iterable with an order is accepted, such as a tuple, a Series, an array of objects or a
    generator. Raises TrustboError for other values, such as a single mission.
    """
    remedy = (
        "give a list of missions; for a single mission, [mission]; for a result or a campaign, its "
        ".missions; for a dict, its .values()"
    )
    return require_list(what, require_order(what, missions), Mission, remedy)


def require_same_team(missions: Iterable[Mission]) -> list[Mission]:
    """Return missions as a list; see `list_of_missions`.

    Raises TrustboError unless there are missions, all with the same robots and features.
    """
    missions = list_of_missions(missions)
    if not missions:
        raise TrustboError("missions must contain at least one mission; got none.")

    first = missions[0]
    for j, mission in enumerate(missions):
        if (mission.robots, mission.features) != (first.robots, first.features):
            raise TrustboError(
                f"mission {j} has robots {mission.robots} and features {mission.features}, but "
                f"mission 0 has {first.robots} and {first.features}; all must agree."
            )
    return missions
