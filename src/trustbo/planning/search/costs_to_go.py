"""Costs to go on the layered DAG: least sums of tolls, losses and risks from each node on.

By dynamic programming from the goal, in the order of the bounds left. A bound costs its toll and a
loss l(x) that falls in the trust x after it; costs to go hold for the largest trust `hi` with which
a node can be entered, and with less they grow by at least `slope` for each unit that lacks.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.parallel import PART
from trustbo.planning.search.contact_loss import expected_loss, least_slope
from trustbo.planning.search.layers import Layers

_compiled = njit(cache=True, nogil=True, error_model="numpy")
_part = njit(nogil=True, error_model="numpy", **PART)
SOFTPLUS, LEAST, NONE = range(2, 5)
"""Losses beside those of `contact_loss`: -log sigma(x); the largest -x; and none."""


class Bounds(NamedTuple):
    """Costs of the edges of the DAG, under one draw."""

    toll: np.ndarray  # (edge,)
    drift: np.ndarray  # (edge,)
    start_cost: np.ndarray  # (length,), of a path by its number of bounds; inf: not admissible
    beta0: float
    x0: float
    noise_sd: float
    law: int


class EdgeRisk(NamedTuple):
    """Risk of the edges, and the least to come."""

    of_bounds: np.ndarray  # (bound, resource)
    bound: np.ndarray  # (edge,), index of its bound
    priced: np.ndarray  # (bound,), a sum that no feasible path has above
    priced_limit: float
    limits: np.ndarray  # (resource,)
    needed: int
    failure_cost: float
    safest: np.ndarray  # (node, resource), least sums from a node to the goal


class Ahead(NamedTuple):
    """Trust with which nodes can be entered, and what its lack costs at least."""

    hi: np.ndarray  # (node,)
    slope: np.ndarray  # (node,), of the losses after the node
    after: np.ndarray  # (edge,), trust after the edge from `hi`
    loss: np.ndarray  # (edge,), its loss


class ToGo(NamedTuple):
    """Least cost from each node to the goal at some price, (node,)."""

    price: np.ndarray  # (edge,), toll with the price of risk
    best: np.ndarray
    second: np.ndarray  # by another first move than that of `best`
    by: np.ndarray  # first move of `best`, -1 at the goal


@_compiled
def safest_to_go(layers: Layers, of_bounds: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Least sum of each risk (bound, resource) from each node to the goal, (node, resource)."""
    n_nodes, n_risks = len(layers.cell), of_bounds.shape[1]
    safest = np.empty((n_nodes, n_risks))
    for node in range(n_nodes):
        for k in range(n_risks):
            safest[node, k] = 0.0 if layers.left[node] == 0 else np.inf
        for e in range(layers.first[node], layers.first[node + 1]):
            h, b = layers.head[e], bound[e]
            for k in range(n_risks):
                safest[node, k] = min(safest[node, k], of_bounds[b, k] + safest[h, k])
    return safest


@_part
def any_start(layers: Layers, bounds: Bounds, risk: EdgeRisk) -> bool:
    """Whether the safest path, resource by resource, could be feasible."""
    nothing = np.zeros(len(risk.limits))
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            if can_be_feasible(risk, nothing, node):
                return True
    return False


@_part
def can_be_feasible(risk: EdgeRisk, so_far: np.ndarray, node: int) -> bool:
    """Whether enough risks, summed up to a node, can stay within their limits."""
    within = 0
    for k in range(len(risk.limits)):
        if so_far[k] + risk.safest[node, k] <= risk.limits[k]:
            within += 1
    return within >= risk.needed


@_part
def loss_of(law: int, x: float, sd: float) -> float:
    """Loss of a bound after which trust is x, under noise of that sd."""
    if law == NONE:
        return 0.0
    if law == LEAST:
        return -x
    if law == SOFTPLUS:
        return max(-x, 0.0) + math.log1p(math.exp(-abs(x)))
    return expected_loss(law, x, sd)


@_part
def _slope(law, lo, hi, sd):
    """Least fall of the loss with trust, between lo and hi."""
    if law == NONE or law == LEAST:
        return 0.0
    if law == SOFTPLUS:
        return 1.0 / (1.0 + math.exp(hi)) if hi < 700.0 else 0.0
    return least_slope(law, lo, hi, sd)


@_part
def joined(law: int, loss: float, to_come: float) -> float:
    """Loss so far and to come, together."""
    return max(loss, to_come) if law == LEAST else loss + to_come


@_part
def look_ahead(layers: Layers, bounds: Bounds) -> Ahead:
    """Trust at the nodes, from the start on, then what its lack costs, from the goal on."""
    n_nodes, n_edges, law = len(layers.cell), len(layers.head), bounds.law
    hi, lo, slope = np.full(n_nodes, -np.inf), np.full(n_nodes, np.inf), np.zeros(n_nodes)
    after, loss = np.zeros(n_edges), np.zeros(n_edges)
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            hi[node] = lo[node] = bounds.x0
    for node in range(n_nodes - 1, -1, -1):
        if hi[node] == -np.inf:  # on no path
            continue
        for e in range(layers.first[node], layers.first[node + 1]):
            h = layers.head[e]
            after[e] = bounds.beta0 * hi[node] + bounds.drift[e]
            loss[e] = loss_of(law, after[e], bounds.noise_sd)
            hi[h] = max(hi[h], after[e])
            lo[h] = min(lo[h], bounds.beta0 * lo[node] + bounds.drift[e])
    if law != NONE and law != LEAST:
        own = np.zeros(n_nodes)
        for node in range(n_nodes):
            if hi[node] == -np.inf:
                continue
            own[node] = _slope(law, lo[node], hi[node], bounds.noise_sd)
            least = 0.0 if layers.left[node] == 0 else np.inf
            for e in range(layers.first[node], layers.first[node + 1]):
                h = layers.head[e]
                least = min(least, own[h] + slope[h])
            slope[node] = bounds.beta0 * least if least < np.inf else 0.0
    return Ahead(hi, slope, after, loss)


@_part
def pass_back(layers: Layers, law: int, ahead: Ahead, price: np.ndarray) -> ToGo:
    """Compute the least cost to go of every node at a price, in the order of the bounds left."""
    n_nodes = len(layers.cell)
    to_go = ToGo(
        price, np.full(n_nodes, np.inf), np.full(n_nodes, np.inf), np.full(n_nodes, -1, np.int8)
    )
    for node in range(n_nodes):
        if layers.left[node] == 0:
            to_go.best[node] = to_go.second[node] = -np.inf if law == LEAST else 0.0
            continue
        if ahead.hi[node] == -np.inf:
            continue
        for e in range(layers.first[node], layers.first[node + 1]):
            h, m = layers.head[e], layers.move[e]
            to_come = least_to_come(layers, to_go, h, m) + ahead.slope[h] * (
                ahead.hi[h] - ahead.after[e]
            )
            total = price[e] + joined(law, ahead.loss[e], to_come)
            if total < to_go.best[node]:
                to_go.second[node] = to_go.best[node]
                to_go.best[node], to_go.by[node] = total, m
            elif total < to_go.second[node]:
                to_go.second[node] = total
    return to_go


@_part
def least_to_come(layers: Layers, to_go: ToGo, node: int, move: int) -> float:
    """Least cost after a node that was entered by a move, from the largest trust."""
    if layers.u_turns or to_go.by[node] != layers.n_moves - 1 - move:
        return to_go.best[node]
    return to_go.second[node]


@_part
def least_trust(layers: Layers, bounds: Bounds, aim: float) -> np.ndarray:
    """Least trust at nodes with which losses -x can stay below an aim, (node,); else infinite."""
    need = np.full(len(layers.cell), np.inf)
    for node in range(len(need)):
        if layers.left[node] == 0:
            need[node] = -aim
        for e in range(layers.first[node], layers.first[node + 1]):
            lack = need[layers.head[e]] - bounds.drift[e]
            if bounds.beta0 > 0.0:
                need[node] = min(need[node], lack / bounds.beta0)
            elif lack <= 0.0:
                need[node] = -np.inf
        need[node] = max(need[node], -aim)
    return need


@_part
def with_safest(layers: Layers, bounds: Bounds, risk: EdgeRisk, need: np.ndarray) -> EdgeRisk:
    """Replace the safest completions by those over edges which leave the trust that nodes need."""
    n_nodes, n_risks = len(layers.cell), len(risk.limits)
    hi, safest = np.full(n_nodes, -np.inf), np.full((n_nodes, n_risks), np.inf)
    for length in range(len(layers.starts)):
        node = layers.starts[length]
        if node >= 0 and bounds.start_cost[length] < np.inf:
            hi[node] = bounds.x0
    for node in range(n_nodes - 1, -1, -1):
        for e in range(layers.first[node], layers.first[node + 1]):
            h, x = layers.head[e], bounds.beta0 * hi[node] + bounds.drift[e]
            hi[h] = max(hi[h], x) if x >= need[h] else hi[h]
    for node in range(n_nodes):
        if layers.left[node] == 0:
            safest[node, :] = 0.0
        for e in range(layers.first[node], layers.first[node + 1]):
            h, b = layers.head[e], risk.bound[e]
            if bounds.beta0 * hi[node] + bounds.drift[e] >= need[h]:
                for k in range(n_risks):
                    safest[node, k] = min(safest[node, k], risk.of_bounds[b, k] + safest[h, k])
    return EdgeRisk(
        risk.of_bounds,
        risk.bound,
        risk.priced,
        risk.priced_limit,
        risk.limits,
        risk.needed,
        risk.failure_cost,
        safest,
    )
