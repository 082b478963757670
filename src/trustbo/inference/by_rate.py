"""Single contact rates as observations, for ArviZ functions that need single observations.

The rates of a mission depend on each other, so the likelihood of a mission is not a product over
rates. It is a product of predictions one step ahead (Buerkner, Gabry and Vehtari 2020),

    p(y_1, ..., y_n | theta) = prod_k p(y_k | y_1, ..., y_k-1, theta),

where the rates of a mission are ordered by bound and then by robot. `by_rate` returns these factors
as log-likelihoods, and draws from the same distributions as predictions. Each rate is thus
predicted from the earlier rates of its mission, and PIT values are uniform if the model is correct.
"""

import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced
from trustbo.inference.latent import Source
from trustbo.inference.learner import Model, learner_of_posterior
from trustbo.inference.order import as_fitted
from trustbo.inference.stored import missions_of
from trustbo.inference.tree import LIKELIHOOD_OF, RATES, TICKS
from trustbo.parallel import computing
from trustbo.statespace import kalman
from trustbo.statespace.blocks import each
from trustbo.streams import stream

_NUMBERS = 2_000_000
"""Largest number of log-likelihoods that are returned; beyond it, fewer draws are returned."""
_FEWEST_DRAWS = 200
"""Smallest number of draws that are returned, regardless of the number of rates."""
_OF_RATES = ("mission", "bound", "robot")
_PER_DRAW = ("posterior", "sample_stats", "log_prior")
"""Groups from which the chosen draws are copied."""
_COPIED = ("prior",)
"""Groups that are copied unchanged."""


@computing()
def by_rate(posterior: xr.DataTree, *, model: Model | None = None) -> xr.DataTree:
    """Return a posterior in which each contact rate is an observation, for ArviZ.

    Functions such as `az.plot_loo_pit`, `az.loo_pit` and `az.metrics` need a log-likelihood and
    predictions of single observations. Here, each rate is predicted one step ahead, from the
    earlier rates of its mission. The log-likelihoods of the rates of a mission add up to that of
    the mission. For Gaussian rates, the sum is exact; for other families, it has the error of
    moment matching (see `TrustFilter`). `az.loo` of the result leaves out one of these one-step
    predictions at a time; to leave out whole missions, call `loo` or `compare` with the posterior
    itself.

    Args:
        posterior: DataTree from `fit` that includes the data.
        model: Model of the posterior; needed if the priors are custom, or if it is a NumPyro
            function that was not used before in this process.

    Returns:
        DataTree with one entry per measured rate on the axis `rate`, whose coordinates are
        `mission`, `bound` and `robot`. The groups `log_likelihood`, `posterior_predictive`,
        `prior_predictive` (for whole missions, if the posterior has it) and `observed_data` contain
        contact_rate[..., rate]. `constant_data` contains each feature[rate]. `posterior`,
        `sample_stats` and `log_prior` contain the same draws, and `prior` is copied. If there would
        be more than 2 million log-likelihoods, fewer draws are returned, evenly spaced, but at
        least 200.

    Raises:
        TrustboError: If the posterior is not from `fit` or contains no data.

    Example:
        >>> az.plot_loo_pit(tb.inference.by_rate(posterior))
    """
    posterior = as_fitted("by_rate", posterior)
    sizes = posterior["posterior"].sizes
    n_chains = sizes["chain"]
    n_rates = int(posterior["observed_data"][RATES].notnull().sum()) if _has_data(posterior) else 1
    most = max(_FEWEST_DRAWS, _NUMBERS // max(n_rates, 1)) // n_chains
    kept = evenly_spaced(sizes["draw"], max(most, 1))
    some = (np.arange(n_chains)[:, None] * sizes["draw"] + kept).ravel()

    learner = learner_of_posterior(posterior, model)
    source = learner.source(posterior, missions_of(posterior), contrasts=False)
    log_p, predicted = _predicted(source, some, int(posterior.attrs["seed"]))

    def by_chain(values: np.ndarray) -> xr.DataArray:
        chained = values.reshape(n_chains, len(kept), -1)
        return xr.DataArray(chained, dims=("chain", "draw", "rate"))

    rates = _rates(posterior)
    chosen = {"chain": posterior["posterior"]["chain"].values, "draw": kept}
    coords = {name: rates[name] for name in ("rate", *_OF_RATES)}
    groups = {
        name: posterior[name].to_dataset().isel(draw=kept)
        for name in _PER_DRAW
        if name in posterior.children
    }
    for name in groups:
        groups[name] = groups[name].assign_coords(draw=kept)
    groups |= {
        "log_likelihood": xr.Dataset({RATES: by_chain(log_p)}, coords | chosen),
        "posterior_predictive": xr.Dataset({RATES: by_chain(predicted)}, coords | chosen),
        "observed_data": rates.to_dataset(name=RATES),
        "constant_data": _features(posterior, rates),
    }
    groups |= {name: posterior[name].to_dataset() for name in _COPIED if name in posterior.children}
    if "prior_predictive" in posterior.children:
        groups["prior_predictive"] = _at_rates(
            posterior["prior_predictive"].to_dataset()[RATES], rates
        )

    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {LIKELIHOOD_OF: TICKS if source.of_counts else RATES}
    return tree


def _has_data(posterior: xr.DataTree) -> bool:
    """Return whether a posterior contains its data; if not, `missions_of` explains what to do."""
    return "observed_data" in posterior.children


def _rates(posterior: xr.DataTree) -> xr.DataArray:
    """Return the measured rates (rate,), with the coordinates mission, bound and robot."""
    y = posterior["observed_data"].to_dataset()[RATES].transpose(*_OF_RATES)
    is_measured = y.notnull().values
    mission, bound, robot = np.nonzero(is_measured)
    coords = {
        "rate": np.arange(len(mission)),
        "mission": ("rate", y["mission"].values[mission]),
        "bound": ("rate", y["bound"].values[bound]),
        "robot": ("rate", y["robot"].values[robot]),
    }
    return xr.DataArray(y.values[is_measured], coords, "rate")


def _at_rates(values: xr.DataArray, rates: xr.DataArray) -> xr.Dataset:
    """Select values (..., mission, bound, robot) at the measured rates."""
    where = {name: rates[name] for name in _OF_RATES}
    return values.sel(where).assign_coords(rates.coords).to_dataset(name=RATES)


def _features(posterior: xr.DataTree, rates: xr.DataArray) -> xr.Dataset:
    """Return each feature (rate,) by name."""
    awareness = posterior["constant_data"].to_dataset()["awareness"]
    features = [str(name) for name in awareness["feature"].values]
    where = {name: rates[name] for name in _OF_RATES}
    return xr.Dataset(
        {name: awareness.sel(where).sel(feature=name, drop=True) for name in features}
    ).assign_coords(rates.coords)


# --- predictions one step ahead ---


def _predicted(source: Source, some: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Predict each measured rate from the earlier rates of its mission, for some draws.

    Returns:
        Log-likelihoods (draw, rate), of tick counts if the source is `of_counts`, and predicted
        rates (draw, rate).
    """
    observations = source.observations
    likelihood = source.likelihood
    is_measured = ~np.isnan(observations.contact_rate)
    y = source.layout.rows(observations.contact_rate)
    n_ticks = source.layout.rows(observations.n_ticks)
    rng = stream(seed, "by rate")

    log_p = []
    predicted = []
    for given in source.given(some):
        cov = each(given.predictor.covariance, source.label)
        sd = given.predictor.noise_sd
        ahead = kalman.one_step_ahead(given.mean, cov, sd, y, n_ticks, likelihood)
        f = ahead.mean + np.sqrt(ahead.var) * rng.standard_normal(given.mean.shape)
        drawn = likelihood.sample(f, sd, n_ticks, rng)

        log_p.append(source.layout.unstack(ahead.log_p)[:, is_measured])
        predicted.append(source.layout.unstack(drawn)[:, is_measured])

    joined = np.concatenate(log_p)
    if source.of_counts:
        shift = likelihood.log_resolution(observations.contact_rate, observations.n_ticks)
        joined = joined + shift[is_measured]
    return joined, np.concatenate(predicted)
