"""The planning problem: workspace, admissible paths, objective, team and the awareness assumed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models.params import Params, params_of
from trustbo.planning.dynamics import TEAMS, Dynamics, trust_dynamics
from trustbo.planning.objectives import ADDITIVE, OBJECTIVES, Objective
from trustbo.planning.paths import AdmissiblePaths
from trustbo.workspace import Workspace


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """Workspace, admissible paths, objective and awareness: the data of a `Planner`.

    Trust of the `team` is the `"mean"` or the least (`"min"`) of its robots'. Awareness has shape
    (robot, row, col, feature), with a leading axis (draw,) where it is uncertain, and a mean over
    these.

    TrustboError: unknown team or objective; a length weight that is negative, or for success or
    bottleneck.
    """

    paths: AdmissiblePaths
    objective: Objective
    team: str
    awareness: np.ndarray
    mean_awareness: np.ndarray

    def __post_init__(self) -> None:
        name, length_weight = self.objective
        require_choice("objective", name, OBJECTIVES)
        require_choice("team", self.team, TEAMS)
        if not 0.0 <= length_weight < np.inf:
            raise TrustboError(f"length_weight must be finite and >= 0; got {length_weight!r}.")
        if length_weight and name not in ADDITIVE:
            raise TrustboError(
                f"length_weight is for {', '.join(ADDITIVE)}; the objective is {name!r}."
            )

    @property
    def workspace(self) -> Workspace:
        """Workspace of the admissible paths."""
        return self.paths.workspace

    def with_awareness(self, awareness: ArrayLike, mean: ArrayLike | None = None) -> Self:
        """Return the problem with another awareness map, or one map for each draw.

        Shape (robot, row, col, feature) or (draw, robot, row, col, feature); `mean` is the map for
        parameters without draws, by default the mean. ShapeError: other numbers of robots, cells or
        features than the workspace's. TrustboError: NaN in a passable cell.
        """
        z = np.asarray(awareness, dtype=float)
        expected = self.workspace.awareness.shape
        if z.ndim not in (4, 5) or z.shape[-4:] != expected:
            raise ShapeError(f"awareness must end in {expected}; got shape {z.shape}.")
        missing = np.isnan(z).any(-1).reshape(-1, *expected[1:3]).any(0) & self.paths.passable
        if missing.any():
            cell = tuple(int(i) for i in np.argwhere(missing)[0])
            raise TrustboError(
                f"awareness of the passable cell {cell} is NaN; fill it, or mark it impassable."
            )
        mean = z.reshape(-1, *expected).mean(0) if mean is None else np.asarray(mean)
        return replace(self, awareness=z, mean_awareness=mean)

    def onward(self, done: Sequence[Cell]) -> Self:
        """Return the problem of the rest of a mission that entered the cells `done`, start first.

        Bounds already made count towards the limit. The value of a plan is that of the rest alone:
        for `mean`, the mean over the bounds still to come. Raises what `AdmissiblePaths.onward`
        raises.
        """
        return replace(self, paths=self.paths.onward(done))

    def of_draw(self, index: int) -> Self:
        """Return the problem with the awareness map of one draw, where awareness is uncertain."""
        if self.awareness.ndim == 4:
            return self
        return self.with_awareness(self.awareness[index % len(self.awareness)])

    def dynamics(
        self,
        params: Params,
        x0: ArrayLike | None = None,
        *,
        draws: np.ndarray | None = None,
        team: str | None = None,
    ) -> Dynamics:
        """Build the recursion of expected trust; params without draws get the mean awareness.

        `x0` is by default `params.x0_mean`, `draws` (indices in the posterior) 0, 1, 2, ..., and
        `team` the problem's.
        """
        z = self.awareness
        if z.ndim == 5:
            if params.leading:
                n = params.leading[0]
                z = z[(np.arange(n) if draws is None else draws) % len(z)]
            else:
                z = self.mean_awareness
        return trust_dynamics(params, z, team or self.team, x0)


def draws_of(posterior: Params | xr.DataTree) -> Params:
    """Parameters as they are, or the draws of a posterior: leading axis (draw,)."""
    return params_of(posterior) if isinstance(posterior, xr.DataTree) else posterior
