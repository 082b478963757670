"""Best path for each draw of a posterior, and the values, regrets and frequencies of paths."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trustbo.data import Station
from trustbo.errors import require_whole
from trustbo.models.draws import Draws
from trustbo.planning.objectives import capped
from trustbo.planning.problem import EXACT, Problem
from trustbo.planning.recursion import states_along, trust_recursion
from trustbo.workspace.moves import cells_along

_NUMBERS = 4_000_000
"""Largest number of drifts (draw, pair) that are computed at once."""


@dataclass(frozen=True, eq=False)
class DrawnPaths:
    """The best path of a planning problem for each parameter draw.

    Attributes:
        problem: Planning problem.
        draws: Parameter draws.
        paths: Stations of each path, shape (draw, cell); see `AdmissiblePaths.cells`.
    """

    problem: Problem
    draws: Draws
    paths: np.ndarray

    @cached_property
    def candidates(self) -> list[tuple[Station, ...]]:
        """Distinct best paths, the most frequent one first."""
        return [self.problem.paths.cells(path) for path in self._distinct[0]]

    @property
    def counts(self) -> np.ndarray:
        """Number of draws for which each of `candidates` is best."""
        return self._distinct[2]

    @cached_property
    def values(self) -> np.ndarray:
        """Value of each draw's best path under that draw, shape (draw,)."""
        values = np.empty(len(self.paths))
        which = self._distinct[1]
        for i, path in enumerate(self.candidates):
            best = which == i
            values[best] = self._value(self.draws.draw(best), path)

        return values

    def values_of(self, paths: Sequence[Sequence[Station]]) -> np.ndarray:
        """Return the value of each given path under every draw, shape (draw, path)."""
        return np.stack([self._value(self.draws, path) for path in paths], axis=1)

    def regret(self, path: Sequence[Station]) -> np.ndarray:
        """Return the best value of each draw minus the value of the given path, shape (draw,)."""
        return np.maximum(0.0, self.values - self.values_of([path])[:, 0])

    def relative_regret(self, path: Sequence[Station]) -> np.ndarray:
        """Return the regret of a path relative to each draw's best value, shape (draw,).

        For lost_contact, the regret is divided by the contact that is kept on the best path: the
        number of bounds of this path minus the lost contact and the failure cost. For other
        objectives, the regret is divided by the absolute value of the best path. If the divisor is
        0, a positive regret becomes infinite.
        """
        scale = np.abs(self.values)
        if self.problem.objective.of_contact:
            most = [len(path) - 1 + self.problem.bound_cost_along(path) for path in self.candidates]
            scale = np.maximum(0.0, np.array(most)[self._distinct[1]] + self.values)

        regret = self.regret(path)
        nothing = np.where(regret > EXACT, np.inf, 0.0)
        return np.divide(regret, scale, out=nothing, where=scale > 0.0)

    def share(self) -> np.ndarray:
        """Return the fraction of draws whose best path contains each cell, shape (row, col)."""
        count = np.zeros(self.problem.paths.bounds.shape[1:])
        for path, n in zip(self.candidates, self.counts, strict=True):
            # Adds n once, even if a path enters the cell twice.
            count[tuple(cells_along(path).T)] += n
        return count / len(self.paths)

    def _value(self, draws: Draws, path: Sequence[Station]) -> np.ndarray:
        """Compute the value of a path for each draw, shape (draw,)."""
        problem = self.problem
        z, bounds = problem.along(path)
        recursion = trust_recursion(draws, z, problem.initial_trust(None), bounds=bounds)
        along = capped(problem.objective, recursion)
        trust = states_along(along).mean(-1)
        value = problem.value_along(problem.bound_cost_along(path), trust, along)
        return value - problem.failure_along(path)

    @cached_property
    def _distinct(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the distinct paths, most frequent first, each draw's index, and the counts."""
        paths, which, counts = np.unique(
            self.paths, axis=0, return_inverse=True, return_counts=True
        )
        order = np.argsort(-counts, kind="stable")
        rank = np.argsort(order)  # new index of each path, the inverse of `order`
        return paths[order], rank[which.ravel()], counts[order]


def choose_draws(params: Draws, n_draws: int | None, seed: int) -> Draws:
    """Choose `n_draws` draws at random, or all draws if None."""
    seed = require_whole("seed", seed, 0)
    n = params.n_draws
    if n_draws is None or require_whole("n_draws", n_draws, 1) >= n:
        return params

    chosen = np.sort(np.random.default_rng(seed).choice(n, n_draws, replace=False))
    return params.draw(chosen)


def drawn_paths(problem: Problem, draws: Draws) -> DrawnPaths:
    """Find the best path for each draw; the draws are processed in parts, to limit memory use."""
    size = draws.n_draws
    if problem.paths.workspace.n_posts > 1:
        size = max(1, _NUMBERS // len(problem.paths.pairs))
    parts = [
        problem.best(problem.searched(draws.draw(slice(first, first + size))))[2]
        for first in range(0, draws.n_draws, size)
    ]
    return DrawnPaths(problem, draws, np.concatenate(parts))
