"""Checks of missions that are to be fitted together."""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Mission
from trustbo.errors import TrustboError, one_line, warn


def known_awareness(missions: Sequence[Mission]) -> list[int]:
    """Return the indices of the missions whose awareness is known in all bounds.

    Call this after the awareness of the map was filled in. A warning names the other missions, as
    `Campaign.tell` does, which excludes them.
    """
    known = [j for j, mission in enumerate(missions) if not np.isnan(mission.awareness).any()]
    unknown = sorted({*range(len(missions))} - {*known})
    if unknown:
        warn(f"missions {unknown} are left out: the map has no awareness in some of their cells.")
    return known


def require_same_team(missions: Sequence[Mission]) -> None:
    """Raise TrustboError unless there are missions, all with the same robots and features."""
    if not isinstance(missions, Sequence) or not missions:
        raise TrustboError(
            f"missions must be a list of at least one mission; got {one_line(missions)}. For a "
            "single mission, give [mission]; for a result or a campaign, give its .missions."
        )

    first = missions[0]
    for j, mission in enumerate(missions):
        if not isinstance(mission, Mission):
            raise TrustboError(f"mission {j} is not a Mission; got {one_line(mission)}.")
        if (mission.robots, mission.features) != (first.robots, first.features):
            raise TrustboError(
                f"mission {j} has robots {mission.robots} and features {mission.features}, but "
                f"mission 0 has {first.robots} and {first.features}; all must agree."
            )
