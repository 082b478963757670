"""Posteriors with two modes: each has its share, or the posterior is refused.

The truth is a quadrature of its own: given beta0, the covariance of a mission's trust without its
noises is diagonalised once, so a grid of (beta0, delta_w, delta_v) costs little; beta and b
integrate out.
"""

from typing import NamedTuple

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

from trustbo.data import Mission
from trustbo.errors import PosteriorError
from trustbo.inference import fit
from trustbo.inference.samplers.convergence import complaints_of_means
from trustbo.models import PooledTrust, Priors

FLOOR = 0.005  # of delta_v, where ticks are not known
REAL = Priors(beta0=dist.Normal(0.5, 0.3))
PRECISION = np.array([1.0, 1.0, 0.5]) ** -2.0  # of the priors of beta and b


class Marginal(NamedTuple):
    """Posterior of beta0 on a grid."""

    beta0: np.ndarray
    density: np.ndarray

    def valley(self, least: float = 0.005) -> float | None:
        """The least density between two modes, if both have mass and the valley is deep."""
        p = self.density
        peaks = np.flatnonzero((p[1:-1] > p[:-2]) & (p[1:-1] >= p[2:])) + 1
        for one in peaks:
            for other in peaks[peaks > one]:
                low = one + int(p[one:other].argmin())
                mass = self.below(self.beta0[low])
                if least < mass < 1.0 - least and p[low] < 0.5 * min(p[one], p[other]):
                    return float(self.beta0[low])
        return None

    def below(self, value: float) -> float:
        """Probability that beta0 is less."""
        inside = self.density * (self.beta0 < value)
        return float(np.trapezoid(inside, self.beta0) / np.trapezoid(self.density, self.beta0))


def marginal(missions: list[Mission], n: int = 36, step: float = 0.004) -> Marginal:
    """Posterior of beta0 by quadrature over it and the noises, n points each."""
    of_noise = stats.halfnorm(0, 0.2).logpdf
    beta0 = np.unique(np.r_[np.linspace(-3, 3, 61), np.arange(-0.4, 1.4, step)])
    logs = np.linspace(np.log(1e-4), np.log(3.0), n)
    w, s = (a.ravel() for a in np.meshgrid(np.exp(logs), np.exp(logs), indexing="ij"))
    v = np.hypot(FLOOR, s)
    log_measure = of_noise(w) + of_noise(v) + np.log(w) + 2.0 * np.log(s) - np.log(v)
    log_p = np.array([_log_density(missions, a, w**2, v**2, log_measure) for a in beta0])
    log_p += stats.norm(0.5, 0.3).logpdf(beta0)
    return Marginal(beta0, np.exp(log_p - log_p.max()))


def _log_density(
    missions: list[Mission],
    beta0: float,
    Q: np.ndarray,
    R: np.ndarray,
    log_measure: np.ndarray,
) -> float:
    """Log of the sum over noises (point,) of the density at one beta0."""
    P = np.zeros((len(Q), 3, 3)) + np.diag(PRECISION)
    h, total = np.zeros((len(Q), 3)), log_measure + 0.5 * np.log(PRECISION).sum()
    for mission in missions:
        K = len(mission.bounds)
        roll = np.linalg.inv(np.eye(K) - beta0 * np.eye(K, k=-1))
        values, U = np.linalg.eigh(roll @ roll.T)
        start = U.T @ (beta0 * roll[:, 0])
        inverse = 1.0 / (Q[:, None] * values + R[:, None])
        first = 0.25 * start**2  # x_0 ~ N(0.5, 0.5^2)
        corner = 1.0 + inverse @ first
        log_det = np.log(corner) - np.log(inverse).sum(1)
        for robot in range(mission.contact_rate.shape[1]):
            design = U.T @ roll @ np.c_[mission.awareness[:, robot], np.ones(K)]
            y = U.T @ mission.contact_rate[:, robot] - 0.5 * start
            both = np.c_[design, y]
            M = np.einsum("gk,ki,kj->gij", inverse, both, both, optimize=True)
            edge = (inverse * start) @ both
            M -= 0.25 * edge[:, :, None] * edge[:, None] / corner[:, None, None]
            P, h = P + M[:, :3, :3], h + M[:, :3, 3]
            total = total - 0.5 * (M[:, 3, 3] + log_det)
    solved = np.linalg.solve(P, h[..., None])[..., 0]
    total = total + 0.5 * ((h * solved).sum(1) - np.linalg.slogdet(P)[1])
    return float(np.logaddexp.reduce(total))


def nearly_constant_missions(rng: np.random.Generator) -> list[Mission]:
    """Missions whose rates are constant but once, of the last mission."""
    n, K, I = int(rng.integers(1, 4)), int(rng.integers(4, 9)), int(rng.integers(1, 3))  # noqa: E741
    rates = np.full((n, K, I), rng.uniform(0.2, 0.8))
    rates[-1, rng.integers(K), 0] = rng.uniform()
    path = [(0, k) for k in range(K + 1)]
    return [Mission.from_arrays(path, rng.uniform(size=(K, I, 2)), y) for y in rates]


ONE_OF_MODES = (163, 556, 643)
"""Data sets, constant but once, of which all draws were on one mode with k-hat < 0.5."""


@pytest.mark.parametrize("seed", ONE_OF_MODES)
def test_the_exact_sampler_gives_each_mode_its_share(seed):
    missions = nearly_constant_missions(np.random.default_rng(seed))
    truth = marginal(missions)
    valley = truth.valley()
    share = truth.below(valley)
    assert 0.05 < share < 0.95
    posterior = fit(missions, PooledTrust(REAL), "exact")
    assert posterior.attrs["sampler"] == "exact"
    found = float((posterior["posterior"]["beta0"] < valley).mean())
    assert abs(found - share) < 0.03


LEFT_OUT = (136, 235)
"""Data sets, constant but once, of which all draws of NUTS were on one mode, R-hat below 1.01."""


@pytest.mark.slow  # its program compiles for this alone
def test_chains_of_nuts_on_one_of_two_modes_are_refused():
    missions = nearly_constant_missions(np.random.default_rng(163))
    with pytest.raises(PosteriorError, match=r"sd from that of importance sampling|R-hat"):
        fit(missions, PooledTrust(REAL), "nuts")


@pytest.mark.slow  # eight runs of NUTS
@pytest.mark.parametrize("seed", LEFT_OUT)
def test_nuts_gives_each_mode_its_share_or_is_refused(seed):
    missions = nearly_constant_missions(np.random.default_rng(seed))
    truth = marginal(missions)
    valley = truth.valley()
    try:
        posterior = fit(missions, PooledTrust(REAL), "nuts")
    except PosteriorError:
        return
    found = float((posterior["posterior"]["beta0"] < valley).mean())
    assert abs(found - truth.below(valley)) < 0.03


def test_a_mode_that_all_chains_left_is_a_complaint():
    """A second mode of 10 % of the mass, 10 sd away, is .3 / sqrt(.09) = 1 / 3 sd of the mean."""
    rng = np.random.default_rng(0)
    points = np.where(np.arange(2000) < 200, -0.5, 0.5) + 0.01 * rng.standard_normal(2000)
    at_points, weight = {"beta0": points, "beta": rng.normal(size=(2000, 2))}, np.full(2000, 5e-4)

    def complaints(share):
        second = rng.uniform(size=(4, 1000)) < share
        beta0 = np.where(second, -0.5, 0.5) + 0.01 * rng.standard_normal((4, 1000))
        params = {"beta0": beta0, "beta": rng.normal(size=(4, 1000, 2))}
        return complaints_of_means(params, at_points, weight)

    (said,) = complaints(0.0)
    assert said == "the mean of beta0 is 0.33 sd from that of importance sampling (limit 0.3)"
    assert complaints(0.1) == []
    assert complaints(0.9)[0].startswith("the mean of beta0 is 2.")
