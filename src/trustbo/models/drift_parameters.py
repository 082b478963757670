"""Parameters of a custom drift: priors and axes."""

import inspect
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import jax
import numpyro.distributions as dist
from jax import Array, random
from numpyro import handlers

from trustbo.errors import TrustboError
from trustbo.models.backend import own_settings
from trustbo.models.drift_form import name_of
from trustbo.models.priors import as_text

Axes = dict[str, tuple[str, ...]]
_SIZES = {5: "robot", 7: "feature"}  # by which axes of a function's parameters are known
_RESERVED = (
    *("beta0", "delta_w", "delta_v", "x0_mean", "x0_sd", "b", "contact_rate", "innovations"),
    *("tau_s", "length_scale", "tau_e", "place", "place_bound", "place_white", "place_unit"),
    *("chain", "draw", "mission", "bound", "robot", "feature", "z"),
)


def listed_axes(parameters: object) -> tuple[Axes, Axes]:
    """Axes of arguments of the drift, and of sample sites, of priors by name."""
    if not isinstance(parameters, Mapping):
        raise TrustboError(
            "parameters must be priors by name, or a function (n_robots, n_features) with "
            f"numpyro.sample statements; got {parameters!r}."
        )
    axes = {str(name): split_prior(name, given)[1] for name, given in parameters.items()}
    return axes, axes


def split_prior(name: str, given: Any) -> tuple[dist.Distribution, tuple[str, ...]]:
    """Prior and axes of a parameter."""
    prior, *axes = given if isinstance(given, tuple) else (given,)
    scalar = isinstance(prior, dist.Distribution) and not prior.batch_shape + prior.event_shape
    if not scalar or not set(axes) <= {"robot", "feature"} or len(set(axes)) < len(axes):
        raise TrustboError(
            f"parameter {name} must be a scalar numpyro distribution, such as Normal(0.0, 1.0), or "
            f'a pair of it and "robot" or "feature"; got {given!r}.'
        )
    return prior, tuple(axes)


def prior_text(name: str, given: Any) -> str:
    """Prior and axes of a parameter in words."""
    prior, axes = split_prior(name, given)
    return f"{name} ~ {as_text(prior)}" + "".join(f" by {axis}" for axis in axes)


@lru_cache(maxsize=64)
def traced_axes(parameters: Callable[[int, int], Mapping[str, Any]]) -> tuple[Axes, Axes]:
    """Axes of a function's parameters, from shapes at unequal numbers of robots and features."""
    try:
        inspect.signature(parameters).bind(5, 7)
    except TypeError:
        raise TrustboError(
            f"the function of parameters {name_of(parameters)} must take (n_robots, n_features)."
        ) from None

    def program() -> tuple[Any, dict[str, Array]]:
        with handlers.trace() as trace:
            returned = handlers.seed(parameters, random.key(0))(5, 7)
        return returned, {n: s["value"] for n, s in trace.items() if s["type"] == "sample"}

    with own_settings():
        returned, sites = jax.eval_shape(program)
    if not isinstance(returned, Mapping):
        raise TrustboError(
            f"the function of parameters {name_of(parameters)} must return them by name, such as "
            f'{{"slope": slope}}; it returns {returned!r}.'
        )

    def named(values: Mapping[str, Any]) -> Axes:
        for name, value in values.items():
            if not set(value.shape) <= set(_SIZES) or len(set(value.shape)) < len(value.shape):
                raise TrustboError(
                    f"parameter {name} must be (), (robot,), (feature,) or (robot, feature); for 5 "
                    f"robots and 7 features it is {value.shape}."
                )
        return {n: tuple(_SIZES[size] for size in value.shape) for n, value in values.items()}

    return named(returned), named(sites)


def require_names(drift: Callable[..., Any], arguments: Axes, sites: Axes) -> None:
    """Refuse names that only the drift or only the priors have, and names that the model uses."""
    for name in arguments | sites:
        if name in _RESERVED:
            raise TrustboError(f"parameter {name!r} is the model's own; give yours another name.")
    first, *others = inspect.signature(drift).parameters.values()
    takes = {p.name: p for p in others if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
    anything = any(p.kind == p.VAR_KEYWORD for p in others)
    if missing := [n for n, p in takes.items() if p.default is p.empty and n not in arguments]:
        raise TrustboError(
            f"the drift {name_of(drift)} takes {missing[0]!r}, which is no parameter; there are "
            f"{', '.join(arguments) or 'none'}. Add its prior to parameters."
        )
    if unused := [name for name in arguments if name not in takes and not anything]:
        raise TrustboError(
            f"parameter {unused[0]!r} is none of the drift {name_of(drift)}, which takes "
            f"{', '.join(takes) or 'none'} besides {first.name}."
        )
