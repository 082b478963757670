"""What a NumPyro function must be, so that it can be sampled and stored: checks of its trace."""

from collections.abc import Container, Mapping
from typing import Any

import numpy as np
from numpyro.distributions import (
    Delta,
    ExpandedDistribution,
    Independent,
    MaskedDistribution,
    TransformedDistribution,
    constraints,
)

from trustbo.display import joined
from trustbo.errors import TrustboError, one_line
from trustbo.files import is_storable
from trustbo.inference.functions.data import RATES, Data
from trustbo.inference.functions.explain import wrong_drift
from trustbo.inference.functions.sites import has_prior, plates_of_rates, safe
from trustbo.models.contact_rate import ContactRate
from trustbo.models.scores import NOISES

_HOW = (
    'End it with numpyro.sample("contact_rate", tb.models.ContactRate(drift, beta0, delta_w, '
    "delta_v), obs=contact_rate)."
)
CHANGED = ExpandedDistribution | Independent | MaskedDistribution
"""Distributions that change the shape or the mask of another one, `base_dist`."""
_AXES = ("chain", "draw")
"""Names that no variable may have."""


def require_rates(who: str, trace: Mapping[str, Any], data: Data) -> None:
    """Raise TrustboError unless the site `contact_rate` is the state space of the missions."""
    _require_no_obs_mask(who, trace)
    site = trace.get(RATES)
    if site is None or site["type"] != "sample":
        names = [f"{name!r}" for name, one in trace.items() if one["type"] == "sample"]
        sites = f"only {joined(names)}" if names else "no site at all"
        raise TrustboError(f"{who} has no site 'contact_rate', {sites}. {_HOW}")

    rates = _require_contact_rate(who, site["fn"])
    if not site["is_observed"]:
        raise TrustboError(
            f"the site 'contact_rate' of {who} is not observed; pass obs=contact_rate."
        )

    given = (*rates.batch_shape, *rates.event_shape)
    if given != np.shape(data[RATES]):
        raise TrustboError(wrong_drift(who, given, data))

    _require_variables(who, trace)
    _require_positive_noises(who, trace, rates)


def _require_positive_noises(who: str, trace: Mapping[str, Any], rates: ContactRate) -> None:
    """Raise TrustboError for a standard deviation of either sign, which rates cannot tell apart."""
    for noise, value in zip(NOISES, rates.noises, strict=False):
        for name, one in trace.items():
            if one["type"] != "sample" or one["value"] is not value:
                continue

            support = one["fn"].support
            if getattr(support, "base_constraint", support) is constraints.real:
                raise TrustboError(
                    f"{noise} of {who} is the variable {name!r}, which may be negative; give it a "
                    "positive distribution, such as HalfNormal or LogNormal."
                )


def _require_no_obs_mask(who: str, trace: Mapping[str, Any]) -> None:
    """Raise TrustboError for a site with `obs_mask`, which NumPyro splits into two sites.

    Entries that are observed have no density at the second site, so NUTS would not find them.
    """
    for name, one in trace.items():
        parts = [trace.get(f"{name}_{part}") for part in ("observed", "unobserved")]
        if one["type"] != "deterministic" or None in parts:
            continue

        remedy = "set values that are to be left out to NaN in the missions"
        if name != RATES:
            remedy = (
                "leave values out with numpyro.handlers.mask(mask=obs_mask), and sample those "
                "that are missing at another site"
            )
        raise TrustboError(
            f"the site {name!r} of {who} has an obs_mask, which NumPyro does not "
            f"support for NUTS; {remedy}."
        )


def _require_contact_rate(who: str, rates: Any) -> ContactRate:
    """Return the distribution of the rates; raise TrustboError unless it is a ContactRate."""
    if isinstance(rates, ContactRate):
        return rates

    where = f"the site 'contact_rate' of {who}"
    rates = base_of(rates)
    if isinstance(rates, ContactRate):
        raise TrustboError(
            f"{where} has a ContactRate that was changed by expand, mask or to_event; give a "
            "drift of the shape (mission, bound, robot), and set rates that are to be left out "
            "to NaN in the missions."
        )
    raise TrustboError(
        f"{where} has the distribution {type(rates).__name__}; it must be "
        f"tb.models.ContactRate. {_HOW}"
    )


def _require_variables(who: str, trace: Mapping[str, Any]) -> None:
    """Raise TrustboError for sites whose kind or name is not allowed in a posterior."""
    taken: dict[str, str] = {}
    missions = plates_of_rates(trace)
    for name, one in trace.items():
        free = one["type"] == "sample" and not one["is_observed"]
        named = free or one["type"] == "deterministic"
        if free and isinstance(base_of(one["fn"], CHANGED | TransformedDistribution), Delta):
            raise TrustboError(
                f"the site {name!r} of {who} has the distribution Delta, whose "
                "single value NUTS cannot sample; use the value itself, and "
                "numpyro.deterministic to record it."
            )
        if free and one["fn"].support.is_discrete:
            raise TrustboError(
                f"the site {name!r} of {who} is discrete, and NUTS samples "
                "continuous variables only; sum over its values."
            )
        if named and name in _AXES:
            raise TrustboError(
                f"the site {name!r} of {who} has the name of an axis of "
                "posteriors; give it another name."
            )
        if named:
            _require_storable(who, one, missions)
        if named and taken.setdefault(safe(name), name) != name:
            raise TrustboError(
                f"the sites {taken[safe(name)]!r} and {name!r} of {who} would have "
                f"the same name {safe(name)!r} in a posterior; rename one of them."
            )
        if one["type"] == "param" and not has_prior(name, trace):
            raise TrustboError(
                f"the site {name!r} of {who} is a parameter to optimise "
                "(numpyro.param, flax_module), which NUTS leaves at its initial value; use "
                "numpyro.sample or random_flax_module."
            )


def _require_storable(who: str, site: Mapping[str, Any], missions: Container[str]) -> None:
    """Raise TrustboError if a file could not store the name of a site, or of one of its axes.

    Plates of `missions` have the name of the axis of missions in a posterior.
    """
    plates = [frame.name for frame in site["cond_indep_stack"] if frame.name not in missions]
    event_dims = (site.get("infer") or {}).get("event_dims") or []
    for name in (site["name"], *plates, *map(str, event_dims)):
        if not is_storable(safe(name)):
            raise TrustboError(
                f"{who} has a site, plate or dim with the name {one_line(name)}, which netCDF "
                "files cannot store; begin with a letter or digit, end without a space, and use at "
                "most 120 bytes without control characters."
            )


def base_of(distribution: Any, changed: Any = CHANGED) -> Any:
    """Return the distribution to which others of the kinds `changed` refer."""
    while isinstance(distribution, changed):
        distribution = distribution.base_dist
    return distribution
