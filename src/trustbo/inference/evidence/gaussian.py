"""Evidence of Gaussian rates under any effects: coefficients and latent trust integrated out.

A chain (mission, robot) has x_k = beta0 x_{k-1} + u_k + w_k ("level"), or the same of x - u with
u_0 = E x_0 ("deviation": what lasts is the departure from what effects expect), u = U c, and rates
y_k = x_k + v_k. Given theta, y = M U c + mean + noise, M = T = (I - beta0 Lag)^-1, or M = I, and
the noise's covariance is V = L L'. The steps, named at the lines of the code:

1. Impulse filter: a scalar Kalman filter of unit impulses gives N = L^-1 T, a missing rate being
   a row of zeros, and E = L^-1. With C = N (level) or E (deviation), L^-1 M U = C U. Chains with
   the same gaps, of robots of one beta0, are of one kind and share these.
2. Gram: A = sum_chains U' S U with S = C'C. The sums of products of columns by pair of bounds, G,
   do not depend on theta and add up over missions, each times its weight: A = G . S is one sparse
   product for all theta.
3. Whitening: c = mean + R e, e ~ N(0, I), R = sd times the root of the prior's correlation. No
   prior is inverted, so that a scale of 0 is exact.
4. Elimination: columns of a robot in a mission touch one chain each. Sets of such columns whose
   coefficients fade from mission to mission go first, see `fading`, before the columns left are
   whitened. Of these the matrix [[I + R'AR, .], [h'R, r'r]], h = sum U'C'r, less what the sets
   took, has one Cholesky factor. Its last diagonal element is the root of the misfit, and

    -2 log p = sum log |V| + log |I + R'AR| + misfit + n log 2 pi.

5. Draws: e of the columns left from the same factor, those of the sets given them.

Exact: the only errors are those of rounding. References: sequential conditioning of a Gaussian
state space, and the bordered Cholesky factor of least squares (Golub and Van Loan 2013, 5.3).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numba as nb
import numpy as np
from scipy import sparse
from scipy.linalg.lapack import dpotrf, dtrtrs  # pyright: ignore

from trustbo.errors import require_choice
from trustbo.inference.evidence.evidence import Evidence, at, repeated
from trustbo.inference.evidence.fading import Eliminated, Sets, eliminate, spread
from trustbo.models.effects.effect import (
    MEMORIES,
    Columns,
    Fading,
    Group,
    Prior,
    Slots,
    Theta,
    dense_root,
)

_compiled = nb.njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})

_NUMBERS = 1e6  # kept at once, of all points of a chunk: about the cache


class Gaussian(Evidence):
    """Evidence of Gaussian rates; exact."""

    exact = True

    def __init__(
        self,
        slots: Slots,
        groups: Sequence[Group],
        x0: tuple[float, float] = (0.5, 0.5),
        memory: str = "level",
        *,
        apart: bool = False,
    ) -> None:
        """Sum products of columns over missions.

        Args:
            slots: Rates of all chains.
            groups: Columns of all effects.
            x0: Mean and sd of trust before the first bound.
            memory: `"level"`, trust is carried on, or `"deviation"` from what effects expect.
            apart: Whether theta has a beta0 of each robot, (point, robot).
        """
        self.slots, self.groups, self.x0 = slots, tuple(groups), x0
        self.level = require_choice("memory", memory, MEMORIES) == "level"
        seen = ~np.isnan(slots.y)
        robot = slots.robot if apart else np.zeros_like(slots.robot)
        alike = np.column_stack([robot, seen])
        kinds, kind = np.unique(alike, axis=0, return_inverse=True)
        self.robot, self.seen, self.kind = kinds[:, 0], kinds[:, 1:] > 0, kind.ravel()
        self.n_measured = float(slots.weight @ seen.sum(1))
        self.mass = np.bincount(self.kind, slots.weight, len(self.seen))
        self.y = np.where(seen, slots.y, 0.0)
        self._first = np.cumsum([0, *(group.columns.shape[1] for group in groups)]).tolist()
        none = sparse.csr_array((slots.y.size, 0))
        U = sparse.hstack([none, *(group.columns for group in groups)], format="csr")
        ahead = np.cumsum(seen[:, ::-1], axis=1)[:, ::-1] > 0  # up to the last rate of a chain
        U: Columns = sparse.csr_array(sparse.diags_array(ahead.ravel().astype(float)) @ U)
        U.eliminate_zeros()
        fading = self._fading(U, self._first)
        size = [0, *(columns.stop - columns.start for columns in fading)]
        self.n_fading = sum(size)
        early = np.concatenate([np.zeros(0, int), *(np.r_[columns] for columns in fading)])
        self.order = np.append(early, np.setdiff1d(np.arange(U.shape[1]), early))
        place = np.argsort(self.order)
        self.joined: list[slice | None] = []  # of columns left, None where eliminated before
        for first, group in zip(self._first, groups, strict=False):
            for columns in group.joined:
                mine = slice(first + columns.start, first + columns.stop)
                i = int(place[mine.start]) - self.n_fading
                self.joined.append(None if mine in fading else slice(i, i + mine.stop - mine.start))
        self.U: Columns = U[:, self.order]
        self.sets = Sets.of(np.cumsum(size), self.U, len(self.y))
        self._gram()

    def log_density(self, theta: Theta) -> np.ndarray:
        """See `Evidence.log_density`."""
        n = len(theta["beta0"])
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            parts = [self._factors(at(theta, i)).log_p for i in self._chunks(n)]
        return np.concatenate([np.zeros(0), *parts])

    def draw(
        self, theta: Theta, count: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """See `Evidence.draw`; no weights are needed."""
        c = self.coefficients(theta, count, rng)
        return named_effects(self.groups, c, repeated(theta, count), rng), None

    def coefficients(self, theta: Theta, count: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Coefficients (draw, column) in the order of the groups, see `draw`."""
        drawn = []
        for i in self._chunks(len(count)):
            factors = self._factors(at(theta, i))
            if self.joined or (count[i] != 1).any():
                drawn += [self._draw(factors, t, int(n), rng) for t, n in enumerate(count[i])]
            else:  # of independent columns one draw each, as NUTS has thousands: all at once
                root, right = np.tril(factors.P[:, :-1, :-1]), factors.P[:, -1, :-1]
                white = (right + rng.standard_normal(right.shape))[..., None]
                e = np.linalg.solve(np.swapaxes(root, 1, 2), white)[..., 0]
                drawn.append(factors.prior.mean + factors.prior.sd * e)
        c = np.empty((int(count.sum()), len(self.order)))
        c[:, self.order] = np.concatenate(drawn)
        return c

    def gram(self, further: Columns) -> tuple[np.ndarray, np.ndarray, Columns]:
        """Row and column of the entries of A, and G (entry, pair of bounds of a kind), see step 2.

        Of all columns, in the order of `order`, and then of further ones (slot, column); the upper
        triangle is left out.
        """
        U = sparse.hstack([self.U, further], format="csr")
        (row, column), G = self._products(U, U)
        lower = row >= column
        return row[lower], column[lower], G[lower]

    def _fading(self, U: Columns, first: list[int]) -> list[slice]:
        """Sets of columns to eliminate first: they fade, each of one chain shared with no other."""
        chain_of = np.repeat(np.arange(len(self.y)), self.y.shape[1])
        taken, sets = np.zeros(len(self.y), dtype=bool), []
        for start, group in zip(first, self.groups, strict=False):
            for columns in group.joined if group.fades else ():
                mine = slice(start + columns.start, start + columns.stop)
                entries = U[:, mine].tocoo()
                pairs = np.unique(np.stack([entries.col, chain_of[entries.row]]), axis=1)
                chains = pairs[1]
                if len(np.unique(pairs[0])) == len(np.unique(chains)) == len(chains) and not (
                    taken[chains].any()
                ):
                    taken[chains] = True
                    sets.append(mine)
        return sets

    def _gram(self) -> None:
        """Step 2: G (entry of A, pair of bounds of a kind), and the entries that may not be 0."""
        left = self.U[:, self.n_fading :]
        (row, column), self._G = self._products(left, left)
        self._entry = row * (left.shape[1] + 1) + column

    def _products(self, left: Columns, U: Columns) -> tuple[tuple[np.ndarray, np.ndarray], Columns]:
        """Products of columns `left` (slot, left) and U, by pair of bounds of a kind.

        Left and column of the entries, in order, and the sparse matrix (entry, pair).
        """
        (n_kinds, K), m, n_left = self.seen.shape, U.shape[1], left.shape[1]
        pair = np.zeros((K, K), dtype=int)
        pair[np.triu_indices(K)] = np.arange(n_pairs := K * (K + 1) // 2)
        pair = np.maximum(pair, pair.T)
        rows, columns, values = [], [], []
        for q in range(n_kinds):
            mine = np.flatnonzero(self.kind == q)
            slot = (mine[:, None] * K + np.arange(K)).ravel()
            X = sparse.csr_array(U[slot].reshape(len(mine), K * m))
            Z = sparse.csr_array(left[slot].reshape(len(mine), K * n_left))
            products = (Z.T @ (sparse.diags_array(self.slots.weight[mine]) @ X)).tocoo()
            (k, a), (j, b) = np.divmod(products.row, n_left), np.divmod(products.col, m)
            rows.append(a * m + b)
            columns.append(q * n_pairs + pair[k, j])
            values.append(products.data)
        entry, index = np.unique(np.concatenate(rows), return_inverse=True)
        where = index.ravel(), np.concatenate(columns)
        shape = len(entry), n_kinds * n_pairs
        return np.divmod(entry, m), sparse.csr_array((np.concatenate(values), where), shape=shape)

    def _chunks(self, n: int) -> list[slice]:
        """Points that are treated together."""
        (n_kinds, K), n_chains = self.seen.shape, len(self.y)
        f, m = self.n_fading, len(self.order) - self.n_fading + 1
        numbers = m * (m + 2 * f) + len(self._entry) + 4 * n_kinds * K**2 + n_chains * K
        size = max(4, int(_NUMBERS / numbers))
        return [slice(i, min(i + size, n)) for i in range(0, n, size)]

    def _factors(self, theta: Theta) -> "_Factors":
        """Steps 1 to 4 at each theta."""
        n, f = len(theta["beta0"]), self.n_fading
        m = len(self.order) - f
        prior = self._prior(theta)
        N, E, log_det = self._impulses(theta)
        C = N if self.level else E
        S = np.swapaxes(C, 2, 3) @ C
        P = np.zeros((n, m + 1, m + 1))
        P.reshape(n, -1)[:, self._entry] = (self._G @ _upper(S).T).T
        r, P[:, -1, -1] = self._residual(theta, N, E, prior.mean)
        h = np.ascontiguousarray((self.U.T @ r.T).T)
        P[:, -1, :-1] = P[:, :-1, -1] = h[:, f:]
        pairs = zip(prior.roots, self.joined, strict=True)
        roots = [root for root, left in pairs if left is None and isinstance(root, Fading)]
        early = eliminate(
            self.sets, P, h[:, :f], S, self.kind, self.slots.weight, prior.sd[:, :f], roots
        )
        self._whiten(P, prior)
        P[:, -1, -1] += 1.0  # taken off again: rates may be just as expected, and the corner 0
        failed = [dpotrf(one.T, lower=0, clean=0, overwrite_a=1)[1] != 0 for one in P]
        diagonal = np.diagonal(P, axis1=1, axis2=2)
        log_p = -0.5 * (log_det @ self.mass + self.n_measured * np.log(2.0 * np.pi))
        quadratic = early.log_det + diagonal[:, -1] ** 2 - 1.0
        log_p -= 0.5 * quadratic + np.log(diagonal[:, :-1]).sum(1)
        return _Factors(np.where(failed, np.nan, log_p), P, early, prior)

    def _impulses(self, theta: Theta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `impulses`."""
        noises = theta["delta_w"], theta["delta_v"]
        return impulses(self._beta0(theta), *noises, self.x0[1], self.seen)

    def _beta0(self, theta: Theta) -> np.ndarray:
        """Memory (point, kind), or (point, 1) where robots share it."""
        beta0 = theta["beta0"]
        return beta0[:, None] if beta0.ndim == 1 else beta0[:, self.robot]

    def _prior(self, theta: Theta) -> Prior:
        """Prior of all columns, in their order; the roots are of the columns joined."""
        prior, _ = prior_of(self.groups, theta)
        return Prior(prior.mean[:, self.order], prior.sd[:, self.order], prior.roots)

    def _residual(
        self, theta: Theta, N: np.ndarray, E: np.ndarray, mean: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """C'r (point, slot) and r'r (point,) of the rates less their prior mean, weighted."""
        n, (n_chains, K) = len(mean), self.y.shape
        on = np.flatnonzero((mean != 0.0).any(0))
        expected = (self.U[:, on] @ mean[:, on].T).T.reshape(n, n_chains, K)
        start = np.zeros(N.shape[:3])
        if self.level:
            start = self._beta0(theta)[..., None] * self.x0[0] * N[..., 0]
        R, misfit = np.zeros((n, n_chains, K)), np.zeros(n)
        C = N if self.level else E
        _residuals(self.y, expected, start, E, C, self.kind, self.slots.weight, R, misfit)
        return R.reshape(n, -1), misfit

    def _whiten(self, P: np.ndarray, prior: Prior) -> None:
        """Step 3: from A, h of the columns left to I + R'AR, R'h, in place."""
        m = P.shape[1] - 1
        sd = np.concatenate([prior.sd[:, self.n_fading :], np.ones((len(P), 1))], axis=1)
        P *= sd[:, :, None] * sd[:, None, :]
        for columns, root in self._roots(prior):
            P[:, columns] = np.swapaxes(root, 1, 2) @ P[:, columns]
            P[:, :, columns] = P[:, :, columns] @ root
        diagonal = np.arange(m)
        P[:, diagonal, diagonal] += 1.0

    def _roots(self, prior: Prior) -> list[tuple[slice, np.ndarray]]:
        """Columns left that are joined, and the roots of their correlations."""
        pairs = zip(self.joined, prior.roots, strict=True)
        return [(columns, dense_root(root)) for columns, root in pairs if columns is not None]

    def _coloured(self, factors: "_Factors", t: int, white: np.ndarray) -> np.ndarray:
        """Coefficients less their means (column, draw) of independent normal numbers."""
        f, n = self.n_fading, len(self.order)
        left = white[2 * f :]
        if n > f:
            left = dtrtrs(factors.P[t, :-1, :-1].T, left, lower=0)[0]
            for columns, root in self._roots(factors.prior):
                left[columns] = root[t] @ left[columns]
            left *= factors.prior.sd[t, f:, None]
        return np.append(spread(factors.early, self.sets, t, white[: 2 * f], left), left, axis=0)

    def _draw(self, factors: "_Factors", t: int, n: int, rng: np.random.Generator) -> np.ndarray:
        """Step 5: coefficients (draw, column), in their order, at the t-th theta."""
        right = np.append(factors.early.Z[t, :, -1], factors.P[t, -1, :-1])
        white = right[:, None] + rng.standard_normal((len(right), n))
        return factors.prior.mean[t] + self._coloured(factors, t, white).T


class _Factors(NamedTuple):
    """Density, factors and prior at each of some theta."""

    log_p: np.ndarray
    P: np.ndarray
    """Cholesky factor of the columns left in the lower triangles; the rates' row is the last."""
    early: Eliminated
    prior: Prior


def joined_columns(groups: Sequence[Group]) -> list[slice]:
    """Columns of all groups that depend on each other a priori."""
    first = np.cumsum([0, *(group.columns.shape[1] for group in groups)]).tolist()
    return [
        slice(start + columns.start, start + columns.stop)
        for start, group in zip(first[:-1], groups, strict=True)
        for columns in group.joined
    ]


def prior_of(groups: Sequence[Group], theta: Theta) -> tuple[Prior, list[slice]]:
    """Prior of the columns of all groups, and the columns that its roots are of."""
    priors, none = [group.prior(theta) for group in groups], np.zeros((len(theta["delta_w"]), 0))
    mean = np.concatenate([none, *(p.mean for p in priors)], axis=1)
    sd = np.concatenate([none, *(p.sd for p in priors)], axis=1)
    return Prior(mean, sd, [root for p in priors for root in p.roots]), joined_columns(groups)


def named_effects(
    groups: Sequence[Group], c: np.ndarray, theta: Theta, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Effects by name of coefficients (draw, column) of all groups, at theta (draw,)."""
    first = np.cumsum([0, *(group.columns.shape[1] for group in groups)]).tolist()
    named = {}
    for group, (i, j) in zip(groups, itertools.pairwise(first), strict=True):
        named |= group.name(c[:, i:j], theta, rng)
    return named


def impulses(
    b: np.ndarray,
    delta_w: np.ndarray,
    delta_v: np.ndarray,
    x0_sd: float,
    seen: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step 1: N and E (point, kind, bound, bound) and log |V| (point, kind).

    Args:
        b: Memory beta0, (point, kind) or (point, 1).
        delta_w: Process noise, (point,).
        delta_v: Measurement noise, (point,).
        x0_sd: Sd of trust before the first bound.
        seen: Mask of the measured rates (kind, bound).
    """
    n, (n_kinds, K) = len(b), seen.shape
    (N, E), log_det = np.zeros((2, n, n_kinds, K, K)), np.zeros((n, n_kinds))
    b = np.broadcast_to(b, (n, n_kinds))
    _impulses(b, delta_w**2, delta_v**2, x0_sd**2, seen, N, E, log_det)
    return N, E, log_det


@_compiled
def _impulses(b, Q, R, x0_variance, seen, N, E, log_det):
    gain = np.empty(seen.shape[1])
    for t in range(len(b)):
        for q in range(len(seen)):
            log_det[t, q] = _filter(b[t, q], Q[t], R[t], x0_variance, seen[q], N[t, q], gain)
            _whitening(b[t, q], gain, N[t, q], E[t, q])


@_compiled
def _filter(b, Q, R, last, seen, N, gain):
    """Set N and gains of a chain; its log |V|."""
    log_det, P = 0.0, b * b * last + Q  # P: variance of trust before the next rate
    m = np.empty(len(seen))  # response of the rate to come
    for k in range(len(seen)):
        left, gain[k], m[k] = 1.0, 0.0, 1.0
        if seen[k]:
            F = P + R
            left, gain[k] = R / F, P / F
            log_det += np.log(F)
            N[k, : k + 1] = m[: k + 1] / np.sqrt(F)
        m[: k + 1] *= b * left
        P = b * b * (P * left) + Q
    return log_det


@_compiled
def _whitening(b, gain, N, E):
    """Set E of a chain."""
    for k in range(len(N)):
        for i in range(k):
            E[k, i] = -b * gain[i] * N[k, i + 1]
        E[k, k] = N[k, k]


@_compiled
def _residuals(y, expected, start, E, C, kind, weight, R, misfit):
    """R (point, chain, bound) and misfit (point,), see `Gaussian._residual`.

    Rates y (chain, bound). Expected rates (point, chain, bound) but for the first trust, whose
    responses (point, kind, bound) are `start`.
    """
    n_chains, K = y.shape
    r = np.empty(K)
    for t in range(len(expected)):
        for c in range(n_chains):
            q = kind[c]
            for k in range(K):
                r[k] = -start[t, q, k]
                for i in range(k + 1):
                    r[k] += E[t, q, k, i] * y[c, i] - C[t, q, k, i] * expected[t, c, i]
            for i in range(K):
                for k in range(i, K):
                    R[t, c, i] += weight[c] * C[t, q, k, i] * r[k]
                misfit[t] += weight[c] * r[i] ** 2


def _upper(S: np.ndarray) -> np.ndarray:
    """Upper triangles of S (point, kind, bound, bound), (point, pair of bounds of a kind)."""
    return S[:, :, *np.triu_indices(S.shape[2])].reshape(len(S), -1)
