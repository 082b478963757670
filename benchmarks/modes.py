"""Posteriors with two modes: the share of each that a sampler finds, and the true one.

Run: python benchmarks/modes.py [exact] [nuts] [-n 24] [--quick]

The truth is a quadrature of its own: given beta0, the covariance of a mission's trust without its
noises is diagonalised once, so a grid of (beta0, delta_w, delta_v) costs little; beta and b
integrate out. Data sets are drawn until enough have two modes in beta0: perfect contact but once,
constant rates but once, and few rates under `Priors.zheng2023`.
"""

import warnings
from typing import NamedTuple

import numpy as np
import numpyro.distributions as dist
from common import arguments, parsed
from scipy import stats

from trustbo.data import Mission
from trustbo.errors import PosteriorError
from trustbo.inference import fit
from trustbo.models import PooledTrust, Priors

FLOOR = 0.005  # of delta_v, where ticks are not known
REAL = Priors(beta0=dist.Normal(0.5, 0.3))
LOG_PRIORS = {
    "real": (
        stats.norm(0.5, 0.3).logpdf,
        stats.halfnorm(0, 0.2).logpdf,
        np.array([1.0, 1.0, 0.5]) ** -2.0,
    ),
    "2023": (stats.norm(0, 10).logpdf, stats.halfcauchy(0, 1).logpdf, np.full(3, 0.01)),
}


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


def marginal(missions: list[Mission], priors: str, n: int = 36, step: float = 0.004) -> Marginal:
    """Posterior of beta0 by quadrature over it and the noises, n points each."""
    of_beta0, of_noise, precision = LOG_PRIORS[priors]
    beta0 = np.unique(np.r_[np.linspace(-3, 3, 61), np.arange(-0.4, 1.4, step)])
    logs = np.linspace(np.log(1e-4), np.log(3.0 if priors == "real" else 30.0), n)
    w, s = (a.ravel() for a in np.meshgrid(np.exp(logs), np.exp(logs), indexing="ij"))
    v = np.hypot(FLOOR, s)
    log_measure = of_noise(w) + of_noise(v) + np.log(w) + 2.0 * np.log(s) - np.log(v)
    log_p = np.array([_log_density(missions, a, w**2, v**2, precision, log_measure) for a in beta0])
    log_p += of_beta0(beta0)
    return Marginal(beta0, np.exp(log_p - log_p.max()))


def _log_density(
    missions: list[Mission],
    beta0: float,
    Q: np.ndarray,
    R: np.ndarray,
    precision: np.ndarray,
    log_measure: np.ndarray,
) -> float:
    """Log of the sum over noises (point,) of the density at one beta0."""
    P = np.zeros((len(Q), 3, 3)) + np.diag(precision)
    h, total = np.zeros((len(Q), 3)), log_measure + 0.5 * np.log(precision).sum()
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


def odd_missions(kind: str, rng: np.random.Generator) -> list[Mission]:
    """Missions of one kind."""
    n, K, I = int(rng.integers(1, 4)), int(rng.integers(4, 9)), int(rng.integers(1, 3))  # noqa: E741
    rates = np.full((n, K, I), 1.0 if kind == "contact" else rng.uniform(0.2, 0.8))
    if kind == "sparse":
        n, I = 1, 2  # noqa: E741
        rates = np.clip(rng.normal(0.6, 0.15, (n, K, I)), 0, 1)
    else:
        rates[-1, rng.integers(K), 0] = rng.uniform()
    path = [(0, k) for k in range(K + 1)]
    return [Mission.from_arrays(path, rng.uniform(size=(K, I, 2)), y) for y in rates]


def share_of_modes(n_wanted: int, sampler: str, n_tried: int = 3000) -> None:
    """Print the share of beta0 below the valley, by quadrature and by the sampler."""
    warnings.simplefilter("ignore")
    done, worst, refused = 0, 0.0, 0
    for seed in range(n_tried):
        kind = ("contact", "constant", "sparse")[seed % 3]
        missions = odd_missions(kind, np.random.default_rng(seed))
        priors = "2023" if kind == "sparse" else "real"
        if marginal(missions, priors, n=12, step=0.02).valley(1e-4) is None:
            continue
        truth = marginal(missions, priors)
        if (valley := truth.valley()) is None:
            continue
        model = PooledTrust(REAL if priors == "real" else Priors.zheng2023())
        try:
            posterior = fit(missions, model, sampler)
        except PosteriorError as error:
            refused += 1
            done += 1
            print(f"{seed:4d} {kind:9s} {sampler} refused: {error.reason[:70]}", flush=True)
            if done == n_wanted:
                break
            continue
        attrs = posterior.attrs
        share = float((posterior["posterior"]["beta0"] < valley).mean())
        worst = max(worst, abs(share - truth.below(valley)))
        done += 1
        print(
            f"{seed:4d} {kind:9s} P(beta0 < {valley:6.3f}) = {truth.below(valley):.3f}, "
            f"{attrs['sampler']} {share:.3f}",
            flush=True,
        )
        if done == n_wanted:
            break
    print(f"{done} posteriors with two modes, {refused} refused; largest error {worst:.3f}")


if __name__ == "__main__":
    parser = arguments(__doc__, names=("exact", "nuts"), n=24, quick="2 posteriors")
    parser.set_defaults(names=["exact"])
    chosen = parsed(parser)
    for sampler in chosen.names:
        share_of_modes(2 if chosen.quick else chosen.n, sampler)
