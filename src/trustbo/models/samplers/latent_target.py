"""The posterior of beta0 and the noises where trust and coefficients do not integrate out exactly.

Scores of (beta0, noises) are those of `scores`. Expectation propagation gives log p(rates | scores)
but for an error of a few hundredths of a nat, with trust and the coefficients (beta, b) integrated
out (`ep.joint`). Draws of coefficients and trust, given scores, have weights that average to the
ratio of the evidence to that of EP (`ep.draws`): importance sampling by them is exact whatever EP
leaves (importance sampling squared: Tran, Scharth, Pitt and Kohn 2014), and so is their evidence.

The rates tell the larger of two noises and leave the other's thin tail towards 0, which moments of
points do not tell of: the defensive proposal spans all angles between the two.
"""

import numpy as np

from trustbo.models.likelihood.ep import draws, joint
from trustbo.models.priors import Priors
from trustbo.models.samplers import scores
from trustbo.models.samplers.laplace import laplace
from trustbo.models.samplers.priors_numpy import numbers
from trustbo.models.samplers.student import Spanning, Student

_ROUGH, _SWEEPS, _SETTLED = 4, 2, 8  # sweeps far from the sites' mode, near it, and to find it
_GRID = tuple(np.stack(np.meshgrid([-1.2, 0.0, 1.2], [-2.2, -1.2, -0.2, 0.6], [-1.2, 0.0, 1.2],
                                   indexing="ij")).reshape(3, -1))  # fmt: skip


class LatentTarget:
    """Log posterior density of the scores of (beta0, noises), by expectation propagation."""

    n_scores = 3
    n_pilot, widths = 256, (1.25, 1.1)
    n_final = 1024
    """Points of the last proposal."""
    n_corrected = 1000
    """Draws whose coefficients and trust are drawn for their weights."""

    def __init__(self, chains: joint.Chains, sites: np.ndarray, priors: Priors) -> None:
        """Take the rates, sites to begin with (2, chain, bound), and the priors."""
        self.chains, self.priors, self._sites = chains, priors, sites
        n_features = chains.u.shape[2] - 1

        def each(name: str) -> np.ndarray:
            of_features = np.broadcast_to(numbers(priors.beta, name), n_features)
            return np.append(of_features, numbers(priors.b, name))

        self.mean, self.precision = each("loc"), each("scale") ** -2.0
        self._nu = max(8.0, 3.0 * len(self.mean))  # more where a heavy tail would cost evenness
        self._x0 = np.array([priors.x0_mean, priors.x0_sd], dtype=float)

    def log_density(self, z: np.ndarray, n_sweeps: int = _SWEEPS) -> np.ndarray:
        """Log posterior density of scores (point, 3), by EP, shape (point,)."""
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            theta = scores.beta0_and_noises(self.priors, z)
            log_prior = scores.log_prior(z)
            ok = np.isfinite(theta).all(1) & np.isfinite(log_prior) & (theta[:, 1:] > 1e-6).all(1)
            out = np.full(len(z), -np.inf)
            given, log_det = self._given(theta[ok])
            value = joint.log_evidence(*given, self.chains, self._sites, n_sweeps)
            out[ok] = value + 0.5 * log_det + log_prior[ok]
        return np.where(np.isfinite(out), out, -np.inf)

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the best point of a grid."""
        grid = np.stack(_GRID, axis=1)
        z = grid[[self.log_density(grid, _ROUGH).argmax()]]
        scale = np.eye(3)[None]
        for _ in range(6):
            self._settle(z[0])
            last, (z, _, scale) = z, laplace(self.log_density, z, n_steps=2)
            if np.abs(np.linalg.solve(scale[0], (z - last)[0])).max() < 0.1:
                break
        self._settle(z[0])
        return Student(z[0], scale[0])

    def defensive(self, proposal: Student) -> Spanning:
        """Proposal that spans all angles between the two noises."""
        return Spanning.of(proposal, 2)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Parameters at the points of sorted indices, and the log weight of each draw."""
        unique, count = np.unique(chosen, return_counts=True)
        theta = scores.beta0_and_noises(self.priors, z[unique])
        (*noises, x0, P, g), log_det = self._given(theta)
        log_prior = scores.log_prior(z[unique]) + 0.5 * log_det
        gamma, nu = rng.standard_normal((len(chosen), len(self.mean))), self._nu
        gamma /= np.sqrt(rng.chisquare(nu, (len(gamma), 1)) / nu)
        log_weight, at = np.empty(len(chosen)), 0
        for i, n in enumerate(count):
            rows = slice(at, at := at + int(n))
            beta0, delta_w, delta_v = (column[i] for column in noises)
            log_weight[rows] = draws.draw_coefficients(
                beta0, delta_w, delta_v, x0, P[i], g[i], self.chains, self._sites, _SWEEPS, nu,
                gamma[rows], rng,
            )  # fmt: skip
        log_weight += np.repeat(log_prior, count) - log_p[chosen]
        theta = np.repeat(theta, count, axis=0)
        params = dict(zip(("beta0", "delta_w", "delta_v"), theta.T, strict=True))
        return params | {"beta": gamma[:, :-1], "b": gamma[:, -1]}, log_weight

    def _given(self, theta: np.ndarray):
        """Arguments of the kernels at theta (point, 3), and log |P|."""
        beta0, delta_w, delta_v = theta.T
        rest = 1.0 - beta0[:, None] if self.priors.stationary else np.ones((len(theta), 1))
        mean, precision = self.mean * rest, self.precision / rest**2
        P = precision[:, :, None] * np.eye(len(self.mean))
        args = beta0[:, None], delta_w, delta_v, self._x0, P, mean
        return args, np.log(precision).sum(1)

    def _settle(self, z: np.ndarray) -> None:
        """Keep the sites of one point, for sweeps to start from."""
        theta = scores.beta0_and_noises(self.priors, z[None])
        (*noises, x0, P, g), _ = self._given(theta)
        beta0, delta_w, delta_v = (column[0] for column in noises)
        known = x0, P[0], g[0], self.chains, self._sites
        self._sites = joint.settle(beta0, delta_w, delta_v, *known, _SETTLED)
