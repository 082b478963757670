"""Recognise a posterior from `fit`, and read its model, effects and names."""

import json

import numpy as np
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.inference.functions.known import is_of_function
from trustbo.models.effects.effect import Effect
from trustbo.models.model import TrustModel
from trustbo.models.record import effects_from_record, with_default_priors

_ATTRIBUTES = ("family", "model_record", "robots", "features")
"""Attributes that a posterior must have."""


def require_fitted(who: str, value: object) -> xr.DataTree:
    """Return a posterior from `fit` as it is, for callers that read only its attributes.

    Raises TrustboError if the value is not a posterior from `fit`, or if it has no draws.
    """
    if not isinstance(value, xr.DataTree):
        remedy = " Give the attribute .posterior." if hasattr(value, "posterior") else ""
        raise TrustboError(f"{who} needs a posterior from fit; got {type(value).__name__}.{remedy}")

    missing = [name for name in _ATTRIBUTES if name not in value.attrs]
    if "posterior" not in value.children:
        missing.insert(0, "posterior")
    if missing:
        raise TrustboError(
            f"{who} needs a posterior from fit, but this DataTree has no {missing[0]!r}. Give the "
            "complete result of trustbo.fit, of this version."
        )

    sizes = value["posterior"].sizes
    lacks = [dim for dim in ("chain", "draw") if not sizes.get(dim)]
    if lacks:
        raise TrustboError(
            f"{who} needs the draws of a posterior, with the dims chain and draw, but there is no "
            f"{lacks[0]}. Keep all draws, or select with a list, such as posterior.isel(chain=[0])."
        )
    return value


def names_in(posterior: xr.DataTree, axis: str) -> tuple[str, ...]:
    """Return the names of the robots or features of a posterior, in the order of the fit."""
    return tuple(np.atleast_1d(posterior.attrs[f"{axis}s"]).tolist())  # a file has one as a text


def model_of(posterior: xr.DataTree) -> TrustModel:
    """Return the model of a posterior with default priors, on which draws do not depend."""
    return with_default_priors(json.loads(posterior.attrs["model_record"]))


def effects_of(posterior: xr.DataTree) -> tuple[Effect, ...]:
    """Return the effects in the model of a posterior."""
    if is_by_position(posterior):
        return effects_from_record({"effects": json.loads(posterior.attrs["effects"])})
    return effects_from_record(json.loads(posterior.attrs["model_record"]))


def is_by_position(posterior: xr.DataTree) -> bool:
    """Return whether a posterior is of a function, which identifies robots by their position."""
    return is_of_function(json.loads(posterior.attrs["model_record"]))


def is_of_people(posterior: xr.DataTree) -> bool:
    """Return whether the model of a posterior is `HumanTrust`."""
    return posterior.attrs.get("model") == "HumanTrust"
