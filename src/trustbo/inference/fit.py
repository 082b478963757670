"""From missions to a posterior: sampling, checking it, and laying it out for ArviZ."""

import json
import time
import warnings
from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import as_array
from trustbo.data import Mission
from trustbo.errors import PosteriorError, ShapeError, TrustboError, require_kind, require_whole
from trustbo.inference.place_maps import place_group
from trustbo.inference.posterior_groups import add_weights, complete
from trustbo.inference.posterior_tree import require_posterior, to_datatree
from trustbo.inference.prior_predictive import draw_sites
from trustbo.inference.samplers.choice import (
    faster_than_nuts,
    needs_evidence,
    resolve_sampler,
    slow_places,
    with_warmup,
)
from trustbo.inference.samplers.run import draw_posterior
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.student import proposal_of
from trustbo.inference.samplers.watching import Watch
from trustbo.models.backend import VERSIONS
from trustbo.models.default import default_model
from trustbo.models.effects.effect import Slots
from trustbo.models.model import TrustModel, require_model
from trustbo.models.people import HumanTrust
from trustbo.models.place import has_places, places_of
from trustbo.models.record import model_to_record
from trustbo.models.ticks import TickWeights, require_ticks, resolution, weigh_ticks
from trustbo.stacking import MissionBatch, require_same_team, stack_missions
from trustbo.workspace import Workspace

_N_PRIOR = 500


def fit(
    missions: Sequence[Mission],
    model: TrustModel | None = None,
    sampler: str = "auto",
    *,
    workspace: Workspace | None = None,
    earlier: xr.DataTree | None = None,
    weights: ArrayLike | None = None,
    seed: int = 0,
    progress: bool = True,
    n_chains: int = 4,
    warmup: int | None = None,
    draws: int | None = None,
    target_accept: float = 0.9,
    max_tree_depth: int = 10,
    check: bool = True,
    whole: bool = True,
) -> xr.DataTree:
    """Posterior of the trust model's parameters, and of latent trust, given missions.

    Args:
        missions: All missions to learn from; contact rates that are NaN were not measured.
        model: Trust model; by default that of campaigns, `models.default_model()`, with effects of
            places and robots. Missions without places, which are those of no map and those whose
            paths jump, have effects of robots alone; reports of people, as of `logs.read_reports`,
            have `HumanTrust` of their scale.
        sampler: `"auto"`: the exact sampler where it applies, else NUTS; the posterior's
            attributes record which, and why. `"exact"`: near-independent draws by importance
            sampling, without compiling, for robots that share their parameters, have nothing in
            common, are partially pooled or influence each other; where its weights are too uneven,
            NUTS is used for Gaussian rates, with a warning. `"nuts"`, for Gaussian rates.
        workspace: Workspace of the missions. Their features and robots are then in its order, and
            awareness that they lack, such as line of sight, is filled in, see `Workspace.fill`. A
            model with effects of places has them over the whole grid, else up to the last row and
            column visited.
        earlier: Posterior of earlier missions, to begin the exact sampler of effects of places or
            coupled robots from; the posterior is the same but for Monte Carlo error.
        weights: Weight of each mission, shape (mission,), in [0, 1]; 1 by default. For Gaussian
            observations.
        seed: Seed; the same seed gives the same posterior.
        progress: Whether a slow fit shows its stages, and NUTS a progress bar and first an estimate
            of a long run's time. A file, which has no bar, gets a line about a long fit, and one
            about a retry.
        n_chains: Number of chains; the exact sampler's draws are divided among them.
        warmup: Warm-up draws per chain of NUTS, not kept; 300 by default, 150 where weights
            are integrated out and the exact sampler gives the metric.
        draws: Draws kept per chain; 1000 by default.
        target_accept: Acceptance rate that NUTS adapts its steps to: towards 1, steps are
            smaller, and divergences fewer.
        max_tree_depth: Doublings of a trajectory of NUTS at most: 10 allow 1023 steps for a draw.
        check: Refuse a posterior with R-hat > 1.01, bulk ESS < 400 or a divergence that a longer
            run does not cure; `False` returns it unchecked.
        whole: Whether to add latent trust, log-likelihoods and predictions at once; `complete` adds
            them later, where trust follows from the parameters.

    Returns:
        An ArviZ DataTree with the groups `posterior` (for `PooledTrust` beta0, beta[feature], b,
        delta_w, delta_v), `latent` (trust[chain, draw, mission, bound, robot] by backward sampling,
        and trust_mean and trust_sd over all draws), `posterior_predictive`, `prior`,
        `prior_predictive`, `log_prior`, `log_likelihood` (contact_rate[chain, draw, mission]: a
        whole mission is one observation, so LOO leaves out missions; see `by_rate`),
        `sample_stats`, `observed_data` and
        `constant_data`. Bound k is labelled k = 1, 2, ...; short missions are padded with NaN.
        Where all rates have an n_ticks, log-likelihoods are of the counts of ticks, on equal terms
        for all families of observations; the attribute `log_likelihood_of` states it.

    Raises:
        ShapeError: There are no missions, or they disagree on robots or features.
        TrustboError: An awareness value is NaN, the sampler is unknown or does not suit the model,
            no contact rate was measured, a path leaves the workspace, a number of draws or the
            seed is no whole number, or a setting of NUTS is given and the sampler is another.
        PosteriorError: The diagnostics are beyond their limits.
    """
    missions = _filled(missions, workspace)
    model = _default_of(missions) if model is None else model
    require_model(model)
    given = {"warmup": warmup, "draws": draws, "n_chains": n_chains}
    care = {"target_accept": target_accept, "max_tree_depth": max_tree_depth}
    settings = NutsSettings.of({**given, **care})
    seed = require_whole("seed", seed, 0)
    if earlier is not None:
        require_posterior("earlier=", earlier)
    batch = stack_missions(missions)
    places = places_of(missions, model.place, batch.contact_rate.shape, workspace)
    require_ticks(model.family, batch)
    weight = _weights(weights, model, batch, len(missions))
    ticks = _weigh_rates(batch, weight)
    started = time.perf_counter()

    model = model.for_features(missions[0].features)
    chosen, reason = resolve_sampler(model, sampler)
    settings.require_sampler(chosen)
    if sampler == "auto" and chosen != "exact" and model.place is not None:
        warnings.warn(slow_places(reason), stacklevel=2)
    floored = model.at_resolution(ticks)
    # Of a campaign, only the first fit warns.
    watch = Watch(progress, estimates=earlier is None)
    watch.faster = "" if chosen == "exact" else faster_than_nuts(model)
    with watch:
        prior = draw_sites(floored, batch.awareness.shape[2:], _N_PRIOR, seed + 2)
        chains = batch, len(missions), missions[0].features, weight, places
        slots = Slots.of(*chains) if needs_evidence(model, chosen) else None
        sampled, complaints = draw_posterior(
            floored, chosen,
            settings if warmup is not None else with_warmup(settings, model),
            seed, batch, weight, places, proposal_of(earlier), slots, check=check, watch=watch,
        )  # fmt: skip
    groups = {
        "posterior": {name: sampled.params[name] for name in model.dims},
        "sample_stats": sampled.stats,
        "prior": {name: values[None] for name, values in prior.items()},
        **{noun: dict(variables) for noun, variables in sampled.effects.items()},
    }
    posterior = to_datatree(groups, missions, model.dims, model.effects)
    if places is not None:
        posterior["places"] = xr.DataTree(place_group(sampled.places, places, seed))
    posterior.attrs |= {
        **_record(model, batch, len(missions), resolution(ticks)),
        **sampled.summary,
        "sampler": sampled.sampler,
        "sampler_reason": sampled.fallback or reason,
        "seed": seed,
    }
    if weights is not None:
        add_weights(posterior, weight[: len(missions)])
    if whole:
        with watch:
            watch.stage("latent trust and predictions")
            posterior = complete(posterior, missions, model=model)
    posterior.attrs["seconds"] = time.perf_counter() - started
    return _require_sound(posterior, complaints)


def _default_of(missions: Sequence[Mission]) -> TrustModel:
    """`HumanTrust` of reports, else the default model, without places that missions lack."""
    if scale := missions[0].scale:
        return HumanTrust(scale=scale)
    return default_model(places=has_places(missions))


def _filled(missions: Sequence[Mission], workspace: Workspace | None) -> list[Mission]:
    """Missions of one team, with the awareness that they lack filled in from a workspace."""
    require_same_team(missions)
    if workspace is None:
        return list(missions)
    require_kind("workspace", workspace, Workspace, "give the one the missions were run on")
    return [workspace.fill(mission) for mission in missions]


def _require_sound(posterior: xr.DataTree, complaints: Sequence[str]) -> xr.DataTree:
    if complaints:
        raise PosteriorError(
            f"posterior refused after a longer retry: {'; '.join(complaints)}.",
            posterior,
            "Give more missions or firmer priors, or pass check=False to have it as it is.",
        )
    return posterior


def _record(
    model: TrustModel, batch: MissionBatch, n_missions: int, finest: float
) -> dict[str, object]:
    """Attributes of a posterior: model, data, sampler; `finest` is the resolution of the rates."""
    return {
        "model": type(model).__name__,
        "inter_robot": "none",
        **model.options(),
        "place": "none" if model.place is None else json.dumps(model.place.to_record()),
        "model_record": json.dumps(model_to_record(model)),
        "n_robots": batch.awareness.shape[2],
        **({"n_missions": n_missions} if model.effects else {}),
        "x0_mean": float(model.priors.x0_mean),
        "x0_sd": float(model.priors.x0_sd),
        "delta_v_floor": finest if model.family.rounds else 0.0,
        **{f"prior_{name}": text for name, text in model.priors.describe().items()},
        **{f"{name}_version": version for name, version in VERSIONS.items()},
    }


def _weigh_rates(batch: MissionBatch, weight: np.ndarray) -> TickWeights:
    """Weight of the rates by their ticks; TrustboError if no rate was measured."""
    ticks = weigh_ticks(batch, weight)
    if not ticks:
        raise TrustboError(
            "every contact rate is NaN: nothing was measured. Give one rate at least."
        )
    if not sum(ticks.values()) > 0.0:
        raise TrustboError(
            f"only missions of weight 0 have a contact rate: nothing is left to learn from. Give "
            f"one of them a positive weight; got {weight}."
        )
    return ticks


def _weights(
    weights: ArrayLike | None, model: TrustModel, batch: MissionBatch, n_missions: int
) -> np.ndarray:
    """One weight per mission of the batch, padding included."""
    padded = np.ones(len(batch.contact_rate))
    if weights is None:
        return padded
    given = as_array("weights", weights)
    if given.shape != (n_missions,):
        raise ShapeError(f"weights must be ({n_missions},), one per mission; got {given.shape}.")
    bad = ~((given >= 0.0) & (given <= 1.0))
    if bad.any() or not given.any():
        raise TrustboError(f"weights must be in [0, 1], and one of them positive; got {given}.")
    if not model.family.integrates_out:
        raise TrustboError(
            f'weights are for observation "gaussian"; with "{model.observation}" a fractional '
            "mission would no longer have its trust integrated out. Leave missions out instead."
        )
    padded[:n_missions] = given
    return padded
