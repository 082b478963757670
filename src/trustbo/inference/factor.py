"""Cholesky factors of a precision matrix whose columns mostly belong to one mission.

Columns that are independent a priori and occur in only one mission, such as bounds visited once,
are *leaves*. All other columns are the *core*. Given the core, leaves of different missions are
independent. With the leaves first, the precision A = F F' and its factor F are

    A = [D  B ]    F = [G   0 ]    G G' = D,  X = G^-1 B,  H' H = C - X' X,
        [B' C ]        [X'  H']

where D and G are block diagonal, with one block per mission. Only H is a large dense factor. Since
LAPACK stores columns contiguously, it factors upper triangles fastest, and in place.

Effects that last over many missions can be split (see `Chains`). Their independent parts are then
leaves, and their lasting parts are hidden columns, which are the first columns of the core. A
hidden column is coupled only to its mission and, a priori, to the missions before and after it. The
part of C with the hidden columns is therefore block tridiagonal, which saves half of the work.
"""

from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.linalg import lapack

from trustbo.kernels import kernel
from trustbo.models.backend import inverse_and_log_det, inverse_from_factor
from trustbo.statespace.matrices import namespace

CHAIN_BLOCK = 30
"""Number of columns of a chain that are eliminated at once."""
_DENSE = 20
"""In JAX, a sparse matrix is multiplied as a dense one if more than one entry in this many is
nonzero."""


class Order(NamedTuple):
    """Order in which columns are eliminated, and layout of the blocks D, B and C in a vector."""

    leaf: np.ndarray  # (mission, place), leaf columns, padded with the number of columns
    core: np.ndarray  # core columns
    group: np.ndarray  # (column,), mission of a leaf, -1 for the core
    place: np.ndarray  # (column,), index among the leaves of the mission, or in the core
    touched: np.ndarray  # (mission, number), places of the core columns that occur in a mission
    number: np.ndarray  # (mission, column), index in `touched`
    spread: Any  # sparse (core, mission * touched), sums the missions' terms of a vector
    pairs: Any  # sparse (pair, mission * touched * touched), sums the missions' terms of C
    pair: np.ndarray  # (pair,), flat index in C
    hidden: np.ndarray  # (mission, chain), hidden columns

    @classmethod
    def from_masks(cls, met: np.ndarray, free: np.ndarray, n_chains: int = 0) -> Self:
        """Find the elimination order of the columns.

        Args:
            met: Mask (mission, column) of the columns that occur in each mission.
            free: Mask (column,) of the columns that are independent of all others a priori.
            n_chains: Number of hidden columns per mission, which are added after the other columns.
        """
        n_missions = len(met)
        hidden = len(free) + np.arange(n_missions * n_chains).reshape(n_missions, n_chains)
        met = np.hstack([met, np.repeat(np.eye(n_missions, dtype=bool), n_chains, axis=1)])
        free = np.append(free, np.zeros(hidden.size, dtype=bool))
        n_columns = len(free)

        # A leaf is free and occurs in one mission. If there is only one mission, leaves gain
        # nothing.
        is_leaf = free & (met.sum(0) == 1)
        if n_missions == 1:
            is_leaf[:] = False
        only = np.where(is_leaf, met.argmax(0), -1)  # mission of each leaf
        core = np.append(hidden.ravel(), np.setdiff1d(np.flatnonzero(only == -1), hidden))
        leaves = [np.flatnonzero(only == j) for j in range(n_missions)]
        leaves = [columns for columns in leaves if len(columns)]

        place = np.empty(n_columns, dtype=int)
        for columns in (core, *leaves):
            place[columns] = np.arange(len(columns))

        leaf = np.full((len(leaves), max(map(len, leaves), default=1)), n_columns)
        group = np.full(n_columns, -1)
        touched_by = []  # places in the core of the columns that occur in each mission with leaves
        for g, columns in enumerate(leaves):
            leaf[g, : len(columns)] = columns
            group[columns] = g
            touched_by.append(np.flatnonzero(met[only[columns[0]], core]))

        n_core = len(core)
        touched = np.full((len(leaves), max(map(len, touched_by), default=0)), n_core)
        number = np.full((len(leaves), n_columns), -1)
        for g, places in enumerate(touched_by):
            touched[g, : len(places)] = places
            number[g, core[places]] = np.arange(len(places))

        flat = touched.ravel()
        spread = _summing(flat, np.flatnonzero(flat < n_core), n_core)

        # Only the upper triangle of C is stored, and only the pairs that some mission touches.
        a, b = np.broadcast_arrays(touched[:, :, None], touched[:, None])
        at = (a * n_core + b).ravel()
        kept = np.flatnonzero((a <= b) & (b < n_core))
        pair, row = np.unique(at[kept], return_inverse=True)
        at[kept] = row
        pairs = _summing(at, kept, len(pair))
        return cls(leaf, core, group, place, touched, number, spread, pairs, pair, hidden)

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of the blocks D, B and C at one point."""
        g, k = self.leaf.shape
        t = self.touched.shape[1]
        q = len(self.core)
        return (g, k, k), (g, k, t), (q, q)

    @property
    def size(self) -> int:
        """Length of the vector that contains the blocks D, B and C."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def entry(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the index of precision entries (a, b), or -1 where (b, a) is stored instead."""
        _, (g, k, t), (q, _) = self.shapes
        a_is_leaf = self.group[a] >= 0
        b_is_leaf = self.group[b] >= 0
        both_leaves = a_is_leaf & b_is_leaf

        # The vector is D, B and C, each in the order of its rows.
        row = self.group[a] * k + self.place[a]
        number = self.number[self.group[a], b] if g else 0
        in_D = row * k + self.place[b]
        in_B = g * k * k + row * t + number
        in_C = g * k * (k + t) + self.place[a] * q + self.place[b]
        index = np.where(a_is_leaf, np.where(both_leaves, in_D, in_B), in_C)

        # The lower triangle of D and the upper triangle of C are stored; B has no rows of the core.
        is_other = np.where(
            both_leaves, self.place[a] < self.place[b], self.place[a] > self.place[b]
        )
        is_other = (a_is_leaf == b_is_leaf) & is_other
        return np.where(is_other | (~a_is_leaf & b_is_leaf), -1, index)

    def views(self, A: Any) -> Any:
        """Return views (point, ...) of the blocks D, B and C in vectors (point, entry)."""
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self.shapes)])
        return tuple(
            A[:, i:j].reshape(len(A), *shape)
            for i, j, shape in zip(ends[:-1], ends[1:], self.shapes, strict=True)
        )


class Factor(NamedTuple):
    """Factor F of the precision at each point; whitened vectors begin with the padded leaves."""

    order: Order
    inverse: Any  # (point, mission, place, place), G^-1
    X: Any  # (point, mission, place, touched), 0 for other core columns
    H: Any  # (point, core, core), upper triangles; entries below are arbitrary

    @classmethod
    def from_precision(cls, order: Order, A: Any) -> Self:
        """Factor precisions stored in vectors A (point, entry); in NumPy, A is overwritten."""
        xp = namespace(A)
        D, B, C = order.views(A)

        # G G' = D; padded leaves get a unit diagonal, so that D stays positive definite.
        is_padding = order.leaf == len(order.place)
        padding = np.where(is_padding[..., None], np.eye(order.leaf.shape[1]), 0.0)
        inverse = inverse_of_lower(cholesky(D + padding))

        # H' H = C - X' X
        X = inverse @ B
        squares = (xp.swapaxes(X, 2, 3) @ X).reshape(len(A), -1)
        C = add_products(C.reshape(len(A), -1), order.pair, order.pairs, -squares).reshape(C.shape)
        H = chain_factor(C, *order.hidden.shape) if order.hidden.size else upper_factor(C)
        return cls(order, inverse, X, H)

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
        xp = namespace(h)
        order = self.order
        h = xp.concatenate([h, xp.zeros((len(h), 1))], axis=1)  # 0 for padded leaves

        leaf = (self.inverse @ h[:, order.leaf][..., None])[..., 0]
        back = xp.einsum("ngkt,ngk->ngt", self.X, leaf).reshape(len(h), -1)

        rest = h[:, order.core] - times(order.spread, back)
        core = solve_upper(self.H, rest[:, None], transposed=True)[:, 0]
        return xp.concatenate([leaf.reshape(len(h), -1), core], axis=1)

    def back(self, white: Any) -> Any:
        """Compute vectors F'^-1 w (point, draw, column) from whitened w (point, draw, ...)."""
        xp = namespace(white)
        order = self.order
        n_leaves = order.leaf.size
        core = solve_upper(self.H, white[..., n_leaves:], transposed=False)

        leaf = white[..., :n_leaves].reshape(*white.shape[:2], *order.leaf.shape)
        padded = xp.concatenate([core, xp.zeros((*core.shape[:2], 1))], axis=2)
        touched = xp.moveaxis(padded[..., order.touched], 1, 3)  # (point, mission, touched, draw)
        leaf = xp.moveaxis(leaf, 1, 3) - self.X @ touched
        leaf = xp.moveaxis(xp.swapaxes(self.inverse, 2, 3) @ leaf, 3, 1)

        # Rearrange leaves and core in the order of the columns; -1 marks the core in `group`.
        found = xp.concatenate([leaf.reshape(*leaf.shape[:2], n_leaves), core], axis=2)
        group = np.where(order.group < 0, len(order.leaf), order.group)
        return found[..., group * order.leaf.shape[1] + order.place]

    def whitened(self, c: np.ndarray) -> np.ndarray:
        """Compute whitened vectors F' c from vectors c (point, column)."""
        order = self.order
        c = np.column_stack([c, np.zeros(len(c))])
        leaf = c[:, order.leaf]
        core = c[:, order.core]

        leaf = np.linalg.solve(np.swapaxes(self.inverse, 2, 3), leaf[..., None])[..., 0]
        padded = np.column_stack([core, np.zeros(len(core))])
        leaf = leaf + np.einsum("ngkt,ngt->ngk", self.X, padded[:, order.touched])

        core = np.einsum("nij,nj->ni", np.triu(self.H), core)
        return np.concatenate([leaf.reshape(len(c), -1), core], axis=1)

    def covariance(self) -> Any:
        """Compute A^-1 at the stored entries of A, with diagonals halved for sums over pairs."""
        C = inverse_of_upper(self.H)
        transposed = self.inverse.swapaxes(2, 3)

        i = np.minimum(self.order.touched, C.shape[1] - 1)  # any column; X is 0 in the padding
        B = -transposed @ self.X @ C[:, i[..., None], i[:, None]]
        D = transposed @ self.inverse - B @ (transposed @ self.X).swapaxes(2, 3)
        return self._entries(D, B, C)

    def _entries(self, D: Any, B: Any, C: Any) -> Any:
        """Join D, B and C in vectors like those of A, with halved diagonals of D and C."""
        D, C = (M * (1.0 - 0.5 * np.eye(M.shape[-1])) for M in (D, C))
        return namespace(C).concatenate([M.reshape(len(C), -1) for M in (D, B, C)], axis=1)

    def outer(self, c: Any) -> Any:
        """Compute the same entries as `covariance`, for the matrices cc' of c (point, column)."""
        xp = namespace(c)
        order = self.order
        zero = xp.zeros((len(c), 1))  # for the padding
        c = xp.concatenate([c, zero], axis=1)
        leaf = c[:, order.leaf]
        core = c[:, order.core]
        touched = xp.concatenate([core, zero], axis=1)[:, order.touched]

        D = leaf[..., None] * leaf[:, :, None]
        B = leaf[..., None] * touched[:, :, None]
        C = core[..., None] * core[:, None]
        return self._entries(D, B, C)


def _summing(row: np.ndarray, kept: np.ndarray, n: int) -> Any:
    """Build the sparse matrix (n, value) that adds each kept value to its row."""
    shape = n, len(row)
    return sparse.csr_array((np.ones(len(kept)), (row[kept], kept)), shape=shape)


def times(M: Any, x: Any) -> Any:
    """Multiply a sparse matrix by vectors x (point, column); returns vectors (point, row)."""
    if isinstance(x, np.ndarray):
        return np.ascontiguousarray((M @ x.T).T)
    if _DENSE * M.nnz > M.shape[0] * M.shape[1]:
        return x @ M.T.toarray()

    M = M.tocoo()
    order = np.argsort(M.row, kind="stable")
    terms = M.data[order, None] * x.T[M.col[order]]
    return jax.ops.segment_sum(terms, M.row[order], M.shape[0], indices_are_sorted=True).T


def add_products(A: Any, at: np.ndarray, M: Any, x: Any) -> Any:
    """Add M x to the entries `at` of vectors A (point, entry), in place in NumPy.

    Args:
        A: Vectors (point, entry), contiguous in NumPy.
        at: Distinct indices (row,) of entries.
        M: Sparse matrix (row, column).
        x: Vectors (point, column).
    """
    if not isinstance(A, np.ndarray):
        return A.at[:, at].add(times(M, x))

    _add_products(A, at, M.indptr, M.indices, M.data, np.ascontiguousarray(x))
    return A


@kernel(fastmath={"contract"})
def _add_products(
    A: np.ndarray,
    at: np.ndarray,
    ends: np.ndarray,
    column: np.ndarray,
    value: np.ndarray,
    x: np.ndarray,
) -> None:
    """Add products of a sparse matrix, given by its arrays, and x (point, column)."""
    for point in range(len(A)):
        for row in range(len(at)):
            total = 0.0
            for i in range(ends[row], ends[row + 1]):
                total += value[i] * x[point, column[i]]
            A[point, at[row]] += total


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
    """Factor A = H' H with upper H, in place in NumPy; NaN where A is not positive definite."""
    if not isinstance(A, np.ndarray):
        lower = jax.lax.linalg.cholesky(A.mT, symmetrize_input=False)
        return lower.mT

    for one in A:
        _, failed = lapack.dpotrf(one.T, lower=1, clean=0, overwrite_a=1)  # pyright: ignore[reportAttributeAccessIssue]
        if failed:
            one[:] = np.nan
    return A


def chain_factor(A: Any, n_missions: int, n_chains: int) -> Any:
    """Factor matrices as `upper_factor` does, if their first columns (mission, chain) are a chain.

    A column of the chain may be coupled only to columns of the same mission, of the mission before
    and of the mission after it, and to columns outside the chain.
    """
    if not isinstance(A, np.ndarray):
        return upper_factor(A)

    n = n_missions * n_chains
    step = n_chains * -(-CHAIN_BLOCK // n_chains)  # whole missions
    for one in A:
        # Block Cholesky: columns i:j of the chain are coupled to columns j:k and, outside the
        # chain, to columns n:.
        for i in range(0, n, step):
            j = min(i + step, n)
            k = min(j + step, n)

            L, failed = lapack.dpotrf(one[i:j, i:j].T, lower=1, clean=1)  # pyright: ignore[reportAttributeAccessIssue]
            inverse = lapack.dtrtri(L, lower=1)[0]  # pyright: ignore[reportAttributeAccessIssue]
            one[i:j, i:j] = L.T
            following = one[i:j, j:k] = inverse @ one[i:j, j:k]
            others = one[i:j, n:] = inverse @ one[i:j, n:]

            one[j:k, j:k] -= following.T @ following
            one[j:k, n:] -= following.T @ others
            if failed:
                one[:] = np.nan
                break

        rest = one[n:, n:] - one[:n, n:].T @ one[:n, n:]
        L, failed = lapack.dpotrf(rest.T, lower=1, clean=0, overwrite_a=1)  # pyright: ignore[reportAttributeAccessIssue]
        one[n:, n:] = np.nan if failed else L.T
    return A


def solve_upper(H: Any, x: Any, *, transposed: bool) -> Any:
    """Solve H y = x or H' y = x for upper triangles H (point, n, n) and x (point, draw, n)."""
    if not isinstance(H, np.ndarray):
        return jax.lax.linalg.triangular_solve(
            H, x.mT, left_side=True, lower=False, transpose_a=transposed
        ).mT

    trans = 0 if transposed else 1  # LAPACK sees the transposed matrices, as it stores columns
    pairs = zip(H, x, strict=True)
    return np.stack([lapack.dtrtrs(h.T, y.T, lower=1, trans=trans)[0].T for h, y in pairs])  # pyright: ignore[reportAttributeAccessIssue]


def inverse_of_lower(L: Any) -> Any:
    """Compute the inverses of lower triangular matrices (..., n, n)."""
    if isinstance(L, np.ndarray):
        return np.linalg.inv(L)

    one = jnp.broadcast_to(jnp.eye(L.shape[-1]), L.shape)
    return jax.lax.linalg.triangular_solve(L, one, left_side=True, lower=True)


def inverse_of_upper(H: Any) -> Any:
    """Compute (H' H)^-1 for upper-triangular H (point, n, n); other entries are ignored."""
    if not isinstance(H, np.ndarray):
        one = jnp.broadcast_to(jnp.eye(H.shape[1]), H.shape)
        half = solve_upper(H, one, transposed=True)
        return half @ half.mT
    return inverse_from_factor(np.triu(H))


def log_det(A: Any) -> Any:
    """Compute the log determinants of positive definite matrices."""
    if not isinstance(A, np.ndarray):
        return inverse_and_log_det(A)[1]
    return 2.0 * log_diagonal(cholesky(A))


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
