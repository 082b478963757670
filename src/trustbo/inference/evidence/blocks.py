"""Evidence of missions with separate effects: trust and these effects integrated out together.

Method: expectation propagation on dense blocks, one of each mission (a person; its rows are the
bounds of its robots, with a report or without): `block_sites` has the equations, `block_draws` the
draws, whose weights leave them exact.
"""

from typing import Any

import numpy as np

from trustbo.inference.evidence.block_draws import draw_blocks
from trustbo.inference.evidence.block_sites import Given, Rows, log_evidence, moments_of, settle
from trustbo.inference.evidence.evidence import Evidence, at, repeated
from trustbo.models.effects.effect import Group, Slots, Theta
from trustbo.models.effects.person import PersonColumns
from trustbo.models.families.terms import GAUSSIAN, INTERVAL, NONE
from trustbo.models.scales import Scale
from trustbo.parallel import plain

_SWEEPS, _MOST, _SETTLED = 2, 8, 12  # sweeps from kept sites, at most, and to find them
_PARTICLES = 2
_LEAST = 1e-4  # sd of a coefficient
_NOISE = 1e-6


class Blocks(Evidence):
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
            given = self._given(at(theta, some))
            out[some] = log_evidence(
                given, self.x0, self.lasting, self.rows, self.sites, self._sweeps
            )
        return out

    def recentre(self, theta: Theta) -> None:
        """See `Evidence.recentre`: sites at one theta, from which sweeps start."""
        given = self._given(theta)
        self.sites = settle(given, self.x0, self.lasting, self.rows, self.sites, _SETTLED)

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
        of_draw = repeated(theta, count)
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
        draw_blocks(
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
        moments_of(self._given(theta), self.x0, self.lasting, self.rows, i, c, mean, cov)
        return mean, cov

    def _given(self, theta: Theta) -> Given:
        """Arguments of the kernels at each theta."""
        prior = self.shared.prior(theta)
        core = (theta[name] for name in ("beta0", "delta_w", "delta_v"))
        sd, own = np.maximum(prior.sd, _LEAST), self.own.sds(theta)
        numbers = (*core, prior.mean, sd, own, self.scale.limits(theta), self.scale.noise)
        return Given(*(plain(np.asarray(values, dtype=float)) for values in numbers))

    def _guess(self) -> None:
        """Sites to begin with: reports taken for their middle, with a sd of .2."""
        theta = {name: np.zeros(1) for name in self.scale.names}
        low, high = self.scale.limits(theta)[0].T if self.scale.n_cases else np.zeros((2, 1))
        low, high = np.maximum(low, -0.1), np.minimum(high, 1.1)
        cut = self.rows.kind == INTERVAL
        middle = 0.5 * (low + high)[np.where(cut, self.rows.case, 0)]
        self.sites[0] = np.where(cut, 25.0, 0.0)
        self.sites[1] = np.where(cut, 25.0 * middle, 0.0)


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
