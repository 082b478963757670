"""Rates of any family as normal ones, by randomised normal scores given a draw of trust.

Given trust x the score s = Phi^-1(u) of a rate is standard normal, u uniform between the
probabilities of a rate below it and of one up to it (Dunn and Smyth 1996). One posterior draw of x
has, over the data that the model gives, the distribution of trust itself (Johnson 2004), so that
x + sd s is normal with the mean and covariance of trust, plus sd^2: what rates are where they are
Gaussian, and rates before they were cut where they are censored. All residuals and tests of normal
rates then hold for them too.
"""

import numpy as np
import xarray as xr
from scipy import special

from trustbo.criticism.joint_normal import Data, Point
from trustbo.data import Mission
from trustbo.inference.draws import params_of_missions
from trustbo.inference.evidence.ep import trust
from trustbo.models.families import FAMILIES
from trustbo.models.params import CoupledParams

_LEAST = 1e-15  # probability, of a rate that no normal score shows


def with_normal_rates(
    posterior: xr.DataTree, missions: list[Mission], data: Data, point: Point, seed: int
) -> tuple[Data, Point]:
    """Data with normal rates in place of the measured ones, and the point with their noise.

    Those of Gaussian rates are returned unchanged.

    Args:
        posterior: Posterior, with latent trust where this does not follow from the parameters.
        missions: Missions that it was fitted to.
        data: Their rates.
        point: Posterior mean of the parameters.
        seed: Seed of the draw of trust and of the scores.
    """
    family = FAMILIES[posterior.attrs["observation"]]
    if family.integrates_out:
        return data, point
    rng = np.random.default_rng([seed, 2])
    every = params_of_missions(posterior, missions, data.batch)
    if "latent" in posterior.children:
        kept = posterior["latent"]["trust"].transpose("chain", "draw", "mission", "bound", "robot")
        chain, i = (int(rng.integers(n)) for n in kept.shape[:2])
        x, label = kept.values[chain, i], int(kept["draw"].values[i])
        draw = chain * posterior["posterior"].sizes["draw"] + label
        one = every.map(lambda values, _: values[draw : draw + 1])
    else:
        draw = int(rng.integers(len(every.b)))
        one = every.map(lambda values, _: values[draw : draw + 1])
        x = trust.sample(family, one, data.batch, data.n_bounds, rng)[0]
    where = tuple(data.slots[data.seen].T)
    if isinstance(one, CoupledParams):
        noise = np.sqrt(np.diagonal(np.asarray(one.Delta_v)[0]))[where[2]]
    else:
        noise = np.broadcast_to(np.asarray(one.delta_v, dtype=float)[0], data.n_robots)[where[2]]
    low, high = family.probabilities(x[where], noise, data.y, data.batch.n_ticks[where])
    u = low + rng.random(len(low)) * (high - low)
    s = special.ndtri(np.clip(u, _LEAST, 1.0 - _LEAST))
    if family.rounds:
        return data._replace(y=x[where] + noise * s), point
    _, slope, variance = family.rate_moments(x[where], noise)
    sd = float(np.median(np.sqrt(variance) / slope))
    params = point.params._replace(delta_v=np.full_like(point.params.delta_v, sd))
    return data._replace(y=x[where] + sd * s), point._replace(params=params)
