"""Build the ArviZ DataTree of a posterior from arrays and missions."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced
from trustbo.data import NOWHERE, POST_SETS, Mission
from trustbo.display import slow_bar
from trustbo.inference.latent import N_TRAJECTORIES, Source, latent_of, replicate
from trustbo.inference.order import transposed
from trustbo.inference.place_maps import place_group
from trustbo.models.backend import VERSIONS
from trustbo.models.effects.effect import Effect
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.observations import Observations
from trustbo.stacking import padded
from trustbo.streams import stream

LIKELIHOOD_OF = "log_likelihood_of"
"""Attribute of a posterior that states what its log-likelihoods refer to."""
TICKS = "ticks"
"""Value of this attribute for log probabilities of tick counts."""
RATES = "contact_rate"
"""Value of this attribute for log densities of rates; also the name of the rates."""
_OF_RATES = ("mission", "bound", "robot")
"""Axes of rates and of latent trust."""
_DIMS = {"trust": _OF_RATES, RATES: _OF_RATES}
"""Axes of draws of trust and rates, by name."""
_PER_DRAW = ("chain", "draw")
"""First axes of draws."""
_N_DRAWS = 1000
"""Number of posterior draws per chain."""
_N_PLACE_DRAWS = 250
"""Number of draws per chain from importance sampling with place effects."""
_OF_MISSIONS = (
    "observed_data",
    "constant_data",
    "latent",
    "log_likelihood",
    "log_prior",
    "posterior_predictive",
    "prior_predictive",
)
"""Groups dropped by `parameters_alone`."""


class Fitted(NamedTuple):
    """Result of a sampler, with what a DataTree needs; draws have their chains joined."""

    variables: Mapping[str, Mapping[str, np.ndarray]]
    """Variables (draw, ...) by group (`posterior` and one per effect) and name."""
    prior: Mapping[str, np.ndarray]
    """Draws (draw, ...) from the prior of the variables in the group `posterior`, by name."""
    dims: Mapping[str, tuple[str, ...]]
    """Axes of these variables by name, after the first; those without axes may be left out."""
    labels: Mapping[str, Any]
    """Labels along axes other than those of missions, bounds, robots and features."""
    effects: Sequence[Effect]
    """Effects of the model."""
    observations: Observations
    """Rates and awareness of the missions, with the data that the effects need."""
    statistics: Mapping[str, np.ndarray]
    """Statistics (chain, draw) of the sampler, by ArviZ's names."""
    attrs: Mapping[str, Any]
    """Attributes of the posterior, such as the sampler and its diagnostics."""
    notes: Mapping[str, Mapping[str, Any]]
    """Attributes of some groups, by group."""
    by_position: bool
    """Whether the model reads variables by position, so that their axes keep their order."""
    complaints: list[str]
    """Failed checks."""
    source: Callable[[xr.DataTree], Source]
    """Function that reads the draws from the DataTree, for `with_latent`."""


def default_draws(effects: Sequence[Effect], sampler: str) -> int:
    """Return the default number of draws per chain; see `fit`."""
    has_places = any(isinstance(effect, PlaceEffect) for effect in effects)
    # Importance draws are independent, so fewer are needed than from a Markov chain.
    return _N_PLACE_DRAWS if has_places and sampler != "nuts" else _N_DRAWS


def to_tree(found: Fitted, missions: Sequence[Mission], seed: int) -> xr.DataTree:
    """Build a DataTree from the result of a sampler and the data of the missions."""
    n_chains = len(found.statistics["lp"])
    coords = {**found.labels, **coords_of(missions)}
    kept = found.dims if found.by_position else {}

    posterior = _dataset(_draws(found.variables["posterior"], n_chains, found.dims), coords)
    prior = _dataset(_draws(found.prior, 1, found.dims), coords)
    statistics = {name: (_PER_DRAW, values) for name, values in found.statistics.items()}
    groups = {
        "posterior": transposed(posterior, kept),
        "prior": transposed(prior, kept),
        "sample_stats": _dataset(statistics, coords),
        **_data_groups(missions, found.observations, coords),
    }
    for effect in found.effects:
        own = found.variables[effect.group]
        if isinstance(effect, PlaceEffect):  # has its own axes
            at: Any = found.observations.visited
            chained = by_chain(own, n_chains)
            robots = missions[0].robots
            groups[effect.group] = place_group(chained, at, robots, f_e=effect.f_e, seed=seed)
        else:
            named = _draws(own, n_chains, effect.variables)
            groups[effect.group] = _dataset(named, {**coords, **effect.coords})

    if kept:
        groups["posterior"].attrs["dims"] = json.dumps(kept)
    for group, attrs in found.notes.items():
        groups[group].attrs.update(attrs)
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {
        **found.attrs,
        "n_robots": found.observations.n_robots,
        "n_missions": len(missions),
        "robots": list(missions[0].robots),
        "features": list(missions[0].features),
        "seed": seed,
        **_library_attrs(found.attrs["sampler"]),
    }
    return tree


def _library_attrs(sampler: str) -> dict[str, str]:
    """Return the attributes of a posterior that name the libraries that made it.

    They include those that ArviZ writes, except for the time, so that a campaign that is resumed
    gives the same files.
    """
    sampled_by = "numpyro" if sampler == "nuts" else "trustbo"
    return {
        "creation_library": "trustbo",
        "creation_library_version": VERSIONS["trustbo"],
        "creation_library_language": "Python",
        "inference_library": sampled_by,
        "inference_library_version": VERSIONS[sampled_by],
        **{f"{name}_version": version for name, version in VERSIONS.items()},
    }


def by_chain(values: Mapping[str, np.ndarray], n_chains: int) -> dict[str, np.ndarray]:
    """Give arrays (draw, ...) the axes (chain, draw, ...)."""
    return {
        name: array.reshape(n_chains, len(array) // n_chains, *array.shape[1:])
        for name, array in values.items()
    }


def _draws(
    values: Mapping[str, np.ndarray], n_chains: int, dims: Mapping[str, tuple[str, ...]]
) -> dict[str, Any]:
    """Name the axes of arrays (draw, ...) by name; variables that are not in `dims` have none."""
    chained = by_chain(values, n_chains)
    return {name: ((*_PER_DRAW, *dims.get(name, ())), v) for name, v in chained.items()}


def _dataset(variables: Mapping[str, Any], coords: Mapping[str, Any]) -> xr.Dataset:
    """Build a group from variables by name, with the labels of their axes.

    Axes of chains and draws without labels are numbered.
    """
    # ArviZ takes the dims from the first variable, so variables with the most dims come first.
    arrays = {name: xr.Variable(*value) for name, value in variables.items()}
    ordered = dict(sorted(arrays.items(), key=lambda item: -item[1].ndim))
    group = xr.Dataset(ordered)

    numbers = {dim: np.arange(group.sizes[dim]) for dim in _PER_DRAW if dim in group.dims}
    labels: dict[Any, Any] = {**numbers, **coords}
    return group.assign_coords({dim: labels[dim] for dim in group.dims if dim in labels})


def coords_of(missions: Sequence[Mission]) -> dict[str, Any]:
    """Return the labels of the axes that posteriors of all models have."""
    n_bounds = max(len(mission.bounds) for mission in missions)
    robots = list(missions[0].robots)
    features = list(missions[0].features)
    return {
        "mission": np.arange(len(missions)),
        "bound": np.arange(1, n_bounds + 1),
        "robot": robots,
        "robot_": robots,  # second axis of a matrix
        "feature": features,
        "feature_": features,
    }


def _data_groups(
    missions: Sequence[Mission], observed: Observations, coords: Mapping[str, Any]
) -> dict[str, xr.Dataset]:
    """Build the groups `observed_data` and `constant_data`."""
    duration = padded([mission.duration for mission in missions], np.nan)
    cells = [np.array([bound.cell for bound in mission.bounds]) for mission in missions]
    cell = padded(cells, -1)
    starts = [mission.path[0] if mission.path else NOWHERE for mission in missions]

    constant: dict[str, Any] = {
        "awareness": ((*_OF_RATES, "feature"), observed.awareness),
        "duration": (_OF_RATES, duration, {"units": "s"}),
        "n_ticks": (_OF_RATES, observed.n_ticks, {"units": "1"}),
        "row": (("mission", "bound"), cell[..., 0]),
        "col": (("mission", "bound"), cell[..., 1]),
        "status": ("mission", [mission.status for mission in missions]),
        "start_row": ("mission", [row for row, _ in starts]),
        "start_col": ("mission", [col for _, col in starts]),
    }

    # The number of bounds follows from the cells, except for missions without a map.
    if not all(mission.path for mission in missions):
        constant["n_bounds"] = ("mission", [len(mission.bounds) for mission in missions])
    if any(mission.post_sets for mission in missions):
        names = np.full(cell.shape[:2], "", dtype=object)
        for own, mission in zip(names, missions, strict=True):
            n_bounds = len(mission.bounds)
            own[:n_bounds] = (mission.post_sets or POST_SETS[:1] * n_bounds)[:n_bounds]
        constant["posts"] = (("mission", "bound"), names.astype(str))
    if any(mission.map for mission in missions):
        constant["map"] = ("mission", [mission.map for mission in missions])

    return {
        "observed_data": _dataset({RATES: (_OF_RATES, observed.contact_rate)}, coords),
        "constant_data": _dataset(constant, coords),
    }


def parameters_alone(posterior: xr.DataTree) -> xr.DataTree:
    """Drop the groups that grow with the number of missions; see `add_latent`."""
    return posterior.drop_nodes(_OF_MISSIONS, errors="ignore")


def with_latent(
    posterior: xr.DataTree, missions: Sequence[Mission], source: Source, *, progress: bool = True
) -> xr.DataTree:
    """Add latent trust, log-likelihoods and predictions to a posterior; see `add_latent`.

    Args:
        posterior: DataTree with the parameters.
        missions: Fitted missions.
        source: Draws as read from the posterior, so that a later call of `add_latent` gives the
            same result.
        progress: Whether to show a progress bar after 1.5 seconds.
    """
    kept, some = kept_draws(posterior)
    seed = posterior.attrs["seed"]
    with slow_bar("latent trust", " draws", progress, total=source.n_draws) as bar:
        latent = latent_of(source, some, stream(seed, "latent"), bar)

    rng = stream(seed, "prior predictive")
    replicated = replicate(source.prior(posterior, rng), rng)

    # The draws have the labels of the posterior, which may be part of a longer one.
    coords = coords_of(missions)
    indexes = posterior["posterior"].to_dataset().indexes
    every = {name: indexes[name].values for name in _PER_DRAW}
    of_kept = every | {"draw": every["draw"][kept]}
    prior_labels: dict[str, Any] = {}
    if "prior" in posterior.children:
        draw = posterior["prior"].to_dataset()["draw"].values
        prior_labels = {"draw": draw[evenly_spaced(len(draw), len(replicated))]}

    lengths = np.array([len(mission.bounds) for mission in missions])
    driven = xr.DataArray(coords["bound"] <= lengths[:, None], dims=("mission", "bound"))
    n_chains = len(every["chain"])

    # Single precision halves the memory; the error is far below the Monte Carlo error.
    trust = _draws({"trust": latent.trust.astype(np.float32)}, n_chains, _DIMS)
    trust |= {"trust_mean": (_OF_RATES, latent.mean), "trust_sd": (_OF_RATES, latent.sd)}
    predicted = _draws({RATES: latent.predicted}, n_chains, _DIMS)
    of_prior = _draws({RATES: replicated.astype(np.float32)}, 1, _DIMS)
    likelihood = _draws({RATES: latent.log_likelihood}, n_chains, {RATES: ("mission",)})
    groups = {
        "log_likelihood": _dataset(likelihood, coords | every),
        "log_prior": _dataset(_draws(latent.log_prior, n_chains, {}), every),
        "latent": _dataset(trust, coords | of_kept).where(driven),
        "posterior_predictive": _dataset(predicted, coords | of_kept).where(driven),
        "prior_predictive": _dataset(of_prior, coords | prior_labels).where(driven),
        **_data_groups(missions, source.observations, coords),
    }
    before = {name: group.to_dataset() for name, group in posterior.children.items()}
    whole = xr.DataTree.from_dict(before | groups)
    whole.attrs = posterior.attrs | {LIKELIHOOD_OF: TICKS if source.of_counts else RATES}
    return whole


def kept_draws(posterior: xr.DataTree) -> tuple[np.ndarray, np.ndarray]:
    """Return which draws of each chain have latent trust, and their indices with chains joined."""
    sizes = posterior["posterior"].sizes
    n_chains = sizes["chain"]
    n_draws = sizes["draw"]
    kept = evenly_spaced(n_draws, max(1, N_TRAJECTORIES // n_chains))
    return kept, (np.arange(n_chains)[:, None] * n_draws + kept).ravel()
