"""Scores of a model with a custom drift, and the posterior that is searched for further modes.

The parameters of the drift, which is no linear function of them, are scores of their priors
(`scores`) in the order of their statements: each is the quantile of its prior, given those before
it, at Phi(score). So where data carry no information the posterior is a sphere, and a hierarchy is
non-centred. The drift is compiled for 256 points at a time; given theta, it is a part of the rates'
mean under the evidence of `evidence.gaussian`, with effects of places as its only columns.

The first proposal is Laplace's at the best of the modes found from the best prior points; where a
second mode matters, weights would not reveal it.
"""

from functools import partial

import jax
import numpy as np
from jax import Array
from scipy import stats

from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.samplers.importance import UnevenWeightsError
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.posterior import Posterior
from trustbo.inference.samplers.scores import Scores
from trustbo.inference.samplers.student import Student
from trustbo.models.backend import in_batches, own_settings
from trustbo.models.drift import DriftTrust
from trustbo.models.drift_form import Drift
from trustbo.models.effects.effect import Slots
from trustbo.stacking import MissionBatch

_CHUNK = 256
_CLOSE, _APART = 6.0, 3.0  # nats below the best that a mode still matters; sd between modes


class DriftScores(Scores):
    """Scores of beta0 and the noises, of a drift's parameters, and of the effects' scales."""

    def __init__(self, model: DriftTrust, awareness: np.ndarray, slots: Slots) -> None:
        """Take the model, awareness (mission, bound, robot, feature), and the chains of rates."""
        super().__init__(model.priors, model.all_effects)
        self._model, self._slots, self._shape = model, slots, awareness.shape[2:]
        self._z = np.where(np.isnan(awareness), 0.5, awareness)
        n_own = model.n_scores(*self._shape)
        self.n_core, self.n_scores = self.n_core + n_own, self.n_scores + n_own

    def theta(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """See `Scores.theta`; with the drift (point, chain, bound)."""
        drift = in_batches(partial(_drifts, self._model, self._z), self._of_drift(z), _CHUNK)
        slots, length = self._slots, self._slots.y.shape[1]
        drift = np.swapaxes(drift, 2, 3)[:, slots.mission, slots.robot, :length]
        return super().theta(z) | {"drift": drift}

    def named(self, z: np.ndarray) -> dict[str, np.ndarray]:
        """See `Scores.named`."""
        at_scores = partial(self._model.parameters_at, shape=self._shape)
        shared = {name: values for name, values in Scores.theta(self, z).items() if name != "rest"}
        return shared | in_batches(at_scores, self._of_drift(z), _CHUNK)

    def _of_drift(self, z: np.ndarray) -> np.ndarray:
        return z[:, Scores.n_core : self.n_core]


class DriftPosterior(Posterior):
    """Posterior of the scores of a model with a custom drift."""

    compiles = True

    @classmethod
    def of(cls, model: DriftTrust, batch: MissionBatch, slots: Slots) -> "DriftPosterior":
        """Posterior of a model given missions and their chains."""
        priors, groups = model.priors, [effect.group(slots) for effect in model.all_effects]
        x0 = float(priors.x0_mean), float(priors.x0_sd)
        evidence = Gaussian(slots, groups, x0, lag=model.lag)
        coordinates = DriftScores(model, batch.awareness, slots)
        return cls(coordinates, evidence, float(np.nanstd(slots.y)))

    def takes(self, start: Student) -> bool:
        """See `ScoreTarget.takes`: never, as modes would go unseen."""
        return False

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the best of points drawn from the prior.

        Raises:
            UnevenWeightsError: A second mode matters.
        """
        alone = self.n_scores == self.scores.n_core
        n, n_starts, n_steps = (2048, 6, 30) if alone else (512, 1, 8)
        u = stats.qmc.Sobol(self.n_scores, scramble=True, rng=0).random(n)
        z = stats.norm.ppf(np.clip(u, 1e-6, 1.0 - 1e-6))
        z[:, 1] = np.log(np.clip(self._spread / 0.2, 1e-2, 3.0)) - 3.0 * u[:, 1]
        best = np.argsort(-self.log_density(z))[:n_starts]
        modes, value, scale = laplace(self.log_density, z[best], n_steps)
        top = int(value.argmax())
        white = np.linalg.solve(scale[top], (modes - modes[top]).T)
        far = np.linalg.norm(white[3:], axis=0) > _APART
        if self.n_scores > 3 and (far & (value > value[top] - _CLOSE)).any():
            raise UnevenWeightsError(
                "weights do not tell the shares of modes, of which the posterior has more than one"
            )
        return Student(modes[top], scale[top])


def _drifts(model: DriftTrust, awareness: np.ndarray, z: np.ndarray) -> np.ndarray:
    with own_settings():
        return np.asarray(_compiled_drifts(model, awareness, z))


@jax.jit
def _compiled_drifts(model: DriftTrust, awareness: Array, z: Array) -> Array:
    """Drift (point, mission, bound, robot) at scores (point, score) of its parameters."""

    def one(z: Array) -> Array:
        theta, _ = model.at_scores(z, *awareness.shape[2:])
        return Drift(model.form, theta, awareness.shape[3]).at(awareness)

    return jax.vmap(one)(z)
