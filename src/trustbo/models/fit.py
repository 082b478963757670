"""From missions to a posterior: sampling, checking it, and laying it out for ArviZ."""

import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
import xarray as xr
from jax import random
from numpy.typing import ArrayLike

from trustbo.data import Mission
from trustbo.errors import PosteriorError, ShapeError, TrustboError, require_choice
from trustbo.models import latent, trajectories
from trustbo.models.contact_rate import mission_log_likelihood
from trustbo.models.datatree import to_datatree
from trustbo.models.geometry import NutsData
from trustbo.models.model import TrustModel, require_exposure
from trustbo.models.nuts import NutsSettings
from trustbo.models.observation import log_resolution
from trustbo.models.params import Params, params_from
from trustbo.models.pooled import PooledTrust
from trustbo.models.prior import draw_sites
from trustbo.models.sampling import SAMPLERS, Draws, draw_posterior, require_sampler
from trustbo.stacking import MissionBatch, stack_missions

_FIRM_NOISE = (
    "keep the noise away from 0, e.g. Priors(delta_v=numpyro.distributions.TruncatedNormal(0.0, "
    "0.2, low=0.01))"
)
_N_PRIOR = 500


def fit(
    missions: Sequence[Mission],
    model: TrustModel | None = None,
    sampler: str = "nuts",
    *,
    weights: ArrayLike | None = None,
    seed: int = 0,
    n_warmup: int = 300,
    n_draws: int = 1000,
    n_chains: int = 4,
    n_trajectories: int = 200,
    check: bool = True,
) -> xr.DataTree:
    """Posterior of the trust model's parameters, and of latent trust, given missions.

    Args:
        missions: All missions to learn from; contact rates that are NaN were not measured.
        model: The trust model; by default `PooledTrust()`.
        sampler: `"nuts"`. Or `"exact"`: near-independent draws by importance sampling, without
            compiling, for Gaussian observations of robots that share their parameters or have
            nothing in common; it falls back on NUTS, with a warning, where that does not work. Or
            `"joint"`: NUTS on parameters and latent trust together, which it is anyway where trust
            cannot be integrated out.
        weights: How much each mission counts, shape (mission,), in [0, 1]; 1 by default. For
            Gaussian observations.
        seed: Same seed, same posterior.
        n_warmup: Warm-up draws per chain of NUTS, not kept.
        n_draws: Draws kept per chain.
        n_chains: Chains.
        n_trajectories: Draws, spread evenly over the chains, for which latent trust and predicted
            contact rates are kept.
        check: Refuse a posterior with R-hat > 1.01, bulk ESS < 400 or a divergence that a longer
            run does not cure; `False` returns it as it is.

    Returns:
        An ArviZ DataTree with the groups `posterior` (for `PooledTrust` beta0, beta[feature], b,
        delta_w, delta_v), `latent` (trust[chain, draw, mission, bound, robot] by backward sampling,
        and trust_mean and trust_sd over all draws), `posterior_predictive`, `prior`,
        `prior_predictive`, `log_likelihood` (contact_rate[chain, draw, mission]: a whole mission is
        one observation, so LOO leaves out missions), `sample_stats`, `observed_data` and
        `constant_data`. Bound k is labelled k = 1, 2, ...; short missions are padded with NaN.
        Where all rates have an exposure, log-likelihoods are of the counts of ticks, on equal terms
        for all families of observations; the attribute `log_likelihood_of` says so.

    Raises:
        ShapeError: No missions, or missions that disagree on robots or features.
        TrustboError: An awareness value is NaN, the sampler is unknown or does not suit the model,
            or the contact rates do not vary at all: the Gaussian noise then has no posterior.
        PosteriorError: The diagnostics say that the posterior must not be used.
    """
    model = PooledTrust() if model is None else model
    if not isinstance(model, TrustModel):
        raise TrustboError(f"model must be a trust model, e.g. PooledTrust(); got {model!r}.")
    require_sampler(model, require_choice("sampler", sampler, SAMPLERS))
    batch = stack_missions(missions)
    require_exposure(model, batch)
    _require_variation(batch, model)
    weight = _weights(weights, model, batch, len(missions))
    settings = NutsSettings(n_warmup, n_draws, n_chains)
    started = time.perf_counter()
    draws, complaints = draw_posterior(model, sampler, settings, seed, batch, weight, check=check)
    # What is not compiled needs no padding.
    shown = stack_missions(missions, pad=False) if _is_apart(model) else batch
    groups = _describe(model, draws, shown, seed, n_trajectories)
    of = _count_ticks(model, shown, groups, len(missions))
    seconds = time.perf_counter() - started
    posterior = to_datatree(groups, missions, model.dims)
    posterior.attrs |= {
        "model": type(model).__name__,
        "observation": model.observation,
        "response": model.response,
        "inter_robot": getattr(model, "inter_robot", "none"),
        "sampler": draws.sampler,
        "seed": seed,
        "seconds": seconds,
        "log_likelihood_of": of,
        **draws.summary,
        "x0_mean": float(model.priors.x0_mean),
        "x0_sd": float(model.priors.x0_sd),
        **{f"prior_{name}": text for name, text in model.priors.describe().items()},
        **{f"{name}_version": version(name) for name in ("trustbo", "numpyro", "jax")},
    }
    if weights is not None:
        counted = xr.DataArray(weight[: len(missions)], dims="mission")
        posterior["constant_data"] = posterior["constant_data"].assign(weight=counted)
    if complaints:
        raise PosteriorError(
            f"posterior refused after a longer retry: {'; '.join(complaints)}. Give more missions, "
            f"or firmer priors (where the rates hardly vary, {_FIRM_NOISE}), or pass check=False "
            "to have it as it is.",
            posterior,
        )
    return posterior


def _require_variation(batch: MissionBatch, model: TrustModel) -> None:
    """Refuse rates that are all the same, unless a prior keeps the noise away from 0.

    The Gaussian likelihood would grow without bound as both noises go to 0, and have no posterior.
    """
    rates = batch.contact_rate[~np.isnan(batch.contact_rate)]
    if not len(rates):
        raise TrustboError(
            "every contact rate is NaN: nothing was measured. Give one rate at least."
        )
    priors = model.priors
    bounded = any(
        getattr(p.support, "lower_bound", 0.0) > 0.0 for p in (priors.delta_w, priors.delta_v)
    )
    degenerate = model.observation == "gaussian" or 0.0 < rates[0] < 1.0
    counted = model.observation == "beta_binomial"
    if len(rates) > 1 and np.ptp(rates) == 0.0 and degenerate and not bounded and not counted:
        raise TrustboError(
            f"all {len(rates)} contact rates are {rates[0]:g}: without variation the model cannot "
            "learn its noise. Add missions over other ground, use observation "
            f'"censored" or "beta_binomial", or {_FIRM_NOISE}.'
        )


def _weights(
    weights: ArrayLike | None, model: TrustModel, batch: MissionBatch, n_missions: int
) -> np.ndarray:
    """One weight per mission of the batch, padding included."""
    padded = np.ones(len(batch.contact_rate))
    if weights is None:
        return padded
    given = np.asarray(weights, dtype=float)
    if given.shape != (n_missions,):
        raise ShapeError(f"weights must be ({n_missions},), one per mission; got {given.shape}.")
    bad = ~((given >= 0.0) & (given <= 1.0))
    if bad.any() or not given.any():
        raise TrustboError(f"weights must be in [0, 1], and one of them positive; got {given}.")
    if model.observation != "gaussian":
        raise TrustboError(
            f'weights are for observation "gaussian"; with "{model.observation}" a fractional '
            "mission would no longer have its trust integrated out. Leave missions out instead."
        )
    padded[:n_missions] = given
    return padded


def _describe(
    model: TrustModel, draws: Draws, batch: MissionBatch, seed: int, n_trajectories: int
) -> dict[str, dict[str, Any]]:
    """Every group of the DataTree as arrays with leading axes (chain, draw), padding included."""
    n_chains, n_draws = draws.stats["lp"].shape
    every = {name: a.reshape(-1, *a.shape[2:]) for name, a in draws.params.items()}
    kept = np.linspace(0, n_draws - 1, min(n_draws, max(1, n_trajectories // n_chains))).astype(int)
    few = {k: a[:, kept].reshape(-1, *a.shape[2:]) for k, a in draws.params.items()}
    all_params, few_params = params_from(every, model.x0), params_from(few, model.x0)
    if _is_apart(model):
        found = _of_gaussian(model, all_params, few_params, batch, seed)
    else:
        found = _of_compiled(model, all_params, few_params, draws, kept, batch, seed)
    prior = draw_sites(model, batch.awareness.shape[2:], _N_PRIOR, seed + 2)

    def by_chain(array: np.ndarray) -> np.ndarray:
        return array.reshape(n_chains, -1, *array.shape[1:])

    return {
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


def _is_apart(model: TrustModel) -> bool:
    """Whether robots do not influence each other, and all is Gaussian: NumPy then does."""
    return model.observation == "gaussian" and getattr(model, "inter_robot", "none") == "none"


def _of_gaussian(
    model: TrustModel,
    every: Params,
    few: Params,
    batch: MissionBatch,
    seed: int,
) -> dict[str, np.ndarray]:
    """Latent trust, log-likelihood and predictions of robots apart, without compiling."""
    rng = np.random.default_rng([seed, 1])
    summary = trajectories.summarize(every.flat(), model.lag, batch)
    return {
        "log_likelihood": summary.log_likelihood,
        "trust": trajectories.sample(few.flat(), model.lag, batch, rng),
        "trust_mean": summary.mean,
        "trust_sd": summary.sd,
        "predicted": trajectories.simulate(few.flat(), model.lag, batch.awareness, rng),
    }


def _of_compiled(
    model: TrustModel,
    every: Params,
    few: Params,
    draws: Draws,
    kept: np.ndarray,
    batch: MissionBatch,
    seed: int,
) -> dict[str, np.ndarray]:
    """The same for coupled robots and other families."""
    family = (model.observation, model.lag)
    every, few = every.flat(), few.flat()
    noise = few_noise = None
    if draws.noise is not None:
        shape = (-1, *draws.noise.shape[2:])
        noise, few_noise = draws.noise.reshape(shape), draws.noise[:, kept].reshape(shape)
    with jax.enable_x64(True):
        data = NutsData(*batch, np.ones(len(batch.contact_rate)))
        keys = random.split(random.fold_in(random.key(seed), 1), 3)
        moments = latent.trust_moments(*family, every, noise, draws.pilot, data)
        found = {
            "log_likelihood": mission_log_likelihood(*family, every, *batch, keys[0]),
            "trust": latent.trust_draws(*family, few, few_noise, draws.pilot, data, keys[1]),
            "trust_mean": moments.mean,
            "trust_sd": moments.sd,
            "predicted": latent.predictive(*family, few, data, keys[2]),
        }
        return {name: np.asarray(array) for name, array in found.items()}


def _predict(
    model: TrustModel, draws: Mapping[str, np.ndarray], batch: MissionBatch, seed: int
) -> np.ndarray:
    """Contact rates of replicated missions, (draw, mission, bound, robot)."""
    params = params_from(draws, model.x0).flat()
    if _is_apart(model):
        rng = np.random.default_rng(seed)
        return trajectories.simulate(params, model.lag, batch.awareness, rng)
    with jax.enable_x64(True):
        data = NutsData(*batch, np.ones(len(batch.contact_rate)))
        key = random.key(seed)
        return np.asarray(latent.predictive(model.observation, model.lag, params, data, key))


def _count_ticks(
    model: TrustModel, batch: MissionBatch, groups: dict[str, dict[str, Any]], n_missions: int
) -> str:
    """Make log-likelihoods those of the counts of ticks, if these are known; say which it is."""
    shift = log_resolution(model.observation, batch.contact_rate, batch.exposure).sum((1, 2))
    if np.isnan(shift[:n_missions]).any():
        return "contact_rate"
    rates = groups["log_likelihood"]["contact_rate"]
    groups["log_likelihood"]["contact_rate"] = rates + shift
    return "ticks"
