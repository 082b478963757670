"""Uniform sampling of admissible paths by counting.

The number of walks from a cell to the goal with n bounds left follows by dynamic programming. A
path drawn cell by cell with these numbers as weights is uniform over all walks.
"""

from weakref import WeakKeyDictionary

import numpy as np

from trustbo.data import Cell
from trustbo.planning.paths import AdmissiblePaths

_Counts = list[dict[tuple[Cell | None, Cell], int]]

_samplers: "WeakKeyDictionary[AdmissiblePaths, PathSampler]" = WeakKeyDictionary()


def path_sampler(admissible: AdmissiblePaths) -> "PathSampler":
    """Sampler of the given admissible paths, built once."""
    if admissible not in _samplers:
        _samplers[admissible] = PathSampler(admissible)
    return _samplers[admissible]


class PathSampler:
    """Numbers of admissible walks, exact as Python integers, and uniform draws from them."""

    def __init__(self, admissible: AdmissiblePaths) -> None:
        """Count backwards from the goal; slow for long walks on large grids."""
        self._graph, self._start = admissible.graph, admissible.start
        self._u_turns = admissible.u_turns
        self._lengths = range(admissible.shortest, admissible.longest + 1)
        # counts[n][before, cell]: walks of n more bounds to the goal. `before` is the cell that the
        # last bound left, or None where U-turns are allowed.
        goal = admissible.goal
        self._counts: _Counts = [{(b, goal): 1 for b in self._befores(goal)}]
        for _ in range(admissible.longest):
            fewer, now = self._counts[-1], {}
            for cell in self._graph:
                if cell == goal:
                    continue  # a path ends on entering the goal
                for before in self._befores(cell):
                    others = (
                        o for o in self._graph.successors(cell) if before is None or o != before
                    )
                    left = None if admissible.u_turns else cell
                    if count := sum(fewer.get((left, other), 0) for other in others):
                        now[before, cell] = count
            self._counts.append(now)

    def draw(self, rng: np.random.Generator) -> tuple[Cell, ...]:
        """Draw one admissible path, each with equal probability."""
        counts, start = self._counts, self._start
        n_of_length = [counts[n].get((None, start), 0) for n in self._lengths]
        before, path = None, [start]
        for n in range(self._lengths[_choose(rng, n_of_length)] - 1, -1, -1):
            here = path[-1]
            left = None if self._u_turns else here
            others = [o for o in self._graph.successors(here) if before is None or o != before]
            path.append(others[_choose(rng, [counts[n].get((left, o), 0) for o in others])])
            before = left
        return tuple(path)

    def _befores(self, cell: Cell) -> list[Cell | None]:
        return [None] if self._u_turns else [None, *self._graph.predecessors(cell)]


def _choose(rng: np.random.Generator, counts: list[int]) -> int:
    # Floating point enters here only; the counts are exact.
    shares = np.array([count / sum(counts) for count in counts])
    return int(rng.choice(len(counts), p=shares / shares.sum()))
