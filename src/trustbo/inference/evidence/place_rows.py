"""Rates of missions as rows with independent noise, for models with place effects.

All robots share the effect g of a bound, so rates of different missions and robots depend on each
other through it. Given parameters, a row of rates is y = T (X c + a g) + noise, T_kj =
beta0^(k - j): trust carries an effect on. Robots of one mission with the same gaps have the same
noise, so that an orthogonal (Helmert) rotation of the n of them leaves it independent: their mean
times sqrt(n) sees sqrt(n) g, and n - 1 contrasts see no effect and no intercept, only awareness.

`filter_rows` gives, for many parameters at once, the sums from which everything else follows:
S = N'N with N = L^-1 T, L L' the noise's covariance; R = N' L^-1 (X, y); and G, the products of
L^-1 (X, y). A scalar Kalman filter applies L^-1: the innovations of a unit impulse at each bound
are the columns of N. A rate that is missing is a zero row of N.
Derivation: docs/derivations/places.md.
"""

from typing import NamedTuple

import numba as nb
import numpy as np
from scipy.linalg import helmert

from trustbo.models.place import Visited


class Rows(NamedTuple):
    """Rows of rates, those of one length and pattern of gaps together."""

    y: np.ndarray  # (row, bound), 0 where missing
    seen: np.ndarray  # (row, bound)
    X: np.ndarray  # (row, bound, coefficient + 1): features, intercept, x0_mean at the first bound
    a: np.ndarray  # (row,), how often a row sees the effect of its bounds: sqrt(n), or 0
    weight: np.ndarray  # (row,), of its mission
    unit: np.ndarray  # (row, bound), index of the effect, -1 beyond the end
    length: np.ndarray  # (row,), bounds up to the last rate
    kind: np.ndarray  # (row,), rows of one kind share length and gaps
    n_measured: float
    """Number of rates, weighted."""


def gather_rows(
    awareness: np.ndarray,
    contact_rate: np.ndarray,
    places: Visited,
    weight: np.ndarray,
    x0_mean: float,
) -> Rows:
    """Rows of awareness (mission, bound, robot, feature) and rates (mission, bound, robot)."""
    _, longest, n_robots, n_features = awareness.shape
    shared, rows = places.unit.shape[2] == 1, []
    for j, w in enumerate(weight):
        seen = ~np.isnan(contact_rate[j])
        groups: dict[bytes, list[int]] = {}
        for i in range(n_robots):
            if seen[:, i].any() and w > 0.0:
                robot_key = b"" if shared else bytes([i])
                groups.setdefault(seen[:, i].tobytes() + robot_key, []).append(i)
        for members in groups.values():
            mask, n = seen[:, members[0]], len(members)
            rotation = helmert(n, full=True)
            y = rotation @ np.where(mask[:, None], contact_rate[j][:, members], 0.0).T
            z = np.einsum("ij,kjf->ikf", rotation, awareness[j][:, members])
            unit = places.unit[j, :, 0 if shared else members[0]]
            length = int(np.flatnonzero(mask)[-1]) + 1
            for k in range(n):
                a = np.sqrt(n) * (k == 0)
                X = np.zeros((longest, n_features + 2))
                X[:, :n_features], X[:, n_features], X[0, -1] = z[k], a, a * x0_mean
                rows.append((y[k], mask, X, a, w, unit, length))
    rows.sort(key=lambda row: (row[-1], row[1].tobytes()))  # like rows share one factor
    y, seen, X, a, weights, unit, length = (np.array(column) for column in zip(*rows, strict=True))
    change = (np.diff(length) != 0) | (seen[1:] != seen[:-1]).any(1)
    kind = np.concatenate([[0], np.cumsum(change)])
    return Rows(y, seen, X, a, weights, unit, length, kind, float((weights @ seen).sum()))


@nb.njit(cache=True, error_model="numpy")
def filter_rows(theta, x0_sd, y, seen, X, a, weight, length, kind):
    """S (point, kind, K, K), R (point, row, K, c), G (point, c, c) and log |L L'| (point,).

    theta (point, 3): beta0, delta_w, delta_v. The columns c are those of X without the last, and
    then the rates less their mean from x0_mean alone.
    """
    n, (n_rows, K), q = len(theta), y.shape, X.shape[2]
    S = np.zeros((n, kind[-1] + 1, K, K))
    R, G, log_det = np.zeros((n, n_rows, K, q)), np.zeros((n, q, q)), np.zeros(n)
    N, white = np.zeros((K, K)), np.empty((K, q))
    gain, scale, m = np.empty(K), np.empty(K), np.empty(K)
    for t in range(n):
        beta0, Q, noise, of_row = theta[t, 0], theta[t, 1] ** 2, theta[t, 2] ** 2, 0.0
        for s in range(n_rows):
            n_bounds, w = length[s], weight[s]
            if s == 0 or kind[s] != kind[s - 1]:
                v, of_row = (beta0 * x0_sd) ** 2 + Q, 0.0
                for k in range(n_bounds):
                    m[k], gain[k], scale[k] = 1.0, 0.0, 0.0
                    if seen[s, k]:
                        F = v + noise
                        scale[k], gain[k] = 1.0 / np.sqrt(F), v / F
                        of_row += np.log(F)
                    for j in range(k + 1):
                        N[k, j] = m[j] * scale[k]
                        m[j] *= beta0 * (1.0 - gain[k])
                    v = beta0 * beta0 * v * (1.0 - gain[k]) + Q
                for k in range(n_bounds):
                    for j in range(k + 1):
                        z = 0.0
                        for i in range(k, n_bounds):
                            z += N[i, k] * N[i, j]
                        S[t, kind[s], k, j] = z
            log_det[t] += w * of_row
            mean = beta0 * X[s, 0, q - 1]
            for k in range(n_bounds):
                e = y[s, k] - mean
                white[k, q - 1] = e * scale[k]
                mean = beta0 * (mean + gain[k] * e)
                for x in range(q - 1):
                    z = 0.0
                    for j in range(k + 1):
                        z += N[k, j] * X[s, j, x]
                    white[k, x] = z
                for i in range(q):
                    for j in range(i + 1):
                        G[t, i, j] += w * white[k, i] * white[k, j]
                        G[t, j, i] = G[t, i, j]
            if a[s] > 0.0:
                for k in range(n_bounds):
                    for i in range(k, n_bounds):
                        for x in range(q):
                            R[t, s, k, x] += N[i, k] * white[i, x]
    return S, R, G, log_det
