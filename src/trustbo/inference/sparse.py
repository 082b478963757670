"""Sparse Cholesky factors of precision matrices that have equal patterns at all points.

A precision matrix A has few nonzero entries, because a coefficient occurs in few missions and
contrasts between robots are nearly orthogonal. Columns are eliminated by minimum degree, which
keeps the factor sparse, until the rest is nearly dense. With the columns in this order, A = U'U.

Consecutive columns with the same pattern form a *panel*, whose rows of U are stored together:
first the columns of the panel, then the later columns that they are coupled to. The last panel
contains the dense rest, which LAPACK factors. A and U have the same layout.

All points share the pattern, so the kernels treat all of them at once. The points vary fastest in
memory: arrays of entries have the shape (entry, point), and each operation is a loop over points,
which compilers turn into vector instructions.
"""

from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import lapack

from trustbo.inference.factor import log_diagonal, upper
from trustbo.kernels import kernel
from trustbo.parallel import plain

_LAPACK_SPEED = 8.0
"""Operations of LAPACK in the time of one operation of the kernels."""


class Order(NamedTuple):
    """Order in which columns are eliminated, and layout of the panels in a vector of entries."""

    column: np.ndarray  # (column,), in the order of elimination
    place: np.ndarray  # (column,), place of each column in this order
    panel: np.ndarray  # (place,), panel of each column
    first: np.ndarray  # (panel + 1,), first place of each panel
    start: np.ndarray  # (panel + 1,), where the pattern of each panel starts in `pattern`
    pattern: np.ndarray  # places of the columns of each panel
    row: np.ndarray  # (place,), entry of each row at the first place of its panel's pattern
    diagonal: np.ndarray  # (place,), entries of the diagonal
    size: int  # number of stored entries

    @classmethod
    def from_pattern(cls, coupled: np.ndarray) -> Self:
        """Order the columns, given which pairs of columns (column, column) are coupled."""
        filled = coupled.copy()
        np.fill_diagonal(filled, False)
        column, degree = _minimum_degree(filled)
        n = len(column)

        # Operations of the kernels before each column, and of LAPACK from there on.
        sparse = np.cumsum([0.0, *(degree + 1.0) ** 2])
        dense = np.arange(n, -1.0, -1.0) ** 3 / (3.0 * _LAPACK_SPEED)
        n_sparse = int(np.argmin((sparse + dense)[:-1]))  # LAPACK gets at least one column

        place = np.empty(n, dtype=np.int64)
        place[column] = np.arange(n)
        first = [0]
        patterns = []
        before = np.empty(0, dtype=np.int64)
        for k in range(n_sparse):
            own = np.sort(place[filled[column[k]]])
            own = np.append(k, own[own > k])
            if not np.array_equal(before, own):
                if k:
                    first.append(k)
                patterns.append(own)
            before = own[1:]

        if n_sparse:
            first.append(n_sparse)
        first.append(n)
        patterns.append(np.arange(n_sparse, n))

        widths = np.diff(first)
        lengths = np.array([len(pattern) for pattern in patterns])

        # Rows are stored one after another, beginning with their diagonal.
        within = np.arange(n) - np.repeat(first[:-1], widths)
        stored = np.repeat(lengths, widths) - within
        ends = np.cumsum(stored)
        return cls(
            column=column,
            place=place,
            panel=np.repeat(np.arange(len(widths)), widths),
            first=np.array(first),
            start=np.append(0, np.cumsum(lengths)),
            pattern=np.concatenate(patterns),
            row=ends - stored - within,
            diagonal=ends - stored,
            size=int(ends[-1]),
        )

    @property
    def n_dense(self) -> int:
        """Number of columns that LAPACK eliminates."""
        return int(self.first[-1] - self.first[-2])

    def entry(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the index of precision entries (a, b), or -1 where (b, a) is stored instead.

        The pairs of columns must be coupled.
        """
        i = self.place[a]
        j = self.place[b]
        panel = self.panel[i]

        # The patterns of all panels are sorted by panel and place, so one search finds all entries.
        n = len(self.column)
        lengths = np.diff(self.start)
        keys = np.repeat(np.arange(len(lengths)), lengths) * n + self.pattern
        at = np.searchsorted(keys, panel * n + j) - self.start[panel]
        return np.where(i <= j, self.row[i] + at, -1)

    @property
    def dense(self) -> int:
        """First entry of the last panel, which has the upper triangle of a matrix."""
        return self.size - self.n_dense * (self.n_dense + 1) // 2

    @property
    def layout(self) -> tuple[np.ndarray, ...]:
        """Arrays that the kernels need."""
        return self.panel, self.first, self.start, self.pattern, self.row


class Factor(NamedTuple):
    """Factor F = U' of the precision at each point; whitened vectors are in the eliminated order.

    Where a precision is not positive definite, the factor is NaN.
    """

    order: Order
    U: np.ndarray  # (entry, point), without the last panel
    H: np.ndarray  # (point, dense, dense), upper triangles of the last panel

    @classmethod
    def from_precision(cls, order: Order, A: np.ndarray) -> Self:
        """Factor precisions A (entry, point), which are overwritten."""
        _eliminate(A, *order.layout)
        H = np.empty((A.shape[1], order.n_dense, order.n_dense))
        _copy_dense(A[order.dense :], H)
        return cls(order, A, upper_factor(H))

    @property
    def size(self) -> int:
        """Length of a whitened vector."""
        return len(self.order.column)

    @property
    def log_det(self) -> np.ndarray:
        """Log determinant (point,) of F."""
        diagonal = self.U[self.order.diagonal[: -self.order.n_dense]]
        return np.log(diagonal).sum(0) + log_diagonal(self.H)

    def forward(self, h: np.ndarray) -> np.ndarray:
        """Compute whitened vectors F^-1 h from vectors h (point, column)."""
        order = self.order
        x = plain(h.T[order.column])
        _forward(self.U, x, *order.layout)

        white = plain(x.T)
        dense = white[:, None, -order.n_dense :]
        dense[:] = solve_upper(self.H, dense, transposed=True)
        return white

    def back(self, white: np.ndarray) -> np.ndarray:
        """Compute vectors F'^-1 w (point, draw, column) from whitened w (point, draw, place)."""
        order = self.order
        x = plain(white.transpose(2, 1, 0))
        dense = solve_upper(self.H, white[..., -order.n_dense :], transposed=False)
        x[-order.n_dense :] = dense.transpose(2, 1, 0)
        _back(self.U, x, *order.layout)
        return plain(x[order.place].transpose(2, 1, 0))

    def covariance(self) -> np.ndarray:
        """Compute A^-1 (entry, point) at the stored entries, with halved diagonals."""
        order = self.order
        Z = self.U.copy()
        dense = self.H.copy()
        for one in dense:
            lapack.dpotri(one.T, lower=1, overwrite_c=1)  # pyright: ignore[reportAttributeAccessIssue]
        Z[order.dense :] = dense[:, *upper(order.n_dense)].T
        _invert(Z, *order.layout)
        Z[order.diagonal] *= 0.5
        return Z


def upper_factor(A: np.ndarray) -> np.ndarray:
    """Factor A = H' H with upper H in place; NaN where A is not positive definite."""
    for one in A:  # `one.T` has LAPACK's memory order
        _, failed = lapack.dpotrf(one.T, lower=1, clean=0, overwrite_a=1)  # pyright: ignore[reportAttributeAccessIssue]
        if failed:
            one[:] = np.nan
    return A


def solve_upper(H: np.ndarray, x: np.ndarray, *, transposed: bool) -> np.ndarray:
    """Solve H y = x or H' y = x for upper triangles H (point, n, n) and x (point, draw, n)."""
    trans = 0 if transposed else 1  # LAPACK sees the transposed matrices, as it stores columns
    pairs = zip(H, x, strict=True)
    return np.stack([lapack.dtrtrs(h.T, y.T, lower=1, trans=trans)[0].T for h, y in pairs])  # pyright: ignore[reportAttributeAccessIssue]


@kernel()
def _minimum_degree(coupled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Order columns such that each one is coupled to as few later columns as possible.

    Args:
        coupled: Which pairs of columns are coupled, except for the diagonal. The pairs that become
            coupled are added.

    Returns:
        The columns in order, and the number of later columns that each is coupled to.
    """
    n = len(coupled)
    degree = np.zeros(n, dtype=np.int64)
    for i in range(n):
        for j in range(n):
            degree[i] += coupled[i, j]

    column = np.empty(n, dtype=np.int64)
    of_column = np.empty(n)
    is_left = np.ones(n, dtype=np.bool_)
    others = np.empty(n, dtype=np.int64)
    for k in range(n):
        chosen = -1
        for i in range(n):
            if is_left[i] and (chosen < 0 or degree[i] < degree[chosen]):
                chosen = i
        column[k] = chosen
        of_column[k] = degree[chosen]
        is_left[chosen] = False

        n_others = 0
        for j in range(n):
            if is_left[j] and coupled[chosen, j]:
                others[n_others] = j
                degree[j] -= 1
                n_others += 1

        for a in range(n_others):
            i = others[a]
            for b in range(a):
                j = others[b]
                if not coupled[i, j]:
                    coupled[i, j] = True
                    coupled[j, i] = True
                    degree[i] += 1
                    degree[j] += 1
    return column, of_column


@kernel(fastmath={"contract"})
def _eliminate(
    U: np.ndarray,
    panel: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    pattern: np.ndarray,
    row: np.ndarray,
) -> None:
    """Factor all panels but the last, and subtract their products from the last panel."""
    n_points = U.shape[1]
    inverse = np.empty(n_points)
    where = np.empty(len(panel), dtype=np.int64)
    for s in range(len(first) - 2):
        w = first[s + 1] - first[s]
        r = start[s + 1] - start[s]
        own = pattern[start[s] : start[s + 1]]

        # The rows of the panel.
        for k in range(w):
            a = row[first[s] + k]
            for p in range(n_points):
                pivot = np.sqrt(U[a + k, p])
                inverse[p] = 1.0 / pivot
                U[a + k, p] = pivot
            for j in range(k + 1, r):
                for p in range(n_points):
                    U[a + j, p] *= inverse[p]
            for i in range(k + 1, w):
                b = row[first[s] + i]
                for j in range(i, r):
                    for p in range(n_points):
                        U[b + j, p] -= U[a + i, p] * U[a + j, p]

        # Products of later columns i and j, which are subtracted from the panel of i.
        i = w
        while i < r:
            t = panel[own[i]]
            length = start[t + 1] - start[t]
            for m in range(length):
                where[pattern[start[t] + m]] = m

            while i < r and panel[own[i]] == t:
                for j in range(i, r):
                    at = row[own[i]] + where[own[j]]
                    k = first[s]
                    while k + 4 <= first[s + 1]:  # four at once, to store each sum less often
                        a = row[k]
                        b = row[k + 1]
                        c = row[k + 2]
                        d = row[k + 3]
                        for p in range(n_points):
                            U[at, p] -= (
                                U[a + i, p] * U[a + j, p]
                                + U[b + i, p] * U[b + j, p]
                                + U[c + i, p] * U[c + j, p]
                                + U[d + i, p] * U[d + j, p]
                            )
                        k += 4
                    while k < first[s + 1]:
                        a = row[k]
                        for p in range(n_points):
                            U[at, p] -= U[a + i, p] * U[a + j, p]
                        k += 1
                i += 1


@kernel()
def _copy_dense(A: np.ndarray, H: np.ndarray) -> None:
    """Copy the upper triangles of matrices A (entry, point) to H (point, n, n)."""
    n_points, n, _ = H.shape
    row = 0
    for i in range(n):
        for p in range(n_points):
            for j in range(i, n):
                H[p, i, j] = A[row + j - i, p]
        row += n - i


@kernel(fastmath={"contract"})
def _forward(
    U: np.ndarray,
    x: np.ndarray,
    panel: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    pattern: np.ndarray,
    row: np.ndarray,
) -> None:
    """Solve U' y = x (place, point) in place, except for the last panel."""
    n_points = U.shape[1]
    for s in range(len(first) - 2):
        r = start[s + 1] - start[s]
        for k in range(first[s + 1] - first[s]):
            one = first[s] + k
            a = row[one]
            for p in range(n_points):
                x[one, p] /= U[a + k, p]
            for j in range(k + 1, r):
                other = pattern[start[s] + j]
                for p in range(n_points):
                    x[other, p] -= U[a + j, p] * x[one, p]


@kernel(fastmath={"contract"})
def _back(
    U: np.ndarray,
    x: np.ndarray,
    panel: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    pattern: np.ndarray,
    row: np.ndarray,
) -> None:
    """Solve U y = x (place, draw, point) in place, given the solution of the last panel."""
    _, n_draws, n_points = x.shape
    for s in range(len(first) - 3, -1, -1):
        r = start[s + 1] - start[s]
        for k in range(first[s + 1] - first[s] - 1, -1, -1):
            one = first[s] + k
            a = row[one]
            for j in range(k + 1, r):
                other = pattern[start[s] + j]
                for d in range(n_draws):
                    for p in range(n_points):
                        x[one, d, p] -= U[a + j, p] * x[other, d, p]
            for d in range(n_draws):
                for p in range(n_points):
                    x[one, d, p] /= U[a + k, p]


@kernel(fastmath={"contract"})
def _invert(
    Z: np.ndarray,
    panel: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    pattern: np.ndarray,
    row: np.ndarray,
) -> None:
    """Replace U by the entries of (U'U)^-1, given those of the last panel (Takahashi 1973).

    For a panel J with later columns R, T = U_JJ^-1 U_JR, Z_JR = -T Z_RR and Z_JJ = (U_JJ' U_JJ)^-1
    - Z_JR T'.
    """
    n_points = Z.shape[1]
    widest = 1
    longest = 1
    for s in range(len(first) - 2):
        w = first[s + 1] - first[s]
        widest = max(widest, w)
        longest = max(longest, start[s + 1] - start[s] - w)
    M = np.empty((longest, longest, n_points))  # Z_RR
    T = np.empty((widest, longest, n_points))
    V = np.empty((widest, widest, n_points))  # U_JJ^-1
    where = np.empty(len(panel), dtype=np.int64)

    for s in range(len(first) - 3, -1, -1):
        w = first[s + 1] - first[s]
        r = start[s + 1] - start[s]
        own = pattern[start[s] + w : start[s + 1]]  # R
        m = len(own)

        i = 0
        while i < m:
            t = panel[own[i]]
            length = start[t + 1] - start[t]
            for j in range(length):
                where[pattern[start[t] + j]] = j
            while i < m and panel[own[i]] == t:
                for j in range(i, m):
                    for p in range(n_points):
                        M[i, j, p] = M[j, i, p] = Z[row[own[i]] + where[own[j]], p]
                i += 1

        for k in range(w - 1, -1, -1):
            a = row[first[s] + k]
            for j in range(m):
                for p in range(n_points):
                    T[k, j, p] = Z[a + w + j, p]
            V[k, :w] = 0.0
            V[k, k] = 1.0
            for i in range(k + 1, w):
                for j in range(m):
                    for p in range(n_points):
                        T[k, j, p] -= Z[a + i, p] * T[i, j, p]
                for j in range(i, w):
                    for p in range(n_points):
                        V[k, j, p] -= Z[a + i, p] * V[i, j, p]
            for j in range(m):
                for p in range(n_points):
                    T[k, j, p] /= Z[a + k, p]
            for j in range(k, w):
                for p in range(n_points):
                    V[k, j, p] /= Z[a + k, p]

        for k in range(w):
            a = row[first[s] + k]
            Z[a + k : a + r] = 0.0
            for i in range(m):
                for j in range(m):
                    for p in range(n_points):
                        Z[a + w + j, p] -= T[k, i, p] * M[i, j, p]
            for j in range(k, w):
                for i in range(j, w):
                    for p in range(n_points):
                        Z[a + j, p] += V[k, i, p] * V[j, i, p]
                for i in range(m):
                    for p in range(n_points):
                        Z[a + j, p] -= Z[a + w + i, p] * T[j, i, p]
