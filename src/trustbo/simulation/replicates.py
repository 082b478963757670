"""Replicates of the bounds of a simulator, with the contact for each possible next bound."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo.data import POST_SETS, Cell, Station, split_path
from trustbo.parallel import in_order
from trustbo.simulation.kinematic import KinematicSimulator, State
from trustbo.simulation.protocol import reads_post_sets
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES, next_names, possible_next, way_names

_DIMS = ("move", "row", "col", "next_move")


class Edge(NamedTuple):
    """Bound with its possible next bounds."""

    way: int
    left: Station
    """Cell left, with the set of posts from which T2 watches the bound."""
    cell: Cell
    next_ways: tuple[int, ...]
    """Possible next ways, then the number of ways for the end of a path."""
    ahead: tuple[tuple[Station, Cell | None], ...]
    """For each of `next_ways`, the cell entered with the next set of posts, and the next cell.

    The next cell is None at the end of a path."""


type Outcomes = Iterator[tuple[Edge, list[tuple[float, str]]]]
"""Bounds, each with the mean contact over robots and the status for each next way.

The contact is NaN if it was not measured.
"""


def table_of(contact: np.ndarray, passed: np.ndarray) -> xr.Dataset:
    """Make a dataset like `Truth.bounds` from arrays (way, row, col, next_way)."""
    n_posts = len(contact) // len(MOVES)
    names = {"move": way_names(n_posts), "next_move": next_names(n_posts)}
    return xr.Dataset({"contact": (_DIMS, contact), "passed": (_DIMS, passed)}, names)


def edges_of(workspace: Workspace, n_posts: int = 1) -> list[Edge]:
    """List the bounds for which all robots have routes, with the first `n_posts` sets of posts."""
    exists = workspace.passable_bounds.values
    follows = possible_next(exists, n_posts)
    n_ways = len(MOVES) * n_posts
    edges = []
    for way, row, col in np.argwhere(follows[..., n_ways]).tolist():
        down, right = MOVES[way % len(MOVES)]
        nexts = np.flatnonzero(follows[way, row, col, :n_ways]).tolist()
        ahead = []
        for number, move in (divmod(after, len(MOVES)) for after in nexts):
            next_cell = row + MOVES[move][0], col + MOVES[move][1]
            ahead.append(((row, col, POST_SETS[number]), next_cell))

        edge = Edge(
            way,
            left=(row - down, col - right, POST_SETS[way // len(MOVES)]),
            cell=(row, col),
            next_ways=(*nexts, n_ways),
            ahead=(*ahead, ((row, col, POST_SETS[0]), None)),
        )
        edges.append(edge)
    return edges


def replicated(simulator: Any, mission: int, n_replicates: int, seed: int) -> xr.Dataset:
    """Average the contact and success of all bounds over replicates; see `Truth.from_simulator`."""
    if hasattr(simulator, "expected_contact"):
        return simulator.expected_contact()

    workspace = simulator.workspace
    n_posts = workspace.n_posts if reads_post_sets(simulator) else 1
    n_ways = len(MOVES) * n_posts
    shape = n_ways, *workspace.passable.shape, n_ways + 1
    total = np.zeros(shape)
    n_passed = np.zeros(shape)
    n_measured = np.zeros(shape)
    n = np.zeros(shape)
    replicates = _of_bounds if isinstance(simulator, KinematicSimulator) else _of_missions

    edges = edges_of(workspace, n_posts)
    for edge, outcomes in replicates(simulator, edges, mission, n_replicates, seed):
        for next_way, (contact, status) in zip(edge.next_ways, outcomes, strict=True):
            where = edge.way, *edge.cell, next_way
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
    ends: dict[tuple[Station, Cell], dict[int, State]] = {}
    for number in range(n + 1):
        before = ends
        ends = {where: dict(states) for where, states in ends.items()}

        def replicate(
            edge: Edge, number: int = number, before: dict[Any, dict[int, State]] = before
        ) -> list[tuple[float, str, State]]:
            rng = np.random.default_rng([seed, number, edge.way, *edge.cell])
            # The replicates take the preceding bounds in turn.
            states = before.get((edge.left, edge.cell), {})
            if states:
                state = states[sorted(states)[number % len(states)]]
            else:
                state = simulator.standing(edge.left, edge.cell)

            found = simulator.outcomes(world, state, 1, edge.ahead, rng, expected=True)
            return [(float(contact.mean()), drive.status, after) for drive, contact, after in found]

        for edge, outcomes in zip(edges, in_order(replicate, edges), strict=True):
            for (entered, next_cell), (_, status, after) in zip(edge.ahead, outcomes, strict=True):
                if status == "ok" and next_cell is not None:
                    ends.setdefault((entered, next_cell), {})[edge.way] = after
            if number:
                yield edge, [(contact, status) for contact, status, _ in outcomes]


def _of_missions(
    simulator: Any, edges: Sequence[Edge], mission: int, n: int, seed: int
) -> Outcomes:
    """Replicate each bound by a short mission for each possible next bound."""
    for number in range(n):
        for edge in edges:
            outcomes = []
            for i, (entered, next_cell) in enumerate(edge.ahead):
                stations = [edge.left, entered]
                if next_cell is not None:
                    stations.append(next_cell)

                path, post_sets = split_path(stations)
                options = {"post_sets": post_sets} if post_sets else {}
                entropy = [seed, number, edge.way, *edge.cell, i]
                drawn = int(np.random.SeedSequence(entropy).generate_state(1)[0])
                bound = simulator.run(path, seed=drawn, mission=mission, **options).bounds[0]
                measured = bound.contact_rate[np.isfinite(bound.contact_rate)]
                contact = float(measured.mean()) if len(measured) else np.nan
                outcomes.append((contact, bound.status))
            yield edge, outcomes
