"""Functions that the baselines share: line of sight of bounds, and best paths for given rates.

Rates of bounds are arrays with the axes (..., move, row, col) for the eight `MOVES`. They contain
the expected contact rate, averaged over robots, of the bound that enters a cell by a move, and NaN
if there is no such bound.
"""

from collections.abc import Sequence

import numpy as np

from trustbo.campaign.campaign import Campaign
from trustbo.data import LINE_OF_SIGHT, Cell, Mission
from trustbo.models.families import FAMILIES
from trustbo.models.params import TrustParams
from trustbo.planning import Plan, Planner
from trustbo.planning.objectives import Weights
from trustbo.planning.problem import Problem
from trustbo.planning.recursion import Recursion
from trustbo.planning.sums import best_sums
from trustbo.workspace.moves import bounds_along

Path = tuple[Cell, ...]


class PathPolicy:
    """Policy that chooses paths by numbers of its own, not by the posterior.

    A baseline has the methods `choose(planner, rng)`, the path of the next mission, and
    `best(planner)`, the path that it recommends; and `learn`, which does nothing here.
    """

    def __call__(self, rng: np.random.Generator, params: TrustParams, planner: Planner) -> Plan:
        """Plan the next mission."""
        return planner.evaluate(self.choose(planner, rng), params.mean())

    def recommend(self, campaign: Campaign) -> Path:
        """Path that is recommended now."""
        return self.best(campaign.planner)

    def learn(self, campaign: Campaign, mission: Mission) -> None:
        """Learn from a mission."""

    def choose(self, planner: Planner, rng: np.random.Generator) -> Path:
        """Path of the next mission, by default the recommended one."""
        return self.best(planner)

    def best(self, planner: Planner) -> Path:
        """Path that is recommended."""
        raise NotImplementedError


def line_of_sight(planner: Planner) -> np.ndarray:
    """Predicted rates of all bounds, mean over robots and assumed sights, (move, row, col)."""
    names = planner.workspace.features
    columns = [k for k, name in enumerate(names) if name.startswith(LINE_OF_SIGHT)]
    return planner.workspace.awareness.values[..., columns].mean((0, -1))


def best_paths(planner: Planner, rates: np.ndarray) -> list[Path]:
    """Best admissible path under each table of rates, (draw, move, row, col), exactly.

    Most contact less the number of bounds; or for the objective `mean`, the largest mean. If
    failures have a cost, it is that of trustbo's plans: the cost of a failure times the failure
    probability of the path, as in `Planner.with_risk`. Rates above 1 then count as 1.

    Raises InfeasibleError if no path respects `max_failure`.
    """
    problem = planner.problem
    if problem.edge_risks is not None:
        return _best_with_failures(problem, rates)

    paths, n_draws = problem.paths, len(rates)
    n_bounds = np.arange(paths.longest + 1.0)
    is_mean = problem.objective.name == "mean"
    weights = Weights(
        np.ones((n_draws, paths.longest + 1, 1)),
        np.tile(0.0 * n_bounds if is_mean else -n_bounds, (n_draws, 1)),
        np.maximum(1.0, n_bounds) if is_mean else np.ones(len(n_bounds)),
    )
    gains = np.nan_to_num(rates).reshape(n_draws, 1, -1)
    _, found = best_sums(paths.graph, gains, weights, np.zeros(gains.shape[2]))
    return [paths.cells(flat) for flat in found]


def _best_with_failures(problem: Problem, rates: np.ndarray) -> list[Path]:
    """Best paths by trustbo's own search, for trust without memory that equals the rates."""
    paths, n_draws = problem.paths, len(rates)
    drift = np.nan_to_num(rates)[:, None]
    if paths.workspace.n_posts > 1:
        way, row, col, _ = paths.pairs.T
        drift = drift[..., way, row, col]

    recursion = Recursion(
        transition=np.zeros((n_draws, 1, 1)),
        drift=drift,
        start=np.zeros((n_draws, 1)),
        noise_sd=np.ones(n_draws),  # matters only for censored rates
        likelihood=FAMILIES["gaussian"],
    )
    _, _, found = problem.best(recursion)
    return [paths.cells(flat) for flat in found]


def value(planner: Planner, rates: Sequence[float] | np.ndarray) -> float:
    """Value of a path with these rates of its bounds: what `best_paths` makes large."""
    rates = np.asarray(rates)
    return float(
        rates.mean() if planner.problem.objective.name == "mean" else rates.sum() - len(rates)
    )


def predicted(planner: Planner, path: Path) -> float:
    """Value of a path by line of sight alone."""
    return value(planner, line_of_sight(planner)[tuple(bounds_along(path).T)])


def rates_of(mission: Mission) -> list[tuple[tuple[int, int, int], float]]:
    """Measured bounds of a mission, (move, row, col), each with its rate, mean over robots.

    A bound that failed kept no contact.
    """
    bounds = bounds_along(mission.stations).tolist()
    rates = []
    for where, bound in zip(bounds, mission.bounds, strict=False):
        measured = np.isfinite(bound.contact_rate)
        if bound.status != "ok":
            rates.append((tuple(where), 0.0))
        elif measured.any():
            rates.append((tuple(where), float(bound.contact_rate[measured].mean())))
    return rates
