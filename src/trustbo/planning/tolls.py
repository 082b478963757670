"""Tolls: costs of bounds apart from trust, for their metres and for the time they go unseen.

A path pays the sum of the tolls of its bounds, so that every search takes them alike: they depend
on the bound alone, not on the way there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trustbo.data import Cell
from trustbo.planning.objectives import Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.workspace.moves import bounds_along


class Toll(NamedTuple):
    """Toll of a path, by its parts."""

    length: float = 0.0
    """Length of the path, in metres, times `length_weight`."""
    unseen: float = 0.0
    """Expected time in which nobody sees anybody, in bounds, times `unseen_cost`."""

    @property
    def total(self) -> float:
        """Sum of the parts."""
        return self.length + self.unseen


NO_TOLL = Toll()


def tolls_of(admissible: AdmissiblePaths, objective: Objective) -> np.ndarray:
    """Toll of each bound, (move, cell), of one cell where all bounds by a move cost the same."""
    toll = objective.length_weight * admissible.lengths[:, None]
    if objective.unseen_cost == 0.0:
        return toll
    unseen = admissible.unseen.reshape(len(toll), -1)
    return toll + objective.unseen_cost * unseen


def toll_along(
    admissible: AdmissiblePaths, objective: Objective, path: Sequence[Cell] | np.ndarray
) -> Toll:
    """Toll of a path."""
    toll = NO_TOLL
    if objective.length_weight:
        toll = toll._replace(length=objective.length_weight * admissible.length_of(path))
    if objective.unseen_cost:
        shares = admissible.workspace.unseen_bounds
        assert shares is not None  # noqa: S101  # `PlanningProblem` refuses a cost without
        unseen = float(shares.values[*bounds_along(path).T].sum())
        toll = toll._replace(unseen=objective.unseen_cost * unseen)
    return toll
