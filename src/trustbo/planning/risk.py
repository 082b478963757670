"""Risk: the chance that each bound ends the mission, and how much of it a plan may take."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.planning.paths import AdmissiblePaths
from trustbo.workspace.moves import MOVE_NAMES, move_indices, moves_along

INFEASIBLE = ("refuse", "safest")
"""Responses to a `max_failure` that no path respects: raise, or plan the safest path."""
_BAND = (0.05, 0.95)
_CERTAIN = 700.0  # -log(1 - p) of a bound that always fails
_ROUNDING = 1e-12  # of the risk of a path that is just within the limit


class InfeasibleError(TrustboError):
    """No admissible path respects `max_failure`.

    Attributes:
        path: Safest admissible path.
        p_fail: Chance that it fails, the least that can be had.
    """

    def __init__(self, message: str, path: tuple[Cell, ...], p_fail: float) -> None:
        super().__init__(message)
        self.path, self.p_fail = path, p_fail


class FailureRule(NamedTuple):
    """Amount of failure that a planner accepts, and the cost of a failure."""

    max_failure: float | None = None
    """Largest chance that a path fails, in [0, 1); None for no limit."""
    confidence: float | None = None
    """Least share of the draws of the risk under which it is within `max_failure`; None for the
    limit at the posterior mean."""
    failure_cost: float | None = None
    """Cost of a failure for lost_contact, in bounds; None: the fewest bounds to the goal."""
    infeasible: str = "refuse"
    """`"refuse"`, or `"safest"` to plan the safest path where none respects `max_failure`."""

    def checked(self, objective: str) -> Self:
        """Return the rule; TrustboError if a number is out of its range or of no use."""
        require_choice("infeasible", self.infeasible, INFEASIBLE)
        for name in ("max_failure", "confidence", "failure_cost"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, Real) or isinstance(value, bool)):
                raise TrustboError(f"{name} must be a number; got {value!r}.")
        if self.max_failure is not None and not 0.0 <= self.max_failure < 1.0:
            raise TrustboError(f"max_failure must be in [0, 1); got {self.max_failure!r}.")
        if self.confidence is not None:
            if not 0.0 < self.confidence <= 1.0:
                raise TrustboError(f"confidence must be in (0, 1]; got {self.confidence!r}.")
            if self.max_failure is None:
                raise TrustboError(f"confidence = {self.confidence:g} needs a max_failure.")
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


NO_RULE = FailureRule()


@dataclass(frozen=True, eq=False)
class Risk:
    """Chance that a bound ends the mission, of all bounds of a workspace.

    Attributes:
        p_fail: Posterior mean, shape (move, row, col) with the moves of `MOVES[8]`; NaN where there
            is no bound.
        draws: Draws from its posterior, shape (draw, move, row, col), or None.
        causes: Shares of the causes of a failure, each a number or an array (move, row, col); they
            add up to 1.

    Raises:
        ShapeError: Another shape.
        TrustboError: A chance outside [0, 1].
    """

    p_fail: np.ndarray
    draws: np.ndarray | None = None
    causes: Mapping[str, ArrayLike] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, p in (("p_fail", self.p_fail), ("draws of p_fail", self.draws)):
            if p is None:
                continue
            if p.shape[-3:] != self.p_fail.shape or p.ndim != 3 + (p is self.draws):
                expected = ("draw, " if p is self.draws else "") + "move, row, col"
                raise ShapeError(f"{name} must have axes ({expected}); got shape {p.shape}.")
            if ((p < 0.0) | (p > 1.0)).any():
                worst = float(p[(p < 0.0) | (p > 1.0)][0])
                raise TrustboError(f"{name} must be in [0, 1]; got {worst:g}.")

    def survival(self, path: Sequence[Cell] | np.ndarray) -> float:
        """Product of 1 - p_fail along a path, what the limits and costs of planning go by.

        Where the draws have bounds fail together, the chance to arrive is larger: see `along`.
        """
        return float(np.prod(1.0 - self.p_fail[_at(path)]))

    def share_within(self, path: Sequence[Cell] | np.ndarray, max_failure: float) -> float:
        """Share of the draws under which a path fails with a chance of at most `max_failure`."""
        if self.draws is None:
            return np.nan
        p_fail = 1.0 - np.prod(1.0 - self.draws[_at(path)], axis=1)
        return float((p_fail <= max_failure + _ROUNDING).mean())

    def along(self, path: Sequence[Cell] | np.ndarray) -> "PathRisk":
        """Select the bounds of a path."""
        at = _at(path)
        p = self.p_fail[at]
        shares = {
            cause: np.broadcast_to(s, self.p_fail.shape)[at] for cause, s in self.causes.items()
        }
        band, arrive = np.full((2, len(p)), np.nan), (np.nan, np.nan)
        reach = np.cumprod(1.0 - p)
        if self.draws is not None:
            drawn = self.draws[at]
            band = np.quantile(drawn, _BAND, axis=0)
            low, high = np.quantile(np.prod(1.0 - drawn, axis=1), _BAND).tolist()
            arrive = low, high
            reach = np.minimum.accumulate(np.minimum(reach * _dependence(drawn), 1.0 - p))
        by_cause = {cause: share * p for cause, share in shares.items()}
        return PathRisk(p, band, float(reach[-1]), arrive, by_cause, reach)


def _at(path: Sequence[Cell] | np.ndarray) -> tuple[Any, ...]:
    """Index of the bounds of a path in arrays (..., move, row, col)."""
    rows, cols = np.asarray(path)[1:].T
    return ..., moves_along(path), rows, cols


def _dependence(draws: np.ndarray) -> np.ndarray:
    """Mean over draws of the product of 1 - p, over the product of the means, (bound,).

    For draws (draw, bound), of the first bound, the first two, and so on: the factor by which
    bounds are likelier to be passed together than if they were independent. Times the product of
    1 - p_fail it is the mean over draws with the error of few draws in each p_fail taken out.
    """
    together = np.cumprod(1.0 - draws, axis=1).mean(0)
    apart = np.cumprod((1.0 - draws).mean(0))
    return np.divide(together, apart, out=np.ones_like(apart), where=apart > 0.0)


class PathRisk(NamedTuple):
    """Chance that a path's bounds end the mission, each given that it is begun."""

    p_fail: np.ndarray
    """Posterior mean, shape (bound,)."""
    p_fail_band: np.ndarray
    """Ends of its 90 % band over draws, shape (end, bound); NaN without draws."""
    p_arrive: float
    """Chance to reach the goal: the mean over draws of the product of 1 - p_fail, as bounds depend
    on what they have in common; without draws, the product of the means."""
    p_arrive_band: tuple[float, float]
    """Ends of its 90 % band over draws; NaN without draws."""
    by_cause: Mapping[str, np.ndarray]
    """`p_fail` by cause of the failure, each of shape (bound,)."""
    p_reach: np.ndarray
    """Chance to complete each bound and all before it, shape (bound,); the last is `p_arrive`."""

    def to_record(self) -> dict[str, Any]:
        """Convert to plain lists and numbers."""
        by_cause = {cause: p.tolist() for cause, p in self.by_cause.items()}
        return {
            **self._asdict(),
            "p_fail": self.p_fail.tolist(),
            "p_fail_band": self.p_fail_band.tolist(),
            "by_cause": by_cause,
            "p_reach": self.p_reach.tolist(),
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Convert the record of `to_record` back."""
        (low, high), p_fail = record["p_arrive_band"], np.array(record["p_fail"])
        return cls(
            p_fail,
            np.array(record["p_fail_band"]),
            record["p_arrive"],
            (low, high),
            {cause: np.array(p) for cause, p in record["by_cause"].items()},
            np.array(record.get("p_reach", np.cumprod(1.0 - p_fail))),  # not in version 0.2
        )


class RiskTable(NamedTuple):
    """Risk -log(1 - p_fail) of bounds, which a path adds up, and its limits.

    A path is feasible if at least `needed` of its sums are within their limits, and costs
    `failure_cost` times the chance to fail at the posterior mean, the first of the sums.
    """

    of_bounds: np.ndarray  # (resource, move, cell)
    limits: np.ndarray  # (resource,), inf where there is none
    needed: int
    failure_cost: float

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
        """Cost of a failure times its chance, for sums (resource,)."""
        return float(-self.failure_cost * np.expm1(-total[0]))


def risk_table(
    risk: Risk, rule: FailureRule, failure_cost: float, paths: AdmissiblePaths
) -> RiskTable | None:
    """Build the table for admissible paths, None where risk does not matter to a planner.

    TrustboError: p_fail of a possible bound is NaN, or a confidence without draws.
    """
    if rule.max_failure is None and failure_cost == 0.0:
        return None
    resources, limits, needed = [risk.p_fail[None]], [np.inf], 1
    if rule.max_failure is not None:
        limit = -np.log1p(-rule.max_failure) + _ROUNDING
        if rule.confidence is None:
            limits = [limit]
        else:
            if risk.draws is None:
                raise TrustboError("a confidence needs draws of the risk; give with_risk draws.")
            n = len(risk.draws)
            resources, limits = [*resources, risk.draws], limits + [limit] * n
            needed += int(np.ceil(rule.confidence * n - 1e-9))
    moves = move_indices(paths.connectivity)
    p = np.concatenate(resources)[:, moves]
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
    return RiskTable(of_bounds, np.array(limits), needed, failure_cost)
