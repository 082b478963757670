"""The posterior of coupled robots with Gaussian rates, their linear coefficients integrated out.

Given B0 and the noises, all weights and intercepts integrate out (`coupled_marginal`), with the
couplings among them. The remaining unknowns are scores of the priors: three robots have 9 numbers
of B0 and 6 of each covariance, 21 in all, for any number of features. beta0 and the noises are
scored as in `scores`, size and angle robot by robot; couplings are normal; correlations are the
partial ones of the LKJ prior. With b = concentration + (n - 2 - k) / 2, the correlation of robots i
and k < i given those before k is 2 Beta(b, b) - 1, and row i of the factor of the correlations is
p_0, p_1 (1 - p_0^2)^1/2, p_2 (1 - p_0^2)^1/2 (1 - p_1^2)^1/2, ..., and last the root of 1 less the
squares before (Lewandowski, Kurowicka and Joe 2009).
"""

import numpy as np
from scipy import optimize, special

from trustbo.inference.evidence.coupled_marginal import (
    Dynamics,
    Sequences,
    gather_sequences,
    integrate,
)
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.importance import ScoreTarget
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.student import Student
from trustbo.models.coupled import CoupledTrust
from trustbo.models.priors_numpy import numbers
from trustbo.stacking import MissionBatch


class CoupledTarget(ScoreTarget):
    """Log posterior density of the scores."""

    n_pilot, n_final, widths, compiles = 2048, 8192, (1.05, 1.1), True

    def __init__(self, model: CoupledTrust, batch: MissionBatch, weight: np.ndarray) -> None:
        """Take missions and their weights."""
        _, _, n, n_features = batch.awareness.shape
        self.priors, self.n, self.n_features = model.priors, n, n_features
        n_inputs = n * n_features + 1
        robot, source = np.divmod(np.arange(n * n_inputs), n_inputs)
        diagonal = source // n_features == robot
        free = source == n_inputs - 1
        self.data: Sequences = gather_sequences(
            batch.awareness, batch.contact_rate, weight, robot, source,
            (float(model.priors.x0_mean), float(model.priors.x0_sd)),
        )  # fmt: skip
        self._own, self._feature = diagonal | free, np.where(free, n_features, source % n_features)
        pairs = n * (n - 1) // 2
        sizes = n, 2 * pairs, n, n, pairs, pairs
        self._ends = np.cumsum(sizes)
        self.n_scores = sum(sizes)

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density of scores (point, score), shape (point,)."""
        with np.errstate(all="ignore"):  # far out noises under- and overflow: no density there
            value = integrate(self.data, self.constrain(z))[0] + self.log_prior(z)
        return np.where(np.isfinite(value), value, -np.inf)

    def log_prior(self, z: np.ndarray) -> np.ndarray:
        """Log prior density of scores (point, score): normal, but for the log sizes."""
        size = z[:, self._ends[1] : self._ends[2]]
        of_sizes = 2.0 * size - 0.5 * np.exp(2.0 * size) + 0.5 * size**2 + scores.LOG_ROOT_2PI
        return scores.log_normal_density(z) + of_sizes.sum(1)

    def first(self) -> Student:
        """Gaussian fit at the mode that a quasi-Newton search finds."""
        start = np.zeros(self.n_scores)
        spread = np.std(self.data.y[self.data.seen])
        start[self._ends[1] : self._ends[2]] = np.log(np.clip(spread / 0.2, 1e-2, 3.0)) - 1.0
        steps = 1e-4 * np.vstack([np.eye(len(start)), -np.eye(len(start))])

        def cost(z: np.ndarray) -> tuple[float, np.ndarray]:
            values = -self.log_density(np.vstack([z, z + steps]))
            up, down = np.split(values[1:], 2)
            with np.errstate(invalid="ignore"):  # next to a point of zero density
                return values[0], np.nan_to_num((up - down) / 2e-4)

        mode = optimize.minimize(cost, start, jac=True, method="BFGS", options={"maxiter": 60}).x
        return Student(mode, laplace(self.log_density, mode[None], 0)[2][0])

    def defensive(self, proposal: Student) -> Student:
        """Defensive proposal: the given one widened."""
        return proposal.widened(1.1)._replace(nu=4.0)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """Parameters at the points of sorted indices; these draws need no weights."""
        unique, where = np.unique(chosen, return_inverse=True)
        dynamics = self.constrain(z[unique])
        factor = integrate(self.data, dynamics)[1]
        F, half = factor[where, :-1, :-1], factor[where, -1, :-1]
        right = (half + rng.standard_normal(half.shape))[..., None]
        c = np.linalg.solve(np.swapaxes(F, 1, 2), right)[..., 0]
        shape = (len(c), self.n, -1)
        B = c.reshape(shape)[..., :-1].reshape(len(c), self.n, self.n, -1)
        named = {
            "B0": dynamics.B0[where],
            "B": np.moveaxis(B, -1, 1),
            "b": c.reshape(shape)[..., -1],
        }
        return named | {"Delta_w": dynamics.Q[where], "Delta_v": dynamics.R[where]}, None

    def constrain(self, z: np.ndarray) -> Dynamics:
        """Dynamics at scores (point, score)."""
        n, eye = self.n, np.eye(self.n)
        beta0, coupling, size, angle, *partial = np.split(z, self._ends[:-1], axis=1)
        triples = np.stack([beta0, size, angle], axis=2).reshape(-1, 3)
        of_robots = scores.beta0_and_noises(self.priors, triples).reshape(-1, n, 3)
        beta0, sd_w, sd_v = np.moveaxis(of_robots, 2, 0)
        coupling = scores.quantile(self.priors.coupling, coupling)
        prior = self._prior(beta0)
        B0 = np.where(eye, beta0[:, :, None], 0.0)
        B0[:, ~np.eye(n, dtype=bool)] = coupling
        w, v = (self._correlations(partials) for partials in partial)
        w, v = w * sd_w[:, :, None], v * sd_v[:, :, None]
        Q, R = w @ np.swapaxes(w, 1, 2), v @ np.swapaxes(v, 1, 2)
        return Dynamics(B0, Q, R, *prior)

    def _prior(self, beta0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and precisions of the coefficients (point, coefficient) given beta0."""
        priors, robot = self.priors, self.data.robot
        rest = 1.0 - beta0[:, robot] if priors.stationary else np.ones((len(beta0), len(robot)))

        def moment_of(name: str) -> np.ndarray:
            of_features = np.broadcast_to(numbers(priors.beta, name), self.n_features)
            diagonal = np.append(of_features, numbers(priors.b, name))[self._feature]
            return np.where(self._own, diagonal * rest, numbers(priors.coupling, name))

        return moment_of("loc"), moment_of("scale") ** -2.0

    def _correlations(self, z: np.ndarray) -> np.ndarray:
        """Factors of correlations (point, robot, robot') of scores (point, pair)."""
        L, columns = np.zeros((len(z), self.n, self.n)), iter(z.T)
        for i in range(self.n):
            left = np.ones(len(z))
            for k in range(i):
                b, score = self.priors.concentration + 0.5 * (self.n - 2 - k), next(columns)
                r = 1.0 - 2.0 * special.betaincinv(b, b, special.ndtr(-np.abs(score)))
                r = np.copysign(r, score)
                L[:, i, k], left = r * left, left * np.sqrt(1.0 - r**2)
            L[:, i, i] = left
        return L
