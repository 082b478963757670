"""The evidence of every model: blocks of jointly normal signals that share columns.

A block (a robot in a mission, a mission of robots that influence each other, or a person) has trust
and a signal

    x = m + T U c + e,    f = x + n,    e ~ N(0, S),  n ~ N(0, noise),  c ~ N(mean, precision^-1),

and every observation is a Gaussian site N(y; f, 1 / lam): exact for Gaussian rates, matched by
expectation propagation for others (`ep`). With L L' = 1 + lam^1/2 (S + noise) lam^1/2 and
W = L^-1 lam^1/2, the rates are a regression of W (y - m) on W T U with unit noise. Products of
columns by pairs of rows, summed over the blocks of one kind, do not depend on theta, so that
U' (W T)' (W T) U is one sparse product for all theta, whatever the number of missions.

One source serves NumPy, where nothing compiles, and JAX, which differentiates it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from scipy import sparse
from scipy.linalg import lapack, solve_triangular

from trustbo.models.backend import namespace
from trustbo.models.signal import Signal, each


class Blocks(NamedTuple):
    """Data of all blocks, which do not depend on theta."""

    y: np.ndarray  # (block, row), 0 where not measured
    U: Any  # sparse (block * input, column)
    kind: np.ndarray  # (block,): blocks of one kind share their factors
    label: np.ndarray  # (kind,): index on the second axis of a `Signal`
    seen: np.ndarray  # (kind, row)
    sums: Any  # sparse (column^2, kind * pair of inputs), lower triangle of the columns

    @classmethod
    def of(cls, y: np.ndarray, U: Any, label: np.ndarray, *, apart: bool = False) -> Self:
        """Lay blocks out; those with the same label and the same gaps are of one kind.

        Args:
            y: Observations (block, row), NaN where not measured.
            U: Columns, sparse (block * input, column).
            label: Index (block,) on the second axis of a `Signal`.
            apart: Whether each block is a kind of its own, as sites that differ need it.
        """
        n, p = len(y), U.shape[1]
        inputs, U = U.shape[0] // n, sparse.csr_array(U)
        seen = ~np.isnan(y)
        kinds = np.column_stack([np.arange(n) if apart else np.zeros(n, dtype=int), label, seen])
        kinds, kind = np.unique(kinds, axis=0, return_inverse=True)
        kind = kind.ravel()
        upper = np.triu_indices(inputs)
        pair = np.zeros((inputs, inputs), dtype=int)
        pair[upper] = pair.T[upper] = np.arange(len(upper[0]))
        at, where, values = [], [], []
        for g in range(len(kinds)):
            rows = (np.flatnonzero(kind == g)[:, None] * inputs + np.arange(inputs)).ravel()
            X = sparse.csr_array(U[rows].reshape(len(rows) // inputs, inputs * p))
            products = (X.T @ X).tocoo()
            (k, a), (j, b) = np.divmod(products.row, p), np.divmod(products.col, p)
            lower = a >= b
            at.append((a.astype(np.int64) * p + b)[lower])
            where.append((g * len(upper[0]) + pair[k, j])[lower])
            values.append(products.data[lower])
        entries = np.concatenate(at), np.concatenate(where)
        shape = p * p, len(kinds) * len(upper[0])
        sums = sparse.csr_array((np.concatenate(values), entries), shape=shape)
        seen_by_kind = kinds[:, 2:].astype(bool)
        return cls(np.where(seen, y, 0.0), U, kind, kinds[:, 1], seen_by_kind, sums)

    @property
    def n_columns(self) -> int:
        """Number of columns."""
        return self.U.shape[1]


class Prior(NamedTuple):
    """Prior of the columns at each theta."""

    mean: Any  # (point, column)
    parts: Sequence[Any]  # precisions (point, k, k), or (point, k) of independent columns, in order
    log_det: Any  # (point,), of the whole precision

    @classmethod
    def of(cls, groups: Sequence[tuple[Any, Sequence[Any]]]) -> Self:
        """Prior of groups of columns, each a mean (point, k) or None, and its precisions."""
        means, parts, log_det, known = [], [], 0.0, {}
        for mean, precisions in groups:
            if not precisions:
                continue
            n = sum(part.shape[1] for part in precisions)
            means.append(np.zeros((len(precisions[0]), n)) if mean is None else mean)
            for part in precisions:
                if id(part) not in known:  # robots often share a part
                    xp = namespace(part)
                    one_axis = part.ndim == 2
                    known[id(part)] = (
                        xp.log(part).sum(1) if one_axis else xp.linalg.slogdet(part)[1]
                    )
                log_det = log_det + known[id(part)]
            parts.extend(precisions)
        xp = namespace(parts[0])
        return cls(xp.concatenate(means, axis=1), parts, log_det)

    def add_to(self, A: Any) -> Any:
        """The precision of the columns added to matrices (point, column, column)."""
        start = 0
        for part in self.parts:
            i = np.arange(start, start := start + part.shape[1])
            at = (slice(None), i, i) if part.ndim == 2 else (slice(None), i[:, None], i)
            if isinstance(A, np.ndarray):
                A[at] += part
            else:
                A = A.at[at].add(part)
        return A

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """One draw of the columns at each point, (point, column)."""
        drawn = []
        for part in self.parts:
            e = rng.standard_normal(part.shape[:2])
            if part.ndim == 2:
                drawn.append(e / np.sqrt(part))
            else:
                roots = np.swapaxes(cholesky(part), 1, 2)
                drawn.append(np.linalg.solve(roots, e[..., None])[..., 0])
        return self.mean + np.concatenate(drawn, axis=1)


class Fit(NamedTuple):
    """Evidence and factors at each theta; the columns are mean + F'^-1 (half + white noise)."""

    log_p: Any  # (point,)
    F: Any  # (point, column, column), lower factor of the precision of the columns
    half: Any  # (point, column)
    W: Any  # (point, kind, row, row)


def evidence(blocks: Blocks, signal: Signal, prior: Prior, lam: Any, y: Any = None) -> Fit:
    """Log p(y | theta) at all points, with signals and columns integrated out.

    Args:
        blocks: Data of all blocks.
        signal: Distribution of the signals given the columns.
        prior: Prior of the columns.
        lam: Precisions of the sites (point, kind, row), 0 where nothing was measured.
        y: Sites (point, block, row), where these are not at the observations.
    """
    W, log_sites = whiten(blocks, signal, lam)
    xp, n, b = namespace(W), len(W), blocks
    residual = (b.y if y is None else y) - expected(b, signal, prior.mean)
    w = (W[:, b.kind] @ residual[..., None])[..., 0]
    C = W @ each(signal.T, b.label)
    back = (xp.swapaxes(C, 2, 3)[:, b.kind] @ w[..., None])[..., 0]
    h = times(b.U.T, back.reshape(n, -1))
    pairs = (xp.swapaxes(C, 2, 3) @ C)[:, :, *np.triu_indices(C.shape[3])]
    A = times(b.sums, pairs.reshape(n, -1)).reshape(n, b.n_columns, b.n_columns)
    F = cholesky(prior.add_to(A))
    half = forward(F, h)
    many = np.bincount(b.kind, minlength=len(b.seen)).astype(float)
    log_p = log_sites @ many + 0.5 * (prior.log_det - (w**2).sum((1, 2)) + (half**2).sum(1))
    return Fit(log_p - log_diagonal(F), F, half, W)


def whiten(blocks: Blocks, signal: Signal, lam: Any) -> tuple[Any, Any]:
    """Matrices W (point, kind, row, row), and log densities of residuals of 0 (point, kind)."""
    V = each(signal.covariance, blocks.label)
    xp, some = namespace(V), lam > 0.0
    d = xp.where(some, xp.where(some, lam, 1.0) ** 0.5, 0.0)  # the root's slope at 0 is infinite
    L = cholesky(np.eye(V.shape[-1]) + d[..., :, None] * V * d[..., None, :])
    log_sites = 0.5 * xp.log(xp.where(some, lam, 2.0 * np.pi) / (2.0 * np.pi)).sum(-1)
    return xp.linalg.inv(L) * d[..., None, :], log_sites - log_diagonal(L)


def expected(blocks: Blocks, signal: Signal, c: Any) -> Any:
    """Mean of the signals (point, block, row) given columns (point, column)."""
    drift = times(blocks.U, c).reshape(len(c), len(blocks.y), -1)
    xp, label = namespace(drift), blocks.label[blocks.kind]
    if signal.T.shape[1] == 1:
        return each(signal.m, label) + drift @ xp.swapaxes(signal.T[:, 0], 1, 2)
    return each(signal.m, label) + (signal.T[:, label] @ drift[..., None])[..., 0]


def draw_columns(prior: Prior, fit: Fit, count: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draws of the columns, so many at each point; shape (sum of count, column)."""
    drawn = []
    for mean, F, half, many in zip(prior.mean, fit.F, fit.half, count, strict=True):
        white = half + rng.standard_normal((many, len(half)))
        drawn.append(mean + solve_triangular(F, white.T, lower=True, trans="T").T)  # pyright: ignore[reportArgumentType]
    return np.concatenate(drawn)


def marginals(
    blocks: Blocks, signal: Signal, prior: Prior, fit: Fit, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (point, block, row) of every signal given all sites.

    Blocks are kinds of their own, in order.
    """
    V, T = each(signal.covariance, blocks.label), each(signal.T, blocks.label)
    n, rows = len(V), V.shape[-1]
    inverse = np.stack([lapack.dpotri(F, lower=1)[0] for F in fit.F])  # pyright: ignore[reportAttributeAccessIssue]
    c = prior.mean + np.stack(
        [
            solve_triangular(F, h, lower=True, trans="T")  # pyright: ignore[reportArgumentType]
            for F, h in zip(fit.F, fit.half, strict=True)
        ]
    )
    gain = V @ (np.swapaxes(fit.W, 2, 3) @ fit.W)
    G = T - gain @ T
    at = expected(blocks, signal, c)
    mean = at + np.einsum("nbij,nbj->nbi", gain, y - at)
    inverse = np.tril(inverse)
    i = np.arange(blocks.n_columns)
    inverse[:, i, i] *= 0.5
    k, j = np.triu_indices(T.shape[3])
    M = np.zeros((n, len(blocks.y), T.shape[3], T.shape[3]))  # U cov U' of each block
    M[..., k, j] = times(blocks.sums.T, inverse.reshape(n, -1)).reshape(n, len(blocks.y), -1)
    M = M + np.swapaxes(M, 2, 3)
    var = np.diagonal(V - gain @ V, axis1=2, axis2=3) + ((G @ M) * G).sum(3)
    return mean, np.broadcast_to(var, (n, len(blocks.y), rows))


def log_diagonal(L: Any) -> Any:
    """Log determinant of triangular matrices."""
    xp = namespace(L)
    return xp.log(xp.diagonal(L, axis1=-2, axis2=-1)).sum(-1)


def times(M: Any, x: Any) -> Any:
    """Products (point, row) of a sparse matrix with vectors x (point, column)."""
    if isinstance(x, np.ndarray):
        return np.ascontiguousarray((M @ x.T).T)
    M = M.tocoo()
    order = np.argsort(M.row, kind="stable")
    terms = M.data[order, None] * x.T[M.col[order]]
    return jax.ops.segment_sum(terms, M.row[order], M.shape[0], indices_are_sorted=True).T


def cholesky(A: Any) -> Any:
    """Lower factors, from the lower triangles; NaN where a matrix is not positive definite."""
    if not isinstance(A, np.ndarray):
        return jax.lax.linalg.cholesky(A, symmetrize_input=False)
    try:
        return np.linalg.cholesky(A)
    except np.linalg.LinAlgError:  # one bad point must not cost the others
        if A.ndim == 2:
            return np.full(A.shape, np.nan)
        return np.stack([cholesky(one) for one in A])


def forward(F: Any, h: Any) -> Any:
    """F^-1 h of lower factors (point, column, column) and vectors (point, column)."""
    if isinstance(F, np.ndarray):
        return np.stack(
            [lapack.dtrtrs(f.T, x, lower=0, trans=1)[0] for f, x in zip(F, h, strict=True)]  # pyright: ignore[reportAttributeAccessIssue]
        )
    return jax.lax.linalg.triangular_solve(F, h[..., None], left_side=True, lower=True)[..., 0]
