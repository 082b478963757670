"""Limits on the risk of a plan: the rule, and the table of risks that searches add up."""

from collections.abc import Sequence
from numbers import Real
from typing import NamedTuple, Self

import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_choice
from trustbo.hazard.risk import ROUNDING, Risk
from trustbo.planning.paths import AdmissiblePaths
from trustbo.workspace.moves import MOVE_NAMES, move_indices, moves_along

INFEASIBLE = ("refuse", "safest")
"""Responses to a `max_failure` that no path respects: raise, or plan the safest path."""
_CERTAIN = 700.0  # -log(1 - p) of a bound that always fails


class InfeasibleError(TrustboError):
    """No admissible path respects `max_failure`.

    Attributes:
        path: Safest admissible path.
        p_fail: Chance that it fails, the least of all admissible paths.
    """

    def __init__(self, message: str, path: tuple[Cell, ...], p_fail: float) -> None:
        super().__init__(message)
        self.path, self.p_fail = path, p_fail


class RiskRule(NamedTuple):
    """Limit on the chance that a plan fails, and the cost of a failure."""

    max_failure: float | None = None
    """Largest chance that a path fails, in [0, 1); None for no limit."""
    failure_cost: float | None = None
    """Cost of a failure for lost_contact, in bounds; None: the fewest bounds to the goal."""
    infeasible: str = "refuse"
    """`"refuse"`, or `"safest"` to plan the safest path where none respects `max_failure`."""

    def checked(self, objective: str) -> Self:
        """Return the rule; TrustboError if a number is out of its range or of no use."""
        require_choice("infeasible", self.infeasible, INFEASIBLE)
        for name in ("max_failure", "failure_cost"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, Real) or isinstance(value, bool)):
                raise TrustboError(f"{name} must be a number; got {value!r}.")
        if self.max_failure is not None and not 0.0 <= self.max_failure < 1.0:
            raise TrustboError(f"max_failure must be in [0, 1); got {self.max_failure!r}.")
        if self.failure_cost is not None:
            if objective != "lost_contact":
                raise TrustboError(
                    f"failure_cost is for lost_contact, not {objective!r}; use max_failure."
                )
            if not 0.0 <= self.failure_cost < np.inf:
                raise TrustboError(
                    f"failure_cost must be finite and >= 0; got {self.failure_cost!r}."
                )
        return self


NO_RULE = RiskRule()


class RiskTable(NamedTuple):
    """Risk -log(1 - p_fail) of bounds, which a path adds up, and its limits.

    A path is feasible if at least `needed` of its sums r are within their limits. It costs the sum
    over the strata m, the first of the sums, of failure_costs[m] (1 - exp(-r_m)).
    """

    of_bounds: np.ndarray  # (resource, move, cell)
    limits: np.ndarray  # (resource,), inf where there is none
    needed: int
    failure_costs: np.ndarray  # (stratum,), cost of a failure times the shares; none without a cost
    at_mean: np.ndarray  # (move, cell), risk at the posterior mean

    def along(self, path: Sequence[Cell] | np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """Sums of a path on a grid of some shape, (resource,)."""
        rows, cols = np.asarray(path)[1:].T
        moves = np.searchsorted(move_indices(self.of_bounds.shape[1]), moves_along(path))
        return self.of_bounds[:, moves, rows * shape[1] + cols].sum(1)

    def priced(self, of_bounds: np.ndarray) -> tuple[np.ndarray, float]:
        """One risk of bounds (bound,) that no feasible path exceeds a limit of, and the limit.

        Of several limits of which n must be kept, with one value: the mean of the n least risks of
        each bound, as for a feasible path their sum is at most the mean of its n sums.
        """
        limited = np.isfinite(self.limits)
        n = self.needed - int((~limited).sum())
        if not limited.any():
            return of_bounds[:, 0].copy(), np.inf
        least = np.partition(of_bounds[:, limited], n - 1, axis=1)[:, :n]
        return least.mean(1), float(self.limits[limited][0])

    def is_feasible(self, total: np.ndarray) -> bool:
        """Whether sums (resource,) are within the limits."""
        return bool((total <= self.limits).sum() >= self.needed)

    def cost(self, total: np.ndarray) -> float:
        """Cost of a failure times its chance, for sums (resource,); 0 without any."""
        of_strata = total[: len(self.failure_costs)]
        return float(-(self.failure_costs * np.expm1(-of_strata)).sum())

    def slopes(self, total: np.ndarray) -> np.ndarray:
        """Rise of the cost with the sum of each stratum, (stratum,), at sums (resource,)."""
        return self.failure_costs * np.exp(-total[: len(self.failure_costs)])

    def within(self, limit: float) -> Self:
        """Return the table with a limit on the risk at the posterior mean, and no other."""
        n = len(self.failure_costs)
        if n <= 1 and np.array_equal(self.of_bounds[0], self.at_mean):
            return self._replace(of_bounds=self.at_mean[None], limits=np.array([limit]), needed=1)
        sums = np.concatenate([self.of_bounds[:n], self.at_mean[None]])
        return self._replace(of_bounds=sums, limits=np.array([np.inf] * n + [limit]), needed=n + 1)


def risk_table(
    risk: Risk, rule: RiskRule, failure_cost: float, paths: AdmissiblePaths
) -> RiskTable | None:
    """Build the table for admissible paths, None where risk does not matter to a planner.

    TrustboError: p_fail of a possible bound is NaN.
    """
    if rule.max_failure is None and failure_cost == 0.0:
        return None
    mean = risk.p_fail[None]
    strata = risk.strata if failure_cost > 0.0 else None
    sums, shares = ([mean], np.ones(1)) if strata is None else ([strata.p_fail], strata.shares)
    limits = [np.inf] * len(shares)
    if rule.max_failure is not None:
        limit = -np.log1p(-rule.max_failure) + ROUNDING
        if strata is None:
            limits = [limit]
        else:
            sums, limits = [*sums, mean], [*limits, limit]
    moves = move_indices(paths.connectivity)
    p = np.concatenate([*sums, mean])[:, moves]
    p = p.reshape(*p.shape[:2], -1)
    possible = np.zeros(p.shape[1:], bool)  # by the cell entered
    left, move = np.nonzero(paths.neighbours >= 0)
    possible[move, paths.neighbours[left, move]] = True
    if (missing := np.isnan(p).any(0) & possible).any():
        move, cell = (int(i) for i in np.argwhere(missing)[0])
        raise TrustboError(
            f"p_fail of the bound into {divmod(cell, risk.p_fail.shape[-1])} by move "
            f"{MOVE_NAMES[moves[move]]!r} is NaN; give a chance to every possible bound."
        )
    with np.errstate(divide="ignore"):
        of_bounds = np.minimum(-np.log1p(-np.nan_to_num(p)), _CERTAIN)
    costs = failure_cost * shares if failure_cost > 0.0 else np.empty(0)
    return RiskTable(of_bounds[:-1], np.array(limits), len(limits), costs, of_bounds[-1])
