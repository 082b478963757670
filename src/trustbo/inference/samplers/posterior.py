"""The posterior of scores under any evidence: what the one importance sampler draws from.

`Scores` map standard normal coordinates to hyperparameters theta, an `Evidence` gives
log p(rates | theta); all else is drawn given theta. A model and a family of observations choose
one of each.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from scipy.optimize import minimize

from trustbo.inference.evidence.evidence import ColumnEvidence, Evidence
from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.evidence.sites import Sites
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.laplace import derivatives, inverse_hessian
from trustbo.inference.samplers.per_robot import PerRobot
from trustbo.inference.samplers.student import Proposal, Spanning, Student
from trustbo.models.effects.effect import Effect, Slots, Theta, rest_of, scales_of
from trustbo.models.effects.weights import Weights
from trustbo.models.families import Family
from trustbo.models.priors import Priors

_LARGEST_NOISE, _LEAST_NOISE = 50.0, 1e-6
_FARTHEST = 7.0  # score that a search of the mode tries
_ENOUGH = 1e-2  # nats that a further step of the search must gain
_ROUNDS, _STILL = 3, 0.1  # rounds of the search and of sites; step of a score taken as none
_MANY = 8  # scores whose moments take more points
_WIDEST = 0.3  # precision of a score, at least: the prior's is 1


class Scores(Protocol):
    """Coordinates of hyperparameters: standard normal, but for the second (`scores.log_prior`)."""

    @property
    def fixed(self) -> bool:
        """Whether `recentre` leaves the coordinates unchanged."""
        ...

    @property
    def pools(self) -> bool:
        """Whether there are spreads of robots."""
        ...

    @property
    def n_scores(self) -> int:
        """Number of coordinates."""
        ...

    @property
    def n_core(self) -> int:
        """Number of the first coordinates, of memory and noises, which the rates determine."""
        ...

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Hyperparameters that the evidence takes, by name, of scores (point, score)."""
        ...

    def named(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """Parameters of the model among them, by name."""
        ...

    def log_prior(self, z: np.ndarray) -> np.ndarray:
        """Log prior density of scores (point,)."""
        ...

    def recentre(self, z: np.ndarray, log_density: Callable[[Theta], np.ndarray]) -> np.ndarray:
        """Choose coordinates for the posterior around a point z (score,); z in these.

        Args:
            z: Scores.
            log_density: Log density of the rates at each theta.
        """
        ...


@scores.with_data("quantiles")
class Shared:
    """Scores of beta0 and the noises, which all robots share, and of the effects' scales."""

    fixed, n_core, pools = True, 3, False

    def __init__(
        self,
        priors: Priors,
        effects: Sequence[Effect],
        memory: str = "level",
        *,
        carries: bool = True,
    ) -> None:
        """Take the priors; `memory` as in `evidence.gaussian`.

        Where nothing `carries` on, beta0 = 0, and the first score is of nothing.
        """
        self.quantiles: Any = scores.Quantiles(priors)
        self.carried = float(carries)
        self.effects, self.memory = tuple(e for e in effects if e.names), memory
        self.n_scores = self.n_core + sum(len(effect.names) for effect in effects)

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """See `Scores.theta`."""
        return self.with_core(self.quantiles.core(z), z)

    def named(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """See `Scores.named`."""
        return {name: values for name, values in self.theta(z).items() if name != "rest"}

    def log_prior(self, z: np.ndarray) -> np.ndarray:
        """See `Scores.log_prior`."""
        return scores.log_prior(z)

    def recentre(self, z: np.ndarray, log_density: Callable[[Theta], np.ndarray]) -> np.ndarray:
        """The point itself."""
        return z

    def with_core(self, core: Any, z: Any) -> dict[str, Any]:
        """Hyperparameters of scores, given beta0 and the noises (point, 3), in NumPy or JAX."""
        beta0, delta_w, delta_v = core.T
        beta0 = beta0 * self.carried
        rest = rest_of(beta0, self.memory)
        theta = {"beta0": beta0, "delta_w": delta_w, "delta_v": delta_v, "rest": rest}
        return theta | scales_of(self.effects, z[:, self.n_core :])


class Posterior:
    """Log posterior density of scores, and draws of all else; see `importance.ScoreTarget`."""

    widths, compiles = (1.25, 1.1), False

    def __init__(self, coordinates: Scores, evidence: Evidence, spread: float) -> None:
        """Take the scores and an evidence; `spread` is the sd of the measured rates."""
        self.scores, self.evidence, self._spread = coordinates, evidence, spread
        alone = coordinates.n_scores == coordinates.n_core  # few coefficients: points are cheap
        cheap, many = alone and evidence.exact, coordinates.n_scores > _MANY
        self.n_pilot = 1024 if cheap else 512 if many else 256
        self.n_final = 4096 if cheap else 1024 if alone else 128
        self.n_corrected = None if evidence.exact else 1000 if alone else 500

    @property
    def n_scores(self) -> int:
        """Number of scores."""
        return self.scores.n_scores

    def takes(self, start: Student) -> bool:
        """See `ScoreTarget.takes`: one of as many scores."""
        return len(start.center) == self.n_scores

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
            out[some] = self.evidence.log_density(_take(theta, some)) + log_prior[some]
        return np.where(np.isfinite(out), out, -np.inf)

    def first(self) -> Student:
        """Gaussian fit at the best mode: BFGS from the better of four sizes of the noises."""
        start = np.zeros((4, self.scores.n_scores))
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
        named = {n: np.repeat(v, count, axis=0) for n, v in self.scores.named(z[unique]).items()}
        effects, log_weight = self.evidence.draw(theta, count, rng)
        if log_weight is not None:
            log_weight = log_weight + self.scores.log_prior(z[chosen]) - log_p[chosen]
        return named | effects, log_weight


def posterior_of(
    priors: Priors,
    family: Family,
    effects: Sequence[Effect],
    slots: Slots,
    *,
    by_robot: bool = False,
    lag: float = 0.0,
    memory: str = "level",
    carries: bool = True,
) -> Posterior:
    """Posterior of weights and other effects, by the evidence of a family of observations.

    Args:
        priors: Priors of the weights and of all scores.
        family: Family of observations.
        effects: Effects but the weights.
        slots: Rates of all chains.
        by_robot: Whether each robot has weights and a beta0 of a common distribution.
        lag: 1 where rates measure the change of trust, else 0.
        memory: That of `PooledTrust`.
        carries: Whether anything lasts from one bound to the next; else beta0 = 0, which all robots
            share.
    """
    evidence = evidence_of(
        priors, family, effects, slots, by_robot=by_robot, lag=lag, memory=memory
    )
    if by_robot:
        coordinates = PerRobot(priors, effects, slots.n_robots, slots.z.shape[2])
    else:
        coordinates = Shared(priors, effects, memory, carries=carries)
    return Posterior(coordinates, evidence, float(np.nanstd(slots.y)))


def evidence_of(
    priors: Priors,
    family: Family,
    effects: Sequence[Effect],
    slots: Slots,
    *,
    by_robot: bool = False,
    lag: float = 0.0,
    memory: str = "level",
) -> ColumnEvidence:
    """Evidence of weights and other effects, by the family of observations; see `posterior_of`."""
    groups = [effect.group(slots) for effect in (Weights(priors, by_robot), *effects)]
    x0 = float(priors.x0_mean), float(priors.x0_sd)
    if family.integrates_out:
        return Gaussian(slots, groups, x0, memory, apart=by_robot, lag=lag)
    return Sites(slots, groups, family, x0, memory, apart=by_robot)


def _take(theta: Theta, points: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[points] for name, values in theta.items()}
