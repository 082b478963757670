"""Admissible paths drawn uniformly, by counting how many ways lead on."""

from weakref import WeakKeyDictionary

import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.planning.course import Course

_TRIES = 10_000
_Ways = list[dict[tuple[Cell | None, Cell], int]]

_counted: "WeakKeyDictionary[Course, Walks]" = WeakKeyDictionary()


def walks_of(course: Course) -> "Walks":
    """The walks of a course, counted once."""
    if course not in _counted:
        _counted[course] = Walks(course)
    return _counted[course]


class Walks:
    """The admissible paths of a course, counted: exact in Python's integers."""

    def __init__(self, course: Course) -> None:
        """Count, from the goal backwards; for long walks on large grids this takes a while."""
        self._graph, self._ends = course.graph, (course.start, course.goal)
        self._u_turns, self._revisit = course.u_turns, course.revisit
        self._lengths = range(course.shortest, course.longest + 1)
        # ways[n][before, cell]: walks of n more bounds to the goal. `before` is the cell that the
        # last bound left, or None where walks may turn straight back.
        self._ways: _Ways = [{(b, course.goal): 1 for b in self._befores(course.goal)}]
        for _ in range(course.longest):
            fewer, now = self._ways[-1], {}
            for cell in self._graph:
                if cell == self._ends[1]:
                    continue  # a path ends when it first gets there
                for before in self._befores(cell):
                    others = (
                        o for o in self._graph.successors(cell) if before is None or o != before
                    )
                    left = None if course.u_turns else cell
                    if n_ways := sum(fewer.get((left, other), 0) for other in others):
                        now[before, cell] = n_ways
            self._ways.append(now)

    def draw(self, rng: np.random.Generator) -> tuple[Cell, ...]:
        """One admissible path, each as likely as any other.

        Raises:
            TrustboError: Walks must not enter a cell twice, and of 10 000 drawn every one did.
        """
        for _ in range(_TRIES):
            path = self._draw_walk(rng)
            # Kept only if simple where it must be: what is kept is still uniform.
            if self._revisit or len(set(path)) == len(path):
                return tuple(path)
        raise TrustboError(
            f"no path without revisits among {_TRIES} walks of up to {self._lengths[-1]} "
            "bounds; lower max_bounds."
        )

    def _befores(self, cell: Cell) -> list[Cell | None]:
        return [None] if self._u_turns else [None, *self._graph.predecessors(cell)]

    def _draw_walk(self, rng: np.random.Generator) -> list[Cell]:
        ways, start = self._ways, self._ends[0]
        n_of_length = [ways[n].get((None, start), 0) for n in self._lengths]
        before, path = None, [start]
        for n in range(self._lengths[_choose(rng, n_of_length)] - 1, -1, -1):
            here = path[-1]
            left = None if self._u_turns else here
            others = [o for o in self._graph.successors(here) if before is None or o != before]
            path.append(others[_choose(rng, [ways[n].get((left, other), 0) for other in others])])
            before = left
        return path


def _choose(rng: np.random.Generator, counts: list[int]) -> int:
    # In floating point only here: the counts themselves are exact.
    shares = np.array([count / sum(counts) for count in counts])
    return int(rng.choice(len(counts), p=shares / shares.sum()))
