"""Risk that a user gives for each bound, instead of the posterior of the hazard model."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled
from trustbo.data import Cell
from trustbo.display import Rows
from trustbo.errors import TrustboError, one_line
from trustbo.hazard.components import Components
from trustbo.hazard.path_risk import BAND, PathRisk, Risk
from trustbo.workspace.moves import MOVE_NAMES, NEXT_NAMES, bounds_and_next

_WEIGHT_ROUNDING = 1e-6
"""Tolerance for rounding errors in the sum of the weights of components."""


@dataclass(frozen=True, eq=False, repr=False)
class GivenRisk(Risk):
    """Given probability that each bound of a workspace ends the mission.

    Attributes:
        p_fail: Posterior mean, shape (move, row, col, next_move), with moves as in `MOVES`. The
            last next move is the end of the path. `p_fail` is NaN where there is no bound.
        draws: Posterior draws, shape (draw, move, row, col, next_move), or None.
        components: Mean failure probabilities of groups of draws, used for the failure probability
            of a path. If None, bounds are assumed to fail independently with probability `p_fail`.

    Raises:
        TrustboError: If the shapes do not match, a probability is outside [0, 1], or the weights of
            the components do not sum to 1.
    """

    p_fail: np.ndarray
    draws: np.ndarray | None = None
    components: Components | None = None

    def __post_init__(self) -> None:
        of_components = None if self.components is None else self.components.p_fail
        more = {"draws": self.draws, "components": of_components}
        for name, p in {"p_fail": self.p_fail[None], **more}.items():
            if p is None:
                continue
            if p.ndim != 5 or not len(p) or p.shape[1:] != self.p_fail.shape:
                raise TrustboError(
                    f"{name} must have shape (..., move, row, col, next_move); got {p.shape}."
                )
            bad = (p < 0.0) | (p > 1.0)
            if bad.any():
                raise TrustboError(f"{name} must be in [0, 1]; got {p[bad][0]:g}.")

        if self.components is not None:
            groups, weights = self.components
            is_share = weights.shape == (len(groups),) and (weights >= 0.0).all()
            if not is_share or abs(weights.sum() - 1.0) > _WEIGHT_ROUNDING:
                raise TrustboError(
                    f"components need {len(groups)} nonnegative weights with the sum 1; got "
                    f"{one_line(weights)}."
                )

    @cached_property
    def mean(self) -> np.ndarray:
        """See `Risk.mean`."""
        return self.p_fail

    @property
    def shape(self) -> tuple[int, ...]:
        """See `Risk.shape`."""
        return self.p_fail.shape

    def _rows(self) -> Rows:
        n_draws = 0 if self.draws is None else len(self.draws)
        together = "independent" if self.components is None else "correlated"
        return [
            *self._rows_of_failures(),
            ("draws", str(n_draws)),
            ("failures of bounds", together),
        ]

    @cached_property
    def searched(self) -> Components:
        """Components with which paths are searched; by default, bounds fail independently."""
        return self.components or Components(self.p_fail[None], np.ones(1))

    def along(self, path: Sequence[Cell] | np.ndarray) -> PathRisk:
        """Compute the risk along a path.

        Without draws, the arrival probability is the product of the means 1 - p_fail. With draws,
        this product is multiplied by the ratio of the mean of the product to the product of the
        means, both over the draws, because failures are correlated.
        """
        index = tuple(bounds_and_next(path).T)
        p = self.p_fail[index]
        reach = np.cumprod(1.0 - p)
        if self.draws is None:
            return PathRisk(p, float(reach[-1]), (np.nan, np.nan))

        drawn = self.draws[:, *index]
        low, high = np.quantile(np.prod(1.0 - drawn, axis=1), BAND).tolist()

        # Passing all bounds is more probable than if bounds were independent. The sampling errors
        # of the mean p_fail nearly cancel in the ratio of the two probabilities.
        together = np.cumprod(1.0 - drawn, axis=1).mean(0)
        apart = np.cumprod((1.0 - drawn).mean(0))
        ratio = np.divide(together, apart, out=np.ones_like(apart), where=apart > 0.0)

        reach = np.minimum.accumulate(np.minimum(reach * ratio, 1.0 - p))
        return PathRisk(p, float(reach[-1]), (low, high))


def read_risk(what: str, values: ArrayLike, leading: Sequence[str] = ()) -> np.ndarray:
    """Read probabilities of bounds with their next moves, (..., move, row, col, next_move).

    Args:
        what: Name of the argument in messages.
        values: Array of this shape; or without the axis of next moves, which then do not matter. A
            DataArray is read by its dims and labels.
        leading: Names of the leading axes.

    Raises:
        TrustboError: If the dims or labels are wrong.
    """
    dims = *leading, "move", "row", "col"
    labels = {"move": MOVE_NAMES, "next_move": NEXT_NAMES}
    n_dims = len(values.dims) if isinstance(values, xr.DataArray) else np.ndim(values)
    if n_dims > len(dims):
        return read_labelled(what, values, (*dims, "next_move"), labels).values

    maps = read_labelled(what, values, dims, labels).values
    return np.broadcast_to(maps[..., None], (*maps.shape, len(NEXT_NAMES)))
