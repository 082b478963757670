"""Cholesky factors of a precision matrix whose columns mostly belong to one mission.

Columns that are independent a priori and occur in only one mission, such as bounds visited once,
are *leaves*. All other columns are the *core*. Given the core, leaves of different missions are
independent. If leaves come first, the precision A = F F' and its factor F are

    A = [D  B ]    F = [G   0 ]    G G' = D,  X = G^-1 B,  H' H = C - X' X,
        [B' C ]        [X'  H']

where D and G are block diagonal, with one block per mission. Only H is a large dense factor. LAPACK
factors upper triangles fastest and in place, because its memory order is transposed.
"""

from typing import Any, NamedTuple, Self

import jax
import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from trustbo.models.backend import namespace


class Order(NamedTuple):
    """Order in which columns are eliminated, and the layout of D, B and C in one vector."""

    leaf: np.ndarray  # (mission, place), leaf columns, padded with the number of columns
    core: np.ndarray  # core columns
    group: np.ndarray  # (column,), mission of a leaf, -1 for the core
    place: np.ndarray  # (column,), index among the leaves of the mission, or in the core
    touched: np.ndarray  # (mission, number), places of core columns in a mission with leaves
    number: np.ndarray  # (mission, column), index in `touched`
    spread: Any  # sparse (core, mission * touched), sums the missions' terms of a vector
    pairs: Any  # sparse (pair, mission * touched * touched), sums the missions' terms of C
    pair: np.ndarray  # (pair,), flat index in C

    @classmethod
    def of(cls, met: np.ndarray, free: np.ndarray) -> Self:
        """Find the elimination order of the columns.

        Args:
            met: Mask (mission, column) of the columns that occur in each mission.
            free: Mask (column,) of the columns that are independent of all others a priori.
        """
        n_missions = len(met)
        alone = free & (met.sum(0) == 1) & (n_missions > 1)
        only = np.where(alone, met.argmax(0), -1)
        place = np.empty(len(only), dtype=int)
        groups = [np.flatnonzero(only == j) for j in range(-1, n_missions)]
        for columns in groups:
            place[columns] = np.arange(len(columns))
        groups = [groups[0], *(columns for columns in groups[1:] if len(columns))]
        leaf = np.full((len(groups) - 1, max(map(len, groups[1:]), default=1)), len(only))
        group = np.full(len(only), -1)
        of_mission = [np.empty(0, dtype=int)]
        for g, columns in enumerate(groups[1:]):
            leaf[g, : len(columns)], group[columns] = columns, g
            of_mission.append(np.flatnonzero(met[only[columns[0]], groups[0]]))
        touched = np.full((len(leaf), max(map(len, of_mission))), len(groups[0]))
        number = np.full((len(leaf), len(only)), -1)
        for g, places in enumerate(of_mission[1:]):
            touched[g, : len(places)] = places
            number[g, groups[0][places]] = np.arange(len(places))
        q, flat = len(groups[0]), touched.ravel()
        spread = _summing(flat, np.flatnonzero(flat < q), q)
        a, b = np.broadcast_arrays(touched[:, :, None], touched[:, None])
        at, kept = (a * q + b).ravel(), np.flatnonzero((a <= b) & (b < q))
        pair, row = np.unique(at[kept], return_inverse=True)
        at[kept] = row
        pairs = _summing(at, kept, len(pair))
        return cls(leaf, groups[0], group, place, touched, number, spread, pairs, pair)

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of D, B and C at one point."""
        (g, k), q = self.leaf.shape, len(self.core)
        return (g, k, k), (g, k, self.touched.shape[1]), (q, q)

    @property
    def size(self) -> int:
        """Length of the vector that contains D, B and C."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def entry(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the index of precision entries (a, b), or -1 where (b, a) is stored instead."""
        (g, k, t), q = self.shapes[1], len(self.core)
        of_leaf, of_both = self.group[a] >= 0, (self.group[a] >= 0) & (self.group[b] >= 0)
        row = self.group[a] * k + self.place[a]
        number = self.number[self.group[a], b] if g else 0
        index = np.where(of_both, row * k + self.place[b], g * k * k + row * t + number)
        index = np.where(of_leaf, index, g * k * (k + t) + self.place[a] * q + self.place[b])
        above = np.where(of_both, self.place[a] < self.place[b], self.place[a] > self.place[b])
        other = (of_leaf == (self.group[b] >= 0)) & above
        return np.where(other | (~of_leaf & (self.group[b] >= 0)), -1, index)

    def views(self, A: Any) -> Any:
        """Return views (point, ...) of D, B and C in vectors (point, entry)."""
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes)])
        return tuple(
            A[:, i:j].reshape(len(A), *shape)
            for i, j, shape in zip(ends[:-1], ends[1:], self.shapes, strict=True)
        )


class Factor(NamedTuple):
    """Factor F at each point; whitened vectors begin with the leaves, including padding."""

    order: Order
    inverse: Any  # (point, mission, place, place), G^-1
    X: Any  # (point, mission, place, touched), 0 for other core columns
    H: Any  # (point, core, core), upper triangles; entries below are arbitrary

    @classmethod
    def of(cls, order: Order, A: Any) -> Self:
        """Factor precisions stored in vectors (point, entry), which NumPy overwrites."""
        D, B, C = order.views(A)
        xp = namespace(A)
        padding = (order.leaf == len(order.place))[..., None] * np.eye(order.leaf.shape[1])
        inverse = xp.linalg.inv(cholesky(D + padding))
        X = inverse @ B
        squares = times(order.pairs, (xp.swapaxes(X, 2, 3) @ X).reshape(len(A), -1))
        C = add(C.reshape(len(A), -1), (slice(None), order.pair), -squares).reshape(C.shape)
        return cls(order, inverse, X, upper_factor(C))

    @property
    def size(self) -> int:
        """Length of a whitened vector."""
        return self.order.leaf.size + len(self.order.core)

    @property
    def log_det(self) -> Any:
        """Log determinant (point,) of F."""
        return log_diagonal(self.H) - log_diagonal(self.inverse).sum(1)

    def forward(self, h: Any) -> Any:
        """Compute whitened vectors F^-1 h from vectors h (point, column)."""
        xp, order = namespace(h), self.order
        h = xp.concatenate([h, xp.zeros((len(h), 1))], axis=1)
        leaf = (self.inverse @ h[:, order.leaf][..., None])[..., 0]
        back = xp.einsum("ngkt,ngk->ngt", self.X, leaf).reshape(len(h), -1)
        rest = h[:, order.core] - times(order.spread, back)
        if isinstance(rest, np.ndarray):
            pairs = zip(self.H, rest, strict=True)
            core = np.stack([lapack.dtrtrs(H.T, x, lower=1)[0] for H, x in pairs])  # pyright: ignore[reportAttributeAccessIssue]
        else:
            core = jax.lax.linalg.triangular_solve(
                self.H, rest[..., None], left_side=True, lower=False, transpose_a=True
            )[..., 0]
        return xp.concatenate([leaf.reshape(len(h), -1), core], axis=1)

    def back(self, white: np.ndarray) -> np.ndarray:
        """Compute vectors F'^-1 w (point, draw, column) from whitened w (point, draw, ...)."""
        order, split = self.order, self.order.leaf.size
        pairs = zip(self.H, white[..., split:], strict=True)
        core = np.stack([lapack.dtrtrs(H.T, w.T, lower=1, trans=1)[0].T for H, w in pairs])  # pyright: ignore[reportAttributeAccessIssue]
        leaf = white[..., :split].reshape(*white.shape[:2], *order.leaf.shape)
        padded = np.concatenate([core, np.zeros((*core.shape[:2], 1))], axis=2)
        leaf = leaf - np.einsum("ngkt,ndgt->ndgk", self.X, padded[..., order.touched])
        leaf = np.einsum("ngjk,ndgj->ndgk", self.inverse, leaf)
        found = np.empty((*white.shape[:2], len(order.place) + 1))
        found[..., order.leaf], found[..., order.core] = leaf, core
        return found[..., :-1]

    def whitened(self, c: np.ndarray) -> np.ndarray:
        """Compute whitened vectors F' c from vectors c (point, column)."""
        order = self.order
        c = np.column_stack([c, np.zeros(len(c))])
        leaf, core = c[:, order.leaf], c[:, order.core]
        leaf = np.linalg.solve(np.swapaxes(self.inverse, 2, 3), leaf[..., None])[..., 0]
        padded = np.column_stack([core, np.zeros(len(core))])
        leaf = leaf + np.einsum("ngkt,ngt->ngk", self.X, padded[:, order.touched])
        core = np.einsum("nij,nj->ni", np.triu(self.H), core)
        return np.concatenate([leaf.reshape(len(c), -1), core], axis=1)

    def covariance(self) -> np.ndarray:
        """Compute A^-1 in the layout of A, with halved diagonals for sums over pairs."""
        entries = np.empty((len(self.H), self.order.size))
        D, B, C = self.order.views(entries)
        for H, found in zip(self.H, C, strict=True):
            upper = np.triu(lapack.dpotri(H.T, lower=1)[0].T)  # pyright: ignore[reportAttributeAccessIssue]
            found[:] = upper + np.triu(upper, 1).T
        turned, q = np.swapaxes(self.inverse, 2, 3), np.arange(C.shape[1])
        i, k = np.minimum(self.order.touched, q[-1]), np.arange(D.shape[2])
        B[:] = -turned @ self.X @ C[:, i[..., None], i[:, None]]  # X is 0 in the padding
        D[:] = turned @ self.inverse - B @ np.swapaxes(turned @ self.X, 2, 3)
        C[:, q, q] *= 0.5
        D[:, :, k, k] *= 0.5
        return entries


def _summing(row: np.ndarray, kept: np.ndarray, n: int) -> Any:
    """Build the sparse matrix (n, value) that adds each kept value to its row."""
    shape = n, len(row)
    return sparse.csr_array((np.ones(len(kept)), (row[kept], kept)), shape=shape)


def times(M: Any, x: Any) -> Any:
    """Multiply a sparse matrix by vectors x (point, column); returns vectors (point, row)."""
    if isinstance(x, np.ndarray):
        return np.ascontiguousarray((M @ x.T).T)
    M = M.tocoo()
    order = np.argsort(M.row, kind="stable")
    terms = M.data[order, None] * x.T[M.col[order]]
    return jax.ops.segment_sum(terms, M.row[order], M.shape[0], indices_are_sorted=True).T


def add(A: Any, at: Any, values: Any) -> Any:
    """Add values to an array at an index, in place in NumPy and to a copy in JAX."""
    if not isinstance(A, np.ndarray):
        return A.at[at].add(values)
    A[at] += values
    return A


def log_diagonal(L: Any) -> Any:
    """Compute the log determinants of triangular matrices."""
    xp = namespace(L)
    return xp.log(xp.diagonal(L, axis1=-2, axis2=-1)).sum(-1)


def upper_factor(A: Any) -> Any:
    """Factor A = H' H with upper H, in place in NumPy; failures are NaN as in `cholesky`."""
    if not isinstance(A, np.ndarray):
        lower = jax.lax.linalg.cholesky(A.mT, symmetrize_input=False)
        return lower.mT
    for one in A:
        if lapack.dpotrf(one.T, lower=1, clean=0, overwrite_a=1)[1]:  # pyright: ignore[reportAttributeAccessIssue]
            one[:] = np.nan
    return A


def cholesky(A: Any) -> Any:
    """Compute lower Cholesky factors, with NaN where a matrix is not positive definite."""
    if not isinstance(A, np.ndarray):
        return jax.lax.linalg.cholesky(A, symmetrize_input=False)
    try:
        return np.linalg.cholesky(A)
    except np.linalg.LinAlgError:  # one bad point must not invalidate the others
        if A.ndim == 2:
            return np.full(A.shape, np.nan)
        return np.stack([cholesky(one) for one in A])
