"""Log predictive density of a mission given all others, by ratios of evidence and by refits.

With effects of places, draws hold the effects of bounds that a single mission made. Leaving that
mission out moves these back to their prior, further than weights of draws can follow. With effects,
coefficients and trust integrated out, few hyperparameters theta are left:

    p(y_j | y_-j) = p(y) / p(y_-j) = 1 / E[ p(y_-j | theta) / p(y | theta) | y ],

so that weights are ratios of the evidence without and with a mission.
"""

from typing import NamedTuple

import numpy as np
import xarray as xr

from trustbo.inference.draws import params_of, sites_of, theta_of
from trustbo.inference.fit import fit
from trustbo.inference.posterior_tree import missions_of
from trustbo.inference.samplers.posterior import evidence_of
from trustbo.inference.samplers.weights import smoothed_weights
from trustbo.models.effects.effect import Slots
from trustbo.models.model import TrustModel
from trustbo.models.place import places_of
from trustbo.parallel import one_blas_thread
from trustbo.stacking import stack_missions


class LeftOut(NamedTuple):
    """One mission left out."""

    log_density: float
    khat: float
    """Pareto shape of the weights it was computed by; of a refit, those of its sampler."""


def weights_of(posterior: xr.DataTree) -> np.ndarray:
    """Weight of each mission of a posterior, shape (mission,)."""
    n = posterior["observed_data"].sizes["mission"]
    weight = np.asarray(posterior.attrs.get("weights", 1.0), dtype=float)
    return np.broadcast_to(weight, n).copy()


@one_blas_thread()
def by_hyperparameters(posterior: xr.DataTree, model: TrustModel) -> list[LeftOut] | None:
    """Leave out each mission by weights over hyperparameters.

    Args:
        posterior: Posterior with the missions in it.
        model: Its model.

    Returns:
        One for each mission; None where the model has no effects, or where only approximations
        integrate these out (rates not Gaussian).
    """
    exact = model.robot_sets == "all" and model.family.integrates_out
    if not model.all_effects or not exact or model.why_not_exact is not None:
        return None
    missions, weight = missions_of(posterior), weights_of(posterior)
    batch = stack_missions(missions, pad=False)
    places = places_of(missions, model.place, batch.contact_rate.shape)
    sites, names = sites_of(posterior), ("beta0", "delta_w", "delta_v", *model.effect_dims)
    points = np.column_stack([sites[name] for name in names])
    points, index = np.unique(points, axis=0, return_inverse=True)
    theta = theta_of(dict(zip(names, points.T, strict=True)), model.memory)

    def log_evidence(j: int | None = None, w: float = 1.0) -> np.ndarray:
        """Log evidence at theta, the weight of mission j being w."""
        counted = weight.copy()
        if j is not None:
            counted[j] = w
        slots = Slots.of(batch, len(missions), missions[0].features, counted, places)
        return evidence_of(model, slots).log_density(theta)[index]

    whole, left_out = log_evidence(), []
    for j, w in enumerate(weight):
        without = log_evidence(j, 0.0) if w > 0.0 else whole
        counted = whole if w == 1.0 else log_evidence(j)
        log_weight, khat, _ = smoothed_weights(without - whole)
        density = float(np.logaddexp.reduce(log_weight + counted - without))
        left_out.append(LeftOut(density, khat if w > 0.0 else 0.0))
    return left_out


def by_refit(posterior: xr.DataTree, model: TrustModel, j: int) -> LeftOut:
    """Leave out one mission by a posterior of the others.

    The density is a difference of log evidence where samplers give one, else a mean over draws.

    Args:
        posterior: Posterior with the missions in it.
        model: Its model.
        j: Index of the mission.
    """
    missions, weight = missions_of(posterior), weights_of(posterior)

    def fitted(w: float) -> xr.DataTree:
        counted = weight.copy()
        counted[j] = w
        kept = np.flatnonzero(counted > 0.0)
        equal = (counted[kept] == 1.0).all()
        return fit(
            [missions[i] for i in kept], model, earlier=posterior,
            weights=None if equal else counted[kept], seed=int(posterior.attrs["seed"]),
            progress=False, check=False, whole=False,
        )  # fmt: skip

    rest = fitted(0.0)
    if "log_evidence" not in rest.attrs:
        density = model.log_likelihood(params_of(rest), [missions[j]])[:, 0]
        return LeftOut(float(np.logaddexp.reduce(density) - np.log(len(density))), 0.0)
    ready = weight[j] == 1.0 and "log_evidence" in posterior.attrs
    whole = posterior if ready else fitted(1.0)
    khat = max(float(one.attrs["k_hat"]) for one in (whole, rest))
    return LeftOut(whole.attrs["log_evidence"] - rest.attrs["log_evidence"], khat)
