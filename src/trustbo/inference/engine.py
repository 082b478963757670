"""Evidence of a model with blocks of jointly normal linear predictors that share columns.

A block is a robot in a mission, a whole mission if its robots are dependent, or a person. Each
block has trust x and a predictor f,

    x = m + T U c + e,    f = x + n,    e ~ N(0, S),  n ~ N(0, noise),  c ~ N(mean, precision^-1),

where every observation is a Gaussian site N(y; f, 1 / lam), and `noise` is what robots share. For
Gaussian rates, 1 / lam is the variance of the noise of each rate (`Density.rate_precision`). For
other families, sites are found by expectation propagation (`ep`). With
L L' = 1 + lam^1/2 (S + noise) lam^1/2 and W = L^-1 lam^1/2, the model is a regression of W (y - m)
on W T U with unit noise. Products of columns for pairs of inputs, summed over the blocks of one
kind, do not depend on theta. Therefore, one sparse product suffices to compute U' (W T)' (W T) U
for all theta and any number of missions. The sums that vanish, such as those of contrasts between
robots, make the precision sparse; see `sparse`.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import sparse

from trustbo.inference.factor import cholesky, log_det, log_diagonal, upper
from trustbo.inference.sparse import Factor, Order
from trustbo.kernels import kernel
from trustbo.parallel import plain
from trustbo.statespace.blocks import LinearPredictor, each

_NEGLIGIBLE = 1e-12
"""Size of a sum of products, relative to the largest one, below which it counts as 0."""


class Blocks(NamedTuple):
    """Data of all blocks; they do not depend on theta."""

    y: np.ndarray  # (block, row), 0 where not measured
    U: Any  # sparse (block * input, column)
    kind: np.ndarray  # (block,), kind of each block; blocks of one kind share factors
    label: np.ndarray  # (kind,), index on the second axis of a `LinearPredictor`
    seen: np.ndarray  # (kind, row)
    first: np.ndarray  # (kind,), the first block of each kind
    sums: Any  # sparse (entry, kind * pair of inputs), for the precision entries in `at`
    at: np.ndarray  # (entry,), precision entries with products of columns; see `Order`
    of_prior: Sequence[np.ndarray]  # precision entries of each part of the prior; see `Prior`
    order: Order

    @classmethod
    def from_rows(
        cls,
        y: np.ndarray,
        U: Any,
        label: np.ndarray,
        noise: np.ndarray,
        *,
        prior: "Prior",
        apart: bool = False,
    ) -> Self:
        """Group blocks into kinds; see `kinds_of`.

        Args:
            y: Observations (block, row), NaN where not measured.
            U: Design as a sparse matrix (block * input, column).
            label: Index (block,) of each block on the second axis of a `LinearPredictor`.
            noise: Standard deviations of the rates' own noise at any theta, shape (1 or block, 1 or
                row).
            prior: Prior at any theta, which shows which columns depend on each other.
            apart: Whether each block is a separate kind, which is needed if sites differ between
                blocks.
        """
        n_blocks = len(y)
        n_columns = U.shape[1]
        n_inputs = U.shape[0] // n_blocks
        U = sparse.csr_array(U)

        kind, first, seen = kinds_of(y, label, noise, apart=apart)

        # Pairs of inputs are unordered: one number stands for both (k, j) and (j, k).
        above = upper(n_inputs)
        n_pairs = len(above[0])
        pair = np.zeros((n_inputs, n_inputs), dtype=int)
        pair[above] = pair.T[above] = np.arange(n_pairs)

        parts = []
        for g in range(len(seen)):
            rows = (np.flatnonzero(kind == g)[:, None] * n_inputs + np.arange(n_inputs)).ravel()
            X = sparse.csr_array(U[rows].reshape(len(rows) // n_inputs, n_inputs * n_columns))
            products = (X.T @ X).tocoo()

            k, a = np.divmod(products.row, n_columns)  # input and column
            j, b = np.divmod(products.col, n_columns)
            parts.append((a, b, g * n_pairs + pair[k, j], products.data))
        a, b, where, values = (np.concatenate(part) for part in zip(*parts, strict=True))

        largest = np.abs(values).max(initial=0.0)
        kept = np.abs(values) > _NEGLIGIBLE * largest
        a, b, where, values = a[kept], b[kept], where[kept], values[kept]

        coupled = prior.coupled()
        coupled[a, b] = True
        order = Order.from_pattern(coupled)

        entry = order.entry(a, b)
        kept = entry >= 0
        at, row = np.unique(entry[kept], return_inverse=True)
        shape = len(at), len(seen) * n_pairs
        sums = sparse.csr_array((values[kept], (row, where[kept])), shape=shape)
        return cls(
            y=np.where(np.isnan(y), 0.0, y),
            U=U,
            kind=kind,
            label=label[first],
            seen=seen,
            first=first,
            sums=sums,
            at=at,
            of_prior=prior.entries(order),
            order=order,
        )

    def precision(self, pairs: np.ndarray, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Compute the posterior precision (entry, point) of the coefficients.

        Args:
            pairs: Products of all pairs of columns of C = W T (point, kind * pair of inputs).
            parts: Parts of the prior precision; see `Prior`.
        """
        A = np.zeros((self.order.size, len(pairs)))
        sums = self.sums
        _add_products(A, self.at, sums.indptr, sums.indices, sums.data, plain(pairs.T))

        for part, entries in zip(parts, self.of_prior, strict=True):
            if part.ndim == 3:
                part = part[:, *upper(part.shape[1])]
            _add(A, entries, plain(part.T))
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
    """Add a sparse matrix, given by its arrays, times x (column, point) to entries of A."""
    n_points = A.shape[1]
    for row in range(len(at)):
        entry = at[row]
        i = ends[row]
        while i + 4 <= ends[row + 1]:  # four at once, to store each sum less often
            a = column[i]
            b = column[i + 1]
            c = column[i + 2]
            d = column[i + 3]
            for p in range(n_points):
                A[entry, p] += (
                    value[i] * x[a, p]
                    + value[i + 1] * x[b, p]
                    + value[i + 2] * x[c, p]
                    + value[i + 3] * x[d, p]
                )
            i += 4
        while i < ends[row + 1]:
            for p in range(n_points):
                A[entry, p] += value[i] * x[column[i], p]
            i += 1


@kernel()
def _add(A: np.ndarray, at: np.ndarray, values: np.ndarray) -> None:
    """Add values (row, point) to entries of A."""
    for row in range(len(at)):
        for p in range(A.shape[1]):
            A[at[row], p] += values[row, p]


class Prior(NamedTuple):
    """Prior on the coefficients of the columns at each theta."""

    mean: Any  # (point, column)
    parts: Sequence[Any]  # precisions (point, k, k), or (point, k) of independent columns, in order
    log_det: Any  # (point,), of the full precision

    @classmethod
    def from_groups(cls, groups: Sequence[tuple[Any, Sequence[Any]]]) -> Self:
        """Combine groups of columns, each with a mean (point, k) or None and with precisions."""
        means = []
        parts = []
        log_det_of_all = 0.0
        known = {}
        for mean, precisions in groups:
            if not precisions:
                continue

            n_columns = sum(part.shape[1] for part in precisions)
            if mean is None:
                mean = np.zeros((len(precisions[0]), n_columns))
            means.append(mean)

            for part in precisions:
                if id(part) not in known:  # robots often share one array
                    is_diagonal = part.ndim == 2
                    known[id(part)] = np.log(part).sum(1) if is_diagonal else log_det(part)
                log_det_of_all = log_det_of_all + known[id(part)]
            parts.extend(precisions)

        return cls(np.concatenate(means, axis=1), parts, log_det_of_all)

    @property
    def _columns(self) -> list[np.ndarray]:
        """Columns of each part."""
        ends = np.cumsum([0, *(part.shape[1] for part in self.parts)])
        return [np.arange(*span) for span in pairwise(ends)]

    def coupled(self) -> np.ndarray:
        """Return which pairs of columns (column, column) depend on each other a priori."""
        n_columns = self.mean.shape[1]
        coupled = np.eye(n_columns, dtype=bool)
        for part, i in zip(self.parts, self._columns, strict=True):
            if part.ndim == 3:
                coupled[i[:, None], i] = True
        return coupled

    def entries(self, order: Order) -> list[np.ndarray]:
        """Return the entries of a precision to which each part, or its upper triangle, is added."""
        entries = []
        for part, i in zip(self.parts, self._columns, strict=True):
            if part.ndim == 2:
                entries.append(order.entry(i, i))
                continue

            a, b = upper(len(i))
            entry = order.entry(i[a], i[b])
            entries.append(np.where(entry < 0, order.entry(i[b], i[a]), entry))
        return entries

    def log_density(self, c: np.ndarray) -> np.ndarray:
        """Compute the log density (point,) of coefficients (point, column)."""
        off = c - self.mean
        start = 0
        square = 0.0
        for part in self.parts:
            end = start + part.shape[1]
            x = off[:, start:end]
            weighted = part * x if part.ndim == 2 else (part @ x[..., None])[..., 0]
            square = square + (weighted * x).sum(1)
            start = end

        return 0.5 * (self.log_det - c.shape[1] * np.log(2.0 * np.pi) - square)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Draw coefficients (point, column) from the prior, once at each point."""
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
    """Evidence and factors at each theta; coefficients are mean + F'^-1 (half + white noise)."""

    log_p: Any  # (point,)
    F: Factor  # of the posterior precision of the coefficients
    half: Any  # (point, column), a whitened vector
    W: Any  # (point, kind, row, row)


def evidence(
    blocks: Blocks, predictor: LinearPredictor, prior: Prior, lam: Any, y: Any = None
) -> Fit:
    """Compute log p(y | theta) at each theta; predictors and coefficients are integrated out.

    Args:
        blocks: Data of all blocks.
        predictor: Distribution of the linear predictors given the coefficients.
        prior: Prior on the coefficients.
        lam: Site precisions (point, kind, row), 0 where nothing was measured.
        y: Site means (point, block, row), if different from the observations.
    """
    W, log_sites = whiten(blocks.label, predictor, lam)
    b = blocks
    residual = (b.y if y is None else y) - expected(b, predictor, prior.mean)
    F, half, w = regress(b, W, residual, each(predictor.response, b.label), prior.parts)

    n_of_kind = np.bincount(b.kind, minlength=len(b.seen)).astype(float)
    log_p = log_sites @ n_of_kind + 0.5 * (prior.log_det - (w**2).sum((1, 2)))

    # With A = F F', integrating over c adds h' A^-1 h / 2 = |F^-1 h|^2 / 2 and -log |F|.
    return Fit(log_p + 0.5 * (half**2).sum(1) - F.log_det, F, half, W)


def regress(
    blocks: Blocks, W: np.ndarray, residual: np.ndarray, T: np.ndarray, parts: Sequence[Any]
) -> tuple[Factor, np.ndarray, np.ndarray]:
    """Regress whitened residuals w = W (y - m) on C U with unit noise, where C = W T.

    Args:
        blocks: Data of all blocks.
        W: Whitening matrices (point, kind, row, row).
        residual: Residuals y - m at the prior mean (point, block, row).
        T: Responses (point, kind, row, input).
        parts: Parts of the prior precision; see `Prior`.

    Returns:
        The factor F of the posterior precision of the coefficients, F^-1 h with h = U' C' w, and w.
    """
    b = blocks
    n = len(W)
    w = (W[:, b.kind] @ residual[..., None])[..., 0]
    C = W @ T

    # h = U' C' w
    back = (np.swapaxes(C, 2, 3)[:, b.kind] @ w[..., None])[..., 0]
    h = (b.U.T @ back.reshape(n, -1).T).T

    # A = U' C' C U + prior precision, from products of columns that do not depend on theta.
    pairs = (np.swapaxes(C, 2, 3) @ C)[:, :, *upper(C.shape[3])]
    A = b.precision(pairs.reshape(n, -1), parts)
    F = Factor.from_precision(b.order, A)
    return F, F.forward(h), w


def kinds_of(
    y: np.ndarray, label: np.ndarray, noise: np.ndarray, *, apart: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Group blocks into kinds, which have equal labels, equal missing rows and equal noise.

    Args:
        y: Observations (block, row), NaN where not measured.
        label: Label (block,) of each block.
        noise: Standard deviations (1 or block, 1 or row) of the rates' own noise at any theta.
        apart: Whether each block is a separate kind.

    Returns:
        The kind (block,) of each block, and the first block (kind,) and seen rows (kind, row) of
        each kind.
    """
    seen = ~np.isnan(y)
    number = np.arange(len(y)) if apart else np.zeros(len(y), dtype=int)
    key = np.column_stack([number, label, seen, np.where(seen, noise, 0.0)])
    _, first, kind = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return kind.ravel(), first, seen[first]


def whiten(label: np.ndarray, predictor: LinearPredictor, lam: Any) -> tuple[Any, Any]:
    """Return whitening matrices W (point, kind, row, row) and log densities at zero residual.

    Args:
        label: Label (kind,) of each kind of blocks.
        predictor: Distribution of the linear predictors given the coefficients.
        lam: Site precisions (point, kind, row), 0 where nothing was measured.
    """
    V = each(predictor.covariance, label)
    some = lam > 0.0
    d = np.where(some, lam, 0.0) ** 0.5

    L = cholesky(np.eye(V.shape[-1]) + d[..., :, None] * V * d[..., None, :])
    log_sites = 0.5 * np.log(np.where(some, lam, 2.0 * np.pi) / (2.0 * np.pi)).sum(-1)
    return np.linalg.inv(L) * d[..., None, :], log_sites - log_diagonal(L)


def inputs(U: Any, n_blocks: int, c: np.ndarray) -> np.ndarray:
    """Compute the inputs U c (point, block, input) of all blocks from coefficients (point, c)."""
    return np.ascontiguousarray((U @ c.T).T).reshape(len(c), n_blocks, -1)


def expected(blocks: Blocks, predictor: LinearPredictor, c: Any) -> Any:
    """Compute the mean linear predictors (point, block, row) given coefficients (point, column)."""
    return predictor.mean_given(inputs(blocks.U, len(blocks.y), c), blocks.label[blocks.kind])


def coefficients_of(
    prior: Prior, fit: Fit, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return posterior means (point, column) and n deviations (point, n, column) of coefficients.

    Deviations are independent draws from the normal posterior at each point, minus its mean. Also
    returns the products (point, n, n) of the whitened deviations.
    """
    white = rng.standard_normal((len(fit.half), n, fit.half.shape[1]))
    found = fit.F.back(np.concatenate([fit.half[:, None], white], axis=1))
    return prior.mean + found[:, 0], found[:, 1:], white @ white.swapaxes(1, 2)


def covariance_of_inputs(blocks: Blocks, covariance: np.ndarray, n_inputs: int) -> np.ndarray:
    """Sum U cov(c) U' (point, kind, input, input) over the blocks of each kind.

    Args:
        blocks: Data of all blocks.
        covariance: Posterior covariance of the coefficients, as in `Factor.covariance`.
        n_inputs: Number of inputs of a block.
    """
    pairs = blocks.sums.T @ covariance[blocks.at]
    n_points = pairs.shape[1]
    n_kinds = len(blocks.seen)

    # The covariance has half of its diagonal, because M + M' adds it twice.
    k, j = upper(n_inputs)
    M = np.zeros((n_points, n_kinds, n_inputs, n_inputs))
    M[..., k, j] = pairs.T.reshape(n_points, n_kinds, -1)
    return M + np.swapaxes(M, 2, 3)


def marginals(
    blocks: Blocks, predictor: LinearPredictor, prior: Prior, fit: Fit, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean and variance (point, block, row) of every predictor given all sites.

    Each block must be a separate kind (`apart` in `Blocks.from_rows`), so that kind i is block i.
    """
    V = each(predictor.covariance, blocks.label)
    T = each(predictor.response, blocks.label)
    n_points = len(V)
    n_blocks = len(blocks.y)
    n_rows = V.shape[-1]
    n_inputs = T.shape[3]

    # Given c, the gain of a block is V (V + 1 / lam)^-1 = V W' W.
    c = prior.mean + fit.F.back(fit.half[:, None])[:, 0]
    gain = V @ (np.swapaxes(fit.W, 2, 3) @ fit.W)
    at = expected(blocks, predictor, c)
    mean = at + np.einsum("nbij,nbj->nbi", gain, y - at)

    M = covariance_of_inputs(blocks, fit.F.covariance(), n_inputs)

    # Law of total variance: the variance given c, plus the variance of the mean given c, which is
    # linear in c.
    G = T - gain @ T
    var = np.diagonal(V, axis1=2, axis2=3) - (gain * V).sum(3) + ((G @ M) * G).sum(3)
    return mean, np.broadcast_to(var, (n_points, n_blocks, n_rows))
