"""What planning goes by: the workspace, the course, and the awareness believed in."""

from collections.abc import Sequence
from copy import copy
from typing import Self

import networkx as nx
import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models.params import Params, params_of
from trustbo.planning.course import Course
from trustbo.planning.dynamics import TEAMS, Dynamics, dynamics
from trustbo.terrain import Workspace


class Setting:
    """A workspace, the admissible paths in it, and the awareness that plans go by.

    Attributes:
        workspace: Where.
        course: Start, goal, and which paths are admissible.
        team: The team's trust is the `"mean"` or the `"min"` of its robots'.
        awareness: Shape (robot, row, col, feature); or with a leading axis (draw,), where it is
            uncertain.
        mean_awareness: Its mean, shape (robot, row, col, feature).
    """

    def __init__(self, workspace: Workspace, course: Course, team: str) -> None:
        """Go by the workspace's own map."""
        self.workspace, self.course = workspace, course
        self.team = require_choice("team", team, TEAMS)
        self.awareness = self.mean_awareness = workspace.awareness.values

    @property
    def graph(self) -> nx.DiGraph:
        """The `networkx.DiGraph` of passable cells (see `cell_graph`)."""
        return self.course.graph

    @property
    def start(self) -> Cell:
        """First cell."""
        return self.course.start

    @property
    def goal(self) -> Cell:
        """Last cell."""
        return self.course.goal

    @property
    def shortest(self) -> int:
        """Fewest bounds from start to goal."""
        return self.course.shortest

    @property
    def longest(self) -> int:
        """Most bounds an admissible path may have."""
        return self.course.longest

    @property
    def max_bounds(self) -> int | str:
        """Which paths are admissible, as it would be given to `Planner`."""
        return self.course.max_bounds

    @property
    def connectivity(self) -> int:
        """4 or 8."""
        return self.course.connectivity

    def require_path(self, path: Sequence[Cell]) -> tuple[Cell, ...]:
        """The path as a tuple of cells, if a team can take it.

        Raises:
            TrustboError: It is broken, or does not lead from start to goal; the cell is named.
        """
        return self.course.require_path(path)

    def with_awareness(self, awareness: ArrayLike, mean: ArrayLike | None = None) -> Self:
        """The same planner, going by another map, or by one for each draw of the parameters.

        Args:
            awareness: Shape (robot, row, col, feature) or (draw, robot, row, col, feature).
            mean: What to go by without draws, (robot, row, col, feature); by default their mean.

        Raises:
            ShapeError: Another number of robots, cells or features than the workspace's.
            TrustboError: NaN in a passable cell.
        """
        z = np.asarray(awareness, dtype=float)
        expected = self.workspace.awareness.shape
        if z.ndim not in (4, 5) or z.shape[-4:] != expected:
            raise ShapeError(f"awareness must end in {expected}; got shape {z.shape}.")
        missing = np.isnan(z).any(-1).reshape(-1, *expected[1:3]).any(0) & self.course.passable
        if missing.any():
            cell = tuple(int(i) for i in np.argwhere(missing)[0])
            raise TrustboError(
                f"awareness of the passable cell {cell} is NaN; fill it, or mark it impassable."
            )
        other = copy(self)
        other.awareness = z
        other.mean_awareness = (
            z.reshape(-1, *expected).mean(0) if mean is None else np.asarray(mean)
        )
        return other

    def onward(self, done: Sequence[Cell]) -> Self:
        """A planner for the rest of a mission.

        Admissible is what is left of this planner's paths: the bounds already made count. A plan's
        value is that of the rest alone: for `mean`, the mean over the bounds still to come.

        Args:
            done: The cells entered so far, start first; the last is where the team is.

        Raises:
            TrustboError: The team is at the goal already.
            NoPathError: Too few bounds are left to get there.
        """
        other = copy(self)
        other.course = self.course.onward(done)
        return other

    def dynamics(
        self,
        params: Params,
        x0: ArrayLike | None = None,
        *,
        draws: np.ndarray | None = None,
        team: str | None = None,
    ) -> Dynamics:
        """The recursion of expected trust over this planner's awareness.

        Args:
            params: With leading axes or not; without, uncertain awareness is averaged.
            x0: Expected trust at the start; by default `params.x0_mean`.
            draws: Which draws of the posterior `params` are; by default, 0, 1, 2, ...
            team: `"min"` for the robots as they are, whatever this planner's team is.
        """
        z = self.awareness
        if z.ndim == 5:
            if params.leading:
                n = params.leading[0]
                z = z[(np.arange(n) if draws is None else draws) % len(z)]
            else:
                z = self.mean_awareness
        return dynamics(params, z, team or self.team, x0)

    def of_draw(self, index: int) -> Self:
        """The planner that goes by the map of one draw, where awareness is uncertain."""
        if self.awareness.ndim == 4:
            return self
        return self.with_awareness(self.awareness[index % len(self.awareness)])


def draws_of(posterior: Params | xr.DataTree) -> Params:
    """Parameters as they are, or the draws of a posterior: leading axis (draw,)."""
    return params_of(posterior) if isinstance(posterior, xr.DataTree) else posterior
