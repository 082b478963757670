"""The posterior of a model with a custom drift, Gaussian rates and few parameters.

Trust and effects of places integrate out. The other parameters are scores of their priors
(`scores`), the user's in the order of their statements: each is the quantile of its prior, given
those before it, at Phi(score). So where data carry no information the posterior is a sphere, and a
hierarchy is non-centred. The density is compiled for 256 points at a time. The first proposal is
Laplace's at the best of the modes found from the best prior points; where a second mode matters,
weights would not reveal it, and NUTS takes over.
"""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats

from trustbo.inference.evidence import place_marginal
from trustbo.inference.evidence.place_marginal import PlaceHyper, PlaceIndex
from trustbo.inference.samplers import scores
from trustbo.inference.samplers.laplace import laplace
from trustbo.inference.samplers.student import Spanning, Student
from trustbo.models.backend import own_settings
from trustbo.models.drift import DriftTrust
from trustbo.models.drift_form import Drift
from trustbo.models.effects.place import Place, split_units
from trustbo.models.params import DriftParams
from trustbo.models.place import PlaceEffect, Visited
from trustbo.models.state_space.scalar import ScalarSSM
from trustbo.stacking import MissionBatch

_CHUNK = 256
_CLOSE, _APART = 6.0, 3.0  # nats below the best that a mode still matters; sd between modes


class DriftTarget:
    """Log posterior density of the scores."""

    widths, n_corrected = (1.1, 1.0), None
    has_modes = False
    """Whether a second mode matters."""

    def __init__(
        self,
        model: DriftTrust,
        batch: MissionBatch,
        weight: np.ndarray,
        places: Visited | None = None,
    ) -> None:
        """Take the model, the missions, the weight of each, and the places visited."""
        self.model, self._visited = model, places
        index = None if places is None else PlaceIndex.of(places, batch.contact_rate)
        self._data = batch.awareness, batch.contact_rate, weight, index
        self._shape = batch.awareness.shape[2:]
        self._n_given = 3 + len(() if model.place is None else model.place.names)
        self.n_scores = self._n_given + model.n_scores(*self._shape)
        # With places each point costs a dense factor.
        self.n_pilot, self.n_final = (1024, 8192) if places is None else (512, 2048)
        measured = batch.contact_rate[~np.isnan(batch.contact_rate)]
        self._spread = float(np.log(np.clip(measured.std() / 0.2, 1e-2, 3.0)))

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density of scores (point, score), shape (point,)."""
        rows = np.minimum(np.arange(-(-len(z) // _CHUNK) * _CHUNK), len(z) - 1)
        with np.errstate(all="ignore"), own_settings():  # far out there is no density
            theta, drift_scores = self._theta(z), z[:, self._n_given :]
            batches = [
                np.asarray(
                    _log_likelihood(self.model, *self._data, theta[part], drift_scores[part])
                )
                for part in rows.reshape(-1, _CHUNK)
            ]
            value = np.concatenate(batches)[: len(z)] + scores.log_prior(z)
        ok = np.isfinite(value) & (theta[:, 1:3] > 1e-6).all(1)
        return np.where(ok, value, -np.inf)

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the best of points drawn from the prior."""
        whole = self._visited is None
        n, n_starts, n_steps = (2048, 6, 30) if whole else (512, 1, 8)
        u = stats.qmc.Sobol(self.n_scores, scramble=True, rng=0).random(n)
        z = stats.norm.ppf(np.clip(u, 1e-6, 1.0 - 1e-6))
        z[:, 1] = self._spread - 3.0 * u[:, 1]
        best = np.argsort(-self.log_density(z))[:n_starts]
        modes, value, scale = laplace(self.log_density, z[best], n_steps)
        top = int(value.argmax())
        white = np.linalg.solve(scale[top], (modes - modes[top]).T)
        far = np.linalg.norm(white[3:], axis=0) > _APART if self.n_scores > 3 else np.zeros(1, bool)
        self.has_modes = bool((far & (value > value[top] - _CLOSE)).any())
        return Student(modes[top], scale[top])

    def recentre(self, z: np.ndarray) -> None:
        """No-op: the density is exact everywhere."""

    def defensive(self, proposal: Student) -> Spanning:
        """Proposal that spans all angles between the two noises."""
        return Spanning.of(proposal, 2)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """Parameters at the points of indices; these draws need no weights."""
        theta, scores = self._theta(z[chosen]), z[chosen, self._n_given :]
        shared = dict(zip(("beta0", "delta_w", "delta_v"), theta.T[:3], strict=True))
        params = shared | self.model.parameters_at(scores, self._shape)
        if self._visited is None:
            return params, None
        place = cast(PlaceEffect, self.model.place)
        column = {"tau_s": 3, "length_scale": 4, "tau_e": 5}
        hyper = {name: theta[:, column[name]] for name in place.names}
        with own_settings():
            keys = jax.random.split(jax.random.key(int(rng.integers(1 << 31))), len(theta))
            rows = np.minimum(np.arange(-(-len(theta) // _CHUNK) * _CHUNK), len(theta) - 1)
            units = [
                np.asarray(_draw_effects(self.model, *self._data, theta[i], scores[i], keys[i]))
                for i in rows.reshape(-1, _CHUNK)
            ]
        flat = np.concatenate(units)[: len(theta), : len(self._visited.units)]
        return params | hyper | split_units(place, self._visited, flat, hyper, rng), None

    def _theta(self, z: np.ndarray) -> np.ndarray:
        """Parameters (point, 3), or (point, 6) with those of places, without those of the drift."""
        theta = scores.beta0_and_noises(self.model.priors, z)
        if self.model.place is None:
            return theta
        place = Place(**self.model.place.to_record())
        absent = {"tau_s": np.zeros(len(z)), "length_scale": np.ones(len(z))}
        absent["tau_e"] = absent["tau_s"]
        hyper = absent | place.scales(z[:, 3 : self._n_given])
        return np.column_stack([theta, *hyper.values()])


@jax.jit
def _log_likelihood(
    model: DriftTrust,
    awareness: Array,
    contact_rate: Array,
    weight: Array,
    places: PlaceIndex | None,
    theta: Array,
    scores: Array,
) -> Array:
    """Log likelihood (point,) at theta, see `_theta`, and scores (point, score) of the drift."""

    def one(theta: Array, scores: Array) -> Array:
        ssm = _ssm(model, awareness, theta, scores)
        if places is None:
            return ssm.log_likelihood(jnp.swapaxes(contact_rate, 0, 1)).sum(1) @ weight
        hyper = PlaceHyper(*theta[3:])
        return place_marginal.log_likelihood(ssm, contact_rate, weight, hyper, places)

    return jax.vmap(one)(theta, scores)


@jax.jit
def _draw_effects(
    model: DriftTrust,
    awareness: Array,
    contact_rate: Array,
    weight: Array,
    places: PlaceIndex,
    theta: Array,
    scores: Array,
    keys: Array,
) -> Array:
    """Effects (point, unit) of visited places, one exact draw at each point."""

    def one(theta: Array, scores: Array, key: Array) -> Array:
        ssm, hyper = _ssm(model, awareness, theta, scores), PlaceHyper(*theta[3:])
        return place_marginal.draw_effects(ssm, contact_rate, weight, hyper, places, key)[0]

    return jax.vmap(one)(theta, scores, keys)


def _ssm(model: DriftTrust, awareness: Array, theta: Array, scores: Array) -> ScalarSSM:
    """State space of one point."""
    drift = Drift(model.form, model.at_scores(scores, *awareness.shape[2:])[0], awareness.shape[3])
    x0 = model.priors.x0_mean, model.priors.x0_sd
    return DriftParams(theta[0], drift, theta[1], theta[2], *x0).ssm(awareness, model.lag)
