"""From missions to a posterior: sampling, checking it, and laying it out for ArviZ."""

import time
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jax import Array, random
from numpy.typing import ArrayLike
from numpyro import handlers

from trustbo.data import Mission
from trustbo.errors import PosteriorError, TrustboError, require_choice
from trustbo.models import latent
from trustbo.models.datatree import to_datatree
from trustbo.models.exact import KHAT_LIMIT, sample_exact
from trustbo.models.nuts import NutsSettings, run_nuts
from trustbo.models.pooled import (
    SITES,
    PooledTrust,
    TrustParams,
    mission_log_likelihood,
    pooled_trust,
)
from trustbo.models.priors import Priors
from trustbo.stacking import MissionBatch, stack_missions

SAMPLERS = ("nuts", "exact")
MAX_RHAT, MIN_ESS = 1.01, 400.0
_FIRM_NOISE = (
    "keep the noise away from 0, e.g. Priors(delta_v=numpyro.distributions.TruncatedNormal(0.0, "
    "0.2, low=0.01))"
)


def fit(
    missions: Sequence[Mission],
    model: PooledTrust | None = None,
    sampler: str = "nuts",
    *,
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
        sampler: `"nuts"`, or `"exact"`: near-independent draws by importance sampling, without
            compiling; it falls back on NUTS, with a warning, where that does not work.
        seed: Same seed, same posterior.
        n_warmup: Warm-up draws per chain of NUTS, not kept.
        n_draws: Draws kept per chain.
        n_chains: Chains.
        n_trajectories: Draws, spread evenly over the chains, for which latent trust and predicted
            contact rates are kept.
        check: Refuse a posterior with R-hat > 1.01, bulk ESS < 400 or a divergence that a longer
            run does not cure; `False` returns it as it is.

    Returns:
        An ArviZ DataTree with the groups `posterior` (beta0, beta[feature], b, delta_w, delta_v),
        `latent` (trust[chain, draw, mission, bound, robot] by backward sampling, and trust_mean and
        trust_sd over all draws), `posterior_predictive`, `prior`, `prior_predictive`,
        `log_likelihood` (contact_rate[chain, draw, mission]: a whole mission is one observation, so
        LOO leaves out missions), `sample_stats`, `observed_data` and `constant_data`. Bound k is
        labelled k = 1, 2, ...; short missions are padded with NaN.

    Raises:
        ShapeError: No missions, or missions that disagree on robots or features.
        TrustboError: An awareness value is NaN, the sampler is unknown, or the contact rates do
            not vary at all: the Gaussian model's noise then has no posterior.
        PosteriorError: The diagnostics say that the posterior must not be used.
    """
    require_choice("sampler", sampler, SAMPLERS)
    model = PooledTrust() if model is None else model
    batch = stack_missions(missions)
    _require_variation(batch, model.priors)
    settings = NutsSettings(n_warmup, n_draws, n_chains)
    started = time.perf_counter()
    with jax.enable_x64(True):
        draws, complaints = draw_posterior(model, sampler, settings, seed, batch, check=check)
        key = random.fold_in(random.key(seed), 1)
        groups = _describe(model, draws, batch, key, n_trajectories)
    seconds = time.perf_counter() - started
    posterior = to_datatree(groups, missions)
    posterior.attrs |= {
        "model": type(model).__name__,
        "sampler": draws.sampler,
        "seed": seed,
        "seconds": seconds,
        **draws.summary,
        "x0_mean": float(model.priors.x0_mean),
        "x0_sd": float(model.priors.x0_sd),
        **{f"prior_{name}": text for name, text in model.priors.describe().items()},
        **{f"{name}_version": version(name) for name in ("trustbo", "numpyro", "jax")},
    }
    if complaints:
        raise PosteriorError(
            f"posterior refused after a longer retry: {'; '.join(complaints)}. Give more missions, "
            f"or firmer priors (where the rates hardly vary, {_FIRM_NOISE}), or pass check=False "
            "to have it as it is.",
            posterior,
        )
    return posterior


def sample_prior(model: PooledTrust, n_features: int, n_draws: int, seed: int) -> TrustParams:
    """Draws of the parameters from the prior, leading axis (draw,)."""
    with jax.enable_x64(True):
        empty = jnp.zeros((1, 1, 1, n_features))
        draws = prior_draws(model.priors, empty, random.split(random.key(seed), n_draws))
        return _params({name: np.asarray(draws[name]) for name in SITES}, model.priors)


def diagnostics(posterior: xr.DataTree) -> dict[str, float]:
    """How far to trust a posterior.

    Returns:
        For NUTS `r_hat` and `ess_bulk`, the worst over all parameters, and `divergences`. For the
        exact sampler, whose draws are nearly independent, `k_hat` (good below 0.5) and `kish`, the
        effective number of its points.
    """
    if posterior.attrs["sampler"] == "exact":
        return {name: posterior.attrs[name] for name in ("k_hat", "kish")}
    by_site = _convergence(posterior["posterior"].to_dataset())
    return {
        "r_hat": max(rhat for rhat, _ in by_site.values()),
        "ess_bulk": min(ess for _, ess in by_site.values()),
        "divergences": int(posterior["sample_stats"].to_dataset()["diverging"].sum()),
    }


def _convergence(sites: xr.Dataset) -> dict[str, tuple[float, float]]:
    """The worst R-hat and the least bulk ESS of each parameter."""
    rhat, ess = az.rhat(sites), az.ess(sites, method="bulk")
    return {str(n): (float(rhat[n].max()), float(ess[n].min())) for n in sites.data_vars}


def _require_variation(batch: MissionBatch, priors: Priors) -> None:
    """Refuse rates that are all the same, unless a prior keeps the noise away from 0.

    The likelihood would grow without bound as both noises go to 0, and have no posterior.
    """
    rates = batch.contact_rate[~np.isnan(batch.contact_rate)]
    if not len(rates):
        raise TrustboError(
            "every contact rate is NaN: nothing was measured. Give one rate at least."
        )
    bounded = any(
        getattr(p.support, "lower_bound", 0.0) > 0.0 for p in (priors.delta_w, priors.delta_v)
    )
    if len(rates) > 1 and np.ptp(rates) == 0.0 and not bounded:
        raise TrustboError(
            f"all {len(rates)} contact rates are {rates[0]:g}: without variation the model cannot "
            f"learn its noise. Add missions over other ground, or {_FIRM_NOISE}."
        )


class Draws(NamedTuple):
    """Draws and statistics with leading axes (chain, draw), and what there is to say of all."""

    params: dict[str, np.ndarray]
    stats: dict[str, np.ndarray]
    summary: dict[str, float]
    sampler: str


def draw_posterior(
    model: PooledTrust,
    sampler: str,
    settings: NutsSettings,
    seed: int,
    batch: MissionBatch,
    *,
    check: bool,
) -> tuple[Draws, list[str]]:
    """Draws given a batch, and what is wrong with them; call it in a float64 scope."""
    if sampler == "exact" and (exact := _sample_exact(model, settings, seed, batch)):
        return exact, []
    return _sample_nuts(model, settings, random.key(seed), batch, check=check)


def _sample_nuts(
    model: PooledTrust, settings: NutsSettings, key: Array, batch: MissionBatch, *, check: bool
) -> tuple[Draws, list[str]]:
    """Draws by NUTS, longer ones if the first are bad, and what is wrong with them in the end."""
    data = (model.priors, batch.awareness, batch.contact_rate)
    longer = NutsSettings(2 * settings.n_warmup, 2 * settings.n_draws, settings.n_chains, 0.98)

    def attempt(tried: NutsSettings, retries: int) -> tuple[Draws, list[str]]:
        raw = run_nuts(pooled_trust, tried, random.fold_in(key, retries), *data)
        params, stats = ({k: np.asarray(v) for k, v in group.items()} for group in raw)
        stats["tree_depth"] = np.ceil(np.log2(stats["n_steps"] + 1)).astype(int)
        draws = Draws(params, stats, {"retries": retries}, "nuts")
        return draws, _complaints(draws) if check else []

    draws, complaints = attempt(settings, 0)
    return attempt(longer, 1) if complaints else (draws, complaints)


def _sample_exact(
    model: PooledTrust, settings: NutsSettings, seed: int, batch: MissionBatch
) -> Draws | None:
    """Draws by importance sampling, or None, with a warning, where its weights are too uneven."""
    shape = (settings.n_chains, settings.n_draws)
    exact = sample_exact(batch, model.priors, shape[0] * shape[1], seed)
    if not exact.khat <= KHAT_LIMIT:
        warnings.warn(
            f"the exact sampler's k-hat is {exact.khat:.2f} (limit {KHAT_LIMIT}): its weights are "
            "too uneven here, so NUTS is used instead.",
            stacklevel=3,
        )
        return None
    params = {k: v.reshape(*shape, *v.shape[1:]) for k, v in exact.params.items()}
    stats = {"lp": exact.lp.reshape(shape), "log_weight": exact.log_weight.reshape(shape)}
    return Draws(
        params,
        stats,
        {"k_hat": exact.khat, "kish": exact.kish, "log_evidence": exact.log_evidence},
        "exact",
    )


def _complaints(draws: Draws) -> list[str]:
    """What is wrong with the draws, parameter by parameter; empty if nothing is."""
    sites = az.from_dict({"posterior": draws.params})["posterior"].to_dataset()
    found = []
    for name, (worst, fewest) in _convergence(sites).items():
        if not worst <= MAX_RHAT:  # NaN is a complaint too
            found.append(f"R-hat of {name} is {worst:.3f} (limit {MAX_RHAT})")
        if not fewest >= MIN_ESS:
            found.append(f"bulk ESS of {name} is {fewest:.0f} (at least {MIN_ESS:.0f})")
    n_divergences = int(draws.stats["diverging"].sum())
    if n_divergences:
        found.append(f"{n_divergences} divergences")
    return found


def _describe(
    model: PooledTrust, draws: Draws, batch: MissionBatch, key: Array, n_trajectories: int
) -> dict[str, dict[str, Any]]:
    """Every group of the DataTree as arrays with leading axes (chain, draw), padding included."""
    n_chains, n_draws = draws.params["beta0"].shape
    data = (jnp.asarray(batch.awareness), jnp.asarray(batch.contact_rate))
    every = {name: a.reshape(-1, *a.shape[2:]) for name, a in draws.params.items()}
    kept = np.linspace(0, n_draws - 1, min(n_draws, max(1, n_trajectories // n_chains))).astype(int)
    thinned = {k: a[:, kept].reshape(-1, *a.shape[2:]) for k, a in draws.params.items()}
    all_params, few_params = _params(every, model.priors), _params(thinned, model.priors)
    key_trust, key_predict, key_prior = random.split(key, 3)

    def by_chain(array: Array) -> np.ndarray:
        return np.asarray(array).reshape(n_chains, -1, *array.shape[1:])

    moments = latent.trust_moments(all_params, *data)
    prior = prior_draws(model.priors, data[0], random.split(key_prior, 500))
    prior = {name: np.asarray(prior[name])[None] for name in (*SITES, "contact_rate")}
    return {
        "posterior": {name: draws.params[name] for name in SITES},
        "sample_stats": draws.stats,
        "log_likelihood": {"contact_rate": by_chain(mission_log_likelihood(all_params, *data))},
        "latent": {
            "trust": by_chain(latent.trust_draws(few_params, *data, key_trust)),
            "trust_mean": np.asarray(moments.mean),
            "trust_sd": np.asarray(moments.sd),
            "draw": kept,
        },
        "posterior_predictive": {
            "contact_rate": by_chain(latent.predictive(few_params, data[0], key_predict)),
            "draw": kept,
        },
        "prior_predictive": {"contact_rate": prior.pop("contact_rate")},
        "prior": prior,
    }


@jax.jit
def prior_draws(priors: Priors, awareness: Array, keys: Array) -> dict[str, Array]:
    """Parameters and contact rates drawn from the prior, one set per key."""

    def one(key: Array) -> dict[str, Array]:
        trace = handlers.trace(handlers.seed(pooled_trust, key)).get_trace(awareness, priors)
        return {name: site["value"] for name, site in trace.items() if site["type"] == "sample"}

    return jax.vmap(one)(keys)


def _params(draws: Mapping[str, ArrayLike], priors: Priors) -> TrustParams:
    n_draws = np.shape(draws["beta0"])[0]
    x0 = {name: np.full(n_draws, getattr(priors, name)) for name in ("x0_mean", "x0_sd")}
    return TrustParams(**{name: draws[name] for name in SITES}, **x0)
