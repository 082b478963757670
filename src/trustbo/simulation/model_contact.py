"""Expected contact of a simulator that draws rates from a trust model, in closed form.

Trust has memory, so the contact of a bound depends on all bounds before it. Expected trust m and
its variance v roll by the Kalman recursion without measurements; v depends on the number of bounds
only. The expected rate is that of N(m, v + delta_v^2) clipped to [0, 1], or E[sigma(N(m, v))] for
counts. It rises with m, and m with the trust before: so of two paths to a bound in as many bounds,
one with less loss and at least as much trust of every robot dominates the other (label setting with
dominance; Martins 1984), and the best path found is exact.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from scipy.special import expit
from scipy.stats import norm

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.models.model import TrustModel
from trustbo.models.params import CoupledParams, Params
from trustbo.planning.dynamics import drift, roll_trust
from trustbo.planning.paths import AdmissiblePaths
from trustbo.workspace.moves import MOVES, along, move_indices, moves_along

_LAST = len(MOVES[8]) - 1
"""Move m is reversed by this less m."""
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(40)


class ModelContact:
    """Expected contact under true parameters and true awareness."""

    standard_error = 0.0

    def __init__(
        self,
        model: TrustModel,
        params: Params,
        awareness: np.ndarray,
        p_fail: np.ndarray | None = None,
    ) -> None:
        """Take one draw of parameters, awareness as `Workspace.bound_maps`, and chances to fail."""
        self._p_fail = p_fail
        self._counts = model.family.needs_ticks
        self._awareness, self._params, n_robots = awareness, params, len(awareness)
        self._transition = params.transition(n_robots)
        if isinstance(params, CoupledParams):
            process, observed = np.asarray(params.Delta_w), np.diagonal(params.Delta_v)
        else:
            noises = [np.broadcast_to(sd, n_robots) for sd in (params.delta_w, params.delta_v)]
            process, observed = np.diag(noises[0] ** 2), noises[1] ** 2
        self._noise = np.asarray(process, float), np.asarray(observed, float)

    def contact(self, path: Sequence[Cell]) -> np.ndarray:
        """Expected contact rates of the bounds of a path, shape (bound, robot)."""
        z = np.swapaxes(along(self._awareness, path), 0, 1)
        trust = roll_trust(self._params.along(path), z)
        return self._rate(trust, self._spread(len(trust)))

    def failure(self, path: Sequence[Cell]) -> np.ndarray:
        """Chance to fail of the bounds of a path, shape (bound,)."""
        if self._p_fail is None:
            return np.zeros(len(path) - 1)
        return self._p_fail[moves_along(path), *np.asarray(path)[1:].T]

    def best(self, paths: AdmissiblePaths, objective: str) -> tuple[Cell, ...]:
        """Best admissible path: least contact lost, or for "mean" the largest mean contact.

        TrustboError: a coefficient of past trust is negative, so that less trust may be better.
        """
        if (self._transition < 0.0).any():
            raise TrustboError(
                "the best path needs trust that rises with the trust before it; got "
                f"beta0 = {self._transition.tolist()}."
            )
        u, spread = drift(self._params, self._awareness), self._spread(paths.longest)
        u = u.reshape(*u.shape[:2], -1)  # (robot, move or 1, cell)
        cell, move = np.array([paths.flat(paths.start)]), np.array([-1])
        trust = np.full((1, len(u)), self._params.x0_mean, float)
        loss, steps = np.zeros(1), move_indices(paths.connectivity)
        layers: list[tuple[np.ndarray, np.ndarray]] = []  # cell and parent of the labels
        ends: list[tuple[float, int, int]] = []  # value, bounds and label of the best at the goal
        goal, to_goal = paths.flat(paths.goal), paths.bounds_to_goal.ravel()
        for k in range(paths.longest):
            other = paths.neighbours[cell]  # (label, move)
            left = to_goal[np.maximum(other, 0)]
            can = (other >= 0) & (left >= 0) & (left <= paths.longest - k - 1)
            can &= (cell != goal)[:, None]
            if not paths.u_turns:
                can &= steps != (_LAST - move)[:, None]
            parent, j = np.nonzero(can)
            cell, move = other[parent, j], steps[j]
            trust = trust[parent] @ self._transition.T + u[:, move % u.shape[1], cell].T
            loss = loss[parent] + 1.0 - self._rate(trust, spread[k : k + 1]).mean(1)
            key = cell if paths.u_turns else cell * len(MOVES[8]) + move
            order: Any = np.lexsort((-trust.sum(1), loss, key))
            kept = order[_undominated(key[order], trust[order])]
            cell, move, loss, trust = cell[kept], move[kept], loss[kept], trust[kept]
            layers.append((cell, parent[kept]))
            there = np.flatnonzero(cell == goal)
            if len(there):
                label = int(there[loss[there].argmin()])
                value = loss[label] / (k + 1.0 if objective == "mean" else 1.0)
                ends.append((float(value), k, label))
        _, k, label = min(ends)
        flat = []
        for cells, parents in layers[k::-1]:
            flat.append(cells[label])
            label = parents[label]
        return paths.start, *paths.cells(np.array(flat[::-1]))

    def _spread(self, n_bounds: int) -> np.ndarray:
        """Standard deviation of the measured quantity, shape (bound, robot)."""
        process, observed = self._noise
        covariance = np.eye(len(process)) * np.asarray(self._params.x0_sd, float) ** 2
        variances = []
        for _ in range(n_bounds):
            covariance = self._transition @ covariance @ self._transition.T + process
            variances.append(np.diagonal(covariance))
        return np.sqrt(np.stack(variances) + (0.0 if self._counts else observed))

    def _rate(self, trust: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Expected rate from expected trust and the standard deviation around it."""
        if self._counts:
            levels = trust[..., None] + spread[..., None] * _NODES
            return expit(levels) @ _WEIGHTS / _WEIGHTS.sum()
        spread = np.maximum(spread, 1e-12)
        low, high = -trust / spread, (1.0 - trust) / spread
        inside = norm.cdf(high) - norm.cdf(low)
        return trust * inside - spread * (norm.pdf(high) - norm.pdf(low)) + norm.sf(high)


@njit(cache=True, nogil=True)
def _undominated(key, trust):
    """Mask of labels, by key and loss, of which no other of their key has as much trust."""
    kept = np.zeros(len(key), np.bool_)
    first = 0
    for i in range(len(key)):
        if key[i] != key[first]:
            first = i
        kept[i] = True
        for j in range(first, i):
            if kept[j] and (trust[j] >= trust[i]).all():
                kept[i] = False
                break
    return kept
