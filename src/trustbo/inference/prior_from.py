"""A model whose priors were learned from earlier campaigns, on the same ground or on other."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.inference.draws import sites_of
from trustbo.inference.posterior_tree import require_posterior
from trustbo.models.backend import own_settings
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors_numpy import number, numbers

_EDGE = 1e-3  # beta0 closer to 0 or 1 has no moments of a Beta


def prior_from(posteriors: Sequence[xr.DataTree], model: TrustModel | None = None) -> TrustModel:
    """Model whose priors have the moments of earlier posteriors and of the default, mixed.

    The mixture gives each posterior and the default prior the same weight: n campaigns leave
    1 / (n + 1) of the default, so that the prior still covers unlike ground. Coefficients stay
    normal, the autoregression a Beta, noises and the spreads of places half-normal and the length
    scale log-normal, of the mixture's first two moments (scales: its mean square).

    Args:
        posteriors: Posteriors of `PooledTrust` with the same features, such as
            `result.posterior` of each campaign.
        model: Model to give the priors to; by default `PooledTrust` with effects of places where
            the posteriors have them.

    Raises:
        TrustboError: There are no posteriors, or they are of other models or features.
    """
    features = _require_alike(posteriors)
    with_places = all("tau_e" in posterior["posterior"] for posterior in posteriors)
    if model is None:
        model = PooledTrust(place=PlaceEffect() if with_places else None)
    base = model.for_features(features).priors
    sites = [sites_of(posterior) for posterior in posteriors]
    if not isinstance(base.beta, dist.Normal) or not isinstance(base.b, dist.Normal):
        raise TrustboError("prior_from needs Normal priors of beta and b to mix with.")
    coefficients = _stationary(sites, base.stationary)
    beta = _mixed(
        [s["beta"] for s in coefficients],
        np.broadcast_to(numbers(base.beta, "loc"), len(features)),
        np.broadcast_to(numbers(base.beta, "scale"), len(features)),
    )
    of_b = numbers(base.b, "loc"), numbers(base.b, "scale")
    b = _mixed([s["b"] for s in coefficients], *of_b)
    beta0 = _mixed([s["beta0"] for s in sites], *_moments(base.beta0))
    with own_settings():
        priors = replace(
            base,
            beta0=_beta(*beta0),
            beta=dist.Normal(*beta),
            b=dist.Normal(*b),
            delta_w=dist.HalfNormal(_scale([s["delta_w"] for s in sites], base.delta_w)),
            delta_v=dist.HalfNormal(_scale([s["delta_v"] for s in sites], base.delta_v)),
        )
    place = model.place
    if place is not None and with_places:
        place = _place(sites, place)
    return replace(model, priors=priors, place=place)


def _require_alike(posteriors: Sequence[xr.DataTree]) -> tuple[str, ...]:
    """Names of the features; TrustboError if posteriors differ in model or features."""
    if isinstance(posteriors, xr.DataTree):
        raise TrustboError("prior_from takes a list of posteriors; got one. Write [posterior].")
    for posterior in posteriors:
        require_posterior("prior_from", posterior)
    if not posteriors:
        raise TrustboError("there are no posteriors to learn priors from; give one at least.")
    none = xr.DataArray([])
    features_of = [p["posterior"].coords.get("feature", none).values for p in posteriors]
    names = [tuple(map(str, features)) for features in features_of]
    for j, (posterior, features) in enumerate(zip(posteriors, names, strict=True)):
        if posterior.attrs["model"] != "PooledTrust" or features != names[0]:
            raise TrustboError(
                f"prior_from takes posteriors of PooledTrust with the same features; posterior {j} "
                f"is of {posterior.attrs['model']} with {features}, posterior 0 has {names[0]}."
            )
    return names[0]


def _stationary(
    sites: list[dict[str, np.ndarray]], stationary: bool
) -> list[dict[str, np.ndarray]]:
    """Coefficients, converted to those of stationary trust where the priors are of these."""
    if not stationary:
        return sites
    rest = [1.0 - s["beta0"] for s in sites]
    return [
        {"beta": s["beta"] / r[:, None], "b": s["b"] / r} for s, r in zip(sites, rest, strict=True)
    ]


def _mixed(
    draws: list[np.ndarray], mean: np.ndarray, sd: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and sd of an equal mixture of posteriors and a prior, given the prior's mean and sd."""
    means = np.stack([*(np.median(values, axis=0) for values in draws), np.asarray(mean)])
    # Medians and quantiles: beta / (1 - beta0) has heavy tails as beta0 comes near 1.
    spreads = [0.5 * np.subtract(*np.quantile(values, [0.841, 0.159], axis=0)) for values in draws]
    variances = np.stack([*(spread**2 for spread in spreads), np.asarray(sd) ** 2])
    center = means.mean(0)
    return center, np.sqrt(variances.mean(0) + ((means - center) ** 2).mean(0))


def _moments(prior: dist.Distribution) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(prior.mean, dtype=float), np.sqrt(np.asarray(prior.variance, dtype=float))


def _beta(mean: np.ndarray, sd: np.ndarray) -> dist.Beta:
    """Beta distribution with given mean and sd."""
    center = float(np.clip(mean, _EDGE, 1.0 - _EDGE))
    count = max(center * (1.0 - center) / float(sd) ** 2 - 1.0, 0.5)
    return dist.Beta(center * count, (1.0 - center) * count)


def _scale(draws: list[np.ndarray], prior: dist.Distribution) -> float:
    """Scale of the half-normal with the mean square of the mixture."""
    squares = [float((values**2).mean()) for values in draws]
    return float(np.sqrt(np.mean([*squares, number(prior, "scale") ** 2])))


def _place(sites: list[dict[str, np.ndarray]], place: PlaceEffect) -> PlaceEffect:
    """Effects of places whose hyperparameters have the mixture's moments."""
    new = {}
    for name in ("tau_s", "tau_e"):
        if name in sites[0]:
            squares = [float((s[name] ** 2).mean()) for s in sites]
            new[name] = float(np.sqrt(np.mean([*squares, getattr(place, name) ** 2])))
    if "length_scale" in sites[0]:
        logs = [np.log(s["length_scale"]) for s in sites]
        usual = np.log(place.length_scale), np.asarray(place.length_scale_sd)
        center, spread = _mixed(logs, *usual)
        new |= {"length_scale": float(np.exp(center)), "length_scale_sd": float(spread)}
    return replace(place, **new)
