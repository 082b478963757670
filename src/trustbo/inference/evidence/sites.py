"""Evidence of rates that are no linear function of trust under any effects, by sites of EP.

The drift of a chain is u = U c as in `gaussian`; c ~ N(m(theta), P(theta)^-1) are the coefficients
gamma of `ep.joint`, in the chains of which a bound has the columns that touch it. EP gives
log p(rates | theta) to a few hundredths of a nat; draws of the coefficients come with weights that
average to its ratio to the exact one (`ep.draws`).

EP inverts the prior, so that a scale is `_LEAST` at least: a coefficient of sd 1e-4 changes contact
by less than any rate shows.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse

from trustbo.errors import require_choice
from trustbo.inference.evidence.ep import joint
from trustbo.inference.evidence.ep.draws import draw_weighted
from trustbo.inference.evidence.evidence import Evidence, at, repeated
from trustbo.inference.evidence.gaussian import named_effects, prior_of
from trustbo.models.effects.effect import MEMORIES, Columns, Group, Slots, Theta, dense_root
from trustbo.models.families import Family

_LEAST = 1e-4  # sd of a coefficient
_NOISE = 1e-6  # sd of a noise
_SWEEPS, _MOST, _SETTLED = 1, 4, 8  # sweeps near the sites' mode, and to find it
_MEMORY = 4e6  # numbers of precisions at once


class Sites(Evidence):
    """Evidence by expectation propagation; draws of coefficients have weights."""

    exact = False

    def __init__(
        self,
        slots: Slots,
        groups: Sequence[Group],
        family: Family,
        x0: tuple[float, float],
        memory: str = "level",
        *,
        apart: bool = False,
    ) -> None:
        """Make chains of the columns of all effects.

        Args:
            slots: Rates of all chains, each of weight 1.
            groups: Columns of all effects.
            family: Family of observations.
            x0: Mean and sd of trust before the first bound.
            memory: `"level"`, trust is carried on, or `"deviation"` from what effects expect.
            apart: Whether theta has a beta0 of each robot, (point, robot).
        """
        self.slots, self.groups, self.x0 = slots, tuple(groups), np.array(x0, dtype=float)
        U: Columns = sparse.hstack([group.columns for group in groups], format="csr")
        self.n_columns = U.shape[1]
        self.chains, self.sites = _chains(slots, U, family)
        lost = 0.0 if require_choice("memory", memory, MEMORIES) == "level" else 1.0
        self.chains = self.chains._replace(lost=lost)
        if apart:
            self.chains = self.chains._replace(robot=slots.robot)
        self._sweeps = _SWEEPS
        self._chunk = max(1, int(_MEMORY / self.n_columns**2))
        self._nu = max(8.0, 2.0 * self.n_columns)  # more where a heavy tail would cost evenness

    def log_density(self, theta: Theta) -> np.ndarray:
        """See `Evidence.log_density`."""
        n = len(theta["beta0"])
        out = np.full(n, np.nan)
        some = np.flatnonzero((theta["delta_w"] > _NOISE) & (theta["delta_v"] > _NOISE))
        for i in range(0, len(some), self._chunk):
            points = some[i : i + self._chunk]
            given, log_det = self._given(at(theta, points))
            args: tuple[Any, ...] = *given, self.chains, self.sites, self._sweeps
            out[points] = joint.log_evidence(*args) + 0.5 * log_det
        return out

    def recentre(self, theta: Theta) -> None:
        """See `Evidence.recentre`: sites at one theta, from which sweeps start."""
        (beta0, delta_w, delta_v, x0, P, mean), _ = self._given(theta)
        fixed = x0, P[0], mean[0], self.chains, self.sites
        self.sites = joint.settle(beta0[0], delta_w[0], delta_v[0], *fixed, _SETTLED)

    def sharpen(self) -> bool:
        """See `Evidence.sharpen`: twice as many sweeps."""
        if self._sweeps == _MOST:
            return False
        self._sweeps *= 2
        return True

    def draw(
        self, theta: Theta, count: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """See `Evidence.draw`."""
        log_dets = []

        def points():
            for i in range(0, len(count), self._chunk):
                points = slice(i, i + self._chunk)
                (beta0, delta_w, delta_v, x0, P, mean), log_det = self._given(at(theta, points))
                log_dets.extend(log_det)
                for t in range(len(log_det)):
                    yield beta0[t], delta_w[t], delta_v[t], x0, P[t], mean[t]

        fixed = self._nu, self.chains, self.sites, self._sweeps
        c, log_weight = draw_weighted(points(), count, *fixed, rng)
        named = named_effects(self.groups, c, repeated(theta, count), rng)
        return named, log_weight + 0.5 * np.repeat(log_dets, count)

    def _given(self, theta: Theta) -> tuple[tuple[Any, ...], np.ndarray]:
        """Arguments of the kernels at each theta, and log |P| (point,)."""
        n, m = len(theta["beta0"]), self.n_columns
        prior, at = prior_of(self.groups, theta)
        sd = np.maximum(prior.sd, _LEAST)
        P, diagonal = np.zeros((n, m, m)), np.arange(m)
        P[:, diagonal, diagonal] = sd**-2.0
        log_det = -2.0 * np.log(sd).sum(1)
        for i, one in zip(at, prior.roots, strict=True):
            root = dense_root(one)
            half = np.linalg.inv(root) / sd[:, None, i]
            P[:, i, i] = np.swapaxes(half, 1, 2) @ half
            log_det -= 2.0 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
        beta0, *noises = (np.ascontiguousarray(theta[n]) for n in ("beta0", "delta_w", "delta_v"))
        return (beta0.reshape(n, -1), *noises, self.x0, P, prior.mean), log_det


def _chains(slots: Slots, U: Columns, family: Family) -> tuple[joint.Chains, np.ndarray]:
    """Chains with the columns that touch each, and the sites to begin with."""
    n_chains, K = slots.y.shape
    touched = [np.unique(U[i * K : i * K + K].indices) for i in range(n_chains)]
    column = np.zeros((n_chains, max(map(len, touched))), dtype=int)
    u = np.zeros((*slots.y.shape, column.shape[1]))
    for i, of_chain in enumerate(touched):
        column[i, : len(of_chain)] = of_chain
        u[i, :, : len(of_chain)] = U[i * K : i * K + K][:, of_chain].toarray()
    n_ticks = np.full(slots.y.shape, np.nan) if slots.n_ticks is None else slots.n_ticks
    return joint.chains_of(family, slots.y, n_ticks, u, column)
