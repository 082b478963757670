"""Leave-one-mission-out cross-validation (LOO).

Draws of the posterior get importance weights 1 / p(y_j | theta, y_-j) for leaving out mission j
(Vehtari, Gelman and Gabry 2017), so that

    p(y_j | y_-j) = 1 / E[ 1 / p(y_j | theta, y_-j) | y ].

For a model class, theta contains only the hyperparameters, because coefficients, effects and trust
are integrated out. p(y_j | theta, y_-j) is then the ratio of the evidence with and without mission
j. If coefficients were not integrated out, the weights would be poor for bounds that occur only in
mission j. For a NumPyro function, theta contains all variables, and p(y_j | theta) is the
likelihood.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from arviz_stats import sampling_diagnostics
from arviz_stats.utils import ELPDData
from scipy.special import logsumexp

from trustbo.arrays import evenly_spaced, in_order
from trustbo.data import Mission
from trustbo.display import slow_bar
from trustbo.errors import TrustboError, warn
from trustbo.inference.density import Density, at
from trustbo.inference.draws import (
    as_fitted,
    joined_draws,
    missions_of,
    names_in,
    read_posterior,
)
from trustbo.inference.fit import by_importance
from trustbo.inference.functions.fit import fit_function, log_likelihood_of_function
from trustbo.inference.functions.function import FunctionModel
from trustbo.inference.functions.sampling import AUTO
from trustbo.inference.importance import MAX_KHAT, smoothed
from trustbo.inference.learner import FunctionLearner, Model, add_latent, learner_of_posterior
from trustbo.inference.tree import LIKELIHOOD_OF, RATES, TICKS
from trustbo.models.observations import Observations
from trustbo.parallel import computing

_POINTS = 500
"""Maximum number of distinct hyperparameter draws that are used."""
_N_REFIT = 1000
"""Number of draws of a refit without a mission; for a function, the number per chain."""
_CHAINS = 4
"""Number of chains of a refit of a function."""
_FEWEST = 4
"""Number of missions below which each one is left out by a refit, because weights would be
optimistic."""
_FEWEST_OF_CLASS = 10
"""The same number for model classes, whose refits take about a second."""
_LEAST_EFFECTIVE = 2.0
"""Smallest effective number of draws that is used to compute the limit of k-hat."""


class LeftOut(NamedTuple):
    """Data that are needed to leave out each mission of a posterior."""

    labels: np.ndarray
    """Label (mission,) of each mission in the posterior."""
    robots: tuple[str, ...]
    """Names of the robots; empty if they are not known."""
    contact_rate: np.ndarray
    """Rates (mission, bound, robot)."""
    n_ticks: np.ndarray | None
    """Tick counts (mission, bound, robot); None if they are not known."""
    is_density: np.ndarray
    """Whether the likelihood of a rate is a density, not a probability, in the same shape."""
    log_density: Callable[[int], np.ndarray]
    """Log p(y_j | theta, y_-j) of mission j at each draw, shape (draw,)."""
    log_likelihood: np.ndarray
    """Log p(y_j | draw) given all variables except trust, at all draws, shape (draw, mission)."""
    log_share: np.ndarray
    """Log of each draw's share of all draws, shape (draw,)."""
    n_effective: float
    """Effective number of draws."""
    efficiency: float
    """Effective draws per draw of a Markov chain; 1 for independent draws."""
    fewest: int
    """Number of missions below which each one is left out by a refit."""
    refit: Callable[[int], tuple[float, float]] | None
    """Function that returns log p(y_j | y_-j) and its k-hat from a fit without mission j, or None
    if refits are not possible."""


@computing()
def loo(posterior: xr.DataTree, *, model: Model | None = None, progress: bool = True) -> ELPDData:
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
        Pointwise `ELPDData` of ArviZ for `az.compare({name: loo(posterior), ...})`. Missions have
        the labels of the posterior, which are negative for earlier missions. The coordinate
        `refitted` (mission,) of `elpd_i` and `pareto_k` marks refitted missions, for which
        `pareto_k` is the k-hat of the refit. The attribute `log_likelihood_of` of `elpd_i` states
        whether the densities refer to tick counts; only then are they comparable between
        observation families.

    Raises:
        TrustboError: If fewer than two missions have measured rates, or if a DataTree that is not
            from `fit` cannot be evaluated.

    Example:
        >>> elpd = tb.inference.loo(posterior)
        >>> elpd.elpd, elpd.se
    """
    return estimated(left_out("loo", posterior, model), progress=progress)


def left_out(who: str, posterior: xr.DataTree, model: Model | None = None) -> LeftOut:
    """Prepare to leave out each mission of a posterior; `who` is named in messages."""
    if isinstance(posterior, xr.DataTree) and "model_record" not in posterior.attrs:
        return _of_own(who, posterior)

    posterior = as_fitted(who, posterior)
    learner = learner_of_posterior(posterior, model)
    if isinstance(learner, FunctionLearner):
        return _of_function(posterior, learner.model)
    return _of_class(posterior, model)


def estimated(target: LeftOut, *, progress: bool = True) -> ELPDData:
    """Leave out each mission that has rates; see `loo`."""
    measured = np.flatnonzero(~np.isnan(target.contact_rate).all((1, 2)))
    labels = target.labels[measured]
    n_measured = len(measured)
    if n_measured < 2:
        raise TrustboError(f"loo needs at least 2 missions with rates; got {n_measured}.")

    limit = good_khat(target.n_effective)
    n_samples = len(target.log_likelihood)
    density = np.zeros(n_measured)
    average = np.zeros(n_measured)  # log of the mean likelihood under the full posterior
    k_hat = np.zeros(n_measured)
    refitted = np.zeros(n_measured, dtype=bool)
    with slow_bar("loo", " missions", progress, total=n_measured) as bar:
        for i, j in enumerate(map(int, measured)):
            log_p = target.log_density(j)
            weight, k_hat[i], _ = smoothed(target.log_share - log_p, target.efficiency)
            density[i] = logsumexp(log_p, b=weight)
            average[i] = logsumexp(target.log_likelihood[:, j]) - np.log(n_samples)

            if n_measured < target.fewest or not k_hat[i] <= limit:
                if target.refit is None:
                    raise TrustboError(_no_refit(labels[i], k_hat[i], limit, n_measured))
                bar.set_description_str(f"loo, refit without mission {labels[i]}")
                density[i], k_hat[i] = target.refit(j)
                refitted[i] = True
                bar.set_description_str("loo")
            bar.update()

    is_bad = ~(k_hat <= limit)
    if is_bad.any():
        warn(
            f"Estimated shape parameter of Pareto distribution is greater than {limit:.2f} for "
            f"missions {labels[is_bad].tolist()}; the results may be inaccurate."
        )

    elpd = float(density.sum())
    coords = {"mission": labels, "refitted": ("mission", refitted)}
    attrs = {LIKELIHOOD_OF: RATES if target.is_density.any() else TICKS}
    return ELPDData(
        elpd=elpd,
        se=float(np.sqrt(n_measured * density.var())),
        p=float(average.sum()) - elpd,
        n_samples=n_samples,
        n_data_points=n_measured,
        scale="log",
        warning=bool(is_bad.any()),
        good_k=limit,
        elpd_i=xr.DataArray(density, coords, "mission", attrs=attrs),
        pareto_k=xr.DataArray(k_hat, coords, "mission"),
    )


def good_khat(n_effective: float) -> float:
    """Return the largest k-hat at which S effective draws suffice (Vehtari et al. 2024)."""
    return float(min(1.0 - 1.0 / np.log10(max(n_effective, _LEAST_EFFECTIVE)), MAX_KHAT))


def _no_refit(mission: Any, k_hat: float, limit: float, n_missions: int) -> str:
    """Explain why a mission needs a refit that is not possible."""
    reason = f"k-hat of mission {mission} is {k_hat:.2f}, above {limit:.2f}"
    if n_missions < _FEWEST:
        reason = f"there are only {n_missions} missions"
    return (
        f"{reason}, so each such mission must be left out by a refit, which is not possible for an "
        "own MCMC; fit the NumPyro function with trustbo.fit(missions, function)."
    )


# --- model classes ---


def _of_class(posterior: xr.DataTree, model: Model | None) -> LeftOut:
    """Prepare to leave out missions of a posterior of a model class."""
    fitted, draws = read_posterior(posterior, model=model)  # pyright: ignore[reportArgumentType]
    fitted.run_ep(draws.theta)
    n_samples = len(draws.c)

    # Resampled draws repeat, and the evidence of each distinct draw is computed only once.
    rows = np.column_stack([v.reshape(n_samples, -1) for v in draws.theta.values()])
    _, first, count = np.unique(rows, axis=0, return_index=True, return_counts=True)
    some = evenly_spaced(len(first), _POINTS)
    theta = at(draws.theta, first[some])
    share = count[some] / count[some].sum()
    whole = fitted.log_evidence(theta)

    # Densities of tick counts are comparable between families. They are NaN where ticks are
    # unknown.
    y = fitted.observations.contact_rate
    n_ticks = fitted.observations.n_ticks
    is_density = ~np.isnan(y) & fitted.model.likelihood.is_density(y)
    shift = fitted.model.likelihood.log_resolution(y, n_ticks).sum((1, 2))
    if np.isnan(shift).any():
        shift = np.zeros(len(y))
    else:
        is_density = np.zeros(y.shape, dtype=bool)

    # The effective number of parameters includes coefficients and effects.
    complete = posterior
    if "log_likelihood" not in posterior.children:
        complete = add_latent(posterior, model=model, progress=False)
    log_likelihood = joined_draws(complete["log_likelihood"].to_dataset()[RATES])

    seed = int(posterior.attrs["seed"])
    known: list[float] = []  # the log evidence of all missions, after the first refit

    def log_density(j: int) -> np.ndarray:
        return whole - fitted.without(j).log_evidence(theta) + shift[j]

    def refit(j: int) -> tuple[float, float]:
        """Compute p(y_j | y_-j) = p(y) / p(y_-j), with a separate fit for each factor."""
        if not known:  # in a copy, because the fit changes the EP sites that `log_density` uses
            known.append(_log_evidence(Density(fitted.model, fitted.observations), seed)[0])
        rest, k_hat = _log_evidence(fitted.without(j), seed)
        return known[0] - rest + float(shift[j]), k_hat

    return LeftOut(
        labels=_labels(posterior),
        robots=names_in(posterior, "robot"),
        contact_rate=y,
        n_ticks=n_ticks,
        is_density=is_density,
        log_density=log_density,
        log_likelihood=log_likelihood,
        log_share=np.log(share),
        n_effective=min(1.0 / float((share**2).sum()), _n_effective(posterior)),
        efficiency=1.0,
        fewest=_FEWEST_OF_CLASS,
        refit=refit,
    )


def _labels(posterior: xr.DataTree) -> np.ndarray:
    """Return the labels of the missions; those of earlier campaigns are negative."""
    return posterior["constant_data"].to_dataset()["mission"].values


def _n_effective(posterior: xr.DataTree) -> float:
    """Return the effective number of draws, as recorded by the sampler of `fit`."""
    name = "kish" if posterior.attrs["sampler"] == "importance" else "ess_bulk"
    return float(posterior.attrs[name])


def _log_evidence(density: Density, seed: int) -> tuple[float, float]:
    """Compute the log evidence by importance sampling, and the k-hat of the weights."""
    _, _, summary = by_importance(density, _N_REFIT, seed)
    return summary["log_evidence"], summary["k_hat"]


# --- NumPyro functions ---


def _of_function(posterior: xr.DataTree, model: FunctionModel) -> LeftOut:
    """Prepare to leave out missions of a posterior of a function."""
    missions = missions_of(posterior)
    observations = Observations.from_missions(missions)
    if "log_likelihood" in posterior.children:
        log_p = joined_draws(posterior["log_likelihood"].to_dataset()[RATES])
        of_counts = posterior.attrs[LIKELIHOOD_OF] == TICKS
    else:
        log_p, of_counts = log_likelihood_of_function(posterior, missions, model)

    is_measured = ~np.isnan(observations.contact_rate)
    n_draws = len(log_p)
    n_effective = min(_n_effective(posterior), float(n_draws))
    seed = int(posterior.attrs["seed"])

    def refit(j: int) -> tuple[float, float]:
        """Average p(y_j | theta) over draws of a fit in which mission j has no rates."""
        others = [_unmeasured(one) if i == j else one for i, one in enumerate(missions)]
        fitted, complaints = fit_function(
            others, model, None, AUTO, _N_REFIT, _CHAINS, None, seed, False, True, posterior
        )
        if complaints:
            warn(f"the refit of {model.in_short()} without mission {j}: {'; '.join(complaints)}.")

        given, _ = log_likelihood_of_function(fitted, missions, model)
        _, k_hat, log_mean = smoothed(given[:, j])
        return log_mean, k_hat

    return LeftOut(
        labels=_labels(posterior),
        robots=names_in(posterior, "robot"),
        contact_rate=observations.contact_rate,
        n_ticks=observations.n_ticks,
        is_density=is_measured & (not of_counts),
        log_density=lambda j: log_p[:, j],
        log_likelihood=log_p,
        log_share=np.full(n_draws, -np.log(n_draws)),
        n_effective=n_effective,
        efficiency=n_effective / n_draws,
        fewest=_FEWEST,
        refit=refit,
    )


def _unmeasured(mission: Mission) -> Mission:
    """Return a mission without its contact rates, but with data of the same shape."""
    return replace(mission, contact_rate=np.full_like(mission.contact_rate, np.nan))


# --- a user's own MCMC ---


def _of_own(who: str, tree: xr.DataTree) -> LeftOut:
    """Prepare to leave out missions of a DataTree of a user's own MCMC, without refits.

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

    y = np.asarray(_by_number(tree, "observed_data")[RATES].values, float)
    log_p = _by_number(tree, "log_likelihood")[RATES]
    dims = log_p.dims
    if y.ndim != 3 or dims[:2] != ("chain", "draw") or log_p.shape[2:] != y.shape[:1]:
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
    flat = joined_draws(log_p)
    largest = flat.mean(0).max()
    if of == TICKS and largest > 0.0:
        raise TrustboError(
            f"{LIKELIHOOD_OF!r} is {TICKS!r}, but a log-likelihood is {largest:.1f} > 0 and so no "
            "log probability of counts; give n_ticks= to ContactRate."
        )

    ticks = _by_number(tree, "constant_data") if "constant_data" in tree.children else {}
    is_measured = ~np.isnan(y)
    measured = is_measured.any((1, 2))
    ess = sampling_diagnostics.ess(log_p.isel({dims[2]: measured}), method="bulk")
    n_draws = len(flat)
    n_effective = min(float(ess.min()), float(n_draws))
    return LeftOut(
        labels=log_p[dims[2]].values,
        robots=(),
        contact_rate=y,
        n_ticks=np.asarray(ticks["n_ticks"].values, float) if "n_ticks" in ticks else None,
        is_density=is_measured & (of == RATES),
        log_density=lambda j: flat[:, j],
        log_likelihood=flat,
        log_share=np.full(n_draws, -np.log(n_draws)),
        n_effective=n_effective,
        efficiency=n_effective / n_draws,
        fewest=_FEWEST,
        refit=None,
    )


def _by_number(tree: xr.DataTree, group: str) -> xr.Dataset:
    """Return a group with all axes whose labels are numbers in order, such as missions."""
    data = tree[group].to_dataset()
    numbers = [axis for axis, index in data.indexes.items() if index.dtype.kind in "iuf"]
    return in_order("the posterior", data, {str(axis): None for axis in numbers})
