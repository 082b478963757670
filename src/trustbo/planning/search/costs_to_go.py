"""Costs to go: least sums of tolls, losses and resources from each node to the goal.

By passes over the nodes in the order of their rank: one where the graph is layered, else as many as
change anything (Bellman 1958). A bound costs its toll and a loss l(x) that falls in the trust x
after it; costs to go hold for the largest trust `hi` with which a node can be entered, and with
less they grow by at least a slope for each unit that lacks. With beta0 >= 0, let a node be entered
at x <= hi. Then

    loss of entering it >= W + m (hi - x),  W = l(hi), m the least -l' on [lo, hi],
    losses after it     >= V + s (hi - x),  s = beta0 min (m' + s') over the heads of its edges,

the latter by induction from the goal, where V = s = 0: an edge at x leads to x' = beta0 x + u,
which lacks beta0 times as much. Both hold from any x, so U-turns may be allowed or not.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import LEAF, PART
from trustbo.planning.search.graph import Costs, Graph, Resources, drift_of, filled
from trustbo.planning.search.losses import LEAST, NONE, least_slope, loss_of

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
_leaf = njit(nogil=True, error_model="numpy", **LEAF)  # see README
_inlined = njit(nogil=True, error_model="numpy", inline="always")  # no counts of references


class Ahead(NamedTuple):
    """Trust with which nodes can be entered, and what its lack costs at least."""

    hi: np.ndarray  # (node,), -inf: on no path
    loss: np.ndarray  # (node,), W: loss of entering the node at `hi`
    fall: np.ndarray  # (node,), m: least rise of that loss for each unit of trust that lacks
    slope: np.ndarray  # (node,), s: the same of the losses after the node
    of_edge: np.ndarray  # (edge,), loss of an edge from `hi`; (0,) where W and m stand for it


class ToGo(NamedTuple):
    """Least cost from each node to the goal with some tolls."""

    toll: np.ndarray  # (edge,), with the prices of resources
    best: np.ndarray  # (node,)
    second: np.ndarray  # (node,), by another first move than that of `best`
    by: np.ndarray  # (node,), first move of `best`, -1 at the goal


@_compiled
def safest_to_go(graph: Graph, of_bounds: np.ndarray) -> np.ndarray:
    """Least sum of each resource (bound, resource) from each node to the goal, (node, resource)."""
    n_nodes, n_resources = len(graph.rank), of_bounds.shape[1]
    safest = np.empty((n_nodes, n_resources))
    for node in range(n_nodes):
        for k in range(n_resources):
            safest[node, k] = 0.0 if graph.rank[node] == 0 else np.inf
    changed = n_resources > 0
    while changed:
        changed = False
        for node in range(n_nodes):
            for e in range(graph.first[node], graph.first[node + 1]):
                h, b = graph.head[e], graph.bound[e]
                for k in range(n_resources):
                    value = of_bounds[b, k] + safest[h, k]
                    if value < safest[node, k]:
                        safest[node, k], changed = value, not graph.layered
    return safest


@_part
def any_start(graph: Graph, costs: Costs, resources: Resources) -> bool:
    """Whether the safest path, resource by resource, could be feasible."""
    nothing = filled(len(resources.limits), 0.0)
    for length in range(len(graph.starts)):
        node = graph.starts[length]
        if node >= 0 and costs.start_cost[length] < np.inf:
            if can_be_feasible(resources, nothing, node):
                return True
    return False


@_inlined
def can_be_feasible(resources: Resources, so_far: np.ndarray, node: int) -> bool:
    """Whether enough sums, up to a node, can stay within their limits."""
    within = 0
    for k in range(len(resources.limits)):
        if so_far[k] + resources.safest[node, k] <= resources.limits[k]:
            within += 1
    return within >= resources.needed


@_part
def look_ahead(graph: Graph, costs: Costs, by_edge: bool) -> Ahead:
    """Trust at the nodes, from the start on, then what its lack costs, from the goal on.

    With `by_edge`, losses are those of edges: closer, and more of them.
    """
    n_nodes, loss = len(graph.rank), costs.loss
    hi, lo = filled(n_nodes, -np.inf), filled(n_nodes, np.inf)
    own, fall, slope = filled(n_nodes, 0.0), filled(n_nodes, 0.0), filled(n_nodes, 0.0)
    if loss == NONE and not graph.layered:
        return Ahead(own, own, fall, slope, filled(0, 0.0))
    of_edge = filled(len(graph.head) if by_edge and loss != NONE else 0, 0.0)
    ahead = Ahead(hi, own, fall, slope, of_edge)
    _fill_ahead(graph, costs, lo, ahead)
    return ahead


@_leaf
def _fill_ahead(graph, costs, lo, ahead):
    """Write down hi, W, m and s of all nodes; see the head of this file."""
    first, head, cell, bound = graph.first, graph.head, graph.cell, graph.bound
    hi, own, fall, slope, of_edge = ahead
    drift, beta0, by_bound, sd, loss = (
        costs.drift,
        costs.beta0,
        costs.by_bound,
        costs.noise_sd,
        costs.loss,
    )
    n_nodes, by_edge = len(hi), len(of_edge) > 0
    for length in range(len(graph.starts)):
        node = graph.starts[length]
        if node >= 0 and costs.start_cost[length] < np.inf:
            hi[node] = lo[node] = costs.x0
    for node in range(n_nodes - 1, -1, -1):  # from the start: a layered graph's tails come first
        if hi[node] == -np.inf:
            continue
        for e in range(first[node], first[node + 1]):
            h = np.uint64(head[e])  # unsigned: no test for a negative index
            if loss == NONE:
                hi[h] = 0.0
                continue
            u = drift[bound[e]] if by_bound else drift[cell[h]]
            hi[h] = max(hi[h], beta0 * hi[node] + u)
            lo[h] = min(lo[h], beta0 * lo[node] + u)
            if by_edge:
                of_edge[e] = loss_of(loss, beta0 * hi[node] + u, sd)
    for node in range(n_nodes if loss != NONE else 0):
        if hi[node] == -np.inf:
            continue
        if not by_edge:
            own[node] = loss_of(loss, hi[node], sd)
        fall[node] = least_slope(loss, lo[node], hi[node], sd)
        if loss == LEAST:  # the largest loss alone counts, and later ones need not be larger
            continue
        least = 0.0 if node == 0 else np.inf
        for e in range(first[node], first[node + 1]):
            h = np.uint64(head[e])
            least = min(least, fall[h] + slope[h])
        slope[node] = beta0 * least if least < np.inf else 0.0


@_part
def pass_back(graph: Graph, costs: Costs, ahead: Ahead, toll: np.ndarray) -> ToGo:
    """Compute the least cost to go of every node with some tolls."""
    n_nodes = len(graph.rank)
    to_go = ToGo(toll, filled(n_nodes, np.inf), filled(n_nodes, np.inf), np.empty(n_nodes, np.int8))
    _settle(graph, costs, ahead, to_go)
    return to_go


@_leaf
def _settle(graph, costs, ahead, to_go):
    """Write down V of all nodes, as the best and second-best of their edges' W + V.

    Invariant: in a layered graph V of all heads is final when a node is reached; else passes go on,
    in alternate directions, until none changes anything.
    """
    toll, best, second, by = to_go
    n_nodes, loss = len(best), costs.loss
    for node in range(n_nodes):
        by[node] = -1
    best[0] = second[0] = -np.inf if loss == LEAST else 0.0
    first, head, move = graph.first, graph.head, graph.move
    cell, bound, drift = graph.cell, graph.bound, costs.drift
    beta0, by_bound, u_turns, last = costs.beta0, costs.by_bound, graph.u_turns, graph.n_moves - 1
    hi, own, fall, slope, of_edge = ahead
    changed, backwards, by_edge = True, False, len(of_edge) > 0
    while changed:
        changed = False
        for i in range(1, n_nodes):
            node = n_nodes - i if backwards else i
            if hi[node] == -np.inf:
                continue
            least, next_least, chosen = np.inf, np.inf, -1
            for e in range(first[node], first[node + 1]):
                h, m = np.uint64(head[e]), move[e]  # unsigned: no test for a negative index
                total = best[h] if u_turns or by[h] != last - m else second[h]
                if loss != NONE:
                    after = beta0 * hi[node] + (drift[bound[e]] if by_bound else drift[cell[h]])
                    lack = hi[h] - after
                    enters = of_edge[e] if by_edge else own[h] + fall[h] * lack
                    total += slope[h] * lack
                    total = max(enters, total) if loss == LEAST else enters + total
                total += toll[e]
                # Without branches: they would be mispredicted at every other edge.
                next_least = min(next_least, max(total, least))
                chosen = m if total < least else chosen
                least = min(total, least)
            changed = changed or (least < best[node] and not graph.layered)
            best[node], second[node], by[node] = least, next_least, chosen
        backwards = not backwards


@_part
def least_trust(graph: Graph, costs: Costs, aim: float) -> np.ndarray:
    """Least trust at nodes with which losses -x can stay below an aim, (node,); else infinite."""
    need = filled(len(graph.rank), np.inf)
    for node in range(len(need)):
        if graph.rank[node] == 0:
            need[node] = -aim
        for e in range(graph.first[node], graph.first[node + 1]):
            lack = need[graph.head[e]] - drift_of(graph, costs, e)
            if costs.beta0 > 0.0:
                need[node] = min(need[node], lack / costs.beta0)
            elif lack <= 0.0:
                need[node] = -np.inf
        need[node] = max(need[node], -aim)
    return need


@_part
def with_safest(graph: Graph, costs: Costs, resources: Resources, need: np.ndarray) -> Resources:
    """Replace the safest completions by those over edges which leave the trust that nodes need."""
    n_nodes, n_resources = len(graph.rank), len(resources.limits)
    hi, safest = filled(n_nodes, -np.inf), np.empty((n_nodes, n_resources))
    for length in range(len(graph.starts)):
        node = graph.starts[length]
        if node >= 0 and costs.start_cost[length] < np.inf:
            hi[node] = costs.x0
    for node in range(n_nodes - 1, -1, -1):
        for e in range(graph.first[node], graph.first[node + 1]):
            h, x = graph.head[e], costs.beta0 * hi[node] + drift_of(graph, costs, e)
            hi[h] = max(hi[h], x) if x >= need[h] else hi[h]
    for node in range(n_nodes):
        for k in range(n_resources):
            safest[node, k] = 0.0 if graph.rank[node] == 0 else np.inf
        for e in range(graph.first[node], graph.first[node + 1]):
            h, b = graph.head[e], graph.bound[e]
            if costs.beta0 * hi[node] + drift_of(graph, costs, e) >= need[h]:
                for k in range(n_resources):
                    safest[node, k] = min(safest[node, k], resources.of_bounds[b, k] + safest[h, k])
    return Resources(
        resources.of_bounds,
        resources.limits,
        resources.needed,
        resources.failure_costs,
        resources.priced,
        resources.priced_limit,
        safest,
    )
