"""Replicates of bounds: contact and status of each, for each bound that can follow."""

from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.parallel import in_order
from trustbo.simulation.events import Fouling
from trustbo.simulation.overwatch import KinematicSimulator
from trustbo.simulation.protocol import require_bounds, takes
from trustbo.simulation.state import State
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES

END = len(MOVES[8])
"""Index of "no next move": the bound enters the goal."""


class Edge(NamedTuple):
    """A bound, and the bounds that can follow it."""

    move: int
    left: Cell
    cell: Cell
    next_moves: tuple[int, ...]  # indices of MOVES[8], and END
    ahead: tuple[Cell | None, ...]


Outcome = tuple[np.ndarray, str]
"""Contact rate of each robot, shape (robot,), and status of a bound."""


def edges_of(workspace: Workspace) -> list[Edge]:
    """All bounds of a workspace for which its robots have a route."""
    exists = workspace.passable_bounds.values
    edges = []
    for move, row, col in np.argwhere(exists).tolist():
        down, right = MOVES[8][move]
        nexts: list[int] = []
        ahead: list[Cell | None] = []
        for n, (i, j) in enumerate(MOVES[8]):
            to = row + i, col + j
            if 0 <= to[0] < exists.shape[1] and 0 <= to[1] < exists.shape[2] and exists[n, *to]:
                nexts.append(n)
                ahead.append(to)
        edge = move, (row - down, col - right), (row, col), (*nexts, END), (*ahead, None)
        edges.append(Edge(*edge))
    return edges


class KinematicReplicates:
    """Replicates of the kinematic simulator, without detection noise.

    Robots stop within half a metre of where they should, hence a replicate begins where one of the
    bounds before it, each in turn, ended in the replicate before, as in missions. In the zeroth,
    which is not counted, all begin in their positions.

    Attributes:
        most: Maximum number of replicates.
    """

    def __init__(self, simulator: KinematicSimulator, mission: int, seed: int) -> None:
        """Take a simulator in the world of a mission."""
        self._simulator, self._seed, self.most = copy(simulator), seed, 64
        self._edges = edges_of(simulator.workspace)
        self._ends: dict[tuple[Cell, Cell | None], dict[int, State]] = {}
        for edge in self._edges[:1]:
            self._simulator.reset(edge.left, seed, mission=mission)

    def run(self, edges: Sequence[Edge], number: int) -> Iterator[list[Outcome]]:
        """Run each bound once for each that can follow it: outcomes in the order of the edges."""
        if not self._ends and number:
            list(self.run(self._edges, 0))
        ends: dict[tuple[Cell, Cell | None], dict[int, State]] = {}

        def work(edge: Edge) -> tuple[Edge, list[tuple[np.ndarray, str, State]]]:
            seed = [self._seed, number, edge.move, *edge.cell]
            rng = np.random.default_rng(seed)
            before = self._ends.get((edge.left, edge.cell), {})
            if before:
                state = before[sorted(before)[number % len(before)]]
            else:
                state = self._simulator.standing(edge.left, edge.cell)
            return edge, self._simulator.run_ahead(1, edge.cell, edge.ahead, rng, state)

        for edge, outcomes in in_order(work, edges):
            for next_cell, (_, status, after) in zip(edge.ahead, outcomes, strict=True):
                if status == "ok":
                    ends.setdefault((edge.cell, next_cell), {})[edge.move] = after
            yield [outcome[:2] for outcome in outcomes]
        for where, states in ends.items():
            self._ends[where] = self._ends.get(where, {}) | states


class PlainReplicates:
    """Replicates of any simulator that runs bound by bound, each the first bound of a mission."""

    def __init__(self, simulator: Any, mission: int, seed: int) -> None:
        """Take a simulator; TrustboError: it lacks `reset` or `run_bound`, or fouls."""
        require_bounds(simulator, "truth")
        if any(isinstance(event, Fouling) for event in getattr(simulator, "events", ())):
            raise TrustboError(
                f"bounds of {type(simulator).__name__} are replicated one by one, which have no "
                "long run of Fouling; use KinematicSimulator."
            )
        self._simulator, self._seed, self.most = simulator, seed, 1000
        self._numbered = {"mission": mission} if takes(simulator.reset, "mission") else {}

    def run(self, edges: Sequence[Edge], number: int) -> Iterator[list[Outcome]]:
        """See `KinematicReplicates.run`."""
        run = self._simulator
        sees_start, sees_next = takes(run.reset, "next_cell"), takes(run.run_bound, "next_cell")
        for edge in edges:
            at_start = {"next_cell": edge.cell} if sees_start else {}
            ahead = edge.ahead if sees_next else edge.ahead[-1:]
            outcomes = []
            for i, next_cell in enumerate(ahead):
                entropy = [self._seed, number, edge.move, *edge.cell, i]
                seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
                run.reset(edge.left, seed, **at_start, **self._numbered)
                options = {"next_cell": next_cell} if sees_next else {}
                bound = run.run_bound(1, edge.cell, **options)
                outcomes.append((np.asarray(bound.contact_rate), bound.status))
            getattr(run, "close", lambda: None)()
            yield outcomes if sees_next else outcomes * len(edge.ahead)
