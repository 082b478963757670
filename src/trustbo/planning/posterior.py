"""Plans under every draw of a posterior, and what they say about the one to take."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trustbo.data import Cell
from trustbo.errors import require_whole
from trustbo.models.params import Params
from trustbo.planning.course import Course
from trustbo.planning.dynamics import Dynamics
from trustbo.planning.objectives import Aim
from trustbo.planning.values import path_value


@dataclass(frozen=True, eq=False)
class DrawnPaths:
    """The best path under each of some draws.

    Attributes:
        course: Which paths were admissible.
        moves: The dynamics of the draws.
        aim: What the paths are best at.
        paths: Flat indices of cells, shape (draw, length), filled with -1.
        slack: By how much a path could be better at most, shape (draw,); 0 where exact.
        chosen: Which draws of the posterior these are, shape (draw,).
    """

    course: Course
    moves: Dynamics
    aim: Aim
    paths: np.ndarray
    slack: np.ndarray
    chosen: np.ndarray

    @cached_property
    def candidates(self) -> list[tuple[Cell, ...]]:
        """The different paths among them, the most frequent first."""
        return [self.course.cells(self._unique[0][i]) for i in self._by_count]

    @property
    def counts(self) -> np.ndarray:
        """For how many draws each of `candidates` is best."""
        return self._unique[2][self._by_count]

    @cached_property
    def values(self) -> np.ndarray:
        """Value of each draw's own best path, shape (draw,)."""
        values, inverse = np.empty(len(self.paths)), self._unique[1]
        for i, path in enumerate(self._unique[0]):
            of = np.flatnonzero(inverse == i)
            moves = self.moves.take(of)
            values[of] = path_value(moves, self.aim, self.course, self.course.cells(path))
        return values

    def values_of(self, paths: Sequence[Sequence[Cell]]) -> np.ndarray:
        """Value of each given path under every draw, shape (draw, path)."""
        return np.stack(
            [path_value(self.moves, self.aim, self.course, path) for path in paths], axis=1
        )

    def regret(self, path: Sequence[Cell]) -> np.ndarray:
        """By how much each draw's best path is better than a given one, shape (draw,), >= 0."""
        return np.maximum(0.0, self.values - self.values_of([path])[:, 0])

    def expected_value_of_information(self) -> float:
        """What knowing the parameters would add to the value, on average over the draws.

        The mean of the draws' best values, less the best mean value of any one path; that path is
        sought among `candidates`, so it is an upper bound, tight where they include it.
        """
        return float(self.values.mean() - self.values_of(self.candidates).mean(0).max())

    def share(self) -> np.ndarray:
        """Share of the paths that enter each cell, shape (row, col)."""
        count = np.zeros(self.course.passable.size)
        for path, n in zip(self._unique[0], self._unique[2], strict=True):
            count[np.unique(path[path >= 0])] += n
        return (count / len(self.paths)).reshape(self.course.passable.shape)

    @cached_property
    def _unique(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        unique, inverse, counts = np.unique(
            self.paths, axis=0, return_inverse=True, return_counts=True
        )
        return unique, inverse.ravel(), counts

    @cached_property
    def _by_count(self) -> np.ndarray:
        return np.argsort(-self._unique[2], kind="stable")


def choose(params: Params, n_draws: int | None, seed: int) -> tuple[Params, np.ndarray]:
    """Some draws at random, in their order, or all; and which."""
    flat = params.flat()
    n = flat.leading[0]
    chosen = np.arange(n)
    if n_draws is not None and require_whole("n_draws", n_draws, 1) < n:
        chosen = np.sort(np.random.default_rng(seed).choice(n, n_draws, replace=False))
    return flat.draw(chosen), chosen  # pyright: ignore[reportArgumentType]


def padded(course: Course, paths: Sequence[Sequence[Cell]]) -> np.ndarray:
    """Paths as flat indices of cells, shape (path, length), filled with -1."""
    flat = np.full((len(paths), max(map(len, paths))), -1)
    for i, path in enumerate(paths):
        flat[i, : len(path)] = [course.flat(cell) for cell in path]
    return flat
