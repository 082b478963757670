"""Given graphs, such as roads, unrolled over the bounds left, for the label search.

State: a node (j, e) is the edge e by which a path came, with j bounds left; the start is one more
state. Edges lead from (j, e) to (j - 1, f) for each edge f that goes on from e: a U-turn, f back
along e, is left out where it is forbidden, so that the search has no moves to heed. Node 0 is the
goal, which the last bound alone enters.

Invariant: a node is there only if the goal can be reached from it in exactly the bounds left, and
it from the start in those that are not. All paths through the graph are hence admissible walks, and
each walk of at most `longest` bounds is one path.
"""

import numpy as np

from trustbo.errors import TrustboError
from trustbo.planning.search.graph import Graph

_MOST_EDGES = 50_000_000
"""Most edges of the unrolled graph, whose tables take some gigabytes."""


def unroll(
    tail: np.ndarray,
    head: np.ndarray,
    ends: tuple[int, int],
    from_start: np.ndarray,
    longest: int,
    *,
    u_turns: bool,
) -> Graph:
    """Unroll edges from `tail` to `head`, (edge,), indices of nodes, between two ends.

    `from_start` has the fewest edges from the start to each node, (node,). Bounds of the graph are
    edges, and its cells are nodes. TrustboError: it is too large to be held.
    """
    (start, goal), n = ends, len(tail)
    enters = np.append(head, start)  # node of each state
    a, b = _onward(tail, enters, goal)
    if not u_turns:
        turns = (a < n) & (head[b] == tail[np.minimum(a, n - 1)])
        a, b = a[~turns], b[~turns]
    if longest * len(a) > _MOST_EDGES:
        raise TrustboError(
            f"paths of up to {longest} bounds over {n} edges are too many to unroll; give a "
            "smaller max_bounds, or a part of the graph."
        )
    entered = np.append(from_start[tail] + 1, 0)  # fewest bounds up to each state
    starts, node_of = np.full(longest + 1, -1), np.full(n + 1, -1)
    none: list[np.ndarray] = [np.zeros(1, int)]  # edges and rank of the goal
    ranks, cells, counts, heads, bounds = [*none], [np.array([goal])], [*none], [], []
    n_nodes = 1
    for left in range(1, longest + 1):
        ahead = head[b] == goal if left == 1 else node_of[b] >= 0
        kept = ahead & (entered[a] <= longest - left)
        states, per_state = np.unique(a[kept], return_counts=True)
        heads.append(np.zeros(kept.sum(), int) if left == 1 else node_of[b[kept]])
        bounds.append(b[kept])
        counts.append(per_state)
        node_of = np.full(n + 1, -1)
        node_of[states] = n_nodes + np.arange(len(states))
        starts[left] = node_of[n]
        ranks.append(np.full(len(states), left))
        cells.append(enters[states])
        n_nodes += len(states)
    bound = np.concatenate(bounds).astype(np.int32)
    return Graph(
        first=np.concatenate([[0], np.cumsum(np.concatenate(counts))]),
        head=np.concatenate(heads).astype(np.int32),
        rank=np.concatenate(ranks).astype(np.int32),
        cell=np.concatenate(cells).astype(np.int32),
        move=np.zeros(len(bound), np.int8),
        bound=bound,
        starts=starts,
        n_moves=1,
        u_turns=True,
        layered=True,
    )


def _onward(tail: np.ndarray, enters: np.ndarray, goal: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a state that is not at the goal, in order, and an edge that goes on from it."""
    order = np.argsort(tail, kind="stable")
    first = np.searchsorted(tail[order], np.arange(max(tail.max(), enters.max()) + 2))
    states = np.flatnonzero(enters != goal)
    count = np.diff(first)[enters[states]]
    a = np.repeat(states, count)
    before = np.repeat(first[enters[states]] - count.cumsum() + count, count)
    return a, order[before + np.arange(len(a))]
