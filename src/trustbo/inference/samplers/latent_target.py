"""The posterior of hyperparameters where trust and coefficients do not integrate out exactly.

Scores of (beta0, noises), and of tau_s, length scale and tau_e where places have effects, are those
of `scores`. Expectation propagation gives log p(rates | scores) to a few hundredths of a nat, with
trust, the coefficients (beta, b) and the effects of visited units integrated out (`ep.joint`).
Draws of these, given scores, have weights that average to the ratio of the evidence to that of EP
(`ep.draws`): importance sampling by them is exact for any error of EP (importance sampling squared:
Tran, Scharth, Pitt and Kohn 2014), and so is their evidence.

The data identify the larger noise; the other has a thin tail towards 0 that a moment-matched
proposal misses: the defensive proposal spans all angles between the two.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from trustbo.inference.evidence import place_prior
from trustbo.inference.evidence.ep import draws, joint
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.place_target import (
    above_jitter,
    hyperparameters,
    name_draws,
    prior_of_places,
)
from trustbo.inference.samplers.student import Spanning, Student
from trustbo.models.place import PlaceEffect, Visited
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import of_coefficients

_ROUGH, SWEEPS, _SETTLED = 4, 2, 8  # sweeps far from the sites' mode, near it, and to find it
_GRID = [-1.2, 0.0, 1.2], [-2.2, -1.2, -0.2, 0.6], [-1.2, 0.0, 1.2]
_MEMORY = 4e6  # numbers of precisions at once
_ROUNDS, _STILL = 4, 0.1  # rounds of mode search and sites; step taken as converged, in sd


class LatentTarget:
    """Log posterior density of the scores, by expectation propagation."""

    n_pilot, widths = 256, (1.25, 1.1)

    def __init__(
        self,
        chains: joint.Chains,
        sites: np.ndarray,
        priors: Priors,
        place: tuple[PlaceEffect, Visited] | None = None,
    ) -> None:
        """Take the rates, sites to begin with (2, chain, bound), the priors, and places visited."""
        self.chains, self.priors, self._sites, self._place = chains, priors, sites, place
        n_units = 0 if place is None else len(place[1].units)
        n_features = chains.u.shape[2] - 1 - (0 if place is None else chains.y.shape[1])
        self.mean, self.precision = of_coefficients(priors.beta, priors.b, n_features)
        self.n_scores = 3 + (0 if place is None else len(place[0].names))
        self.n_final = 1024 if place is None else 512
        self.n_corrected = 1000 if place is None else 500
        self._size = len(self.mean) + n_units
        self._step = max(1, int(_MEMORY / self._size**2))  # points at once
        self._nu = max(8.0, 3.0 * self._size)  # more where a heavy tail would cost evenness
        self._x0 = np.array([priors.x0_mean, priors.x0_sd], dtype=float)

    def log_density(self, z: np.ndarray, n_sweeps: int = SWEEPS) -> np.ndarray:
        """Log posterior density of scores (point, score), by EP, shape (point,)."""
        step, n = self._step, len(z)
        parts = [self._evaluate(z[i : i + step], n_sweeps) for i in range(0, n, step)]
        return np.concatenate(parts)

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the best point of a grid."""
        grid = np.stack(np.meshgrid(*_GRID, indexing="ij")).reshape(3, -1).T
        grid = np.pad(grid, ((0, 0), (0, self.n_scores - 3)))
        z = grid[[self.log_density(grid, _ROUGH).argmax()]]
        scale = np.eye(self.n_scores)[None]
        for _ in range(_ROUNDS):
            self.recentre(z[0])
            last, (z, _, scale) = z, laplace(self.log_density, z, n_steps=2)
            if np.abs(np.linalg.solve(scale[0], (z - last)[0])).max() < _STILL:
                break
        self.recentre(z[0])
        return Student(z[0], scale[0])

    def recentre(self, z: np.ndarray) -> None:
        """Recentre the sites at one point, for sweeps to start from."""
        (beta0, delta_w, delta_v, x0, P, g), _ = self._given(self._theta(z[None]))
        fixed = x0, P[0], g[0], self.chains, self._sites
        self._sites = joint.settle(beta0[0], delta_w[0], delta_v[0], *fixed, _SETTLED)

    def defensive(self, proposal: Student) -> Spanning:
        """Proposal that spans all angles between the noises; the prior for scores of places."""
        return Spanning.of(proposal if self._place is None else prior_of_places(proposal), 2)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Parameters at the points of sorted indices, and the log weight of each draw."""
        unique, count = np.unique(chosen, return_counts=True)
        theta = self._theta(z[unique])
        log_det, step = np.empty(len(unique)), self._step

        def given():
            for i in range(0, len(unique), step):
                (beta0, delta_w, delta_v, x0, P, g), block_log_det = self._given(
                    theta[i : i + step]
                )
                log_det[i : i + step] = block_log_det
                for t in range(len(block_log_det)):
                    yield beta0[t], delta_w[t], delta_v[t], x0, P[t], g[t]

        gamma, log_weight = draw_weighted(given(), count, self._nu, self.chains, self._sites, rng)
        log_weight += 0.5 * np.repeat(log_det, count)
        log_weight += scores.log_prior(z[chosen]) - log_p[chosen]
        theta = np.repeat(theta, count, axis=0)
        c, g = np.split(gamma, [len(self.mean)], axis=1)
        if self._place is not None:
            place, places = self._place
            return name_draws(theta, c, g, places, place, rng), log_weight
        params = dict(zip(("beta0", "delta_w", "delta_v"), theta.T, strict=True))
        return params | {"beta": c[:, :-1], "b": c[:, -1]}, log_weight

    def _theta(self, z: np.ndarray) -> np.ndarray:
        """Hyperparameters (point, 3), or (point, 6) with those of places."""
        if self._place is None:
            return scores.beta0_and_noises(self.priors, z)
        return above_jitter(hyperparameters(self.priors, self._place[0], z))

    def _evaluate(self, z: np.ndarray, n_sweeps: int) -> np.ndarray:
        out = np.full(len(z), -np.inf)
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            theta, log_prior = self._theta(z), scores.log_prior(z)
            ok = np.isfinite(theta).all(1) & np.isfinite(log_prior)
            ok &= (theta[:, 1:3] > 1e-6).all(1)
            given, log_det = self._given(theta[ok])
            value = joint.log_evidence(*given, self.chains, self._sites, n_sweeps)
            out[ok] = value + 0.5 * log_det + log_prior[ok]
        return np.where(np.isfinite(out), out, -np.inf)

    def _given(self, theta: np.ndarray):
        """Arguments of the kernels at theta, and log |P| of the prior precision."""
        n, k = len(theta), len(self.mean)
        rest = 1.0 - theta[:, :1] if self.priors.stationary else np.ones((n, 1))
        precision, log_det = self.precision / rest**2, np.zeros(n)
        mean, P = np.zeros((n, self._size)), np.zeros((n, self._size, self._size))
        mean[:, :k] = self.mean * rest
        P[:, np.arange(k), np.arange(k)] = precision
        if self._place is not None:
            for t in range(n):
                log_det[t] = -_fill_places(P[t, k:, k:], self._place[1], theta[t, 3:])
        beta0, delta_w, delta_v = np.ascontiguousarray(theta[:, :3].T)
        args = beta0[:, None], delta_w, delta_v, self._x0, P, mean
        return args, log_det + np.log(precision).sum(1)


def draw_weighted(
    given: Iterable[tuple[Any, ...]],
    count: np.ndarray,
    nu: float,
    chains: joint.Chains,
    sites: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (draw, coefficient) at each of some points, and log weights but for |P|^(1/2).

    Args:
        given: Arguments of the kernel at each point: beta0 of the robots, noises, mean and sd of
            x0, prior precision and mean of the coefficients.
        count: Draws at each point.
        nu: Degrees of freedom of the proposals.
        chains: Rates.
        sites: Sites to begin with.
        rng: Random number generator.
    """
    gammas, log_weights = [], []
    for point, n in zip(given, count, strict=True):
        gamma = rng.standard_normal((n, len(point[-1])))
        gamma /= np.sqrt(rng.chisquare(nu, (n, 1)) / nu)
        beta0, delta_w, delta_v, x0, P, g = point
        weights = draws.draw_coefficients(
            beta0, delta_w, delta_v, x0, P, g, chains, sites, SWEEPS, nu, gamma, rng
        )
        gammas.append(gamma)
        log_weights.append(weights)
    return np.concatenate(gammas), np.concatenate(log_weights)


def _fill_places(P: np.ndarray, places: Visited, theta: np.ndarray) -> float:
    """Fill in the prior precision of the effects of units; the log determinant of its inverse."""
    tau_s, length_scale, tau_e = theta
    n_cells, n_units = len(places.cells), len(places.units)
    n_c = np.bincount(places.cell_of, minlength=n_cells).astype(float)
    M, A = np.zeros((n_cells, n_cells)), np.zeros((n_units, n_units))
    shape = places.shape
    place_prior.fill_cells(M, places.cells, shape, np.sqrt(n_c), tau_s, length_scale, tau_e)
    if place_prior.factor(M):
        return np.nan
    log_det = 2.0 * np.log(M.diagonal()).sum() + 2.0 * (n_units - n_cells) * np.log(tau_e)
    place_prior.invert(M)
    place_prior.fill_units(A, M, places.cell_of, n_c, tau_e)
    P[:] = A + A.T
    P[np.diag_indices(n_units)] *= 0.5
    return log_det
