"""Leave-one-mission-out cross-validation (LOO).

Draws of the posterior get importance weights 1 / p(y_j | theta, y_-j) for leaving out mission j
(Vehtari, Gelman and Gabry 2017), so that

    p(y_j | y_-j) = 1 / E[ 1 / p(y_j | theta, y_-j) | y ].

For a model class, theta contains only the hyperparameters, because coefficients, effects and trust
are integrated out. p(y_j | theta, y_-j) is then the ratio of the evidence with and without mission
j. If coefficients were not integrated out, the weights would be poor for bounds that occur only in
mission j. For a NumPyro function, theta contains all variables, and p(y_j | theta) is the
likelihood. Where the weights are too uneven, p(y_j | theta, y_-j) is averaged over draws of a fit
without mission j.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from arviz_stats import sampling_diagnostics
from arviz_stats.utils import ELPDDataLOO
from scipy.optimize import brentq
from scipy.special import expit, logsumexp
from tqdm import tqdm

from trustbo.arrays import evenly_spaced, in_order
from trustbo.data import Mission
from trustbo.display import say, shows_bars, slow_bar
from trustbo.errors import PosteriorError, TrustboError, require_switch, warn
from trustbo.inference.density import at
from trustbo.inference.fit import fit
from trustbo.inference.functions.known import is_of_function, model_of_record
from trustbo.inference.learner import Model, add_latent, as_learner
from trustbo.inference.order import as_fitted
from trustbo.inference.posterior import names_in
from trustbo.inference.stored import missions_of, read_posterior
from trustbo.inference.tree import LIKELIHOOD_OF, RATES, TICKS
from trustbo.inference.weights import MAX_KHAT
from trustbo.models.model import TrustModel
from trustbo.models.record import model_from_record
from trustbo.parallel import computing

_POINTS = 700
"""Maximum number of draws that are used for a model class."""
_FEWEST = 4
"""Number of missions below which each one is left out by a refit, because weights would be
optimistic."""
_FEWEST_OF_CLASS = 10
"""The same number for model classes, whose refits take about a second."""
_LONG = 20.0
"""Seconds of refits from which their duration is announced."""
_LEAST_EFFECTIVE = 2.0
"""Smallest effective number of draws that is used to compute the limit of k-hat."""


@computing()
def loo(
    posterior: xr.DataTree, *, model: Model | None = None, progress: bool = True
) -> ELPDDataLOO:
    """Estimate the log predictive density of each mission given all other missions.

    Posterior draws get Pareto-smoothed weights. For a model class, all variables except
    hyperparameters are integrated out, by expectation propagation if rates are not Gaussian. If the
    k-hat of a mission exceeds min(1 - 1 / log10(S), 0.7) for S effective draws (Vehtari et al.
    2024), the model is refitted without that mission. With fewer than ten missions, a model class
    is refitted without each mission, because weights are then optimistic even if k-hat is good; a
    NumPyro function, whose refits are slow, with fewer than four. Missions without measured rates
    are excluded.

    With few missions, the sum `elpd` is uncertain even if k-hat is good; see `compare`. `p`, the
    effective number of parameters, should be much smaller than `n_data_points`, the number of
    missions.

    Args:
        posterior: DataTree from `fit` that includes the data, or a DataTree from
            `arviz.from_numpyro` with the attribute `log_likelihood_of` (see `compare`). The latter
            cannot be refitted.
        model: Model of the posterior; needed if the priors are custom, or if it is a NumPyro
            function that was not used before in this process.
        progress: Whether to show a progress bar after 1.5 seconds.

    Returns:
        Pointwise `ELPDDataLOO` of ArviZ for `az.compare({name: loo(posterior), ...})`. Missions
        have the labels of the posterior, which are negative for earlier missions. The coordinate
        `refitted` (mission,) of `elpd_i` and `pareto_k` marks refitted missions, for which
        `pareto_k` is the k-hat of the average over the draws of the refit. The attribute
        `log_likelihood_of` of `elpd_i` states whether the densities refer to tick counts; only then
        are they comparable between observation families.

    Raises:
        TrustboError: If fewer than two missions have measured rates, or if a DataTree that is not
            from `fit` cannot be evaluated.

    Example:
        >>> elpd = tb.inference.loo(posterior)
        >>> elpd.elpd, elpd.se
    """
    require_switch("progress", progress)
    return estimated(complete("loo", posterior, model), model, progress=progress)


def complete(who: str, posterior: xr.DataTree, model: Model | None = None) -> xr.DataTree:
    """Return a posterior with the log-likelihoods of missions; `who` is named in messages."""
    if isinstance(posterior, xr.DataTree) and "model_record" not in posterior.attrs:
        return _own(who, posterior)

    posterior = as_fitted(who, posterior)
    if "log_likelihood" in posterior.children:
        return posterior
    return add_latent(posterior, model=model, progress=False)


def estimated(
    posterior: xr.DataTree, model: Model | None = None, *, progress: bool = True
) -> ELPDDataLOO:
    """Leave out each mission that has rates, of a posterior as returned by `complete`."""
    model = _model_of(posterior, model)
    rates = posterior["observed_data"].to_dataset()[RATES]
    measured = np.flatnonzero(rates.notnull().any(("bound", "robot")))
    likelihood = posterior["log_likelihood"].to_dataset()[RATES].isel(mission=measured)
    labels = likelihood["mission"].values
    n_missions = len(measured)
    if n_missions < 2:
        raise TrustboError(f"loo needs at least 2 missions with rates; got {n_missions}.")

    with slow_bar("loo", " missions", progress, total=n_missions) as bar:
        log_p = likelihood
        if isinstance(model, TrustModel):
            log_density = ratio_of_evidence(posterior, missions_of(posterior), model)
            log_p = _by_mission(log_density, measured, labels, bar)

        n_draws = log_p.sizes["chain"] * log_p.sizes["draw"]
        ess = sampling_diagnostics.ess(log_p, method="bulk").min()
        n_effective = float(np.fmin(ess, n_draws))
        limit = good_khat(n_effective)
        density, k_hat, _ = log_p.azstats.loo(
            sample_dims=["chain", "draw"], r_eff=n_effective / n_draws
        )

        fewest = _FEWEST_OF_CLASS if isinstance(model, TrustModel) else _FEWEST
        is_refitted = ~(k_hat.values <= limit) | (n_missions < fewest)
        began = time.monotonic()
        for k, i in enumerate(np.flatnonzero(is_refitted)):
            if k == 1 and progress and not shows_bars():
                _announce_refits(int(is_refitted.sum()) - 1, time.monotonic() - began)
            if model is None:
                raise TrustboError(_no_refit(labels[i], float(k_hat[i]), limit, n_missions))
            bar.set_description_str(f"loo, refit without mission {labels[i]}")
            without, k_hat[i] = refit(posterior, model, int(measured[i]))
            density[i] = mean_likelihood(without, log_p[..., i].values)

    is_bad = ~(k_hat.values <= np.where(is_refitted, MAX_KHAT, limit))  # a refit has its own limit
    if is_bad.any():
        warn(
            f"Estimated shape parameter of Pareto distribution is greater than {limit:.2f} for "
            f"missions {labels[is_bad].tolist()}; the results may be inaccurate."
        )

    # The effective number of parameters includes coefficients and effects.
    n_samples = likelihood.sizes["chain"] * likelihood.sizes["draw"]
    average = logsumexp(likelihood, axis=(0, 1)) - np.log(n_samples)
    elpd, se, p, _ = density.azstats.loo_summary(average - density)
    coords = {"mission": labels, "refitted": ("mission", is_refitted)}
    attrs = {LIKELIHOOD_OF: posterior.attrs[LIKELIHOOD_OF]}
    return ELPDDataLOO(
        elpd=float(elpd),
        se=float(se),
        p=float(p),
        n_samples=n_samples,
        n_data_points=n_missions,
        scale="log",
        warning=bool(is_bad.any()),
        good_k=limit,
        elpd_i=xr.DataArray(density.values, coords, "mission", attrs=attrs),
        pareto_k=xr.DataArray(k_hat.values, coords, "mission"),
    )


def _announce_refits(n_left: int, seconds: float) -> None:
    """Print how long refits will take, where no bar tells it, if this is more than a moment."""
    left = n_left * seconds
    if left > _LONG:
        minutes = f"{left / 60.0:.0f} min" if left > 90.0 else f"{left:.0f} s"
        say(f"loo: {n_left} more missions must be left out by refits, about {minutes}.")


def _by_mission(
    log_density: Callable[[int], np.ndarray], missions: np.ndarray, labels: np.ndarray, bar: tqdm
) -> xr.DataArray:
    """Return log densities (chain, draw, mission) in one chain, and count missions in a bar."""
    found = []
    for j in missions.tolist():
        found.append(log_density(j))
        bar.update()
    return xr.DataArray(
        np.stack(found, axis=-1)[None], {"mission": labels}, ("chain", "draw", "mission")
    )


def good_khat(n_effective: float) -> float:
    """Return the largest k-hat at which S effective draws suffice (Vehtari et al. 2024)."""
    return float(min(1.0 - 1.0 / np.log10(max(n_effective, _LEAST_EFFECTIVE)), MAX_KHAT))


def _no_refit(mission: int, k_hat: float, limit: float, n_missions: int) -> str:
    """Explain why a mission needs a refit that is not possible."""
    reason = f"k-hat of mission {mission} is {k_hat:.2f}, above {limit:.2f}"
    if n_missions < _FEWEST:
        reason = f"there are only {n_missions} missions"
    return (
        f"{reason}, so each such mission must be left out by a refit, which is not possible for an "
        "own MCMC; fit the NumPyro function with trustbo.fit(missions, function)."
    )


# --- posteriors from fit ---


def _model_of(posterior: xr.DataTree, model: Model | None) -> Model | None:
    """Return the model of a posterior from `fit`, or None for an own MCMC."""
    if "model_record" not in posterior.attrs:
        return None

    given: Any = model
    record = json.loads(posterior.attrs["model_record"])
    if is_of_function(record):
        return model_of_record(record, given).function

    features = names_in(posterior, "feature")
    if given is not None:
        given = given.for_features(features)
    return model_from_record(record, given)


def refit(posterior: xr.DataTree, model: Model, j: int) -> tuple[np.ndarray, float]:
    """Fit without mission j; return log p(y_j | theta, y_-j) (draw,) and the k-hat of the fit.

    The k-hat is 0 for NUTS, as in `arviz.reloo`.
    """
    missions = missions_of(posterior)
    others = [_unmeasured(one) if i == j else one for i, one in enumerate(missions)]
    seed = int(posterior.attrs["seed"])
    try:
        fitted = fit(others, model, seed=seed, progress=False, latent=False, start=posterior)
    except PosteriorError as error:
        warn(f"the refit without mission {j}: {error.reason}.")
        fitted: Any = error.posterior

    if isinstance(model, TrustModel):
        log_p = ratio_of_evidence(fitted, missions, model)(j)
    else:
        log_p = as_learner(model).source(fitted, missions).log_likelihood()[:, j]
    return log_p, float(fitted.attrs.get("k_hat", 0.0))


def mean_likelihood(without: np.ndarray, whole: np.ndarray) -> float:
    """Estimate log p(y_j | y_-j) from log p(y_j | theta, y_-j) at two sets of draws of theta.

    The draws given the other missions and those given all missions are joined by the acceptance
    ratio of Bennett (1976, J. Comput. Phys. 22), which is accurate if the two sets overlap. The
    mean over the former would depend on few draws if mission j is informative.

    Args:
        without: Values at draws given the other missions.
        whole: Values at draws given all missions.
    """

    def excess(log_p: float) -> float:
        return expit(without - log_p).mean() - expit(log_p - whole).mean()

    low = min(without.min(), whole.min())
    high = max(without.max(), whole.max())
    log_p: Any = brentq(excess, low - 1.0, high + 1.0)
    return log_p


def ratio_of_evidence(
    posterior: xr.DataTree, missions: Sequence[Mission], model: TrustModel
) -> Callable[[int], np.ndarray]:
    """Return a function of j with log p(y_j | theta, y_-j) (draw,) of a model class.

    The rates are those of `missions`, also if the posterior was fitted to fewer of them.
    """
    fitted, draws = read_posterior(posterior, missions, model=model)
    fitted.run_ep(draws.theta)
    draws = draws.at(evenly_spaced(len(draws.c), _POINTS))

    # Resampled draws repeat, and the evidence of each distinct draw is computed only once.
    rows = np.column_stack([v.reshape(len(draws.c), -1) for v in draws.theta.values()])
    _, first, index = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    theta = at(draws.theta, first)
    whole = fitted.log_evidence(theta)

    # Densities of tick counts are comparable between families. They are NaN where ticks are
    # unknown.
    observations = fitted.observations
    shift = fitted.model.likelihood.log_resolution(observations.contact_rate, observations.n_ticks)
    shift = shift.sum((1, 2))
    if np.isnan(shift).any():
        shift = np.zeros(len(shift))

    def log_density(j: int) -> np.ndarray:
        return (whole - fitted.without(j).log_evidence(theta) + shift[j])[index.ravel()]

    return log_density


def _unmeasured(mission: Mission) -> Mission:
    """Return a mission without its contact rates, but with data of the same shape."""
    return replace(mission, contact_rate=np.full_like(mission.contact_rate, np.nan))


# --- a user's own MCMC ---


def _own(who: str, tree: xr.DataTree) -> xr.DataTree:
    """Return the data and log-likelihoods of a user's own MCMC with the axes of a posterior.

    Raises:
        TrustboError: If information is missing that makes its log-likelihoods comparable.
    """
    for group in ("log_likelihood", "observed_data"):
        if group not in tree.children or RATES not in tree[group].data_vars:
            raise TrustboError(
                f"{who} needs a posterior from trustbo.fit, or one of az.from_numpyro(mcmc, "
                f"log_likelihood=True) whose site of rates is called {RATES!r}; this DataTree has "
                f"no {RATES!r} in the group {group!r}."
            )

    y = _by_number(tree, "observed_data")[RATES].values
    log_p = _by_number(tree, "log_likelihood")[RATES]
    if y.ndim != 3 or log_p.dims[:2] != ("chain", "draw") or log_p.shape[2:] != y.shape[:1]:
        raise TrustboError(
            f"{who} needs one log-likelihood for each mission, with dims (chain, draw, mission), "
            f"and rates (mission, bound, robot); got {log_p.shape} and {y.shape}."
        )

    of = tree.attrs.get(LIKELIHOOD_OF)
    if of not in (TICKS, RATES):
        raise TrustboError(
            f"{who} cannot know whether the log-likelihoods of an own MCMC are of tick counts or "
            f"densities of rates: set tree.attrs[{LIKELIHOOD_OF!r}] to {TICKS!r} if its "
            f"ContactRate has n_ticks=, and to {RATES!r} otherwise; got {of!r}."
        )
    largest = float(log_p.mean(("chain", "draw")).max())
    if of == TICKS and largest > 0.0:
        raise TrustboError(
            f"{LIKELIHOOD_OF!r} is {TICKS!r}, but a log-likelihood is {largest:.1f} > 0 and so no "
            "log probability of counts; give n_ticks= to ContactRate."
        )

    groups = {
        "log_likelihood": xr.Dataset({RATES: log_p.rename({log_p.dims[2]: "mission"})}),
        "observed_data": xr.Dataset({RATES: (("mission", "bound", "robot"), y)}),
    }
    if "constant_data" in tree.children and "n_ticks" in tree["constant_data"]:
        n_ticks = _by_number(tree, "constant_data")["n_ticks"].values
        groups["constant_data"] = xr.Dataset({"n_ticks": (("mission", "bound", "robot"), n_ticks)})
    own = xr.DataTree.from_dict(groups)
    own.attrs = {LIKELIHOOD_OF: of}
    return own


def _by_number(tree: xr.DataTree, group: str) -> xr.Dataset:
    """Return a group with all axes whose labels are numbers in order, such as missions."""
    data = tree[group].to_dataset()
    numbers = [axis for axis, index in data.indexes.items() if index.dtype.kind in "iuf"]
    return in_order("the posterior", data, {str(axis): None for axis in numbers})
