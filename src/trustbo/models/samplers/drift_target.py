"""The posterior of a model with a drift of the user's own, Gaussian rates and few parameters.

Trust integrates out; all else is a score of its prior (`scores`), the user's parameters in the
order of their statements: each is the quantile of its prior, given those before it, at Phi(score).
So where data say nothing the posterior is a sphere, and a hierarchy is non-centred. The density is
compiled for 256 points at a time. The first proposal is Laplace's at the best of the modes that are
found from the best prior points; where two modes matter, weights would not tell, and NUTS is left
to treat them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import stats

from trustbo.models.backend import own_settings
from trustbo.models.drift import DriftTrust
from trustbo.models.drift_form import Drift
from trustbo.models.params import DriftParams
from trustbo.models.samplers import scores
from trustbo.models.samplers.laplace import laplace
from trustbo.models.samplers.student import Spanning, Student
from trustbo.stacking import MissionBatch

_CHUNK = 256
_N_PRIOR, _N_STARTS = 2048, 6
_CLOSE, _APART = 6.0, 3.0  # nats below the best that a mode still matters; sd between modes


class DriftTarget:
    """Log posterior density of the scores."""

    n_pilot, widths = 1024, (1.1, 1.0)
    n_final = 8192
    """Points of the last proposal."""
    n_corrected = None

    def __init__(self, model: DriftTrust, batch: MissionBatch, weight: np.ndarray) -> None:
        """Take the model, the missions, and the weight of each."""
        self.model, self._batch, self._weight = model, batch, weight
        self._shape = batch.awareness.shape[2:]
        self.n_scores = 3 + model.n_scores(*self._shape)
        measured = batch.contact_rate[~np.isnan(batch.contact_rate)]
        self._spread = float(np.log(np.clip(measured.std() / 0.2, 1e-2, 3.0)))

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """Log posterior density of scores (point, score), shape (point,)."""
        rates = self._batch.awareness, self._batch.contact_rate, self._weight
        rows = np.minimum(np.arange(-(-len(z) // _CHUNK) * _CHUNK), len(z) - 1)
        with np.errstate(all="ignore"), own_settings():  # far out there is no density
            theta = scores.beta0_and_noises(self.model.priors, z)
            each = [
                np.asarray(_log_likelihood(self.model, *rates, theta[part], z[part, 3:]))
                for part in rows.reshape(-1, _CHUNK)
            ]
            value = np.concatenate(each)[: len(z)] + scores.log_prior(z)
        ok = np.isfinite(value) & (theta[:, 1:] > 1e-6).all(1)
        return np.where(ok, value, -np.inf)

    def first(self) -> Student:
        """Gaussian fit at the best mode, found from the best of points drawn from the prior."""
        u = stats.qmc.Sobol(self.n_scores, scramble=True, rng=0).random(_N_PRIOR)
        z = stats.norm.ppf(np.clip(u, 1e-6, 1.0 - 1e-6))
        z[:, 1] = self._spread - 3.0 * u[:, 1]
        best = np.argsort(-self.log_density(z))[:_N_STARTS]
        modes, value, scale = laplace(self.log_density, z[best], n_steps=30)
        top = int(value.argmax())
        white = np.linalg.solve(scale[top], (modes - modes[top]).T)
        far = np.linalg.norm(white[3:], axis=0) > _APART if self.n_scores > 3 else np.zeros(1, bool)
        self.has_modes = bool((far & (value > value[top] - _CLOSE)).any())
        return Student(modes[top], scale[top])

    def look(self, z: np.ndarray) -> None:
        """Nothing: the density is exact wherever it is looked at from."""

    def defensive(self, proposal: Student) -> Spanning:
        """Proposal that spans all angles between the two noises."""
        return Spanning.of(proposal, 2)

    def draw(
        self, z: np.ndarray, log_p: np.ndarray, chosen: np.ndarray, rng: np.random.Generator
    ) -> tuple[dict[str, np.ndarray], None]:
        """Parameters at the points of indices; these draws need no weights."""
        theta = scores.beta0_and_noises(self.model.priors, z[chosen])
        shared = dict(zip(("beta0", "delta_w", "delta_v"), theta.T, strict=True))
        return shared | self.model.parameters_at(z[chosen, 3:], self._shape), None


@jax.jit
def _log_likelihood(
    model: DriftTrust,
    awareness: Array,
    contact_rate: Array,
    weight: Array,
    theta: Array,
    own: Array,
) -> Array:
    """Log likelihood of (beta0, delta_w, delta_v) (point, 3) and scores (point, score)."""
    y, n_features = jnp.swapaxes(contact_rate, 0, 1), awareness.shape[3]
    form, x0_mean, x0_sd = model.form, model.priors.x0_mean, model.priors.x0_sd

    def one(theta: Array, own: Array) -> Array:
        drift = Drift(form, model.at_scores(own, *awareness.shape[2:])[0], n_features)
        params = DriftParams(theta[0], drift, theta[1], theta[2], x0_mean, x0_sd)
        return params.ssm(awareness, model.lag).log_likelihood(y).sum(1) @ weight

    return jax.vmap(one)(theta, own)
