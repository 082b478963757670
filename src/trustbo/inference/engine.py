"""Evidence of a model with blocks of jointly normal linear predictors that share columns.

A block is a robot in a mission, a whole mission if its robots are dependent, or a person. Each
block has trust x and a predictor f,

    x = m + T U c + e,    f = x + n,    e ~ N(0, S),  n ~ N(0, noise),  c ~ N(mean, precision^-1),

where every observation is a Gaussian site N(y; f, 1 / lam). Sites are exact for Gaussian rates. For
other families, they are found by expectation propagation (`ep`). With
L L' = 1 + lam^1/2 (S + noise) lam^1/2 and W = L^-1 lam^1/2, the model is a regression of W (y - m)
on W T U with unit noise. Products of columns for pairs of inputs, summed over the blocks of one
kind, do not depend on theta. Therefore, one sparse product suffices to compute U' (W T)' (W T) U
for all theta and any number of missions.

The same code runs in NumPy, without compilation, and in JAX, with derivatives.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from scipy import sparse

from trustbo.inference.factor import (
    Factor,
    Order,
    add,
    add_products,
    cholesky,
    log_det,
    log_diagonal,
    times,
)
from trustbo.models.effects.effect import Chains
from trustbo.statespace.blocks import LinearPredictor, each
from trustbo.statespace.matrices import namespace


class Blocks(NamedTuple):
    """Data of all blocks; they do not depend on theta."""

    y: np.ndarray  # (block, row), 0 where not measured
    U: Any  # sparse (block * input, column)
    kind: np.ndarray  # (block,), kind of each block; blocks of one kind share factors
    label: np.ndarray  # (kind,), index on the second axis of a `LinearPredictor`
    seen: np.ndarray  # (kind, row)
    sums: Any  # sparse (entry, kind * pair of inputs), for the precision entries in `at`
    at: np.ndarray  # (entry,), precision entries with products of columns; see `Order`
    order: Order

    @classmethod
    def from_rows(
        cls, y: np.ndarray, U: Any, label: np.ndarray, *, order: Order, apart: bool = False
    ) -> Self:
        """Group blocks into kinds; a kind has blocks with equal labels and equal missing rows.

        Args:
            y: Observations (block, row), NaN where not measured.
            U: Design as a sparse matrix (block * input, column).
            label: Index (block,) of each block on the second axis of a `LinearPredictor`.
            order: Order in which the columns are eliminated.
            apart: Whether each block is a separate kind, which is needed if sites differ between
                blocks.
        """
        n_blocks = len(y)
        n_columns = U.shape[1]
        n_inputs = U.shape[0] // n_blocks
        U = sparse.csr_array(U)

        # A row of `kinds` contains a number that can keep blocks apart, the label, and the seen
        # rows.
        seen = ~np.isnan(y)
        number = np.arange(n_blocks) if apart else np.zeros(n_blocks, dtype=int)
        kinds, kind = np.unique(np.column_stack([number, label, seen]), axis=0, return_inverse=True)
        kind = kind.ravel()

        # Pairs of inputs are unordered: one number stands for both (k, j) and (j, k).
        upper = np.triu_indices(n_inputs)
        n_pairs = len(upper[0])
        pair = np.zeros((n_inputs, n_inputs), dtype=int)
        pair[upper] = pair.T[upper] = np.arange(n_pairs)

        entries = []
        where = []
        values = []
        for g in range(len(kinds)):
            rows = (np.flatnonzero(kind == g)[:, None] * n_inputs + np.arange(n_inputs)).ravel()
            X = sparse.csr_array(U[rows].reshape(len(rows) // n_inputs, n_inputs * n_columns))
            products = (X.T @ X).tocoo()

            k, a = np.divmod(products.row, n_columns)  # input and column
            j, b = np.divmod(products.col, n_columns)
            entry = order.entry(a, b)
            is_stored = entry >= 0
            entries.append(entry[is_stored])
            where.append((g * n_pairs + pair[k, j])[is_stored])
            values.append(products.data[is_stored])

        at, row = np.unique(np.concatenate(entries), return_inverse=True)
        index = row, np.concatenate(where)
        shape = len(at), len(kinds) * n_pairs
        sums = sparse.csr_array((np.concatenate(values), index), shape=shape)
        return cls(
            y=np.where(seen, y, 0.0),
            U=U,
            kind=kind,
            label=kinds[:, 1],
            seen=kinds[:, 2:].astype(bool),
            sums=sums,
            at=at,
            order=order,
        )


class Prior(NamedTuple):
    """Prior on the coefficients of the columns at each theta."""

    mean: Any  # (point, column)
    parts: Sequence[Any]  # precisions (point, k, k), or (point, k) of independent columns, in order
    log_det: Any  # (point,), of the full precision
    chains: Chains | None = None  # lasting parts of columns, as hidden columns
    first: int = 0  # first column with a lasting part

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
                    known[id(part)] = (
                        namespace(part).log(part).sum(1) if is_diagonal else log_det(part)
                    )
                log_det_of_all = log_det_of_all + known[id(part)]
            parts.extend(precisions)

        xp = namespace(parts[0])
        return cls(xp.concatenate(means, axis=1), parts, log_det_of_all)

    def add_to(self, A: Any, order: Order) -> Any:
        """Add the prior precision to A (point, entry), the stored entries of precision matrices."""
        start = 0
        for part in self.parts:
            end = start + part.shape[1]
            i = np.arange(start, end)
            start = end
            if part.ndim == 2:
                A = add(A, (slice(None), order.entry(i, i)), part)
            elif isinstance(A, np.ndarray):  # dependent columns are neighbours in the core
                _, _, C = order.views(A)
                first = order.place[i[0]]
                last = order.place[i[-1]] + 1
                C[:, first:last, first:last] += part
            else:
                a, b = np.triu_indices(len(i))
                A = add(A, (slice(None), order.entry(i[a], i[b])), part[:, a, b])

        if self.chains is None:
            return A
        return self._add_chains(A, order)

    def with_chains(self, chains: Chains, first: int, n_missions: int) -> Self:
        """Add hidden columns, which are the lasting parts of the columns from `first` onwards.

        The other columns then have the precision of their independent parts, which is stored in
        `parts`.
        """
        xp = namespace(chains.lasting)
        n_chains = chains.lasting.shape[1]

        # In a stationary AR(1) chain, the first state has the full variance, and the innovations of
        # the others have 1 - rho^2 of it.
        of_hidden = n_missions * xp.log(chains.lasting).sum(1)
        of_hidden = of_hidden - n_chains * (n_missions - 1) * np.log(1.0 - chains.rho**2)
        return self._replace(log_det=self.log_det + of_hidden, chains=chains, first=first)

    def _add_chains(self, A: Any, order: Order) -> Any:
        """Add the precision of the hidden columns s and their coupling to the columns s + e."""
        independent, lasting, rho = self.chains  # pyright: ignore[reportGeneralTypeIssues]
        n_missions = len(order.hidden)
        s = order.hidden.T  # (chain, mission)
        total = self.first + np.arange(s.size).reshape(s.shape)

        # The precision of an AR(1) chain is tridiagonal (Rue and Held 2005, chapter 1).
        inner = np.ones(n_missions)
        inner[1:-1] += rho**2
        tied = lasting[..., None] / (1.0 - rho**2)  # (point, chain, 1)

        coupling = order.entry(total, s)
        coupling = np.where(coupling < 0, order.entry(s, total), coupling)

        for entry, values in (
            (order.entry(s, s), independent[..., None] + tied * inner),
            (order.entry(s[:, :-1], s[:, 1:]), -rho * tied * np.ones(n_missions - 1)),
            (coupling, -independent[..., None] * np.ones(n_missions)),
        ):
            A = add(A, (slice(None), entry.ravel()), values.reshape(len(A), -1))
        return A

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
    F: Any  # Factor of the posterior precision of the coefficients
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
    W, log_sites = whiten(blocks, predictor, lam)
    xp = namespace(W)
    n = len(W)
    b = blocks

    # Regression of W (y - m) on C U with unit noise, where C = W T, about the prior mean.
    residual = (b.y if y is None else y) - expected(b, predictor, prior.mean)
    w = (W[:, b.kind] @ residual[..., None])[..., 0]
    C = W @ each(predictor.response, b.label)

    # h = U' C' w; hidden columns do not occur in the data.
    back = (xp.swapaxes(C, 2, 3)[:, b.kind] @ w[..., None])[..., 0]
    h = times(b.U.T, back.reshape(n, -1))
    h = xp.concatenate([h, xp.zeros((n, b.order.hidden.size))], axis=1)

    # A = U' C' C U + prior precision, from products of columns that do not depend on theta.
    pairs = (xp.swapaxes(C, 2, 3) @ C)[:, :, *np.triu_indices(C.shape[3])]
    A = add_products(xp.zeros((n, b.order.size)), b.at, b.sums, pairs.reshape(n, -1))
    A = prior.add_to(A, b.order)

    n_of_kind = np.bincount(b.kind, minlength=len(b.seen)).astype(float)
    log_p = log_sites @ n_of_kind + 0.5 * (prior.log_det - (w**2).sum((1, 2)))

    # With A = F F', integrating over c adds h' A^-1 h / 2 = |F^-1 h|^2 / 2 and -log |F|.
    F = Factor.from_precision(b.order, A)
    half = F.forward(h)
    return Fit(log_p + 0.5 * (half**2).sum(1) - F.log_det, F, half, W)


def whiten(blocks: Blocks, predictor: LinearPredictor, lam: Any) -> tuple[Any, Any]:
    """Return whitening matrices W (point, kind, row, row) and log densities at zero residual."""
    V = each(predictor.covariance, blocks.label)
    xp = namespace(V)
    some = lam > 0.0
    d = xp.where(some, xp.where(some, lam, 1.0) ** 0.5, 0.0)  # lam**0.5 has no slope at 0

    L = cholesky(np.eye(V.shape[-1]) + d[..., :, None] * V * d[..., None, :])
    log_sites = 0.5 * xp.log(xp.where(some, lam, 2.0 * np.pi) / (2.0 * np.pi)).sum(-1)
    return xp.linalg.inv(L) * d[..., None, :], log_sites - log_diagonal(L)


def expected(blocks: Blocks, predictor: LinearPredictor, c: Any) -> Any:
    """Compute the mean linear predictors (point, block, row) given coefficients (point, column)."""
    drift = times(blocks.U, c).reshape(len(c), len(blocks.y), -1)
    label = blocks.label[blocks.kind]
    if predictor.response.shape[1] == 1:  # one product for all blocks is faster
        response = namespace(drift).swapaxes(predictor.response[:, 0], 1, 2)
        return each(predictor.mean, label) + drift @ response
    return each(predictor.mean, label) + (predictor.response[:, label] @ drift[..., None])[..., 0]


def coefficients_of(
    prior: Prior, fit: Fit, n: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return posterior means (point, column) and n deviations (point, n, column) of coefficients.

    Deviations are independent draws from the normal posterior at each point, minus its mean.
    """
    white = rng.standard_normal((len(fit.half), n, fit.half.shape[1]))
    found = fit.F.back(np.concatenate([fit.half[:, None], white], axis=1))
    found = found[..., : prior.mean.shape[1]]  # without hidden columns
    return prior.mean + found[:, 0], found[:, 1:]


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

    # M = U cov(c) U' of each block; `covariance` halves the diagonal, because M + M' adds it twice.
    k, j = np.triu_indices(n_inputs)
    M = np.zeros((n_points, n_blocks, n_inputs, n_inputs))
    pairs = times(blocks.sums.T, fit.F.covariance()[:, blocks.at])
    M[..., k, j] = pairs.reshape(n_points, n_blocks, -1)
    M = M + np.swapaxes(M, 2, 3)

    # Law of total variance: the variance given c, plus the variance of the mean given c, which is
    # linear in c.
    G = T - gain @ T
    var = np.diagonal(V, axis1=2, axis2=3) - (gain * V).sum(3) + ((G @ M) * G).sum(3)
    return mean, np.broadcast_to(var, (n_points, n_blocks, n_rows))
