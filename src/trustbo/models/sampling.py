"""Draws from a model's posterior by the sampler asked for, and whether they may be used."""

import warnings
from typing import NamedTuple

import arviz as az
import jax
import numpy as np
import xarray as xr
from jax import Array, random

from trustbo.errors import TrustboError
from trustbo.models.exact import KHAT_LIMIT, ExactDraws, sample_exact
from trustbo.models.geometry import NutsData
from trustbo.models.model import TrustModel
from trustbo.models.nuts import NutsSettings, run_nuts
from trustbo.models.spectral import spectrum
from trustbo.stacking import MissionBatch

SAMPLERS = ("nuts", "exact", "joint")
MAX_RHAT, MIN_ESS = 1.01, 400.0


class Draws(NamedTuple):
    """Draws and statistics with leading axes (chain, draw), and what there is to say of all."""

    params: dict[str, np.ndarray]
    stats: dict[str, np.ndarray]
    summary: dict[str, float]
    sampler: str
    noise: np.ndarray | None = None
    """What latent trust is made of, if it was sampled."""
    pilot: Array | None = None


def draw_posterior(
    model: TrustModel,
    sampler: str,
    settings: NutsSettings,
    seed: int,
    batch: MissionBatch,
    weight: np.ndarray | None = None,
    *,
    check: bool,
) -> tuple[Draws, list[str]]:
    """Draws given a batch, and what is wrong with them.

    Args:
        model: The trust model.
        sampler: `"nuts"`, `"exact"` or `"joint"`.
        settings: Length of the run.
        seed: Same seed, same draws.
        batch: The missions.
        weight: Of each mission, shape (mission,); 1 by default.
        check: Whether to look for what is wrong, and try again for longer.
    """
    if sampler == "exact" and (exact := _sample_exact(model, settings, seed, batch, weight)):
        return exact, []
    joint = model.observation != "gaussian"
    weight = np.ones(len(batch.contact_rate)) if weight is None else weight
    data = nuts_data(model, batch, weight)
    with jax.enable_x64(True):
        return _sample_nuts(model, settings, random.key(seed), data, joint=joint, check=check)


def nuts_data(model: TrustModel, batch: MissionBatch, weight: np.ndarray) -> NutsData:
    """The data for NUTS: of the pooled Gaussian model without gaps, sums alone."""
    if model.robot_sets == "all" and model.observation == "gaussian":
        (statistics,) = model.gather(batch, weight)
        if not statistics.gaps:
            seen = ~np.isnan(batch.contact_rate)
            means = (np.asarray(batch.contact_rate[seen].mean()), batch.awareness[seen].mean(0))
            # One bound and robot that measured nothing: the shape tells the number of features.
            nothing = np.full((1, 1, 1), np.nan)
            awareness = np.zeros((1, 1, 1, batch.awareness.shape[3]))
            return NutsData(awareness, nothing, nothing, np.ones(1), spectrum(statistics), means)
    return NutsData(*batch, weight)


def require_sampler(model: TrustModel, sampler: str) -> None:
    """Refuse a sampler that cannot treat the model.

    Raises:
        TrustboError: `"exact"` for observations that are not Gaussian, or robots that share some
            parameters only or influence each other; `"joint"` where trust integrates out.
    """
    if sampler == "exact":
        model.require_exact()
    if sampler == "joint" and model.observation == "gaussian":
        raise TrustboError(
            'sampler "joint" is for observations that trust does not integrate out of; with '
            'Gaussian ones use "nuts" or "exact".'
        )


def _sample_exact(
    model: TrustModel,
    settings: NutsSettings,
    seed: int,
    batch: MissionBatch,
    weight: np.ndarray | None,
) -> Draws | None:
    """Draws by importance sampling, or None, with a warning, where its weights are too uneven."""
    shape = (settings.n_chains, settings.n_draws)
    each = [
        sample_exact(statistics, model.priors, shape[0] * shape[1], seed + i)
        for i, statistics in enumerate(model.gather(batch, weight))
    ]
    khat = max(exact.khat for exact in each)
    if not all(exact.khat <= KHAT_LIMIT for exact in each):
        warnings.warn(
            f"the exact sampler's k-hat is {khat:.2f} (limit {KHAT_LIMIT}): its weights are "
            "too uneven here, so NUTS is used instead.",
            stacklevel=4,
        )
        return None
    summary = {
        "k_hat": khat,
        "kish": min(exact.kish for exact in each),
        "log_evidence": sum(exact.log_evidence for exact in each),
    }
    params, stats = _join(each, shape, per_robot=model.robot_sets == "each")
    return Draws(params, stats, summary, "exact")


def _join(each: list[ExactDraws], shape: tuple[int, int], *, per_robot: bool):
    """Draws of all robots side by side; their weights multiply."""

    def join(columns: list[np.ndarray]) -> np.ndarray:
        joined = np.stack(columns, axis=1) if per_robot else columns[0]
        return joined.reshape(*shape, *joined.shape[1:])

    params = {name: join([e.params[name] for e in each]) for name in each[0].params}
    stats = {
        "lp": np.sum([e.lp for e in each], axis=0).reshape(shape),
        "log_weight": np.sum([e.log_weight for e in each], axis=0).reshape(shape),
    }
    return params, stats


def _sample_nuts(
    model: TrustModel,
    settings: NutsSettings,
    key: Array,
    data: NutsData,
    *,
    joint: bool,
    check: bool,
) -> tuple[Draws, list[str]]:
    """Draws by NUTS, longer ones if the first are bad, and what is wrong with them in the end."""
    longer = NutsSettings(
        2 * settings.n_warmup, 2 * settings.n_draws, settings.n_chains, 0.98, collapse=True
    )
    options = {
        "shared": _is_complete(np.asarray(data.contact_rate)),
        "joint": joint,
    }

    def attempt(tried: NutsSettings, retries: int) -> tuple[Draws, list[str]]:
        raw = run_nuts(tried, random.fold_in(key, retries), model, data, **options)
        params, stats = ({k: np.asarray(v) for k, v in g.items()} for g in (raw.params, raw.stats))
        stats["tree_depth"] = np.ceil(np.log2(stats["n_steps"] + 1)).astype(int)
        noise = None if raw.noise is None else np.asarray(raw.noise)
        name = "joint" if joint else "nuts"
        draws = Draws(params, stats, {"retries": retries}, name, noise, raw.pilot)
        return draws, _complaints(draws) if check else []

    draws, complaints = attempt(settings, 0)
    return attempt(longer, 1) if complaints else (draws, complaints)


def _is_complete(contact_rate: np.ndarray) -> bool:
    """Whether in each mission all robots' rates are measured up to one bound, and none after."""
    seen = ~np.isnan(contact_rate)
    together = (seen.any(2) == seen.all(2)).all()
    return bool(together and (np.diff(seen.any(2).astype(int), axis=1) <= 0).all())


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
    with np.errstate(invalid="ignore"):
        rhat, ess = az.rhat(sites), az.ess(sites, method="bulk")
    found = {}
    for name, draws in sites.data_vars.items():
        # What never moves is a constant of the model, such as a correlation it does not have.
        free = np.ptp(draws.values, axis=(0, 1)) > 0.0
        if free.any():
            worst = float(rhat[name].values[free].max())
            found[str(name)] = (worst, float(ess[name].values[free].min()))
    return found


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
