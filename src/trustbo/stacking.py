"""Stack missions of different lengths into one batch of arrays."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.data import Mission
from trustbo.errors import TrustboError, one_line


class MissionBatch(NamedTuple):
    """Stacked missions, padded to the length of the longest one with unmeasured bounds."""

    awareness: np.ndarray
    """Shape (mission, bound, robot, feature); 0 in the padding."""
    contact_rate: np.ndarray
    """Shape (mission, bound, robot); NaN in the padding."""
    n_ticks: np.ndarray
    """Number of ticks, shape (mission, bound, robot); NaN in the padding and where not recorded."""


def stack_missions(missions: Sequence[Mission]) -> MissionBatch:
    """Stack missions with the same robots and features, of any length, into one batch.

    Raises TrustboError if there are no missions, robots or features differ between missions, or an
    awareness value is NaN; only contact rates may be missing.
    """
    require_same_team(missions)
    n_bounds = max(len(mission.bounds) for mission in missions)
    shape = (len(missions), n_bounds, *missions[0].awareness.shape[1:])
    batch = MissionBatch(np.zeros(shape), *np.full((2, *shape[:-1]), np.nan))
    for j, mission in enumerate(missions):
        if np.isnan(mission.awareness.sum()):
            k, i, m = np.argwhere(np.isnan(mission.awareness))[0]
            raise TrustboError(
                f"awareness of mission {j}, bound {k + 1}, robot {mission.robots[i]}, feature "
                f"{mission.features[m]} is NaN; pass workspace= to fill it, or leave out the "
                "mission if the map does not know the cell."
            )
        for name, padded in batch._asdict().items():
            padded[j, : len(mission.bounds)] = getattr(mission, name)
    return batch


def known_awareness(missions: Sequence[Mission]) -> list[int]:
    """Return the indices of the missions whose awareness is known in all bounds.

    Call this after the awareness of the map was filled in. A warning names the other missions, as
    `Campaign.tell` does, which excludes them.
    """
    known = [j for j, mission in enumerate(missions) if not np.isnan(mission.awareness).any()]
    if unknown := sorted({*range(len(missions))} - {*known}):
        warnings.warn(
            f"missions {unknown} are left out: the map has no awareness in some of their cells.",
            stacklevel=3,
        )
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
