"""Risk that a user gives for each bound, instead of the posterior of the hazard model."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import read_labelled
from trustbo.data import Station
from trustbo.display import Rows
from trustbo.errors import TrustboError, one_line
from trustbo.hazard.components import Components
from trustbo.hazard.path_risk import BAND, PathRisk, Risk
from trustbo.workspace.moves import MOVES, next_names, way_names

_WEIGHT_ROUNDING = 1e-6
"""Tolerance for rounding errors in the sum of the weights of components."""


@dataclass(frozen=True, eq=False, repr=False)
class GivenRisk(Risk):
    """Given probability that each bound of a workspace ends the mission.

    Attributes:
        p_fail: Posterior mean, shape (way, row, col, next_way); see `workspace.moves`. The last
            next way is the end of the path. `p_fail` is NaN where there is no bound.
        draws: Posterior draws, shape (draw, way, row, col, next_way), or None.
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

    def along(self, path: Sequence[Station] | np.ndarray) -> PathRisk:
        """Compute the risk along a path.

        Without draws, the arrival probability is the product of the means 1 - p_fail. With draws,
        this product is multiplied by the ratio of the mean of the product to the product of the
        means, both over the draws, because failures are correlated.
        """
        index = tuple(self.pairs_along(path).T)
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


def read_risk(
    what: str, values: ArrayLike, leading: Sequence[str] = (), n_posts: int = 1
) -> np.ndarray:
    """Read probabilities of bounds with their next ways, (..., way, row, col, next_way).

    Args:
        what: Name of the argument in messages.
        values: Array of this shape; or without the axis of next ways, which then do not matter. If
            the ways or the next ways are the eight moves, the probabilities hold for all sets of
            posts. A DataArray is read by its dims, `move` and `next_move`, and its labels.
        leading: Names of the leading axes.
        n_posts: Number of sets of posts.

    Raises:
        TrustboError: If the dims or labels are wrong.
    """
    dims = *leading, "move", "row", "col", "next_move"
    is_labelled = isinstance(values, xr.DataArray)
    sizes = dict(values.sizes if is_labelled else zip(dims, np.shape(values), strict=False))
    by_next = len(sizes) == len(dims)

    n_ways = len(MOVES) * n_posts
    for_all = sizes.get("move") == len(MOVES)
    next_for_all = sizes.get("next_move") == len(MOVES) + 1
    labels = {
        "move": way_names(1 if for_all else n_posts),
        "next_move": next_names(1 if next_for_all else n_posts),
    }
    maps = read_labelled(what, values, dims if by_next else dims[:-1], labels).values

    if not by_next:
        maps = np.broadcast_to(maps[..., None], (*maps.shape, n_ways + 1))
    elif next_for_all:
        after = np.append(np.arange(n_ways) % len(MOVES), len(MOVES))
        maps = maps[..., after]
    if for_all:
        maps = np.take(maps, np.arange(n_ways) % len(MOVES), axis=len(leading))
    return maps
