"""Elimination of columns of one chain each, whose coefficients fade from one to the next.

A set of such columns has c_j = mean + sd (sqrt(share) a_j + sqrt(1 - share) d_j), d white and a an
AR(1) process of unit variance and correlation rho, of precision Lambda, which is tridiagonal and
free of theta. D_j is the information of the rates on c_j, x_j the products of its column with those
left and with the rates. A column shares its chain with no other of these, so that

1. d_j, of the day: g_j = 1 + sd^2 (1 - share) D_j; products left fall by z'z, z = sd
   sqrt(1 - share) x_j / sqrt(g_j), and D_j, x_j become D_j / g_j, x_j / g_j.
2. a: T = Lambda + share sd^2 diag(D / g), tridiagonal, = L L'; products left fall by Z'Z,
   Z = L^-1 sqrt(share) sd x / g, a recursion over the set.
3. The determinant of I + R'AR of the set is |T| / |Lambda| times all g_j.

No scale is inverted: of 0 they leave z = Z = 0 and g = 1. A set of n columns costs n times the
number of columns left, where a dense factor costs n^2 times it.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numba as nb
import numpy as np
from scipy import sparse

from trustbo.models.effects.effect import Columns, Fading

_compiled = nb.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})


class Sets(NamedTuple):
    """Sets of fading columns, which come before all others."""

    first: np.ndarray  # (set + 1,), the first column of each
    chain: np.ndarray  # (column,), -1 where a column has no rates
    profile: np.ndarray  # (column, bound), the column at the slots of its chain
    of_slots: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Rows of the columns left, compressed: first entry of each slot, column, value."""

    @classmethod
    def of(cls, first: np.ndarray, U: Columns, n_chains: int) -> Self:
        """Sets whose columns start at `first`, of columns U (slot, column)."""
        n, K = int(first[-1]), U.shape[0] // n_chains
        profile, chain = np.zeros((n, K)), np.full(n, -1)
        entries = U[:, :n].tocoo()
        chain[entries.col] = entries.row // K
        profile[entries.col, entries.row % K] = entries.data
        left = sparse.csr_array(U[:, n:])
        of_slots = left.indptr.astype(np.int64), left.indices.astype(np.int64), left.data
        return cls(first, chain, profile, of_slots)


class Eliminated(NamedTuple):
    """Factors of the eliminated columns at each of some points."""

    slow: np.ndarray  # (point, column), sd sqrt(share)
    day: np.ndarray  # (point, column), sd sqrt(1 - share)
    D: np.ndarray  # (point, column)
    g: np.ndarray  # (point, column)
    L: np.ndarray  # (point, 2, column), diagonal and what is left of it
    Z: np.ndarray  # (point, 2 columns, column left), a's first, the rates' last
    log_det: np.ndarray  # (point,)


def eliminate(
    sets: Sets, P: np.ndarray, h: np.ndarray, S: np.ndarray, kind: np.ndarray, weight: np.ndarray,
    sd: np.ndarray, roots: Sequence[Fading],
) -> Eliminated:  # fmt: skip
    """Take fading columns out of the products P (point, column left, column left), in place.

    Args:
        sets: Columns to eliminate.
        P: Products of the columns left and the rates.
        h: Products of the columns eliminated with the rates, (point, column).
        S: See `gaussian`, (point, kind, bound, bound).
        kind: Kind of each chain.
        weight: Weight of each chain.
        sd: Sds of the columns eliminated, (point, column).
        roots: Correlation of each set.
    """
    n, f = sd.shape
    share = np.empty((n, f))
    for root, i, j in zip(roots, sets.first[:-1], sets.first[1:], strict=True):
        share[:, i:j] = root.share[:, None]
    rho = np.array([root.rho for root in roots])
    out = Eliminated(
        sd * np.sqrt(share), sd * np.sqrt(1.0 - share), np.zeros((n, f)), np.ones((n, f)),
        np.zeros((n, 2, f)), np.zeros((n, 2 * f, P.shape[1])), np.zeros(n),
    )  # fmt: skip
    _eliminate(h, S, kind, weight, rho, *sets[:-1], *sets.of_slots, *out)
    P -= np.swapaxes(out.Z, 1, 2) @ out.Z
    return out


@_compiled
def _eliminate(
    h, S, kind, weight, rho, first, chain, profile, row, column, value,
    slow, day, D, g, L, Z, log_det,
):  # fmt: skip
    n = len(chain)
    for t in range(len(h)):
        for s in range(len(first) - 1):
            r = rho[s]
            alone, off = 1.0 / (1.0 - r * r), -r / (1.0 - r * r)
            log_det[t] += (first[s + 1] - first[s] - 1) * np.log(1.0 - r * r)
            for j in range(first[s], first[s + 1]):
                c, x = chain[j], Z[t, n + j]
                if c >= 0:
                    D[t, j] = _take_products(
                        x, S[t, kind[c]], weight[c], profile[j], c, row, column, value
                    )
                    x[-1] = h[t, j]
                g[t, j] = 1.0 + day[t, j] ** 2 * D[t, j]
                of_slow, of_day = slow[t, j] / g[t, j], day[t, j] / np.sqrt(g[t, j])
                for i in range(len(x)):
                    Z[t, j, i] = of_slow * x[i]
                    x[i] *= of_day
                # Lambda: both ends have one neighbour, and a column alone has none.
                is_first, is_last = j == first[s], j + 1 == first[s + 1]
                diagonal = alone * (1.0 + r * r * (1.0 - is_first - is_last))
                diagonal += slow[t, j] * of_slow * D[t, j]
                if not is_first:
                    L[t, 1, j] = off / L[t, 0, j - 1]
                    diagonal -= L[t, 1, j] ** 2
                L[t, 0, j] = np.sqrt(diagonal)
                below = L[t, 1, j] if j > first[s] else 0.0
                scale, last = 1.0 / L[t, 0, j], max(j - 1, 0)
                for i in range(len(x)):
                    Z[t, j, i] = scale * (Z[t, j, i] - below * Z[t, last, i])
                log_det[t] += np.log(diagonal * g[t, j])


@_compiled
def _take_products(x, S, weight, profile, c, row, column, value):
    """D of a column of chain c; adds the products x with the columns left."""
    D, K = 0.0, len(profile)
    for k in range(K):
        v = 0.0
        for i in range(K):
            v += S[k, i] * profile[i]
        v *= weight
        D += v * profile[k]
        for e in range(row[c * K + k], row[c * K + k + 1]):
            x[column[e]] += v * value[e]
    return D


def spread(out: Eliminated, sets: Sets, t: int, white: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Coefficients less their means of fading columns, (column, draw), at the t-th point.

    Args:
        out: See `eliminate`.
        sets: Columns eliminated.
        t: Index of the point.
        white: Independent normal numbers (2 columns, draw), a's first, of means Z's last column.
        left: Coefficients less their means of the columns left (column left, draw).
    """
    rest = white - out.Z[t, :, :-1] @ left
    return _spread(rest, sets.first, out.slow[t], out.day[t], out.D[t], out.g[t], out.L[t])


@_compiled
def _spread(rest, first, slow, day, D, g, L):
    n = len(D)
    c = np.empty((n, rest.shape[1]))
    for i in range(rest.shape[1]):
        for s in range(len(first) - 1):
            a = 0.0
            for j in range(first[s + 1] - 1, first[s] - 1, -1):
                below = L[1, j + 1] if j + 1 < first[s + 1] else 0.0
                a = (rest[j, i] - below * a) / L[0, j]
                root = np.sqrt(g[j])
                d = (rest[n + j, i] - day[j] * D[j] * slow[j] * a / root) / root
                c[j, i] = slow[j] * a + day[j] * d
    return c
