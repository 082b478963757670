"""Tolls: costs of bounds apart from trust, for their metres and for the time they go unseen.

A path pays the sum of the tolls of its bounds, so that every search takes them alike: they depend
on the bound alone, not on the way there.
"""

from collections.abc import Sequence

import numpy as np

from trustbo.data import Cell
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.workspace.moves import bounds_along


def tolls_of(admissible: AdmissiblePaths, objective: Objective) -> np.ndarray:
    """Toll of each bound, (move, cell), of one cell where all bounds by a move cost the same."""
    toll = objective.length_weight * admissible.lengths[:, None]
    if objective.unseen_cost == 0.0:
        return toll
    unseen = admissible.unseen.reshape(len(toll), -1)
    return toll + objective.unseen_cost * unseen


def toll_along(
    admissible: AdmissiblePaths, objective: Objective, path: Sequence[Cell] | np.ndarray
) -> float:
    """Toll of a path."""
    toll = unseen_along(admissible, objective, path)
    if objective.length_weight:
        toll += objective.length_weight * admissible.length_of(path)
    return toll


def unseen_along(
    admissible: AdmissiblePaths, objective: Objective, path: Sequence[Cell] | np.ndarray
) -> float:
    """Part of a path's toll for the expected time in which nobody sees anybody."""
    if not objective.unseen_cost:
        return 0.0
    shares = admissible.workspace.unseen_bounds
    assert shares is not None  # noqa: S101  # `PlanningProblem` refuses a cost without
    return objective.unseen_cost * float(shares.values[*bounds_along(path).T].sum())
