"""Checks of what a function computes from its data, for some draws from the prior.

The padding adds missions and bounds without contact rates. They have no effect on the likelihood of
the rates, but functions may use them elsewhere, for example in the mean of awareness or in a second
likelihood. The function is therefore run on a part of the data that needs no padding, and on the
same part with padding. A third run, on the data, shows which rates and tick counts are observed.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from trustbo.errors import TrustboError
from trustbo.inference.functions.data import RATES, Data, arrays_of, padded
from trustbo.inference.functions.function import FunctionModel
from trustbo.inference.functions.sites import Site, doubled, latent_in
from trustbo.models.backend import own_settings
from trustbo.models.contact_rate import ParameterShapeError
from trustbo.statespace import Inputs, StateSpace

_N_DRAWS = 4
"""Number of draws from the prior for which the function is run."""
_SEED = 20261127
"""Seed for these draws."""
_OTHER_SEED = _SEED + 1
"""Seed with which the function is run again with the same draws."""
_MISSIONS_PER_PART = 4
"""Number of padded missions for each mission of the part; at least a quarter are not padding."""
_SAME = 1e-5
"""Largest relative difference of results that should be equal; functions may use 32 bits."""


class Probe(NamedTuple):
    """Results of all sites of a function for one draw of its variables."""

    space: StateSpace
    inputs: Inputs
    rates: Any
    """Observed value of the site `contact_rate`, shape (mission, bound, robot)."""
    n_ticks: Any
    """Tick counts of its distribution, of the same shape; None if it has none."""
    values: dict[str, Any]
    """Latent variables."""
    log_p: dict[str, Any]
    """Log density of each sample site, in the shape of its plates."""
    computed: dict[str, Any]
    """Sites of `numpyro.deterministic`."""


def require_fittable(
    model: FunctionModel, data: Data, sites: Mapping[str, Site], n_bounds: Sequence[int]
) -> None:
    """Raise TrustboError if the posterior of a function would not be that of its data.

    The padding may change nothing but the variables of single missions. The site `contact_rate`
    must observe the rates and tick counts of the data, and its parameters must be those of robots.

    Args:
        model: The function.
        data: Its inputs, padded unless it takes all data as one object.
        sites: Its variables for these data.
        n_bounds: Number of bounds of each mission.
    """
    values: dict[str, np.ndarray] = {}
    if model.needs_observations:  # its data are not padded
        _require_parameters_of_robots(model, data)
    else:
        values = require_unpadded_results(model, data, sites, n_bounds)

    probe = _probe(model, data)
    found: Probe = probe(values, _keys())
    _require_rates_of_data(model, data, found)
    if not values:  # otherwise, `require_unpadded_results` has checked it
        _require_same_again(model, found, probe(found.values, _keys(_OTHER_SEED)))
    _require_ticks_of_data(model, data, found)
    _require_symmetric(model, found)


def require_unpadded_results(
    model: FunctionModel, data: Data, sites: Mapping[str, Site], n_bounds: Sequence[int]
) -> dict[str, np.ndarray]:
    """Raise TrustboError if the padding changes the posterior.

    Returns:
        Draws of the variables from the prior, in the shape of the padded data. They are empty if
        the function accepts no other number of missions or bounds than that of the data.
    """
    part = _part_of(data, n_bounds)
    try:
        sites_of_part = model.sites(part)
        wanted: Probe = _probe(model, part)({}, _keys())
    except TrustboError as error:
        _require_no_shape_error(model, error)
        return {}

    for name, site in sites.items():
        own = sites_of_part.get(name)
        if own is None or (site.mission_axis is None and site.shape != own.shape):
            raise TrustboError(
                f"the size of the variable {name!r} of {model.in_short()} depends on the number "
                "of missions or bounds, which are padded; sample variables of single missions "
                "within the plate of the site 'contact_rate', numpyro.plate(\"mission\", "
                "len(awareness))."
            )

    values = {name: _extended(v, sites[name].shape) for name, v in wanted.values.items()}
    with_padding = padded(part, np.shape(data[RATES])[:2])
    probe = _probe(model, with_padding)
    found: Probe = probe(values, _keys())
    _require_rates_of_data(model, with_padding, found)
    _require_same_again(model, found, probe(values, _keys(_OTHER_SEED)))
    _require_same_rates(model, wanted, found)
    _require_same_densities(model, wanted, found, sites, sites_of_part)
    _require_same_computed(model, wanted, found, list(model.computed_sites(data)))
    return values


def _probe(model: FunctionModel, data: Data) -> Callable[..., Probe]:
    """Return a compiled function of values and keys, with the axis (draw,), for these data.

    Variables without values are drawn from the prior. The effects on the drift, which are not of
    the function itself, are 0.
    """

    def one(values: Mapping[str, Any], key: jax.Array, data: Data) -> Probe:
        trace = model.trace(values, key, data)
        rates: Any = trace[RATES]["fn"]
        if rates.effects:
            trace[RATES]["fn"] = rates.given(np.zeros(rates.shape()))

        log_p = {}
        for name, site in trace.items():
            if site["type"] == "sample":
                scale = 1.0 if site["scale"] is None else site["scale"]
                log_p[name] = scale * site["fn"].log_prob(site["value"])

        return Probe(
            space=rates.space_with_resolution,
            inputs=rates.inputs,
            rates=trace[RATES]["value"],
            n_ticks=rates.n_ticks,
            values={name: trace[name]["value"] for name in latent_in(trace)},
            log_p=log_p,
            computed={n: s["value"] for n, s in trace.items() if s["type"] == "deterministic"},
        )

    return model.compiled_over_draws(("probe",), one, 2, data)


def _part_of(data: Data, n_bounds: Sequence[int]) -> dict[str, Any]:
    """Return some of the longest missions, up to the last bound that all of them drove.

    Their number depends only on that of the padded missions, which limits the number of compiled
    shapes. There are fewer missions and bounds than in the padded data.
    """
    n_missions, n_padded = np.shape(data[RATES])[:2]
    n_some = n_missions // _MISSIONS_PER_PART
    some = np.sort(np.argsort(-np.asarray(n_bounds), kind="stable")[:n_some])
    n_driven = max(1, min(min(n_bounds[j] for j in some), n_padded - 1))
    return {**data, **{name: v[some, :n_driven] for name, v in arrays_of(data).items()}}


def _keys(seed: int = _SEED) -> Any:
    """Return the random keys of the draws."""
    with own_settings():
        return jax.random.split(jax.random.key(seed), _N_DRAWS)


def _extended(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Extend values (draw, ...) to the shape of each draw, with values of another draw."""
    missing = [(0, n - m) for n, m in zip(shape, values.shape[1:], strict=True)]
    extended = np.pad(values[::-1], [(0, 0), *missing], mode="edge")
    extended[tuple(slice(n) for n in values.shape)] = values
    return extended


def _is_same(wanted: np.ndarray, found: np.ndarray) -> bool:
    """Return whether results without padding equal the first ones of the results with padding."""
    if wanted.ndim != found.ndim:
        return False

    first = found[tuple(slice(n) for n in wanted.shape)]
    if first.shape != wanted.shape:
        return False
    size = np.abs(wanted[np.isfinite(wanted)]).max(initial=0.0)
    return np.allclose(first, wanted, rtol=_SAME, atol=_SAME * size, equal_nan=True)


def _require_same_again(model: FunctionModel, found: Probe, again: Probe) -> None:
    """Raise TrustboError if the densities differ between two runs with the same variables."""
    pairs = [*zip(found.space, again.space, strict=True)]
    pairs += zip(found.inputs, again.inputs, strict=True)
    pairs += [(log_p, again.log_p[name]) for name, log_p in found.log_p.items()]
    if all(_is_same(a, b) for a, b in pairs if a is not None):
        return

    raise TrustboError(
        f"{model.in_short()} draws random numbers that are no variables, for example by "
        "numpyro.prng_key or subsample_size, which would be the same in the whole fit; draw them "
        "with numpyro.sample, or use a constant such as jax.random.key(0)."
    )


def _require_same_rates(model: FunctionModel, wanted: Probe, found: Probe) -> None:
    """Raise TrustboError if the padding changes the distribution of the measured rates."""
    fields = [(a, b) for a, b in zip(wanted.space, found.space, strict=True) if a is not None]
    if not all(a.shape == b.shape and _is_same(a, b) for a, b in fields):
        raise TrustboError(_not_of_robots(model))

    names = {"drift": "drift", "offset": "offset", "noise": "noise_scale"}
    for field, name in names.items():
        if not _is_same(getattr(wanted.inputs, field), getattr(found.inputs, field)):
            raise TrustboError(
                f"the {name} of {model.in_short()} changes with the padding of missions and "
                "bounds; instead of means, sums or numbers of missions and bounds, use constants, "
                "for example from workspace.awareness."
            )


def _require_same_densities(
    model: FunctionModel,
    wanted: Probe,
    found: Probe,
    sites: Mapping[str, Site],
    sites_of_part: Mapping[str, Site],
) -> None:
    """Raise TrustboError if the padding changes a prior or another likelihood."""
    for name, log_p in found.log_p.items():
        own = wanted.log_p.get(name)
        if name in sites and sites[name].mission_axis is not None:
            if _has_longer_events(name, found, sites, sites_of_part):
                continue  # the density includes that of the padding
        elif name != RATES and own is not None:
            axes = tuple(range(1, log_p.ndim))
            log_p = log_p.sum(axes)
            own = own.sum(tuple(range(1, own.ndim)))

        if own is None or not _is_same(own, log_p):
            raise TrustboError(
                f"the density of the site {name!r} of {model.in_short()} changes with the padding "
                "of missions and bounds, which would change the posterior; leave out the padding, "
                "which has no contact rates, for example with numpyro.handlers.mask(mask="
                "jnp.isfinite(contact_rate).any((1, 2))) for a site with one value per mission."
            )


def _has_longer_events(
    name: str, found: Probe, sites: Mapping[str, Site], sites_of_part: Mapping[str, Site]
) -> bool:
    """Return whether the padding adds entries to each event of a variable."""
    n_batch = found.log_p[name].ndim - 1
    return sites[name].shape[n_batch:] != sites_of_part[name].shape[n_batch:]


def _require_same_computed(
    model: FunctionModel, wanted: Probe, found: Probe, names: Sequence[str]
) -> None:
    """Raise TrustboError if the padding changes a site of `numpyro.deterministic`."""
    for name in names:
        if name not in wanted.computed or not _is_same(wanted.computed[name], found.computed[name]):
            raise TrustboError(
                f"the site {name!r} of {model.in_short()} changes with the padding of missions and "
                "bounds; compute it from the draws of the posterior, or leave out the missions and "
                "bounds whose contact rates are all NaN."
            )


def _require_parameters_of_robots(model: FunctionModel, data: Data) -> None:
    """Raise TrustboError if a parameter of the rates has one value for each mission or bound."""
    try:
        for axis in (0, 1):
            model.sites(doubled(data, axis))
    except TrustboError as error:
        _require_no_shape_error(model, error)


def _require_no_shape_error(model: FunctionModel, error: TrustboError) -> None:
    """Raise TrustboError if an error for fewer or more missions is one of a parameter's shape."""
    if isinstance(error.__cause__, ParameterShapeError):
        raise TrustboError(_not_of_robots(model)) from error


def _not_of_robots(model: FunctionModel) -> str:
    """Return a message that a parameter of the rates depends on missions or bounds."""
    return (
        f"beta0, a noise or the trust at the start in {model.in_short()} changes with the number "
        "of missions or bounds; tb.models.ContactRate takes one value, or one of each robot, which "
        "must depend on variables outside the plate of missions alone."
    )


def _require_rates_of_data(model: FunctionModel, data: Data, found: Probe) -> None:
    """Raise TrustboError unless the rates that are observed are those of the data."""
    wanted = np.asarray(data[RATES])
    if not all(np.allclose(y, wanted, rtol=_SAME, atol=0.0, equal_nan=True) for y in found.rates):
        raise TrustboError(
            f"the site 'contact_rate' of {model.in_short()} observes other values than the input "
            "contact_rate; pass obs=contact_rate unchanged. To leave rates out, set them to NaN in "
            "the missions."
        )


def _require_ticks_of_data(model: FunctionModel, data: Data, found: Probe) -> None:
    """Raise TrustboError unless the tick counts are those of the data, or none."""
    if found.n_ticks is None:
        return

    wanted, given = (np.where(n > 0.0, n, 0.0) for n in (data["n_ticks"], found.n_ticks))
    is_measured = ~np.isnan(data[RATES])
    if not np.allclose(given[:, is_measured], wanted[is_measured], rtol=_SAME):
        raise TrustboError(
            f"the n_ticks of ContactRate in {model.in_short()} differs from the tick counts of the "
            "missions; pass the input n_ticks unchanged, or leave it out."
        )


def _require_symmetric(model: FunctionModel, found: Probe) -> None:
    """Raise TrustboError if a covariance matrix is not symmetric."""
    matrices = {"delta_w": found.space.process_cov, "delta_v": found.space.shared_cov}
    for name, matrix in matrices.items():
        if matrix is not None and not _is_same(matrix, np.swapaxes(matrix, -1, -2)):
            raise TrustboError(
                f"the matrix {name} of ContactRate in {model.in_short()} is not symmetric; give a "
                "covariance matrix, for example L @ L.T."
            )
