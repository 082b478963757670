"""Latent trust and likelihoods under parameter draws, for families not linear in trust.

Given parameters chains are independent: EP's sites of each, settled in three sweeps, guide draws of
its trust whose weights average to its evidence (`draws`). Averages over draws are weighted, and a
trajectory to keep is one of four, by weight.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numba import njit

from trustbo.inference.evidence.ep.draws import N_CANDIDATES, draw_chain
from trustbo.inference.evidence.ep.joint import (
    Chains,
    chains_of,
    copy,
    propagate,
    start_sites,
)
from trustbo.inference.evidence.kalman_numpy import TrustSummary
from trustbo.models.families import Family
from trustbo.models.families.terms import OPTIONS, concentration, constants, new_table, table_at
from trustbo.models.params import Params
from trustbo.stacking import MissionBatch

_SWEEPS, _CHOICES = 4, 4  # the last sweep updates no site
_N_TRAJECTORIES = 2000
_CELLS = 1 << 19  # numbers per chunk of draws


def summarize(
    family: Family,
    params: Params,
    batch: MissionBatch,
    n_bounds: np.ndarray,
    rng: np.random.Generator,
) -> TrustSummary:
    """Mean and sd of latent trust over all draws, and each mission's log-likelihood per draw.

    Args:
        family: Family of observations.
        params: Draws with leading axis (draw,).
        batch: Missions, padded with NaN.
        n_bounds: Bounds of each mission, measured or not.
        rng: Random number generator.
    """
    n, shape = len(params.b), batch.contact_rate.shape
    mean, square = np.zeros(shape), np.zeros(shape)
    log_likelihood = np.zeros((n, shape[0]))
    for group in _groups(family, params, batch, n_bounds):
        _, first, index, count = np.unique(
            group.numbers, axis=0, return_index=True, return_inverse=True, return_counts=True
        )  # resampled draws repeat: each is evaluated once
        n_each = int(np.clip(_N_TRAJECTORIES // len(first), 2, 64))
        where = group.mission, slice(None), group.robot
        for rows in _chunks(group, len(first)):
            x, log_weight = group.trajectories(first[rows], n_each, rng)
            weight = np.exp(log_weight - log_weight.max(1, keepdims=True))
            weight /= weight.sum(1, keepdims=True) * (n / count[rows, None, None])
            mean[where] += np.einsum("dtc,dtck->ck", weight, x)
            square[where] += np.einsum("dtc,dtck->ck", weight, x**2)
            log_mean = np.logaddexp.reduce(log_weight, axis=1) - np.log(n_each)
            here = np.flatnonzero((index.ravel() >= rows.start) & (index.ravel() < rows.stop))
            of_draws = log_mean[index.ravel()[here] - rows.start]
            for c, j in enumerate(group.mission):
                log_likelihood[here, j] += of_draws[:, c]
    return TrustSummary(mean, np.sqrt(np.maximum(square - mean**2, 0.0)), log_likelihood)


def sample(
    family: Family,
    params: Params,
    batch: MissionBatch,
    n_bounds: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """One joint draw of latent trust per parameter draw, (draw, mission, bound, robot)."""
    n = len(params.b)
    trust = np.zeros((n, *batch.contact_rate.shape))
    for group in _groups(family, params, batch, n_bounds):
        for rows in _chunks(group, n):
            draws = np.arange(n)[rows]
            x, log_weight = group.trajectories(draws, _CHOICES, rng)
            # The largest of log weight + Gumbel noise: a choice by weight.
            chosen = np.argmax(log_weight + rng.gumbel(size=log_weight.shape), axis=1)
            x = np.take_along_axis(x, chosen[:, None, :, None], axis=1)[:, 0]
            trust[draws[:, None], group.mission, :, group.robot] = x
    return trust


def gather_chains(
    family: Family, batch: MissionBatch, n_bounds: np.ndarray
) -> tuple[Chains, np.ndarray]:
    """Chains of a batch whose coefficients are (weights, intercept), and the sites to begin with.

    Args:
        family: Family of observations.
        batch: Missions, padded with NaN.
        n_bounds: Bounds of each mission, measured or not: the lengths of its chains.
    """
    n_robots = batch.contact_rate.shape[2]
    # One row per mission and robot: (chain, bound[, column]).
    y = np.swapaxes(batch.contact_rate, 1, 2).reshape(-1, batch.contact_rate.shape[1])
    n_ticks = np.swapaxes(np.broadcast_to(batch.n_ticks, batch.contact_rate.shape), 1, 2)
    z = np.swapaxes(batch.awareness, 1, 2).reshape(*y.shape, -1)
    u = np.concatenate([z, np.ones_like(z[..., :1])], axis=-1)
    column = np.tile(np.arange(u.shape[2]), (len(y), 1))
    lengths = np.repeat(n_bounds, n_robots)
    return chains_of(family, y, n_ticks.reshape(y.shape), u, column, lengths)


class _Group(NamedTuple):
    """Chains of robots that share parameters, with their parameters."""

    chains: Chains
    sites: np.ndarray  # (2, chain, bound)
    mission: np.ndarray  # (chain,)
    robot: np.ndarray  # (chain,)
    theta: np.ndarray  # (draw, 5): beta0, delta_w, delta_v, mean and sd of x0
    coefficients: np.ndarray  # (draw, feature + 1), weights and intercept
    effects: np.ndarray | None  # (draw, chain, bound), where intercepts differ by bound

    @property
    def numbers(self) -> np.ndarray:
        """All numbers of each draw without effects of places, to find repeated draws."""
        return np.concatenate([self.theta, self.coefficients], axis=1)

    def trajectories(
        self, draws: np.ndarray, n: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Trust (draw, n, chain, bound) and log weights (draw, n, chain) of some draws."""
        u = self.chains.u
        drift = np.einsum("ckf,df->dck", u, self.coefficients[draws], optimize=True)
        if self.effects is not None:
            drift += self.effects[draws]
        chains = self.chains._replace(u=u[..., :0], gamma_index=self.chains.gamma_index[:, :0])
        x = np.zeros((len(draws), n, *u.shape[:2]))
        log_weight = np.empty(x.shape[:3])
        _trajectories(self.theta[draws], drift, chains, self.sites, x, log_weight, rng)
        return x, log_weight


def _groups(
    family: Family, params: Params, batch: MissionBatch, n_bounds: np.ndarray
) -> Iterator[_Group]:
    params = params.with_drift(batch.awareness)
    n_robots, b = batch.contact_rate.shape[2], np.asarray(params.b)
    of_bounds = b.ndim == 4  # (draw, mission, bound, robot), see `Params.on`
    for members in params.alike(n_robots):
        shared = params._replace(b=np.zeros((len(b), n_robots))) if of_bounds else params
        one = shared.of_robot(members[0])
        n = len(b)

        def column(name: str, one: Params = one, n: int = n) -> np.ndarray:
            return np.broadcast_to(np.asarray(getattr(one, name), dtype=float), (n,))

        names = ("beta0", "delta_w", "delta_v", "x0_mean", "x0_sd")
        rates = MissionBatch(*(a[:, :, members] for a in batch))
        mission, robot = (a.ravel() for a in np.indices((len(rates.contact_rate), len(members))))
        chains, sites = gather_chains(family, rates, n_bounds)
        robot, effects = np.asarray(members)[robot], None
        if of_bounds:
            effects = b[:, mission, :, np.minimum(robot, b.shape[3] - 1)].transpose(1, 0, 2)
        theta = np.stack([column(name) for name in names], axis=1)
        intercept = np.zeros(n) if of_bounds else column("b")
        coefficients = np.column_stack([one.beta, intercept])  # pyright: ignore
        yield _Group(chains, sites, mission, robot, theta, coefficients, effects)


def _chunks(group: _Group, n: int) -> Iterator[slice]:
    """Yield chunks of draws to evaluate together."""
    step = max(1, _CELLS // group.chains.y.size)
    for start in range(0, n, step):
        yield slice(start, min(start + step, n))


@njit(**OPTIONS)
def _trajectories(theta, drift, chains, kept, x, log_weight, rng):
    """Fill in trust x (draw, n, chain, bound) and log weights (draw, n, chain)."""
    table, sites = new_table(chains.tables), np.empty(kept.shape)
    ahead, choice = np.empty((kept.shape[2], 2)), np.empty((2, N_CANDIDATES))
    nothing, empty = np.empty(0), np.empty((0, 0))
    for t in range(len(theta)):
        b0, delta_w, delta_v, x0 = theta[t, :1], theta[t, 1], theta[t, 2], theta[t, 3:]
        table_at(chains.tables, delta_v, table)
        start_sites(chains, delta_v, kept, sites[0], sites[1])
        copy(drift[t], chains.drift)
        propagate(
            b0, delta_w, delta_v, x0, empty, nothing, chains, table, sites[0], sites[1],
            np.int64(_SWEEPS), 1.0, nothing, empty, np.bool_(False),
        )  # fmt: skip
        constant = constants(chains.counts, concentration(delta_v))
        for i in range(x.shape[1]):
            for c in range(x.shape[2]):
                log_weight[t, i, c] = draw_chain(
                    b0[0], delta_w, delta_v, x0, chains, c, drift[t, c], table, constant, sites[0],
                    sites[1], ahead, x[t, i, c], choice, rng,
                )  # fmt: skip
