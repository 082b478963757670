"""Build the ArviZ DataTree of a posterior from arrays and missions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced
from trustbo.data import NOWHERE, Mission
from trustbo.display import slow_bar
from trustbo.inference.density import Density, JointDraws
from trustbo.inference.draws import (
    effects_of,
    parameters_of,
)
from trustbo.inference.latent import Latent, latent_of, replicate
from trustbo.inference.variables import prior_parameters, with_prior_effects
from trustbo.models.effects.effect import Effect
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.observations import Observations
from trustbo.models.scores import log_density
from trustbo.stacking import padded
from trustbo.streams import stream

LIKELIHOOD_OF = "log_likelihood_of"
"""Attribute of a posterior that states what its log-likelihoods refer to."""
TICKS = "ticks"
"""Value of this attribute for log probabilities of tick counts."""
RATES = "contact_rate"
"""Value of this attribute for log densities of rates; also the name of the rates."""
_OF_RATES = ("mission", "bound", "robot")
_DIMS = dict.fromkeys(("trust", "trust_mean", "trust_sd", "contact_rate"), _OF_RATES)
_N_DRAWS = 1000
"""Number of posterior draws per chain."""
_N_PLACE_DRAWS = 250
"""Number of draws per chain from importance sampling with place effects."""
_N_TRAJECTORIES = 200
"""Number of kept draws of latent trust and predicted rates, evenly spaced in the chains."""
N_PRIOR = 500
"""Number of draws in the group `prior`, of which `prior_predictive` has those that are kept."""
_ORDER = ("robot", "robot_", "feature", "feature_")
"""Order of the axes of the parameters of model classes.

`az.summary` labels rows incorrectly if two variables have common axes in different orders, or if
the axes of a variable occur first in other variables, in a different order.
"""
_KEPT = ("posterior", "sample_stats", "prior", "hazard")
"""Groups kept by `parameters_alone`, besides those of the effects."""


def default_draws(effects: Sequence[Effect], sampler: str) -> int:
    """Return the default number of draws per chain; see `fit`."""
    has_places = any(isinstance(effect, PlaceEffect) for effect in effects)
    # Importance draws are independent, so fewer are needed than from a Markov chain.
    return _N_PLACE_DRAWS if has_places and sampler != "nuts" else _N_DRAWS


def to_datatree(
    groups: dict[str, dict[str, Any]],
    missions: Sequence[Mission],
    parameter_dims: dict[str, tuple[str, ...]],
    effects: Sequence[Effect] = (),
    labels: Mapping[str, Any] | None = None,
) -> xr.DataTree:
    """Build a DataTree with named axes, without padding, and with NaN after a mission's end.

    Args:
        groups: Arrays by group and name, with leading axes (chain, draw) except for moments.
        missions: Missions of the posterior.
        parameter_dims: Axes of the model's parameters by name, without (chain, draw).
        effects: Effects of the model; the groups may include variables of these effects.
        labels: Labels of further axes.
    """
    observed = Observations.from_missions(missions)
    n_missions, n_bounds = observed.contact_rate.shape[:2]
    lengths = np.array([len(m.bounds) for m in missions])
    ended = (np.arange(1, n_bounds + 1) > lengths[:, None])[..., None]  # (mission, bound, robot)

    coords: dict[str, Any] = {
        "mission": np.arange(n_missions),
        "bound": np.arange(1, n_bounds + 1),
        "robot": list(missions[0].robots),
        "robot_": list(missions[0].robots),
        "feature": list(missions[0].features),
        "feature_": list(missions[0].features),
    }
    coords = {**(labels or {}), **coords}
    dims_of = _DIMS | parameter_dims
    for effect in effects:
        dims_of |= effect.variables
        coords |= effect.coords

    tree = {}
    for group, arrays in groups.items():
        variables = {}
        used = set()
        shape = (0, 0)  # of chains and draws
        for name, array in arrays.items():
            dims = dims_of.get(name, ())
            if group.endswith("log_likelihood"):
                dims = ("mission",)
            elif group == "log_prior":
                dims = ()
            kept = array[(..., *(slice(len(coords[d])) for d in dims))]
            if "bound" in dims:
                kept = np.where(ended, np.nan, kept)
            if len(dims) < array.ndim:
                dims = ("chain", "draw", *dims)
                shape = array.shape[:2]
            variables[name] = (dims, kept)
            used |= set(dims)

        index = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
        labelled = {name: labels for name, labels in (coords | index).items() if name in used}
        # ArviZ takes the dims from the first variable, so variables with the most dims come first.
        ordered = dict(sorted(variables.items(), key=lambda item: -len(item[1][0])))
        tree[group] = xr.Dataset(ordered, labelled)

    tree["observed_data"], tree["constant_data"] = _data_groups(observed, missions, coords)
    return xr.DataTree.from_dict(tree)


def in_label_order(
    groups: dict[str, dict[str, Any]], parameter_dims: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """Transpose parameters (chain, draw, ...) of groups in place, as ArviZ needs for labels.

    Returns:
        The axes of the parameters by name.
    """
    ordered = {}
    for name, dims in parameter_dims.items():
        ordered[name] = tuple(sorted(dims, key=_ORDER.index))
        axes = [2 + dims.index(dim) for dim in ordered[name]]
        for arrays in groups.values():
            if name in arrays:
                arrays[name] = np.transpose(arrays[name], (0, 1, *axes))
    return ordered


def _data_groups(
    observed: Observations, missions: Sequence[Mission], coords: dict[str, object]
) -> tuple[xr.Dataset, xr.Dataset]:
    """Build the groups `observed_data` and `constant_data`."""
    duration = padded([mission.duration for mission in missions], np.nan)
    cells = [np.array([bound.cell for bound in mission.bounds]) for mission in missions]
    cell = padded(cells, -1)
    starts = [mission.path[0] if mission.path else NOWHERE for mission in missions]

    # The number of bounds follows from the cells, except for missions without a map.
    counted = {}
    if not all(mission.path for mission in missions):
        counted["n_bounds"] = (("mission",), [len(mission.bounds) for mission in missions])

    if any(mission.map for mission in missions):
        counted["map"] = (("mission",), [mission.map for mission in missions])

    dims = _OF_RATES
    labelled = {name: coords[name] for name in _OF_RATES}
    rates = xr.Dataset({"contact_rate": (dims, observed.contact_rate)}, labelled)
    constant = xr.Dataset(
        {
            "awareness": ((*dims, "feature"), observed.awareness),
            "duration": (dims, duration, {"units": "s"}),
            "n_ticks": (dims, observed.n_ticks, {"units": "1"}),
            "row": (("mission", "bound"), cell[..., 0]),
            "col": (("mission", "bound"), cell[..., 1]),
            "status": (("mission",), [mission.status for mission in missions]),
            "start_row": (("mission",), [row for row, _ in starts]),
            "start_col": (("mission",), [col for _, col in starts]),
            **counted,
        },
        labelled | {"feature": coords["feature"]},
    )
    return rates, constant


def parameters_alone(posterior: xr.DataTree) -> xr.DataTree:
    """Drop the groups that grow with the number of missions; see `add_latent`."""
    kept = [*_KEPT, *(effect.group for effect in effects_of(posterior))]
    kept = [name for name in kept if name in posterior.children]

    alone = xr.DataTree.from_dict({name: posterior[name].to_dataset() for name in kept})
    alone.attrs = posterior.attrs
    return alone


def with_latent(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    fitted: Density,
    draws: JointDraws,
    *,
    progress: bool = True,
) -> xr.DataTree:
    """Add latent trust, log-likelihoods and predictions to a posterior; see `add_latent`.

    Args:
        posterior: DataTree with the parameters.
        missions: Fitted missions.
        fitted: Density of the model given the missions.
        draws: Draws as read from the posterior, so that a later call of `add_latent` gives the same
            result.
        progress: Whether to show a progress bar after 1.5 seconds.
    """
    fitted.reset_ep()
    fitted.run_ep(draws.theta)
    seed = posterior.attrs["seed"]

    _, some = kept_draws(posterior)
    with slow_bar("latent trust", " draws", progress) as bar:
        fitted.evaluated = bar.update
        latent = latent_of(fitted, draws, some, stream(seed, "latent"))

    # As for the posterior, predictions of the prior are kept for evenly spaced draws.
    rng = stream(seed, "prior predictive")
    if "prior" in posterior.children:
        prior = parameters_of(posterior, group="prior")
    else:  # the user has dropped it
        prior = prior_parameters(fitted, N_PRIOR, rng)
    prior = {n: values[evenly_spaced(len(values), _N_TRAJECTORIES)] for n, values in prior.items()}
    replicated = replicate(fitted, with_prior_effects(fitted, prior, rng), rng)

    # Single precision halves the memory; the error is far below the Monte Carlo error.
    latent = latent._replace(trust=latent.trust.astype(np.float32))
    replicated = replicated.astype(np.float32)

    # Log likelihoods of tick counts are comparable between families. They are NaN where ticks are
    # unknown.
    of_counts = False
    shift = fitted.model.likelihood.log_resolution(
        fitted.observations.contact_rate, fitted.observations.n_ticks
    ).sum((1, 2))
    if not np.isnan(shift).any():
        latent = latent._replace(log_likelihood=latent.log_likelihood + shift)
        of_counts = True

    densities = log_prior(fitted, parameters_of(posterior))
    return add_groups(posterior, missions, latent, replicated, densities, of_counts=of_counts)


def add_groups(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    latent: Latent,
    replicated: np.ndarray,
    densities: Mapping[str, np.ndarray],
    *,
    of_counts: bool,
) -> xr.DataTree:
    """Add the groups that `add_latent` computes to a posterior.

    Args:
        posterior: DataTree with the parameters.
        missions: Fitted missions.
        latent: Trust, likelihoods and predictions, with chains joined.
        replicated: Rates (draw, mission, bound, robot) for evenly spaced draws of the group
            `prior`.
        densities: Log prior densities (draw,) by name, with chains joined.
        of_counts: Whether the log-likelihoods are of tick counts.
    """
    parameters = posterior["posterior"].to_dataset()
    labels = {name: parameters[name].values for name in ("chain", "draw")}
    n_chains = len(labels["chain"])

    def by_chain(array: np.ndarray) -> np.ndarray:
        return array.reshape(n_chains, -1, *array.shape[1:])

    groups = {
        "log_likelihood": {RATES: by_chain(latent.log_likelihood)},
        "latent": {
            "trust": by_chain(latent.trust),
            "trust_mean": latent.mean,
            "trust_sd": latent.sd,
        },
        "posterior_predictive": {RATES: by_chain(latent.predicted)},
        "prior_predictive": {RATES: replicated[None]},
        "log_prior": {name: by_chain(values) for name, values in densities.items()},
    }
    added = to_datatree(groups, missions, {})
    parts = {**posterior.children, **added.children}
    datasets = {name: part.to_dataset() for name, part in parts.items()}

    # The draws have the labels of the posterior, which may be part of a longer one.
    kept, _ = kept_draws(posterior)
    some = labels | {"draw": labels["draw"][kept]}
    prior: dict[str, Any] = {}
    if "prior" in posterior.children:
        prior = {name: posterior["prior"][name].values for name in ("chain", "draw")}
        prior["draw"] = prior["draw"][evenly_spaced(len(prior["draw"]), len(replicated))]
    for name, of_draws in (
        ("log_likelihood", labels),
        ("log_prior", labels),
        ("latent", some),
        ("posterior_predictive", some),
        ("prior_predictive", prior),
    ):
        datasets[name] = datasets[name].assign_coords(of_draws)

    whole = xr.DataTree.from_dict(datasets)
    whole.attrs = posterior.attrs | {LIKELIHOOD_OF: TICKS if of_counts else RATES}
    return whole


def kept_draws(posterior: xr.DataTree) -> tuple[np.ndarray, np.ndarray]:
    """Return which draws of each chain have latent trust, and their indices with chains joined."""
    sizes = posterior["posterior"].sizes
    n_chains = sizes["chain"]
    n_draws = sizes["draw"]
    kept = evenly_spaced(n_draws, max(1, _N_TRAJECTORIES // n_chains))
    return kept, (np.arange(n_chains)[:, None] * n_draws + kept).ravel()


def log_prior(fitted: Density, parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute the log prior density (draw,) of each parameter with an independent prior.

    Deviations of robots from a common mean belong to the model and not to the prior, so only means
    and standard deviations are included for `HierarchicalTrust`. In the coupled model, the LKJ
    prior on correlations R has the density det(R)^(concentration - 1), up to a constant. The prior
    on `delta_v` does not include the noise that is due to the resolution of the rates.

    Args:
        fitted: Density of the model given missions.
        parameters: Draws (draw, ...) of the parameters by name.
    """
    model = fitted.model
    priors = fitted.scores.priors
    resolution = fitted.observations.resolution
    inverse_gain = model.derived(parameters)["inverse_gain"]

    with_prior = dict(parameters)
    if "delta_v" in parameters:
        with_prior["delta_v"] = model.noise_without(parameters["delta_v"], resolution)
    densities = {n: log_density(p, with_prior[n]) for n, p in priors.items() if n in parameters}
    for name, (field, values) in model.prior_terms(parameters).items():
        if field == "delta_v":
            values = model.noise_without(values, resolution)
        given = inverse_gain.reshape(*inverse_gain.shape, *(1,) * (values.ndim - inverse_gain.ndim))
        densities[name] = model.priors.log_density(field, values, given)

    for noise in ("Delta_w", "Delta_v"):
        if noise in parameters:
            sd = np.sqrt(np.einsum("...ii->...i", parameters[noise]))
            correlation = parameters[noise] / (sd[..., :, None] * sd[..., None, :])
            log_det = np.linalg.slogdet(correlation)[1]
            densities[f"correlation_{noise[-1]}"] = (model.priors.concentration - 1.0) * log_det

    return {name: values.reshape(len(values), -1).sum(1) for name, values in densities.items()}
