"""The posterior of scores under any evidence: what the one importance sampler draws from.

`Scores` map standard normal coordinates to hyperparameters theta, an `Evidence` gives
log p(rates | theta); all else is drawn given theta. A model and a family of observations choose
one of each.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.optimize import minimize

from trustbo.inference.evidence.evidence import Evidence
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.laplace import derivatives, inverse_hessian
from trustbo.inference.samplers.student import Student
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.priors import Priors

_LARGEST_NOISE, _LEAST_NOISE = 50.0, 1e-6
_FARTHEST = 7.0  # score that a search of the mode tries
_ENOUGH = 1e-2  # nats that a further step of the search must gain
_WIDEST = 0.3  # precision of a score, at least: the prior's is 1


class Scores(Protocol):
    """Coordinates of hyperparameters: standard normal, but for the second (`scores.log_prior`)."""

    @property
    def n_scores(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def n_core(self) -> int:
        """Number of the first coordinates, of memory and noises, which the rates determine."""
        ...

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Hyperparameters by name of scores (point, score)."""
        ...


class Shared:
    """Scores of beta0 and the noises, which all robots share, and of the effects' scales."""

    n_core = 3

    def __init__(self, priors: Priors, effects: Sequence[Effect], memory: str = "level") -> None:
        """Take the priors; `memory` as in `evidence.gaussian`."""
        self.priors, self.effects, self.memory = priors, tuple(effects), memory
        self.n_scores = self.n_core + sum(len(effect.names) for effect in effects)

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """See `Scores.theta`."""
        beta0, delta_w, delta_v = scores.beta0_and_noises(self.priors, z).T
        rest = 1.0 - beta0 if self.memory == "level" else np.ones(len(z))
        theta = {"beta0": beta0, "delta_w": delta_w, "delta_v": delta_v, "rest": rest}
        start = self.n_core
        for effect in self.effects:
            stop = start + len(effect.names)
            theta |= effect.scales(z[:, start:stop])
            start = stop
        return theta


class Posterior:
    """Log posterior density of scores, and draws of all else; see `importance.ScoreTarget`."""

    n_pilot, n_final, widths = 256, 512, (1.25, 1.1)
    n_corrected = None

    def __init__(self, coordinates: Scores, evidence: Evidence, spread: float) -> None:
        """Take the scores and an exact evidence; `spread` is the sd of the measured rates."""
        self.scores, self.evidence, self._spread = coordinates, evidence, spread

    @property
    def n_scores(self) -> int:
        """Number of scores."""
        return self.scores.n_scores

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density, not divided by the evidence; shape (point,)."""
        out = np.full(len(z), -np.inf)
        with np.errstate(all="ignore"):  # far out, scores over- and underflow: no density there
            theta, log_prior = self.scores.theta(z), scores.log_prior(z)
            noise = np.hypot(theta["delta_w"], theta["delta_v"])
            possible = np.isfinite(np.stack([*theta.values(), log_prior])).all(0)
            possible &= (noise > _LEAST_NOISE) & (noise < _LARGEST_NOISE) & (theta["rest"] != 0.0)
            some = np.flatnonzero(possible)
            out[some] = self.evidence.log_density(_take(theta, some)) + log_prior[some]
        return np.where(np.isfinite(out), out, -np.inf)

    def first(self) -> Student:
        """Gaussian fit at the best mode: BFGS from the better of four sizes of the noises."""
        start = np.zeros((4, self.scores.n_scores))
        size = np.log(np.clip(self._spread / 0.2, 1e-2, 3.0))
        start[:, 1] = size - np.array([0.3, 1.0, 1.8, 2.6])
        best = start[self.log_density(start).argmax()]
        limits = [(-_FARTHEST, _FARTHEST)] * len(best)
        limits[1] = (-_FARTHEST, np.log(_LARGEST_NOISE))
        z = minimize(
            self._cost, best, jac=True, method="L-BFGS-B", bounds=limits,
            options={"ftol": _ENOUGH / max(1.0, -float(self.log_density(best[None])[0])),
                     "maxiter": 40},
        ).x  # fmt: skip
        hessian = derivatives(self.log_density, z[None])[1][0]
        if not np.isfinite(hessian).all():
            return Student(z, np.eye(len(z)))
        return Student(z, np.linalg.cholesky(inverse_hessian(np, -hessian, _WIDEST)))

    def _cost(self, z: np.ndarray, h: float = 1e-3) -> tuple[float, np.ndarray]:
        """Minus the log density and its gradient, by forward differences in one batch."""
        value = -self.log_density(np.concatenate([z[None], z + h * np.eye(len(z))]))
        value = np.minimum(value, 1e10)
        return float(value[0]), (value[1:] - value[0]) / h

    def recentre(self, z: np.ndarray) -> None:
        """No-op: the density is exact everywhere."""

    def defensive(self, proposal: Student) -> Student:
        """Fitted memory and noises; the prior for the scores of effects' scales."""
        n, d = self.scores.n_core, len(proposal.center)
        cov = 1.5 * proposal.scale @ proposal.scale.T
        cov[n:], cov[:, n:] = 0.0, 0.0
        cov[n:, n:] = np.eye(d - n)
        center = np.append(proposal.center[:n], np.zeros(d - n))
        return proposal._replace(center=center, scale=np.linalg.cholesky(cov))

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """Hyperparameters and effects at the points of sorted indices; no weights are needed."""
        unique, count = np.unique(chosen, return_counts=True)
        theta = self.scores.theta(z[unique])
        named = {name: np.repeat(values, count) for name, values in theta.items()}
        del named["rest"]
        return named | self.evidence.draw(theta, count, rng), None


def _take(theta: Theta, points: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[points] for name, values in theta.items()}
