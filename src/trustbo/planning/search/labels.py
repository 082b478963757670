"""Best path of a `SearchProblem`: one trust, or none, and any number of resources.

Method: label setting with dominance for the resource-constrained shortest path (Martins 1984;
Irnich and Desaulniers 2005), pruned by the Lagrangian dual of `dual`.

State: a label at a node has its cost so far, the trust x of the team, which follows x -> beta0 x +
u, and the sum r of each resource along its edges. An edge costs its toll and a loss l(x) that falls
in x; `NONE` has no loss and needs no trust, `LEAST` takes the largest loss instead of the sum. A
path is feasible if enough of its r are within their limits, and costs in addition the sum of
failure costs c_m times 1 - exp(-r_m) over the first few resources, the strata of a risk. Without
resources every path is feasible.

A label is dropped if its cost with a lower limit on that of its completions, (a) or (b) of `dual`,
cannot beat the best path known, or if the safest completion, resource by resource, exceeds the
limits.

Invariant: in a layered graph nodes are processed from the highest rank to the goal, so that all
labels of a node are known; else labels are, in the order of their lower limit. A label is dropped
if another one at its node costs no more, has no less trust and no more of every resource that it
could still keep within its limit. Every completion of it is then one of the other, at no higher
cost, because trust stays ordered (beta0 >= 0) and l falls. Where U-turns are
forbidden, the other must have come by the same move, or there must be two of these that came by
different moves: a completion is forbidden to one of them at most.

Exact because the labels that are left include the best path, unless it is the one known. Beyond
`max_labels` the best path known is returned, with the lower limit of the dual.
"""

import heapq
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import LEAF, PART, over_rows
from trustbo.planning.search.costs_to_go import (
    any_start,
    least_trust,
    look_ahead,
    with_safest,
)
from trustbo.planning.search.dual import Found, failure, maximise_dual
from trustbo.planning.search.graph import Best, SearchProblem, costs_of
from trustbo.planning.search.losses import LEAST, NONE, joined, loss_of
from trustbo.planning.search.room import with_room

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
_leaf = njit(nogil=True, error_model="numpy", **LEAF)  # see README
_inlined = njit(nogil=True, error_model="numpy", inline="always")  # see README
MAX_LABELS = 300_000
"""Limit on the labels of a draw."""
_MAX_ENTRIES = 20_000_000  # of the resources of labels
_MAX_CELLS = 1 << 22  # of the paths of several draws at once
_AIMS = 100
"""Number of costs that a bottleneck is sought below."""


def solve(problem: SearchProblem, below: np.ndarray | None = None) -> Best:
    """Find the feasible path of least cost under every draw.

    No cells where there is no path that costs less than `below` (draw,), by default infinite; the
    cost is then `below`. A lower limit of inf: no path is feasible.
    """
    n_draws = len(problem.trust)
    below = np.full(n_draws, np.inf) if below is None else below
    found = np.full(n_draws, np.inf), np.empty(n_draws)  # cost, lower limit
    graph = problem.graph
    options = _AIMS if problem.loss == LEAST else None, None if graph.layered else True
    most = graph.rank[-1] + 1 if graph.layered else len(graph.rank)  # cells of a path
    parts, step = [], max(1, _MAX_CELLS // most)
    for begin in range(0, n_draws, step):
        part = np.full((min(step, n_draws - begin), most), -1, np.int32)

        def work(first: int, last: int, begin: int = begin, part: np.ndarray = part) -> None:
            draws = begin, begin + first, begin + last
            _solve(problem, below, _most_labels(problem), *options, *draws, part, *found)

        over_rows(work, len(part)) if len(part) > 1 else work(0, len(part))
        parts.append(part[:, : max(1, (part >= 0).any(0).sum())])
    if len(parts) == 1:
        return Best(parts[0], *found)
    paths, begin = np.full((n_draws, max(part.shape[1] for part in parts)), -1, np.int32), 0
    for part in parts:
        paths[begin : begin + len(part), : part.shape[1]] = part
        begin += len(part)
    return Best(paths, *found)


def _most_labels(problem: SearchProblem) -> int:
    """Limit on the labels of a draw."""
    return min(MAX_LABELS, _MAX_ENTRIES // max(1, len(problem.resources.limits)))


@_compiled
def _solve(problem, below, max_labels, aims, any_order, offset, first, last, paths, cost, lower):
    """Find the paths of some draws; row 0 of `paths` is that of draw `offset`.

    `aims` is None unless the largest loss counts, and `any_order` unless nodes have no order: what
    a None stands for is not compiled.
    """
    graph, resources = problem.graph, problem.resources
    for d in range(first, last):
        costs = costs_of(problem, d)
        cost[d] = lower[d] = np.inf
        if not any_start(graph, costs, resources):
            continue
        ahead = look_ahead(graph, costs, len(resources.limits) > 0)
        dual = maximise_dual(graph, costs, resources, ahead, below[d])
        known, root = dual.known, dual.root
        if root >= known.cost:
            root = known.cost
        elif aims is not None:
            known, root = _best_bottleneck(graph, costs, resources, ahead, dual, max_labels, aims)
        else:
            need, best = np.empty(0), known.cost
            if any_order is None:
                found, least = _by_rank(
                    graph, costs, resources, ahead, need, dual, best, max_labels
                )
            else:
                found, least = _best_first(
                    graph, costs, resources, ahead, need, dual, best, max_labels
                )
            if len(found.path) > 0:
                known = found
            root = min(max(root, least), known.cost)
        cost[d], lower[d] = known.cost, root
        for k in range(len(known.path)):
            paths[d - offset, k] = known.path[k]


@_inlined
def _best_bottleneck(graph, costs, resources, ahead, dual, max_labels, aims):
    """Find the path whose largest loss is least, and a lower limit on that of all paths.

    A path is sought whose every loss is below an aim: the cost so far does not matter then to what
    dominates, labels with less trust than every completion needs are dropped, and the safest
    completion is that over edges which the largest trust can take. The lower the aim, the fewer the
    labels, so aims rise from the lower limit in growing steps until there is a path (exponential
    search: Bentley and Yao 1976), then halve the interval between the lower limit and its cost.

    Invariant: root <= least cost <= known.cost. A search that sees everything and finds no path
    raises root to the aim; one that finds a path lowers known.cost below the aim.
    """
    known, root, complete = dual.known, dual.root, True
    gap = known.cost - root if known.cost < np.inf else 1.0
    step = gap / 32.0  # the first aim is low, and cheap where it is in vain
    aim = root + step
    for _ in range(aims):
        # Labels at a node n need x >= need[n], else some later loss is the aim or more.
        need = least_trust(graph, costs, aim)
        narrowed = with_safest(graph, costs, resources, need)
        found, lower = _by_rank(graph, costs, narrowed, ahead, need, dual, aim, max_labels)
        complete = lower == np.inf  # no label was left at the limit on their number
        if len(found.path) > 0:
            known = found
            aim, step = 0.5 * (root + known.cost), np.inf  # from now on halves
        elif not complete or aim == known.cost:
            break  # nothing is proven, or nothing costs less than the best known
        else:
            # Steps grow by a tenth, as labels multiply with the aim; past a quarter of the gap the
            # next aim is the best cost known.
            step = 1.1 * step if step < 0.25 * gap else np.inf
            root, aim = aim, min(aim + step, known.cost)
    proven = complete and (aim == known.cost or root >= known.cost)
    return known, known.cost if proven else root


class _Labels(NamedTuple):
    """Labels, in the order in which they were made."""

    link: np.ndarray  # (label, 4): node, move by which it came, parent, next of the node
    state: np.ndarray  # (label, 4): cost, trust, sum of prices, lower limit of completions
    used: np.ndarray  # (label, resource): sums of the resources


@_inlined
def _first_labels(graph, costs, n_resources):
    """Labels of the start, the first of them at each node, -1 where none, and their number."""
    labels = _Labels(np.empty((256, 4), np.int64), np.empty((256, 4)), np.empty((256, n_resources)))
    labels = _with_room(labels, len(graph.starts))
    link, state, used = labels
    heads = np.empty(len(graph.rank), np.int64)
    for node in range(len(heads)):
        heads[node] = -1
    n = np.int64(0)  # no literal, for which callees are compiled again
    for length in range(len(graph.starts)):
        node = graph.starts[length]
        if node >= 0 and costs.start_cost[length] < np.inf:
            link[n, 0], link[n, 1], link[n, 2], link[n, 3] = node, -1, -1, -1
            state[n, 0] = -np.inf if costs.loss == LEAST else costs.start_cost[length]
            state[n, 1], state[n, 2], state[n, 3] = costs.x0, 0.0, -np.inf
            for k in range(n_resources):
                used[n, k] = 0.0
            heads[node] = n
            n += 1
    return labels, heads, n


@_inlined
def _by_rank(graph, costs, resources, ahead, need, dual, best, max_labels):
    """Find the best path that costs less than `best`, no cells if none, in a layered graph.

    Nodes are processed by rank: all labels of a node are then known when the first is expanded.
    Also a lower limit on the cost of all paths where labels were left at the limit on their number,
    inf where all was seen.
    """
    labels, heads, n = _first_labels(graph, costs, len(resources.limits))
    node, label, goal = np.int64(len(heads)), np.int64(-1), np.int64(-1)
    while True:
        node, label, n, goal, best = _expand_by_rank(
            graph, costs, resources, ahead, need, dual, best, labels, heads, node, label, n, goal
        )
        if node < 0:
            return _found(graph, labels, goal, best), np.inf
        if n >= max_labels:
            return _found(graph, labels, goal, best), dual.root
        labels = _with_room(labels, n + graph.first[node + 1] - graph.first[node])


@_leaf
def _expand_by_rank(
    graph, costs, resources, ahead, need, dual, best, labels, heads, node, label, n, goal
):
    """Expand labels from one of a node on, until all are or there is no room for more.

    Returns the node, -1 after the last, and its label to go on from, the number of labels, the best
    one at the goal, and its cost.
    """
    failure_costs, rank, first = resources.failure_costs, graph.rank, graph.first
    link, state, used = labels
    while True:
        while label < 0:
            node -= 1
            if node < 0:
                return node, label, n, goal, best
            label = heads[node]
        if rank[node] == 0:
            cost = state[label, 0]
            for k in range(len(failure_costs)):
                cost += failure(failure_costs[k], used[label, k])
            if cost < best:
                best, goal = cost, label
        elif not _is_dominated(graph, resources, labels, heads[node], label, costs.loss):
            if n + first[node + 1] - first[node] > len(state):
                return node, label, n, goal, best
            n = _extend(graph, costs, resources, ahead, need, dual, best, label, labels, heads, n)
        label = link[label, 3]


@_inlined
def _best_first(graph, costs, resources, ahead, need, dual, best, max_labels):
    """Find what `_by_rank` does in any graph.

    Labels are processed by the lower limit of their completions: the first at the goal is the best.
    """
    labels, heads, n = _first_labels(graph, costs, len(resources.limits))
    queue = [(dual.root, np.int64(0))]
    while queue:
        estimate, label = heapq.heappop(queue)
        node = labels.link[label, 0]
        if graph.rank[node] == 0:
            return _found(graph, labels, label, labels.state[label, 3]), np.inf
        if _is_dominated(graph, resources, labels, heads[node], label, costs.loss):
            continue
        most = n + graph.first[node + 1] - graph.first[node]
        if most > len(labels.state):
            if n >= max_labels:
                return _found(graph, labels, np.int64(-1), best), estimate
            labels = _with_room(labels, most)
        before = n
        n = _extend(graph, costs, resources, ahead, need, dual, best, label, labels, heads, n)
        for new in range(before, n):
            heapq.heappush(queue, (labels.state[new, 3], np.int64(new)))
    return _found(graph, labels, np.int64(-1), best), np.inf


@_inlined
def _with_room(labels, n):
    """Labels with room for `n` of them."""
    return _Labels(with_room(labels.link, n), with_room(labels.state, n), with_room(labels.used, n))


@_leaf
def _extend(graph, costs, resources, ahead, need, dual, best, label, labels, heads, n):
    """Add the labels of one more edge that may lead to less than `best`; their number."""
    # Arrays of records by names of their own: a loop counts the references of a record's.
    link, state, used = labels
    first, head, move, cell, bound = graph.first, graph.head, graph.move, graph.cell, graph.bound
    drift, toll, beta0, by_bound = costs.drift, costs.toll, costs.beta0, costs.by_bound
    hi, own, fall, slope, _ = ahead
    _, free, free_second, free_by = dual.free
    paid_toll, priced, priced_second, priced_by = dual.priced
    of_bounds, limits, safest = resources.of_bounds, resources.limits, resources.safest
    loss, sd, n_resources = costs.loss, costs.noise_sd, len(limits)
    failure_costs = resources.failure_costs
    u_turns, last = graph.u_turns, graph.n_moves - 1
    node, came = link[label, 0], link[label, 1]
    cost, x, prices = state[label, 0], state[label, 1], state[label, 2]
    for e in range(first[node], first[node + 1]):
        h, m, b, within = head[e], move[e], bound[e], 0
        if not u_turns and came >= 0 and m == last - came:
            continue
        for k in range(n_resources):
            used[n, k] = used[label, k] + of_bounds[b, k]
            within += used[n, k] + safest[h, k] <= limits[k]
        if within < resources.needed:  # even the safest completions exceed too many limits
            continue
        # x' = beta0 x + u at the head, where the costs to go are those of x = hi.
        after, lack = x, 0.0
        if loss != NONE:
            after = beta0 * x + (drift[b] if by_bound else drift[cell[h]])
            lack = hi[h] - after
        if loss == LEAST and after < need[h]:
            continue
        to_come = free[h] if u_turns or free_by[h] != last - m else free_second[h]
        to_come += slope[h] * lack
        if n_resources == 0 and loss != LEAST:  # before the loss, which takes longer
            if cost + toll[e] + own[h] + fall[h] * lack + to_come >= best:
                continue
        now = joined(loss, cost, loss_of(loss, after, sd)) + toll[e]
        # `paid` sums lambda r + mu . r_m over the edges: what (b) counts beyond the cost so far.
        least, paid = joined(loss, now, to_come), prices + (paid_toll[e] - toll[e])
        if n_resources > 0:
            for k in range(len(failure_costs)):  # (a)
                least += failure(failure_costs[k], used[n, k] + safest[h, k])
            if least >= best:
                continue
            to_come = priced[h] if u_turns or priced_by[h] != last - m else priced_second[h]
            to_come += slope[h] * lack
            least = max(least, joined(loss, now, to_come) + paid + dual.offset)  # (b)
        if least >= best:
            continue
        link[n, 0], link[n, 1], link[n, 2], link[n, 3] = h, m, label, heads[h]
        state[n, 0], state[n, 1], state[n, 2], state[n, 3] = now, after, paid, least
        heads[h] = n
        n += 1
    return n


@_leaf
def _is_dominated(graph, resources, labels, other, label, loss):
    """True if labels of the same node have all the completions of one, at no higher cost."""
    link, state, used = labels  # no call below: each would count the references of all arrays
    limits, safest, u_turns = resources.limits, resources.safest, graph.u_turns
    node, came, by = link[label, 0], link[label, 1], -1
    cost, x = state[label, 0], state[label, 1]
    while other >= 0:
        # Whether the other is as good in all that matters, and if so, whether it is equal.
        costs_more = loss != LEAST and state[other, 0] > cost
        if costs_more or (loss != NONE and state[other, 1] < x) or other == label:
            other = link[other, 3]
            continue
        covers, k = True, 0
        equal = loss == LEAST or state[other, 0] == cost
        equal = equal and (loss == NONE or state[other, 1] == x)
        while covers and k < len(limits):
            r_other, r = used[other, k], used[label, k]
            if limits[k] < np.inf:  # a limit that is exceeded anyway matters no more
                most = limits[k] - safest[node, k]
                r_other = r_other if r_other <= most else np.inf
                r = r if r <= most else np.inf
            covers, equal, k = r_other <= r, equal and r_other == r, k + 1
        if covers and (not equal or other < label):  # of two that are equal, the earlier stays
            if u_turns or link[other, 1] == came:
                return True
            if by >= 0 and link[other, 1] != by:
                return True
            by = link[other, 1]
        other = link[other, 3]
    return False


@_part
def _found(graph, labels, label, cost):
    """Path of a label, no cells for label -1, and its cost."""
    n, k = 0, label
    while k >= 0:
        n, k = n + 1, labels.link[k, 2]
    path = np.empty(n, np.int64)
    for k in range(n - 1, -1, -1):
        path[k] = graph.cell[labels.link[label, 0]]
        label = labels.link[label, 2]
    return Found(path, cost)
