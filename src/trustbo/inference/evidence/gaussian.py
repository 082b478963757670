"""Evidence of Gaussian rates under any effects: coefficients and latent trust integrated out.

A chain (mission, robot) has x_k = beta0 x_{k-1} + u_k + w_k ("level"), or the same of x - u with
u_0 = E x_0 ("deviation": what lasts is the departure from what effects expect), u = U c, and rates
y_k = x_k + v_k. Given theta, y = M U c + mean + noise, M = T = (I - beta0 Lag)^-1 or M = I, and the
noise's covariance is V = L L'. The steps, named at the lines of the code:

1. Impulse filter: a scalar Kalman filter of unit impulses gives N = L^-1 T, a missing rate being a
   row of zeros, and E = L^-1 = N (I - beta0 Lag). With C = N (level) or E (deviation), L^-1 M U =
   C U. Chains with the same gaps are of one kind and share these.
2. Gram: A = sum_chains U' S U with S = C'C. The sums of products of columns by pair of bounds, G,
   do not depend on theta and add up over missions, each times its weight: A = G . S is one sparse
   product for all theta.
3. Whitening: c = mean + R e, e ~ N(0, I), R = sd times the root of the prior's correlation. No
   prior is inverted, so that a scale of 0 is exact.
4. Elimination: columns of one robot alone touch no chain of another; with blocks of robots first,
   the matrix [[I + R'AR, .], [h'R, r'r]], h = sum U'C'r, is an arrow, and its Cholesky factor costs
   a factor for each block. Its last diagonal element is the root of the misfit, and

    -2 log p = sum log |V| + log |I + R'AR| + misfit + n log 2 pi.

5. Draws: e from the same factor, c = mean + R e.

Exact: the only errors are those of rounding. References: sequential conditioning of a Gaussian
state space, and the bordered Cholesky factor of least squares (Golub and Van Loan 2013, 5.3).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg.blas import dsyrk, dtrsm  # pyright: ignore
from scipy.linalg.lapack import dpotrf, dtrtrs  # pyright: ignore

from trustbo.errors import require_choice
from trustbo.inference.evidence.scan import Sums, take_projections, weigh_chains
from trustbo.models.effects.effect import Columns, Group, Prior, Slots, Theta

MEMORIES = ("level", "deviation")
_NUMBERS = 1e6  # kept at once, of all points of a chunk: about the cache


class Gaussian:
    """Evidence of Gaussian rates; exact."""

    exact = True

    def __init__(
        self,
        slots: Slots,
        groups: Sequence[Group],
        x0: tuple[float, float] = (0.5, 0.5),
        memory: str = "level",
    ) -> None:
        """Sum products of columns over missions.

        Args:
            slots: Rates of all chains.
            groups: Columns of all effects.
            x0: Mean and sd of trust before the first bound.
            memory: `"level"`, trust is carried on, or `"deviation"` from what effects expect.
        """
        self.slots, self.groups, self.x0 = slots, tuple(groups), x0
        self.level = require_choice("memory", memory, MEMORIES) == "level"
        seen = ~np.isnan(slots.y)
        self.seen, self.kind = np.unique(seen, axis=0, return_inverse=True)
        self.kind = self.kind.ravel()
        self.n_measured = float(slots.weight @ seen.sum(1))
        self.mass = np.bincount(self.kind, slots.weight, len(self.seen))
        self.y = np.where(seen, slots.y, 0.0)
        joined = joined_columns(groups)
        U = sparse.hstack([group.columns for group in groups], format="csr")
        ahead = np.cumsum(seen[:, ::-1], axis=1)[:, ::-1] > 0  # up to the last rate of a chain
        U: Columns = sparse.csr_array(sparse.diags_array(ahead.ravel().astype(float)) @ U)
        U.eliminate_zeros()
        self.order, self.blocks = self._arrow(U, joined)
        place = np.argsort(self.order)
        self.joined = [slice(place[c.start], place[c.stop - 1] + 1) for c in joined]
        self.U = U[:, self.order]
        self._gram()

    def log_density(self, theta: Theta) -> np.ndarray:
        """See `Evidence.log_density`."""
        n = len(theta["beta0"])
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            parts = [self._factors(_take(theta, i)).log_p for i in self._chunks(n)]
        return np.concatenate([np.zeros(0), *parts])

    def recentre(self, theta: Theta) -> None:
        """No-op: the density is exact everywhere."""

    def draw(
        self, theta: Theta, count: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """See `Evidence.draw`; no weights are needed."""
        c = self.coefficients(theta, count, rng)
        of_draw = {name: np.repeat(values, count) for name, values in theta.items()}
        return named_effects(self.groups, c, of_draw, rng), None

    def scan(
        self, theta: Theta, columns: Columns, run: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Products a = z'C^-1 z and b = z'C^-1 r of further columns z, each (point, column).

        r are the rates less their mean and C is their covariance, each through L^-1 M z as above:
        with a coefficient N(0, t^2) of z, the log evidence rises by
        -log(1 + t^2 a) / 2 + t^2 b^2 / (2 (1 + t^2 a)), and given the rates the coefficient has
        variance 1 / (a + t^-2) and mean b times that.

        Args:
            theta: Hyperparameters, each (point,).
            columns: Sparse matrix (slot, column).
            run: Run of each column (column,), runs being contiguous: z is the sum of a column and
                of all later ones of its run, which may not share a chain. By default z is the
                column.
        """
        run = np.arange(columns.shape[1]) if run is None else run
        sums = Sums.of(sparse.csc_array(columns))
        (atom, column), G = self._products(sums.atoms)
        shape = sums.atoms.shape[1], len(self.order)
        start = np.searchsorted(atom, np.arange(shape[0] + 1))
        out = np.zeros((2, len(theta["beta0"]), columns.shape[1]))
        for i in self._chunks(len(theta["beta0"])):
            some = _take(theta, i)
            factors = self._factors(some)
            N, E, _ = impulses(some, self.x0[1], self.seen)
            C = N if self.level else E
            S = np.swapaxes(C, 2, 3) @ C
            R, _ = self._residual(some, N, E, factors.prior.mean)
            values = (G @ _upper(S).T).T
            for t in range(len(S)):
                a, b = out[0, i.start + t], out[1, i.start + t]
                weigh_chains(a, b, S[t], self.kind, self.slots.weight, R[t], *sums.slots, run)
                half, right = self._half(factors, t)
                T = sparse.csr_array((values[t], column, start), shape=shape) @ half
                take_projections(a, b, T, right, *sums.of_atoms, run)
        return out[0], out[1]

    def coefficients(self, theta: Theta, count: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Coefficients (draw, column) in the order of the groups, see `draw`."""
        drawn = []
        for i in self._chunks(len(count)):
            factors = self._factors(_take(theta, i))
            drawn += [self._draw(factors, t, int(n), rng) for t, n in enumerate(count[i])]
        c = np.empty((int(count.sum()), len(self.order)))
        c[:, self.order] = np.concatenate(drawn)
        return c

    def _arrow(self, U: Columns, joined: list[slice]) -> tuple[np.ndarray, list[slice]]:
        """Order of columns, those of one robot alone first, and the slices of their blocks.

        The last block has the columns that robots share, and the rates.
        """
        n_robots, entries = self.slots.n_robots, U.tocoo()
        robot = np.repeat(self.slots.robot, self.slots.y.shape[1])
        touched = np.zeros((U.shape[1], n_robots), dtype=bool)
        touched[entries.col, robot[entries.row]] = True
        for columns in joined:
            touched[columns] = touched[columns].any(0)
        block = np.where(touched.sum(1) == 1, touched.argmax(1), n_robots)
        order = np.argsort(block, kind="stable")
        limits = np.searchsorted(block[order], np.arange(n_robots + 2)).tolist()
        limits[-1] += 1
        return order, [slice(i, j) for i, j in itertools.pairwise(limits) if i < j]

    def _gram(self) -> None:
        """Step 2: G (entry of A, pair of bounds of a kind), and the entries that may not be 0.

        Entries within a block are in both triangles, others in the lower one.
        """
        m = self.U.shape[1]
        block = np.searchsorted([b.stop for b in self.blocks], np.arange(m), side="right")
        (row, column), G = self._products(self.U)
        kept = (row >= column) | (block[row] == block[column])
        self._entry, self._G = (row * (m + 1) + column)[kept], G[kept]

    def _products(self, left: Columns) -> tuple[tuple[np.ndarray, np.ndarray], Columns]:
        """Products of columns `left` (slot, left) and all columns, by pair of bounds of a kind.

        Left and column of the entries, in order, and the sparse matrix (entry, pair).
        """
        (n_kinds, K), m, n_left = self.seen.shape, self.U.shape[1], left.shape[1]
        pair = np.zeros((K, K), dtype=int)
        pair[np.triu_indices(K)] = np.arange(n_pairs := K * (K + 1) // 2)
        pair = np.maximum(pair, pair.T)
        rows, columns, values = [], [], []
        for q in range(n_kinds):
            mine = np.flatnonzero(self.kind == q)
            slot = (mine[:, None] * K + np.arange(K)).ravel()
            X = sparse.csr_array(self.U[slot].reshape(len(mine), K * m))
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
        numbers = (len(self.order) + 1) ** 2 + len(self._entry) + 4 * n_kinds * K**2 + n_chains * K
        size = max(4, int(_NUMBERS / numbers))
        return [slice(i, min(i + size, n)) for i in range(0, n, size)]

    def _factors(self, theta: Theta) -> "_Factors":
        """Steps 1 to 4 at each theta."""
        n, m = len(theta["beta0"]), len(self.order)
        prior = self._prior(theta)
        N, E, log_det = impulses(theta, self.x0[1], self.seen)
        C = N if self.level else E
        P = np.zeros((n, m + 1, m + 1))
        P.reshape(n, -1)[:, self._entry] = (self._G @ _upper(np.swapaxes(C, 2, 3) @ C).T).T
        r, P[:, -1, -1] = self._residual(theta, N, E, prior.mean)
        P[:, -1, :-1] = (self.U.T @ r.T).T
        self._whiten(P, prior)
        arrows = [_eliminate(one, self.blocks) for one in P]
        log_p = -0.5 * (log_det @ self.mass + self.n_measured * np.log(2.0 * np.pi))
        log_p -= [0.5 * arrow.minus_two_log for arrow in arrows]
        return _Factors(log_p, arrows, prior)

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
        R, misfit = np.empty((n, n_chains, K)), np.zeros(n)
        for q in range(len(self.seen)):
            mine = np.flatnonzero(self.kind == q)
            C = N[:, q] if self.level else E[:, q]
            r = self.y[mine] @ np.swapaxes(E[:, q], 1, 2) - expected[:, mine] @ np.swapaxes(C, 1, 2)
            if self.level:
                r -= (theta["beta0"] * self.x0[0])[:, None, None] * N[:, q, None, :, 0]
            weight = self.slots.weight[mine, None]
            misfit += (weight * r**2).sum((1, 2))
            R[:, mine] = (weight * r) @ C
        return R.reshape(n, -1), misfit

    def _whiten(self, P: np.ndarray, prior: Prior) -> None:
        """Step 3: from A, h to I + R'AR, R'h, in place."""
        m, shared = len(self.order), self.blocks[-1]
        sd = np.concatenate([prior.sd, np.ones((len(P), 1))], axis=1)
        for block in self.blocks:
            for rows in (block, shared) if block != shared else (shared,):
                P[:, rows, block] *= sd[:, rows, None] * sd[:, None, block]
        for columns, root in zip(self.joined, prior.roots, strict=True):
            block = next(b for b in self.blocks if columns.start < b.stop)
            left = slice(0, m) if block == shared else block  # where rows of a block are not 0
            P[:, columns, left] = np.swapaxes(root, 1, 2) @ P[:, columns, left]
            P[:, block, columns] = P[:, block, columns] @ root
            if block != shared:
                P[:, shared, columns] = P[:, shared, columns] @ root
        diagonal = np.arange(m)
        P[:, diagonal, diagonal] += 1.0

    def _half(self, factors: "_Factors", t: int) -> tuple[np.ndarray, np.ndarray]:
        """R F'^-1 (column, column) at the t-th theta, F the factor of I + R'AR, and F^-1 R'h."""
        arrow, prior, shared = factors.arrows[t], factors.prior, self.blocks[-1]
        R, last = np.diag(prior.sd[t]), slice(shared.start, shared.stop - 1)
        for columns, root in zip(self.joined, prior.roots, strict=True):
            R[columns, columns] = prior.sd[t][columns, None] * root[t]
        half, right = np.zeros_like(R), np.zeros(len(R))
        for block, (F, X) in zip(self.blocks, arrow.robots, strict=False):
            half[block, block] = dtrsm(1.0, F, R[block, block].T, lower=1).T
            half[block, last] = -half[block, block] @ X[:-1].T
            right[block] = X[-1]
        if last.start < last.stop:
            half[last, last] = R[last, last]
            half[:, last] = dtrsm(1.0, arrow.shared[:-1, :-1], half[:, last].T, lower=1).T
            right[last] = arrow.shared[-1, :-1]
        return half, right

    def _draw(self, factors: "_Factors", t: int, n: int, rng: np.random.Generator) -> np.ndarray:
        """Step 5: coefficients (draw, column), in their order, at the t-th theta."""
        arrow, prior = factors.arrows[t], factors.prior
        e, shared = rng.standard_normal((len(self.order), n)), self.blocks[-1]
        F, last = arrow.shared[:-1, :-1], slice(shared.start, shared.stop - 1)
        if len(F):
            e[last] = dtrtrs(F, arrow.shared[-1, :-1, None] + e[last], lower=1, trans=1)[0]
        for block, (F, X) in zip(self.blocks, arrow.robots, strict=False):
            right = X[-1, :, None] - X[:-1].T @ e[last] + e[block]
            e[block] = dtrtrs(F, right, lower=1, trans=1)[0]
        for columns, root in zip(self.joined, prior.roots, strict=True):
            e[columns] = root[t] @ e[columns]
        return prior.mean[t] + prior.sd[t] * e.T


class _Arrow(NamedTuple):
    """Cholesky factor of the arrow of one theta."""

    robots: list[tuple[np.ndarray, np.ndarray]]  # factor of a block, and its rows of the last block
    shared: np.ndarray  # factor of the last block
    minus_two_log: float
    """Log |I + R'AR| + misfit; NaN where there is no factor."""


class _Factors(NamedTuple):
    """Density, factor and prior at each of some theta."""

    log_p: np.ndarray
    arrows: list[_Arrow]
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
    priors = [group.prior(theta) for group in groups]
    mean, sd = (np.concatenate([p[i] for p in priors], axis=1) for i in range(2))
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
    theta: Theta, x0_sd: float, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Step 1: N and E (point, kind, bound, bound) and log |V| (point, kind).

    Args:
        theta: Hyperparameters beta0, delta_w, delta_v, each (point,).
        x0_sd: Sd of trust before the first bound.
        seen: Mask of the measured rates (kind, bound).
    """
    n, (n_kinds, K) = len(theta["beta0"]), seen.shape
    b, Q, R = (
        theta["beta0"][:, None],
        theta["delta_w"][:, None] ** 2,
        theta["delta_v"][:, None] ** 2,
    )
    N, gain = np.zeros((n, n_kinds, K, K)), np.zeros((n, n_kinds, K))
    m, P = np.zeros((n, n_kinds, K)), np.broadcast_to((b * x0_sd) ** 2 + Q, (n, n_kinds))
    log_det = np.zeros((n, n_kinds))
    for k in range(K):
        F = P + R
        gain[..., k] = np.where(seen[:, k], P / F, 0.0)
        left = np.where(seen[:, k], R / F, 1.0)
        m[..., k] = 1.0
        N[..., k, : k + 1] = m[..., : k + 1] * np.where(seen[:, k], F**-0.5, 0.0)[..., None]
        m[..., : k + 1] *= (b * left)[..., None]
        log_det += np.where(seen[:, k], np.log(F), 0.0)
        P = b * b * P * left + Q
    E = np.zeros_like(N)
    E[..., :-1] = N[..., 1:] * (-b[..., None] * gain[..., :-1])[..., None, :]
    diagonal = np.arange(K)
    E[..., diagonal, diagonal] = N[..., diagonal, diagonal]
    return N, E, log_det


def _eliminate(P: np.ndarray, blocks: list[slice]) -> _Arrow:
    """Step 4: Cholesky factor of an arrow, block by block."""
    last, robots, total = blocks[-1], [], 0.0
    rest = np.asfortranarray(P[last, last])
    for block in blocks[:-1]:
        F, failed = dpotrf(P[block, block], lower=1)
        if failed:
            return _Arrow([], rest, np.nan)
        X = dtrsm(1.0, F, P[last, block], side=1, lower=1, trans_a=1)
        rest = dsyrk(-1.0, X, beta=1.0, c=rest, lower=1, overwrite_c=1)
        total += 2.0 * np.log(F.diagonal()).sum()
        robots.append((F, X))
    F, failed = dpotrf(rest, lower=1)
    diagonal = F.diagonal()
    total += 2.0 * np.log(diagonal[:-1]).sum() + diagonal[-1] ** 2
    return _Arrow(robots, F, np.nan if failed else total)


def _upper(S: np.ndarray) -> np.ndarray:
    """Upper triangles of S (point, kind, bound, bound), (point, pair of bounds of a kind)."""
    return S[:, :, *np.triu_indices(S.shape[2])].reshape(len(S), -1)


def _take(theta: Theta, points: slice) -> dict[str, np.ndarray]:
    return {name: values[points] for name, values in theta.items()}
