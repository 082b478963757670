"""Prior of the effects of visited places: the precision of their sum at each visited bound.

g = B s + e, B naming the cell each bound enters, s ~ N(0, tau_s^2 K), e ~ N(0, tau_e^2 I). With n_c
bounds into cell c, W = diag(sqrt(n_c)) and M = tau_e^2 I + tau_s^2 W K W (Woodbury):

    K_g^-1 = tau_e^-2 (I - B N_c^-1 B') + B W^-1 M^-1 W^-1 B'
    log |K_g| = 2 (D - C) log tau_e + log |M|

so that D visited bounds cost one factor of C visited cells. Without bounds' effects the units are
cells, n_c = 1, and tau_e is only a jitter; without cells' effects tau_s = 0.
"""

import numba as nb
import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs  # pyright: ignore

from trustbo.models.place import matern

JITTER = 1e-4
"""Lower limit of tau_e in units of tau_s or the noise: below, K_g is singular to rounding."""
LENGTH_SCALES = 1e-6, 1e6
"""Lower and upper limit of the length scale, in cells: outside, cells are independent, or equal."""

_compiled = nb.njit(cache=True, error_model="numpy")


def correlation(places: np.ndarray, others: np.ndarray, length_scale: float) -> np.ndarray:
    """Correlation of s between cells (cell, 3) and others (other, 3): robot, row, col."""
    gap = places[:, None].astype(float) - others[None]
    return matern(np.hypot(gap[..., 1], gap[..., 2]), length_scale) * (gap[..., 0] == 0)


@_compiled
def fill_cells(M, cells, shape, w, tau_s, length_scale, tau_e):
    """Lower triangle of M = tau_e^2 I + tau_s^2 W K W; cells (cell, 3)."""
    table = np.empty(shape)
    for i in range(shape[0]):
        for j in range(shape[1]):
            h = np.sqrt(3.0 * (i * i + j * j)) / length_scale
            table[i, j] = tau_s**2 * (1.0 + h) * np.exp(-h)
    for i in range(len(cells)):
        for j in range(i + 1):
            M[i, j] = 0.0
            if cells[i, 0] == cells[j, 0]:
                down, right = abs(cells[i, 1] - cells[j, 1]), abs(cells[i, 2] - cells[j, 2])
                M[i, j] = w[i] * w[j] * table[down, right]
        M[i, i] += tau_e**2


@_compiled
def fill_units(A, M_inverse, cell_of, n_c, tau_e):
    """Lower triangle of K_g^-1, from that of M^-1."""
    for i in range(len(cell_of)):
        ci = cell_of[i]
        for j in range(i + 1):
            cj = cell_of[j]
            A[i, j] = M_inverse[max(ci, cj), min(ci, cj)] / np.sqrt(n_c[ci] * n_c[cj])
            if ci == cj:
                A[i, j] += tau_e**-2 * ((i == j) - 1.0 / n_c[ci])


@_compiled
def add_rows(A, h, S, R, a, weight, length, kind, unit):
    """Add the rows' information on g: lower triangle A += sum w a^2 S, h (c, unit) += sum w a R."""
    for s in range(len(a)):
        if a[s] > 0.0:
            w = weight[s]
            for k in range(length[s]):
                i = unit[s, k]
                for j in range(k + 1):
                    o, v = unit[s, j], w * a[s] ** 2 * S[kind[s], k, j]
                    A[max(i, o), min(i, o)] += 2.0 * v if i == o and j < k else v
                for c in range(R.shape[2]):
                    h[c, i] += w * a[s] * R[s, k, c]


def factor(A: np.ndarray) -> bool:
    """Cholesky's factor of A's lower triangle, in place; whether it failed.

    LAPACK sees rows as columns: A.T is its upper triangle, without a copy.
    """
    return dpotrf(A.T, lower=0, clean=0, overwrite_a=1)[1] != 0


def invert(A: np.ndarray) -> None:
    """Lower triangle of the inverse, in place, of a matrix factored by `factor`."""
    dpotri(A.T, lower=0, overwrite_c=1)


def solve(L: np.ndarray, b: np.ndarray, *, transposed: bool = False) -> np.ndarray:
    """L^-1 or L'^-1 of each row of b (row, unit)."""
    return dtrtrs(L.T, b.T, lower=0, trans=0 if transposed else 1)[0].T
