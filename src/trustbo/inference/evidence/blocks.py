"""Evidence of missions with separate effects: trust and these effects integrated out together.

Method: expectation propagation on dense blocks, one of each mission (a person; its rows are the
bounds of its robots, with a report or without). Given hyperparameters, trust at the rows is

    x = m + V c + e,  e ~ N(0, S),  S = autoregression + W diag(sd^2) W',

c the coefficients that all missions share, V their columns, of which those that last are carried
on by beta0, and W those of the mission's own effects. Each report's term is replaced by a site
exp(-lam (x - z)^2 / 2), exact for a Gaussian one, so that c integrates out by one Cholesky factor
of as many rows as there are shared columns, for any number of missions. Marginals of x give
cavities, and sites are matched, all at once, as in `ep.joint`, of which a block is a dense form.

Draws: given c, each block's trust is drawn row by row from its prior times the sites of later rows
times the row's own term, and weighted by the ratio of masses of term and site (twisted particles,
as in `ep.draws`). The mean weight of some particles is an unbiased estimate of the block's
likelihood; draws of c with the product of these as weights are exact for any number of particles
(importance sampling squared). The own effects follow from the trust that is drawn.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from trustbo.inference.evidence.ep.draws import log_student
from trustbo.inference.evidence.ep.joint import backward, cholesky, solve
from trustbo.models.effects.effect import Group, Slots, Theta
from trustbo.models.effects.person import PersonColumns
from trustbo.models.families.terms import (
    GAUSSIAN,
    INTERVAL,
    LOG_2PI,
    NONE,
    OPTIONS,
    PART_OPTIONS,
    draw_interval,
    log_overlap,
    match_interval,
)
from trustbo.models.scales import Scale
from trustbo.parallel import plain

_SWEEPS, _MOST, _SETTLED = 2, 8, 12  # sweeps from kept sites, at most, and to find them
_PARTICLES = 2
_TEMPER, _TEMPER_AT_END = 0.8, 0.5  # precision of the wide proposal's sites
_SHARES = (0.5, 0.4, 0.1)  # of the proposals of the shared coefficients
_LEAST = 1e-4  # sd of a coefficient
_NOISE = 1e-6


class Rows(NamedTuple):
    """Rows of all blocks; block i has those from `start[i]` to `start[i + 1]`."""

    start: np.ndarray  # (block + 1,), of measured rows
    step: np.ndarray  # (block + 1,), of bounds
    U: np.ndarray  # (bound, column), shared columns of the drift
    own: np.ndarray  # (bound, own column)
    begins: np.ndarray  # (bound,), whether it is the first of its chain
    row: np.ndarray  # (bound,), its row, or -1
    y: np.ndarray  # (row,), 0 where a report is an interval or none
    kind: np.ndarray  # (row,), NONE, GAUSSIAN or INTERVAL
    case: np.ndarray  # (row,), index of its limits


class Blocks:
    """Evidence by expectation propagation on blocks; exact where no report is an interval."""

    def __init__(
        self,
        slots: Slots,
        shared: Group,
        own: PersonColumns,
        scale: Scale,
        x0: tuple[float, float],
        lasting: tuple[np.ndarray, np.ndarray],
        *,
        asked: np.ndarray | None = None,
    ) -> None:
        """Lay out the rows of all missions.

        Args:
            slots: Reports of all chains.
            shared: Columns that all missions share, with independent coefficients.
            own: Columns of each mission.
            scale: Scale of the reports.
            x0: Mean and sd of trust before the first bound.
            lasting: Masks of the shared columns and of the own ones that beta0 carries on.
            asked: Mask (chain, bound) of bounds that are rows without a report too, for draws of
                their trust.
        """
        self.slots, self.shared, self.own, self.scale = slots, shared, own, scale
        self.x0 = np.array(x0, dtype=float)
        self.lasting = tuple(np.array(mask, dtype=float) for mask in lasting)
        self.rows, self.index, self.at = _rows(slots, shared, own, scale, asked)
        self.exact = not (self.rows.kind == INTERVAL).any()
        self.sites = np.zeros((2, len(self.rows.y)))
        self._guess()
        self._sweeps = _SWEEPS

    @property
    def n_columns(self) -> int:
        """Number of shared columns."""
        return self.rows.U.shape[1]

    def log_density(self, theta: Theta) -> np.ndarray:
        """See `Evidence.log_density`."""
        out = np.full(len(theta["beta0"]), np.nan)
        some = np.flatnonzero((theta["delta_w"] > _NOISE) & (theta["delta_v"] > _NOISE))
        if len(some):
            given = self._given({name: values[some] for name, values in theta.items()})
            out[some] = _log_evidence(
                given, self.x0, self.lasting, self.rows, self.sites, self._sweeps
            )
        return out

    def recentre(self, theta: Theta) -> None:
        """See `Evidence.recentre`: sites at one theta, from which sweeps start."""
        given = self._given(theta)
        self.sites = _settle(given, self.x0, self.lasting, self.rows, self.sites, _SETTLED)

    def sharpen(self) -> bool:
        """See `Evidence.sharpen`: twice as many sweeps."""
        if self.exact or self._sweeps == _MOST:
            return False
        self._sweeps *= 2
        return True

    def draw(
        self, theta: Theta, count: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """See `Evidence.draw`."""
        n, D = int(count.sum()), self.n_columns
        nu = 1e6 if self.exact else max(12.0, 2.0 * D)
        c = rng.standard_normal((n, D))
        c /= np.sqrt(rng.chisquare(nu, (n, 1)) / nu) if not self.exact else 1.0
        _, _, own, log_weight = self._run(theta, count, c, rng, n_particles=_PARTICLES, nu=nu)
        of_draw = {name: np.repeat(values, count, axis=0) for name, values in theta.items()}
        named = self.shared.name(c, of_draw, rng) | self.own.name(own, of_draw)
        return named, None if self.exact else log_weight

    def given(
        self, theta: Theta, c: np.ndarray, rng: np.random.Generator, n_particles: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Trust, likelihoods and own effects under draws of theta and of shared coefficients.

        Args:
            theta: Hyperparameters, each (draw,).
            c: Shared coefficients (draw, column).
            rng: Random number generator.
            n_particles: Number of particles of a block.

        Returns:
            One draw of trust given all reports (draw, row); the log likelihood of each mission, the
            person's effects integrated out too, (draw, mission); and a draw of these effects given
            that trust, (draw, mission, own column).
        """
        count = np.ones(len(c), dtype=int)
        x, log_block, own, _ = self._run(
            theta, count, c.copy(), rng, n_particles=n_particles, nu=0.0
        )
        out = np.zeros((len(c), self.slots.n_missions))
        out[:, self.index] = log_block
        return x, out, own

    def _run(
        self,
        theta: Theta,
        count: np.ndarray,
        c: np.ndarray,
        rng: np.random.Generator,
        *,
        n_particles: int,
        nu: float,
    ) -> tuple[np.ndarray, ...]:
        """Trust, log likelihoods of blocks, own effects and log weights; `c` is filled in."""
        n = len(c)
        x, log_block = np.empty((n, len(self.rows.y))), np.empty((n, len(self.index)))
        own, log_weight = np.zeros((n, len(self.index), self.own.n_columns)), np.empty(n)
        _draws(
            self._given(theta), self.x0, self.lasting, self.rows, self.sites, self._sweeps, nu,
            n_particles, count, c, x, log_block, own, log_weight, self.exact, rng,
        )  # fmt: skip
        effects = np.zeros((n, self.slots.n_missions, self.own.n_columns))
        effects[:, self.index] = own
        # Missions without a report have effects of their prior.
        silent = np.setdiff1d(np.arange(self.slots.n_missions), self.index)
        sds = np.repeat(self.own.sds(theta), count, axis=0)[:, None]
        effects[:, silent] = sds * rng.standard_normal((n, len(silent), self.own.n_columns))
        return x, log_block, effects, log_weight

    def moments(self, theta: Theta, c: np.ndarray, mission: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean (draw, row) and covariance (draw, row, row) of a mission's trust before any report.

        Args:
            theta: Hyperparameters, each (draw,).
            c: Shared coefficients (draw, column).
            mission: Index of the mission.
        """
        i = int(np.flatnonzero(self.index == mission)[0])
        first, last = self.rows.start[i : i + 2]
        size = len(c), last - first
        mean, cov = np.empty(size), np.empty((*size, size[1]))
        _moments_of(self._given(theta), self.x0, self.lasting, self.rows, i, c, mean, cov)
        return mean, cov

    def _given(self, theta: Theta) -> "_Given":
        """Arguments of the kernels at each theta."""
        prior = self.shared.prior(theta)
        core = (theta[name] for name in ("beta0", "delta_w", "delta_v"))
        sd, own = np.maximum(prior.sd, _LEAST), self.own.sds(theta)
        numbers = (*core, prior.mean, sd, own, self.scale.limits(theta), self.scale.noise)
        return _Given(*(plain(np.asarray(values, dtype=float)) for values in numbers))

    def _guess(self) -> None:
        """Sites to begin with: reports taken for their middle, with a sd of .2."""
        theta = {name: np.zeros(1) for name in self.scale.names}
        low, high = self.scale.limits(theta)[0].T if self.scale.n_cases else np.zeros((2, 1))
        low, high = np.maximum(low, -0.1), np.minimum(high, 1.1)
        cut = self.rows.kind == INTERVAL
        middle = 0.5 * (low + high)[np.where(cut, self.rows.case, 0)]
        self.sites[0] = np.where(cut, 25.0, 0.0)
        self.sites[1] = np.where(cut, 25.0 * middle, 0.0)


class _Given(NamedTuple):
    """Hyperparameters of the kernels, leading axis (point,)."""

    beta0: np.ndarray
    delta_w: np.ndarray
    delta_v: np.ndarray
    mean: np.ndarray  # (point, column), prior of the shared coefficients
    sd: np.ndarray
    own_sd: np.ndarray  # (point, own column)
    limits: np.ndarray  # (point, case, 2)
    noise: np.ndarray  # (component, 2), weights and sds by delta_v, see `Scale.noise`


def _rows(
    slots: Slots, shared: Group, own: PersonColumns, scale: Scale, asked: np.ndarray | None
) -> tuple[Rows, np.ndarray, np.ndarray]:
    """Rows of the blocks, the mission of each block, and chain and bound of each row."""
    U = shared.columns.toarray().reshape(*slots.y.shape, -1)
    n_ticks = np.full(slots.y.shape, np.nan) if slots.n_ticks is None else slots.n_ticks
    kind, case = scale.terms(slots.y, n_ticks)
    kept = kind != NONE if asked is None else asked | (kind != NONE)
    missions = np.unique(slots.mission)
    of_bounds: list[tuple[Any, ...]] = []
    start, step, n_rows = [0], [0], 0
    for j in missions:
        for chain in np.flatnonzero(slots.mission == j):
            for k in range(int(np.flatnonzero(kept[chain])[-1]) + 1):
                of_bounds.append((chain, k, n_rows if kept[chain, k] else -1))
                n_rows += kept[chain, k]
        start.append(n_rows)
        step.append(len(of_bounds))
    chain, k, row = np.array(of_bounds, dtype=int).T
    at = row >= 0
    y = np.where(kind == GAUSSIAN, np.nan_to_num(slots.y), 0.0)
    columns = start, step, U[chain, k], own.values[chain, k], k == 0, row
    of_rows = (values[chain, k][at] for values in (y, kind, case))
    rows = Rows(*(plain(np.asarray(values)) for values in (*columns, *of_rows)))
    return rows, missions, np.stack([chain[at], k[at]])


@njit(**PART_OPTIONS)
def _prior(given, t, x0, lasting, rows, i, room):
    """Fill in the columns, the mean and the covariance of the rows of a block, before reports."""
    V, m, S, w, P = room.V, room.m, room.S[i], room.w, room.P
    b0, q = given.beta0[t], given.delta_w[t] ** 2
    D, L, first = rows.U.shape[1], rows.own.shape[1], rows.start[i]
    v, own, constant, var, chain = np.zeros(D), np.zeros(L), 0.0, 0.0, 0
    for s in range(rows.step[i], rows.step[i + 1]):
        if rows.begins[s]:
            v[:], own[:], constant, var, chain = 0.0, 0.0, x0[0], x0[1] * x0[1], s
        for a in range(D):
            v[a] = b0 * lasting[0][a] * v[a] + rows.U[s, a]
        for a in range(L):
            own[a] = b0 * lasting[1][a] * own[a] + rows.own[s, a]
        constant, var = b0 * constant, b0 * b0 * var + q
        r = rows.row[s] - first
        if r < 0:
            continue
        m[first + r] = constant
        for a in range(D):
            V[first + r, a] = v[a]
        for a in range(L):
            w[first + r, a] = own[a]
        P[r, 0], P[r, 1] = var, s
        for k in range(r + 1):
            z = 0.0
            for a in range(L):
                z += own[a] * given.own_sd[t, a] ** 2 * w[first + k, a]
            if P[k, 1] >= chain:
                z += b0 ** (s - P[k, 1]) * P[k, 0]
            S[r, k] = S[k, r] = z


@njit(**PART_OPTIONS)
def _whiten(rows, i, lam, eta, room):
    """Factor L of a block under its sites, and `constant`, the log of its integral over x.

    With T the sites' precisions, z their centres and LL' = T^(1/2) S T^(1/2) + 1, `KV` becomes
    L^-1 T^(1/2) V (row, column) and `Kd` L^-1 T^(1/2) (z - m) (row,).
    """
    f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
    S, L, work, KV, Kd = room.S[i], room.L[i], room.work, room.KV, room.Kd
    D, constant = room.V.shape[1], 0.0
    for r in range(n):
        for k in range(r + 1):
            work[r, k] = S[r, k] * math.sqrt(lam[f + r] * lam[f + k])
        work[r, r] += 1.0
    if not cholesky(work[:n, :n], L[:n, :n]):
        room.constant[i] = np.nan
        return
    for r in range(n):
        p = lam[f + r]
        root, scale = math.sqrt(p), 1.0 / L[r, r]
        constant += math.log(scale)
        for k in range(D):
            KV[f + r, k] = root * scale * room.V[f + r, k]
        Kd[f + r] = root * scale * (eta[f + r] / p - room.m[f + r]) if p > 0.0 else 0.0
        for j in range(r):
            z = L[r, j] * scale
            for k in range(D):
                KV[f + r, k] -= z * KV[f + j, k]
            Kd[f + r] -= z * Kd[f + j]
        if rows.kind[f + r] == GAUSSIAN:
            constant += 0.5 * (math.log(p) - LOG_2PI)
        elif rows.kind[f + r] == INTERVAL:
            constant += 0.5 * eta[f + r] ** 2 / p
    room.constant[i] = constant


@njit(**PART_OPTIONS)
def _condition(rows, i, lam, room, whole):
    """Mean AV c + a and covariance C of a whitened block's x given c.

    Of C its diagonal alone unless `whole`, then its lower triangle. `work` holds L^-1 T^(1/2) S.
    """
    f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
    S, L, C, work, AV, a = room.S[i], room.L[i], room.C[i], room.work, room.AV, room.a
    D = room.V.shape[1]
    for r in range(n):
        root, scale = math.sqrt(lam[f + r]), 1.0 / L[r, r]
        for k in range(n):
            work[r, k] = root * scale * S[r, k]
        for j in range(r):
            z = L[r, j] * scale
            for k in range(n):
                work[r, k] -= z * work[j, k]
        for k in range(D):
            AV[f + r, k] = room.V[f + r, k]
        a[f + r] = room.m[f + r]
        for k in range(0 if whole else r, r + 1):
            C[r, k] = S[r, k]
    for j in range(n):
        for r in range(n):
            z = work[j, r]
            for k in range(D):
                AV[f + r, k] -= z * room.KV[f + j, k]
            a[f + r] += z * room.Kd[f + j]
            for k in range(0 if whole else r, r + 1):
                C[r, k] -= z * work[j, k]


class _Room(NamedTuple):
    """Arrays that the kernels write to."""

    V: np.ndarray  # (row, column), columns before reports
    m: np.ndarray  # (row,), mean
    S: np.ndarray  # (block, row, row), covariance
    w: np.ndarray  # (row, own column)
    P: np.ndarray  # (row, 2), variance and bound of each row of a block
    L: np.ndarray  # (block, row, row), see `_whiten`; at last factors of C
    C: np.ndarray  # (block, row, row), see `_condition`
    KV: np.ndarray  # (row, column)
    Kd: np.ndarray  # (row,)
    AV: np.ndarray  # (row, column)
    a: np.ndarray  # (row,)
    constant: np.ndarray  # (block,)
    work: np.ndarray  # (row, row)


@njit(**PART_OPTIONS)
def _room(rows):
    """New arrays, and sites lam and eta (row,), and Q and h of the shared coefficients."""
    n, n_blocks, most = len(rows.y), len(rows.start) - 1, 0
    for i in range(n_blocks):
        most = max(most, rows.start[i + 1] - rows.start[i])
    D, square = rows.U.shape[1], (n_blocks, most, most)
    room = _Room(
        np.zeros((n, D)), np.zeros(n), np.zeros(square), np.zeros((n, rows.own.shape[1])),
        np.zeros((most, 2)), np.zeros(square), np.zeros(square), np.zeros((n, D)), np.zeros(n),
        np.zeros((n, D)), np.zeros(n), np.zeros(n_blocks), np.zeros((most, most)),
    )  # fmt: skip
    return room, np.empty(n), np.empty(n), np.zeros((D, D)), np.zeros(D)


@njit(**PART_OPTIONS)
def _start(given, t, rows, kept, lam, eta):
    """Sites to begin with: exact ones of Gaussian terms, those kept of intervals."""
    precision = 1.0 / given.delta_v[t] ** 2
    for r in range(len(rows.y)):
        lam[r], eta[r] = kept[0, r], kept[1, r]
        if rows.kind[r] == GAUSSIAN:
            lam[r], eta[r] = precision, precision * rows.y[r]


@njit(**PART_OPTIONS)
def _gather(given, t, rows, lam, eta, room, Q, h):
    """Quadratic form of the shared coefficients, prior included; the log constant, without it."""
    D, total = len(h), 0.0
    for a in range(D):
        for b in range(D):
            Q[a, b] = 0.0
        p = given.sd[t, a] ** -2.0
        Q[a, a], h[a] = p, p * given.mean[t, a]
        total -= 0.5 * h[a] * given.mean[t, a] + math.log(given.sd[t, a])
    for i in range(len(rows.start) - 1):
        _whiten(rows, i, lam, eta, room)
        total += room.constant[i]
    KV, Kd = room.KV, room.Kd
    for r in range(len(rows.y)):
        total -= 0.5 * Kd[r] * Kd[r]
        for a in range(D):
            h[a] += KV[r, a] * Kd[r]
            for b in range(a + 1):
                Q[a, b] += KV[r, a] * KV[r, b]
    return total


@njit(**PART_OPTIONS)
def _sweep(given, t, rows, lam, eta, room, Q, h, F, mean, damp):
    """Log evidence under the sites, which are matched then, in place if `damp` > 0."""
    D, total = len(h), _gather(given, t, rows, lam, eta, room, Q, h)
    total += 0.5 * solve(Q, h, F, mean)
    if not np.isfinite(total):
        return np.nan
    AV, u = room.AV, np.empty(D)
    for i in range(len(rows.start) - 1):
        f, g = rows.start[i], rows.start[i + 1]
        some = False
        for r in range(f, g):
            some = some or rows.kind[r] == INTERVAL
        if not some:
            continue
        _condition(rows, i, lam, room, False)
        for r in range(f, g):
            if rows.kind[r] != INTERVAL:
                continue
            x, v = room.a[r], room.C[i, r - f, r - f]
            for j in range(D):  # AV' Q^-1 AV = |F^-1 AV|^2
                x += AV[r, j] * mean[j]
                z = AV[r, j]
                for k in range(j):
                    z -= F[j, k] * u[k]
                u[j] = z / F[j, j]
                v += u[j] * u[j]
            lv, e = lam[r], eta[r]
            rest = max(1.0 / v - lv, 1e-9)
            low, high = given.limits[t, rows.case[r]]
            mass, new, slope = match_interval(
                low, high, given.delta_v[t], given.noise, (x / v - e) / rest, 1.0 / rest, lv, e
            )
            total += mass
            lam[r] += damp * (new - lv)
            eta[r] += damp * (slope - e)
    return total


@njit(**PART_OPTIONS)
def _prepare(given, t, x0, lasting, rows, room, kept, lam, eta):
    """Lay out all blocks at a point, and the sites to begin with."""
    for i in range(len(rows.start) - 1):
        _prior(given, t, x0, lasting, rows, i, room)
    _start(given, t, rows, kept, lam, eta)


@njit(**OPTIONS)
def _log_evidence(given, x0, lasting, rows, kept, n_sweeps):
    """Log evidence at each point; the last sweep only evaluates."""
    room, lam, eta, Q, h = _room(rows)
    F, mean, out = np.zeros(Q.shape), np.zeros(len(h)), np.empty(len(given.beta0))
    for t in range(len(out)):
        _prepare(given, t, x0, lasting, rows, room, kept, lam, eta)
        for s in range(n_sweeps):
            damp = 1.0 if s + 1 < n_sweeps else 0.0
            out[t] = _sweep(given, t, rows, lam, eta, room, Q, h, F, mean, damp)
    return out


@njit(**OPTIONS)
def _settle(given, x0, lasting, rows, kept, n_sweeps):
    """Sites (2, row) after damped sweeps at the first point."""
    room, _, _, Q, h = _room(rows)
    F, mean, sites = np.zeros(Q.shape), np.zeros(len(h)), kept.copy()
    _prepare(given, 0, x0, lasting, rows, room, kept, sites[0], sites[1])
    for _ in range(n_sweeps):
        _sweep(given, 0, rows, sites[0], sites[1], room, Q, h, F, mean, 0.8)
    return sites


@njit(**OPTIONS)
def _moments_of(given, x0, lasting, rows, i, c, mean, cov):
    """Mean and covariance of the rows of block i at each point, before reports."""
    room, f, n = _room(rows)[0], rows.start[i], rows.start[i + 1] - rows.start[i]
    for t in range(len(c)):
        _prior(given, t, x0, lasting, rows, i, room)
        for r in range(n):
            z = room.m[f + r]
            for a in range(c.shape[1]):
                z += room.V[f + r, a] * c[t, a]
            mean[t, r] = z
            for k in range(n):
                cov[t, r, k] = room.S[i, r, k]


@njit(**PART_OPTIONS)
def _draw_block(given, t, rows, i, lam, eta, c, room, x, e, rng):
    """One particle of a block into x; its log weight."""
    f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
    G, total = room.L[i], 0.0
    for r in range(n):
        mean = room.a[f + r]
        for k in range(len(c)):
            mean += room.AV[f + r, k] * c[k]
        for k in range(r):
            mean += G[r, k] * e[k]
        d = G[r, r]
        if rows.kind[f + r] == INTERVAL:
            lv, s = lam[f + r], eta[f + r]
            v = 1.0 / max(1.0 / (d * d) - lv, 1e-9)
            m = v * (mean / (d * d) - s)
            low, high = given.limits[t, rows.case[f + r]]
            x[r], log_p = draw_interval(
                low, high, given.delta_v[t], given.noise, m, math.sqrt(v), rng
            )
            total += log_p - log_overlap(m, v, lv, s)
        else:
            x[r] = mean + d * rng.standard_normal()
        e[r] = (x[r] - mean) / d if d > 1e-12 else 0.0
    return total


@njit(**PART_OPTIONS)
def _factor(A, n, G):
    """Lower factor of a covariance, its pivots kept from 0."""
    for r in range(n):
        for k in range(r + 1):
            z = A[r, k]
            for j in range(k):
                z -= G[r, j] * G[k, j]
            G[r, k] = math.sqrt(max(z, 1e-14 + 1e-12 * A[r, r])) if k == r else z / G[k, k]


@njit(**PART_OPTIONS)
def _draw_own(given, t, rows, i, c, x, room, own, rng):
    """Own effects of a block given its trust x."""
    V, m, w, G = room.V, room.m, room.w, room.work
    f, n, L = rows.start[i], rows.start[i + 1] - rows.start[i], rows.own.shape[1]
    _factor(room.S[i], n, G)
    e, B = np.empty(n), np.empty((n, L))
    for r in range(n):  # G^-1 (x - m - V c), and G^-1 W diag(sd)
        z = x[r] - m[f + r]
        for k in range(len(c)):
            z -= V[f + r, k] * c[k]
        for k in range(r):
            z -= G[r, k] * e[k]
        e[r] = z / G[r, r]
        for a in range(L):
            z = w[f + r, a] * given.own_sd[t, a]
            for k in range(r):
                z -= G[r, k] * B[k, a]
            B[r, a] = z / G[r, r]
    left, root, noise = np.empty((L, L)), np.zeros((L, L)), np.empty(L)
    for a in range(L):
        noise[a] = rng.standard_normal()
        for b in range(L):
            z = 1.0 if a == b else 0.0
            for r in range(n):
                z -= B[r, a] * B[r, b]
            left[a, b] = z
    _factor(left, L, root)
    for a in range(L):
        z = 0.0
        for r in range(n):
            z += B[r, a] * e[r]
        for b in range(a + 1):
            z += root[a, b] * noise[b]
        own[a] = given.own_sd[t, a] * z


@njit(**PART_OPTIONS)
def _propose(given, t, mean, F, nu, exact, c, rng):
    """Shared coefficients of numbers c, in place; log prior density less that of the proposal.

    Proposals are EP's normal, a wider one, and the prior, which bounds the weights.
    """
    D, j, total, share = len(c), 0, 0.0, rng.random()
    if not exact:
        j = 0 if share < _SHARES[0] else 1 if share < _SHARES[0] + _SHARES[1] else 2
    backward(F[j], c)
    for k in range(D):
        c[k] += mean[j, k]
        z = (c[k] - given.mean[t, k]) / given.sd[t, k]
        total -= 0.5 * z * z + math.log(given.sd[t, k])
    if exact:
        return total
    top, mass = -np.inf, 0.0
    for i in range(3):
        a = log_student(c, mean[i], F[i], nu) + math.log(_SHARES[i])
        if a > top:
            top, mass = a, mass * math.exp(top - a) + 1.0
        else:
            mass += math.exp(a - top)
    return total - top - math.log(mass)


@njit(**PART_OPTIONS)
def _log_given(rows, i, room, c):
    """Log integral of a block under its sites given c."""
    total = room.constant[i]
    for r in range(rows.start[i], rows.start[i + 1]):
        z = room.Kd[r]
        for k in range(len(c)):
            z -= room.KV[r, k] * c[k]
        total -= 0.5 * z * z
    return total


@njit(**OPTIONS)
def _draws(given, x0, lasting, rows, kept, n_sweeps, nu, n_particles, count, c, x, log_block, own,
           log_weight, exact, rng):  # fmt: skip
    """Draws at each point in turn: trust, likelihoods of blocks, own effects and log weights.

    With nu > 0 the rows of `c` are numbers of a standard Student-t, or normal ones if `exact`, and
    become draws of the shared coefficients; with nu = 0 they are these.
    """
    D, n_blocks = rows.U.shape[1], len(rows.start) - 1
    room, lam, eta, Q, h = _room(rows)
    mean, F = np.zeros((3, D)), np.zeros((3, D, D))
    wide_lam, wide_eta = np.empty(len(rows.y)), np.empty(len(rows.y))
    most = len(room.work)
    particle, best, e = np.empty(most), np.empty(most), np.empty(most)
    d = 0
    for t in range(len(count)):
        _prepare(given, t, x0, lasting, rows, room, kept, lam, eta)
        if not exact:
            for _ in range(n_sweeps + 1):
                _sweep(given, t, rows, lam, eta, room, Q, h, F[0], mean[0], 1.0)
        if not exact and nu > 0.0:
            for r in range(len(rows.y)):
                factor = 1.0
                if rows.kind[r] == INTERVAL:
                    low, high = given.limits[t, rows.case[r]]
                    factor = _TEMPER if np.isfinite(high - low) else _TEMPER_AT_END
                wide_lam[r], wide_eta[r] = factor * lam[r], factor * eta[r]
            _gather(given, t, rows, wide_lam, wide_eta, room, Q, h)
            solve(Q, h, F[1], mean[1])
            for k in range(D):
                mean[2, k], F[2, k, k] = given.mean[t, k], 1.0 / given.sd[t, k]
        _gather(given, t, rows, lam, eta, room, Q, h)
        solve(Q, h, F[0], mean[0])
        for i in range(n_blocks):
            _condition(rows, i, lam, room, True)
            _factor(room.C[i], rows.start[i + 1] - rows.start[i], room.L[i])
        for _ in range(count[t]):
            total = 0.0
            if nu > 0.0:
                total = _propose(given, t, mean, F, nu, exact, c[d], rng)
            for i in range(n_blocks):
                f, n = rows.start[i], rows.start[i + 1] - rows.start[i]
                log_sum = -np.inf
                for _p in range(1 if exact else n_particles):
                    w = _draw_block(given, t, rows, i, lam, eta, c[d], room, particle, e, rng)
                    top = max(log_sum, w)
                    log_sum = top + math.log(math.exp(log_sum - top) + math.exp(w - top))
                    if math.log(1.0 - rng.random()) <= w - log_sum:  # a choice by weight
                        for r in range(n):
                            best[r] = particle[r]
                log_sum -= math.log(1 if exact else n_particles)
                log_block[d, i] = _log_given(rows, i, room, c[d]) + log_sum
                total += log_block[d, i]
                for r in range(n):
                    x[d, f + r] = best[r]
                _draw_own(given, t, rows, i, c[d], best, room, own[d, i], rng)
            log_weight[d] = total
            d += 1
