"""Replicates of the bounds of a simulator, with the contact for each possible next bound."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import Cell
from trustbo.parallel import in_order
from trustbo.simulation.kinematic import KinematicSimulator, State
from trustbo.workspace import Workspace
from trustbo.workspace.moves import END, MOVES, next_names, possible_next, way_names

_DIMS = ("move", "row", "col", "next_move")


class Edge(NamedTuple):
    """Bound with its possible next bounds."""

    move: int
    left: Cell
    cell: Cell
    next_moves: tuple[int, ...]
    """Indices of the possible next moves in `MOVES`, then `END`."""
    ahead: tuple[Cell | None, ...]
    """Next cell for each of `next_moves`; None for `END`."""


type Outcomes = Iterator[tuple[Edge, list[tuple[float, str]]]]
"""Bounds, each with the mean contact over robots and the status for each next move.

The contact is NaN if it was not measured.
"""


def table_of(contact: np.ndarray, passed: np.ndarray) -> xr.Dataset:
    """Make a dataset like `Truth.bounds` from arrays (move, row, col, next_move)."""
    names = {"move": way_names(1), "next_move": next_names(1)}
    return xr.Dataset({"contact": (_DIMS, contact), "passed": (_DIMS, passed)}, names)


def edges_of(workspace: Workspace) -> list[Edge]:
    """List the bounds of a workspace for which all robots have routes."""
    exists = workspace.passable_bounds.values
    follows = possible_next(exists)
    edges = []
    for move, row, col in np.argwhere(exists).tolist():
        down, right = MOVES[move]
        to = [(row + i, col + j) for i, j in MOVES]
        nexts = np.flatnonzero(follows[move, row, col, :END]).tolist()
        edge = Edge(
            move,
            left=(row - down, col - right),
            cell=(row, col),
            next_moves=(*nexts, END),
            ahead=(*(to[n] for n in nexts), None),
        )
        edges.append(edge)
    return edges


def replicated(simulator: Any, mission: int, n_replicates: int, seed: int) -> xr.Dataset:
    """Average the contact and success of all bounds over replicates; see `Truth.from_simulator`."""
    if hasattr(simulator, "expected_contact"):
        return simulator.expected_contact()

    workspace = simulator.workspace
    shape = END, *workspace.passable.shape, END + 1
    total = np.zeros(shape)
    n_passed = np.zeros(shape)
    n_measured = np.zeros(shape)
    n = np.zeros(shape)
    replicates = _of_bounds if isinstance(simulator, KinematicSimulator) else _of_missions

    edges = edges_of(workspace)
    for edge, outcomes in replicates(simulator, edges, mission, n_replicates, seed):
        for next_move, (contact, status) in zip(edge.next_moves, outcomes, strict=True):
            where = edge.move, *edge.cell, next_move
            n[where] += 1.0
            if status == "ok":
                n_passed[where] += 1.0
                if np.isfinite(contact):
                    n_measured[where] += 1.0
                    total[where] += contact

    always_failed = (n > 0.0) & (n_passed == 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        contact = np.where(always_failed, 0.0, total / n_measured)
        return table_of(contact, n_passed / n)


def _of_bounds(
    simulator: KinematicSimulator, edges: Sequence[Edge], mission: int, n: int, seed: int
) -> Outcomes:
    """Replicate bounds; each bound begins where a preceding bound ended in the previous replicate.

    In replicate 0, which is not returned, the robots begin at their stop and posts.
    """
    world = simulator.world(mission, long_run=True)
    ends: dict[tuple[Cell, Cell], dict[int, State]] = {}
    for number in range(n + 1):
        before = ends
        ends = {where: dict(states) for where, states in ends.items()}

        def replicate(
            edge: Edge, number: int = number, before: dict[Any, dict[int, State]] = before
        ) -> list[tuple[float, str, State]]:
            rng = np.random.default_rng([seed, number, edge.move, *edge.cell])
            # The replicates take the preceding bounds in turn.
            states = before.get((edge.left, edge.cell), {})
            if states:
                state = states[sorted(states)[number % len(states)]]
            else:
                state = simulator.standing(edge.left, edge.cell)

            found = simulator.outcomes(world, state, 1, edge.cell, edge.ahead, rng, expected=True)
            return [(float(contact.mean()), drive.status, after) for drive, contact, after in found]

        for edge, outcomes in zip(edges, in_order(replicate, edges), strict=True):
            for next_cell, (_, status, after) in zip(edge.ahead, outcomes, strict=True):
                if status == "ok" and next_cell is not None:
                    ends.setdefault((edge.cell, next_cell), {})[edge.move] = after
            if number:
                yield edge, [(contact, status) for contact, status, _ in outcomes]


def _of_missions(
    simulator: Any, edges: Sequence[Edge], mission: int, n: int, seed: int
) -> Outcomes:
    """Replicate each bound by a short mission for each possible next bound."""
    for number in range(n):
        for edge in edges:
            outcomes = []
            for i, next_cell in enumerate(edge.ahead):
                path = [edge.left, edge.cell]
                if next_cell is not None:
                    path.append(next_cell)

                entropy = [seed, number, edge.move, *edge.cell, i]
                drawn = int(np.random.SeedSequence(entropy).generate_state(1)[0])
                bound = simulator.run(tuple(path), seed=drawn, mission=mission).bounds[0]
                measured = bound.contact_rate[np.isfinite(bound.contact_rate)]
                contact = float(measured.mean()) if len(measured) else np.nan
                outcomes.append((contact, bound.status))
            yield edge, outcomes
