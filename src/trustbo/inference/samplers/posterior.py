"""The posterior of scores under any evidence: what the one importance sampler draws from.

Scores map standard normal coordinates to hyperparameters theta, an `Evidence` gives
log p(rates | theta); all else is drawn given theta. A model and a family of observations choose
one of each.
"""

import numpy as np
from scipy.optimize import minimize

from trustbo.inference.evidence.evidence import Evidence, at, repeated
from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.sites import Sites
from trustbo.inference.samplers.importance import ScoreTarget
from trustbo.inference.samplers.laplace import derivatives, inverse_hessian
from trustbo.inference.samplers.per_robot import PerRobot
from trustbo.inference.samplers.scores import Scores
from trustbo.inference.samplers.student import Proposal, Spanning, Student
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.weights import Weights
from trustbo.models.model import TrustModel

_LARGEST_NOISE, _LEAST_NOISE = 50.0, 1e-6
_FARTHEST = 7.0  # score that a search of the mode tries
_ENOUGH = 1e-2  # nats that a further step of the search must gain
_ROUNDS, _STILL = 3, 0.1  # rounds of the search and of sites; step of a score taken as none
_MANY = 8  # scores whose moments take more points
_WIDEST = 0.3  # precision of a score, at least: the prior's is 1


class Posterior(ScoreTarget):
    """Log posterior density of scores, and draws of all else."""

    widths = 1.25, 1.1

    def __init__(self, coordinates: Scores, evidence: Evidence, spread: float) -> None:
        """Take the scores and an evidence; `spread` is the sd of the measured rates."""
        self.scores, self.evidence, self._spread = coordinates, evidence, spread
        self.n_scores = coordinates.n_scores
        alone = self.n_scores == coordinates.n_core  # few coefficients: points are cheap
        cheap, many = alone and evidence.exact, self.n_scores > _MANY
        self.n_pilot = 1024 if cheap else 512 if many else 256
        self.n_final = 4096 if cheap else 1024 if alone else 128
        self.n_corrected = None if evidence.exact else 1000 if alone else 500

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density, not divided by the evidence; shape (point,)."""
        out = np.full(len(z), -np.inf)
        with np.errstate(all="ignore"):  # far out, scores over- and underflow: no density there
            theta, log_prior = self.scores.theta(z), self.scores.log_prior(z)
            noise = np.hypot(theta["delta_w"], theta["delta_v"])
            flat = [values.reshape(len(z), -1) for values in theta.values()]
            possible = np.isfinite(np.column_stack([*flat, log_prior])).all(1)
            possible &= (noise > _LEAST_NOISE) & (noise < _LARGEST_NOISE) & (theta["rest"] != 0.0)
            some = np.flatnonzero(possible)
            out[some] = self.evidence.log_density(at(theta, some)) + log_prior[some]
        return np.where(np.isfinite(out), out, -np.inf)

    def first(self) -> Student:
        """Gaussian fit at the best mode: BFGS from the better of four sizes of the noises."""
        start = np.zeros((4, self.n_scores))
        size = np.log(np.clip(self._spread / 0.2, 1e-2, 3.0))
        start[:, 1] = size - np.array([0.3, 1.0, 1.8, 2.6])
        best = start[self.log_density(start).argmax()]
        for _ in range(_ROUNDS):
            last, best = best, self._mode(best)
            fixed = self.scores.fixed and self.evidence.exact
            if fixed or np.abs(best - last).max() < _STILL:
                break
            best = self.recentre(best)
        gradient, hessian = (d[0] for d in derivatives(self.log_density, best[None]))
        if not (np.isfinite(gradient).all() and np.isfinite(hessian).all()):
            return Student(best, np.eye(len(best)))
        cov = inverse_hessian(np, -hessian, _WIDEST)
        step = cov @ gradient  # of Newton, one sd long at most
        return Student(best + step / max(1.0, np.sqrt(gradient @ step)), np.linalg.cholesky(cov))

    def _mode(self, best: np.ndarray) -> np.ndarray:
        """Mode by BFGS from a point."""
        limits = [(-_FARTHEST, _FARTHEST)] * len(best)
        limits[1] = (-_FARTHEST, np.log(_LARGEST_NOISE))
        return minimize(
            self._cost, best, jac=True, method="L-BFGS-B", bounds=limits,
            options={"ftol": _ENOUGH / max(1.0, abs(float(self.log_density(best[None])[0]))),
                     "maxiter": 40},
        ).x  # fmt: skip

    def _cost(self, z: np.ndarray, h: float = 1e-3) -> tuple[float, np.ndarray]:
        """Minus the log density and its gradient, by forward differences in one batch."""
        value = -self.log_density(np.concatenate([z[None], z + h * np.eye(len(z))]))
        value = np.minimum(value, 1e10)
        return float(value[0]), (value[1:] - value[0]) / h

    def recentre(self, z: np.ndarray) -> np.ndarray:
        """See `Evidence.recentre` and `Scores.recentre`."""
        self.evidence.recentre(self.scores.theta(z[None]))
        return self.scores.recentre(z, self.evidence.log_density)

    def sharpen(self) -> bool:
        """See `Evidence.sharpen`."""
        return self.evidence.sharpen()

    def defensive(self, proposal: Student) -> Proposal:
        """Fitted memory and noises; the prior for the scores of effects' scales.

        Where the rates are not Gaussian, all angles between the two noises: the smaller one has a
        thin tail towards 0.
        """
        n, d = self.scores.n_core, len(proposal.center)
        cov = 1.5 * proposal.scale @ proposal.scale.T
        cov[n:], cov[:, n:] = 0.0, 0.0
        cov[n:, n:] = np.eye(d - n)
        center = np.append(proposal.center[:n], np.zeros(d - n))
        wide = proposal._replace(center=center, scale=np.linalg.cholesky(cov))
        return wide if self.evidence.exact else Spanning.of(wide, 2)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Hyperparameters and effects at the points of sorted indices; see `ScoreTarget.draw`."""
        unique, count = np.unique(chosen, return_counts=True)
        theta = self.scores.theta(z[unique])
        named = repeated(self.scores.named(z[unique]), count)
        effects, log_weight = self.evidence.draw(theta, count, rng)
        if log_weight is not None:
            log_weight = log_weight + self.scores.log_prior(z[chosen]) - log_p[chosen]
        return named | effects, log_weight


def posterior_of(model: TrustModel, slots: Slots, *, carries: bool = True) -> Posterior:
    """Posterior of a model whose coefficients are columns.

    Args:
        model: Model, its priors of the weights Normal.
        slots: Rates of all chains.
        carries: Whether anything lasts from one bound to the next; else beta0 = 0, which all robots
            share.
    """
    effects = model.all_effects
    if model.robot_sets == "pooled":
        coordinates = PerRobot(model.priors, effects, slots.n_robots, slots.z.shape[2])
    else:
        coordinates = Scores(model.priors, effects, model.memory, carries=carries)
    return Posterior(coordinates, evidence_of(model, slots), float(np.nanstd(slots.y)))


def evidence_of(model: TrustModel, slots: Slots) -> Evidence:
    """Evidence of weights and effects, by the family of observations; see `posterior_of`."""
    by_robot = model.robot_sets == "pooled"
    effects = Weights(model.priors, by_robot), *model.all_effects
    groups = [effect.group(slots) for effect in effects]
    x0 = model.x0["x0_mean"], model.x0["x0_sd"]
    if model.family.integrates_out:
        return Gaussian(slots, groups, x0, model.memory, apart=by_robot)
    return Sites(slots, groups, model.family, x0, model.memory, apart=by_robot)
