"""Groups of a posterior's DataTree: latent trust, likelihoods and predictions under its draws."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from jax import random

from trustbo.data import Mission
from trustbo.inference.draws import (
    effects_of,
    is_of_people,
    memory_of,
    params_of_missions,
    slots_of,
    theta_of,
    with_effects,
)
from trustbo.inference.evidence import kalman_numpy, latent
from trustbo.inference.evidence.ep import trust
from trustbo.inference.log_prior import log_prior_group
from trustbo.inference.people import groups_of_people
from trustbo.inference.place_maps import prior_maps
from trustbo.inference.posterior_tree import missions_of, require_posterior, to_datatree
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import draw_effects
from trustbo.models.families import FAMILIES, Family
from trustbo.models.model import TrustModel
from trustbo.models.params import Params, params_from
from trustbo.models.place import bounds_of
from trustbo.models.state_space.contact_rate import mission_log_likelihood
from trustbo.models.state_space.generate import draw_missions
from trustbo.stacking import MissionBatch, stack_missions

LIKELIHOODS = ("log_likelihood", "mission_log_likelihood")
"""Group of log p(rates of a mission | draw), without and with weights of missions."""
_N_TRAJECTORIES = 200  # draws, spread evenly over the chains, that latent trust is kept of


_KEPT = ("posterior", "sample_stats", "prior", "places", "hazard")


def parameters_alone(posterior: xr.DataTree) -> xr.DataTree:
    """Posterior without the groups that grow with the number of missions; see `complete`."""
    kept = [*_KEPT, *(effect.noun for effect in effects_of(posterior))]
    kept = [name for name in kept if name in posterior.children]
    alone = xr.DataTree.from_dict({name: posterior[name].to_dataset() for name in kept})
    alone.attrs = posterior.attrs
    return alone


class Conditional(NamedTuple):
    """Conditional distribution of contact rates given parameters."""

    family: Family
    by_numpy: bool
    """Whether scalar recursions suffice, which run faster than JAX compiles them."""
    of_people: bool = False

    @classmethod
    def of(cls, posterior: xr.DataTree) -> Self:
        """Read the conditional distribution from the attributes of a posterior."""
        family = FAMILIES[posterior.attrs["observation"]]
        apart = posterior.attrs["inter_robot"] == "none"
        return cls(family, apart, is_of_people(posterior))


def complete(
    posterior: xr.DataTree,
    missions: Sequence[Mission] | None = None,
    *,
    model: TrustModel | None = None,
) -> xr.DataTree:
    """Add latent trust, log-likelihoods and predictions to a posterior of parameters alone.

    A campaign keeps the parameters of its posteriors; these groups grow with the number of
    missions, and are the same whenever they are computed.

    Args:
        posterior: DataTree from `fit`, or one of `Result.posteriors`.
        missions: Missions that it was fitted to; needed where it holds no data.
        model: Its model, for `log_prior`; needed with custom priors.

    Returns:
        The posterior with the groups `latent`, `posterior_predictive`, `prior_predictive`,
        `log_prior` and `log_likelihood`; itself, if it has them. Where missions have weights, the
        last is called `mission_log_likelihood`: `az.loo` would take it for that of an unweighted
        posterior; use `trustbo.inference.loo`.

    Raises:
        TrustboError: The posterior holds no data and no missions are given.
    """
    if "latent" in require_posterior("complete", posterior).children:
        return posterior
    conditional = Conditional.of(posterior)
    missions = missions_of(posterior) if missions is None else missions
    groups, data_name = _groups(posterior, conditional, missions)
    added = to_datatree(groups, missions, {})
    parts = {**posterior.children, **added.children}
    whole = xr.DataTree.from_dict({name: part.to_dataset() for name, part in parts.items()})
    if (densities := log_prior_group(posterior, model)) is not None:
        whole["log_prior"] = xr.DataTree(densities)
    whole.attrs = posterior.attrs | {"log_likelihood_of": data_name}
    if "weights" in posterior.attrs:
        add_weights(whole, np.atleast_1d(posterior.attrs["weights"]))
    return whole


def add_weights(posterior: xr.DataTree, weight: np.ndarray) -> None:
    """Add the weights of missions (mission,) to their data, and as an attribute."""
    counted = xr.DataArray(weight, dims="mission")
    posterior["constant_data"] = posterior["constant_data"].assign(weight=counted)
    posterior.attrs["weights"] = weight.tolist()


def _groups(
    posterior: xr.DataTree, conditional: Conditional, missions: Sequence[Mission]
) -> tuple[dict[str, dict[str, Any]], str]:
    """Arrays by group and name, (chain, draw) leading, and the data of the log-likelihoods."""
    n_chains, n_draws = (posterior["posterior"].sizes[d] for d in ("chain", "draw"))
    kept = np.linspace(0, n_draws - 1, min(n_draws, max(1, _N_TRAJECTORIES // n_chains))).astype(
        int
    )
    if conditional.of_people:
        return groups_of_people(posterior, missions, kept), "contact_rate"
    # NumPy needs no padding.
    batch = stack_missions(missions, pad=not conditional.by_numpy)
    every = params_of_missions(posterior, missions, batch)
    index = (np.arange(n_chains)[:, None] * n_draws + kept).ravel()
    few = every.map(lambda values, _: values[index])
    seed = posterior.attrs["seed"]
    if conditional.by_numpy:
        n_bounds = np.array([len(mission.bounds) for mission in missions])
        arrays = _trust_by_numpy(conditional, every, few, batch, n_bounds, seed)
    else:
        arrays = _trust_compiled(conditional, every, few, batch, seed)
    prior = _prior_of(posterior, missions, batch)

    rng = np.random.default_rng(seed + 3)

    def by_chain(array: np.ndarray) -> np.ndarray:
        return array.reshape(n_chains, -1, *array.shape[1:])

    likelihood, data_name = _count_ticks(
        conditional.family, batch, arrays["log_likelihood"], len(missions)
    )
    return {
        LIKELIHOODS[is_weighted(posterior)]: {"contact_rate": by_chain(likelihood)},
        "latent": {
            "trust": by_chain(arrays["trust"]),
            "trust_mean": arrays["trust_mean"],
            "trust_sd": arrays["trust_sd"],
            "draw": kept,
        },
        "posterior_predictive": {"contact_rate": by_chain(arrays["predicted"])},
        "prior_predictive": {"contact_rate": _predict(conditional, prior, batch, rng)[None]},
    }, data_name


def is_weighted(posterior: xr.DataTree) -> bool:
    """Whether missions have weights other than 1."""
    return bool((np.asarray(posterior.attrs.get("weights", 1.0)) != 1.0).any())


def _prior_of(posterior: xr.DataTree, missions: Sequence[Mission], batch: MissionBatch) -> Params:
    """Draws of the prior, for the bounds of some missions."""
    sites = {str(n): a.values[0] for n, a in posterior["prior"].data_vars.items()}
    params = params_from(sites, posterior.attrs).flat()
    if "places" in posterior.children:
        maps = prior_maps(posterior["places"].to_dataset(), sites)
        params = params._replace(**maps)  # pyright: ignore
        params = params.on(bounds_of(missions, batch.contact_rate.shape[:2]))
    rng = np.random.default_rng([posterior.attrs["seed"], 4])
    theta = theta_of(sites, memory_of(posterior))
    slots = slots_of(missions, batch)
    effects = effects_of(posterior)
    drawn = [draw_effects(effect, theta, slots, rng) for effect in effects]
    return with_effects(params, effects, drawn, theta, slots)


def _trust_by_numpy(
    conditional: Conditional,
    every: Params,
    few: Params,
    batch: MissionBatch,
    n_bounds: np.ndarray,
    seed: int,
) -> dict[str, np.ndarray]:
    """Latent trust, log-likelihood and predictions of robots apart, without JAX."""
    rng = np.random.default_rng([seed, 1])
    if conditional.family.integrates_out:
        summary = kalman_numpy.summarize(every, batch, n_bounds)
        trajectories = kalman_numpy.sample(few, batch, rng, n_bounds)
    else:
        summary = trust.summarize(conditional.family, every, batch, n_bounds, rng)
        trajectories = trust.sample(conditional.family, few, batch, n_bounds, rng)
    return {
        "log_likelihood": summary.log_likelihood,
        "trust": trajectories,
        "trust_mean": summary.mean,
        "trust_sd": summary.sd,
        "predicted": _predict(conditional, every, batch, rng),
    }


def _trust_compiled(
    conditional: Conditional,
    every: Params,
    few: Params,
    batch: MissionBatch,
    seed: int,
) -> dict[str, np.ndarray]:
    """Latent trust, log-likelihood and predictions of coupled robots, compiled by JAX."""
    with own_settings():
        keys = random.split(random.fold_in(random.key(seed), 1))
        mean, sd = latent.trust_moments(every, batch)
        arrays = {
            "log_likelihood": mission_log_likelihood(conditional.family, every, *batch, keys[0]),
            "trust": latent.trust_draws(few, batch, keys[1]),
            "trust_mean": mean,
            "trust_sd": sd,
            "predicted": _predict(conditional, every, batch, np.random.default_rng([seed, 1])),
        }
        return {name: np.asarray(array) for name, array in arrays.items()}


def _predict(
    conditional: Conditional, params: Params, batch: MissionBatch, rng: np.random.Generator
) -> np.ndarray:
    """Contact rates of missions drawn anew, one set per draw: (draw, mission, bound, robot)."""
    drawn = draw_missions(conditional.family, params, batch.awareness, batch.n_ticks, rng)
    return drawn.contact_rate


def _count_ticks(
    family: Family, batch: MissionBatch, likelihood: np.ndarray, n_missions: int
) -> tuple[np.ndarray, str]:
    """Log-likelihoods, of counts of ticks where these are known, and the name of their data."""
    shift = family.log_resolution(batch.contact_rate, batch.n_ticks).sum((1, 2))
    if np.isnan(shift[:n_missions]).any():
        return likelihood, "contact_rate"
    return likelihood + shift, "ticks"
