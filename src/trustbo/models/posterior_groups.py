"""Groups of a posterior's DataTree: latent trust, likelihoods and predictions under its draws."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax import random

from trustbo.data import Mission
from trustbo.models.likelihood import kalman_numpy, latent
from trustbo.models.likelihood.contact_rate import mission_log_likelihood
from trustbo.models.model import TrustModel
from trustbo.models.params import Params, assemble_params
from trustbo.models.prior_predictive import draw_sites
from trustbo.models.samplers.run import Draws
from trustbo.stacking import MissionBatch, stack_missions

Groups = dict[str, dict[str, Any]]
_N_PRIOR = 500


def describe(
    model: TrustModel, draws: Draws, missions: Sequence[Mission], seed: int, n_trajectories: int
) -> tuple[Groups, str]:
    """Arrays of every group of a posterior's DataTree.

    Args:
        model: Trust model.
        draws: Draws of its parameters.
        missions: Missions they were drawn given.
        seed: Seed of latent trust and predictions.
        n_trajectories: Number of draws to keep trajectories of.

    Returns:
        Arrays by group and name with leading axes (chain, draw), padding included; and the data
        that log-likelihoods are of, `"ticks"` or `"contact_rate"`.
    """
    # NumPy needs no padding.
    batch = stack_missions(missions, pad=not _by_numpy(model))
    n_chains, n_draws = draws.stats["lp"].shape
    every = {name: a.reshape(-1, *a.shape[2:]) for name, a in draws.params.items()}
    kept = np.linspace(0, n_draws - 1, min(n_draws, max(1, n_trajectories // n_chains))).astype(int)
    few = {k: a[:, kept].reshape(-1, *a.shape[2:]) for k, a in draws.params.items()}
    all_params, few_params = assemble_params(every, model.x0), assemble_params(few, model.x0)
    if _by_numpy(model):
        n_bounds = np.array([len(mission.bounds) for mission in missions])
        found = _trust_by_numpy(model, all_params, few_params, batch, n_bounds, seed)
    else:
        found = _trust_compiled(model, all_params, few_params, draws, kept, batch, seed)
    prior = draw_sites(model, batch.awareness.shape[2:], _N_PRIOR, seed + 2)

    def by_chain(array: np.ndarray) -> np.ndarray:
        return array.reshape(n_chains, -1, *array.shape[1:])

    groups = {
        "posterior": {name: draws.params[name] for name in model.dims},
        "sample_stats": draws.stats,
        "log_likelihood": {"contact_rate": by_chain(found["log_likelihood"])},
        "latent": {
            "trust": by_chain(found["trust"]),
            "trust_mean": found["trust_mean"],
            "trust_sd": found["trust_sd"],
            "draw": kept,
        },
        "posterior_predictive": {"contact_rate": by_chain(found["predicted"]), "draw": kept},
        "prior_predictive": {"contact_rate": _predict(model, prior, batch, seed + 3)[None]},
        "prior": {name: values[None] for name, values in prior.items()},
    }
    return groups, _count_ticks(model, batch, groups, len(missions))


def _by_numpy(model: TrustModel) -> bool:
    """Whether scalar recursions suffice, which NumPy runs faster than they compile."""
    return model.family.integrates_out and model.robots_are_apart


def _trust_by_numpy(
    model: TrustModel,
    every: Params,
    few: Params,
    batch: MissionBatch,
    n_bounds: np.ndarray,
    seed: int,
) -> dict[str, np.ndarray]:
    """Latent trust, log-likelihood and predictions of robots apart, without compiling."""
    rng = np.random.default_rng([seed, 1])
    summary = kalman_numpy.summarize(every.flat(), model.lag, batch, n_bounds)
    return {
        "log_likelihood": summary.log_likelihood,
        "trust": kalman_numpy.sample(few.flat(), model.lag, batch, rng, n_bounds),
        "trust_mean": summary.mean,
        "trust_sd": summary.sd,
        "predicted": kalman_numpy.simulate(few.flat(), model.lag, batch.awareness, rng),
    }


def _trust_compiled(
    model: TrustModel,
    every: Params,
    few: Params,
    draws: Draws,
    kept: np.ndarray,
    batch: MissionBatch,
    seed: int,
) -> dict[str, np.ndarray]:
    """The same for coupled robots and families that do not integrate out."""
    law = (model.family, model.lag)
    every, few = every.flat(), few.flat()
    latents = few_latents = draws.latents
    if (innovations := draws.latents.innovations) is not None:
        shape = (-1, *innovations.shape[2:])
        latents = latents._replace(innovations=innovations.reshape(shape))
        few_latents = latents._replace(innovations=innovations[:, kept].reshape(shape))
    with jax.enable_x64(True):
        keys = random.split(random.fold_in(random.key(seed), 1), 3)
        moments = latent.trust_moments(*law, every, latents, batch)
        found = {
            "log_likelihood": mission_log_likelihood(*law, every, *batch, keys[0]),
            "trust": latent.trust_draws(*law, few, few_latents, batch, keys[1]),
            "trust_mean": moments.mean,
            "trust_sd": moments.sd,
            "predicted": latent.predictive(*law, few, batch, keys[2]),
        }
        return {name: np.asarray(array) for name, array in found.items()}


def _predict(
    model: TrustModel, draws: Mapping[str, np.ndarray], batch: MissionBatch, seed: int
) -> np.ndarray:
    """Contact rates of replicated missions, (draw, mission, bound, robot)."""
    params = assemble_params(draws, model.x0).flat()
    if _by_numpy(model):
        rng = np.random.default_rng(seed)
        return kalman_numpy.simulate(params, model.lag, batch.awareness, rng)
    with jax.enable_x64(True):
        key = random.key(seed)
        return np.asarray(latent.predictive(model.family, model.lag, params, batch, key))


def _count_ticks(model: TrustModel, batch: MissionBatch, groups: Groups, n_missions: int) -> str:
    """Turn log-likelihoods into those of counts of ticks, if these are known; name their data."""
    shift = model.family.log_resolution(batch.contact_rate, batch.n_ticks).sum((1, 2))
    if np.isnan(shift[:n_missions]).any():
        return "contact_rate"
    rates = groups["log_likelihood"]["contact_rate"]
    groups["log_likelihood"]["contact_rate"] = rates + shift
    return "ticks"
