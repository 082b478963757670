"""Leave-one-mission-out cross-validation of any posterior, weighted ones among them."""

import warnings
from dataclasses import replace
from typing import Any, cast

import numpy as np
import xarray as xr
from arviz_stats.loo import loo as unweighted
from arviz_stats.utils import ELPDData

from trustbo.errors import TrustboError
from trustbo.inference.left_out import LeftOut, by_hyperparameters, by_refit, weights_of
from trustbo.inference.log_prior import model_of
from trustbo.inference.posterior_groups import LIKELIHOODS, complete
from trustbo.inference.posterior_tree import missions_of, require_posterior
from trustbo.models.families import FAMILIES
from trustbo.models.model import TrustModel
from trustbo.stacking import stack_missions


def loo(posterior: xr.DataTree, *, model: TrustModel | None = None) -> ELPDData:
    """Expected log predictive density of a mission left out, p(rates of it | all other missions).

    By Pareto-smoothed importance weights where these hold: of draws, or, with effects of places, of
    hyperparameters alone, all else integrated out. A mission whose weights are too uneven
    (k-hat above `good_k`) is left out of a refit, and has the difference of log evidence.
    Of draws of a posterior with weights w_j, which holds p(y_j | parameters)^w_j, the ratios are
    p(y_j | parameters)^-w_j. Missions without any rate have nothing to predict and are left out of
    the sum.

    Args:
        posterior: DataTree from `fit`.
        model: Its model; needed where it has custom priors. Without it, a mission
            that needs a refit keeps the density by weights of draws, with a warning.

    Returns:
        ArviZ's `ELPDData`, pointwise, for `az.compare({name: loo(posterior), ...})`. `elpd_i` and
        `pareto_k` have a coordinate `refitted` (mission,); there `pareto_k` is that of the refit's
        sampler, 0 for NUTS. Other than for weights of draws, `log_weights` are NaN.

    Raises:
        TrustboError: Fewer than two missions have rates, a view `by_rate`; or see `complete`.
    """
    posterior = require_posterior("loo", posterior)
    if "observed_data" in posterior.children and "rate" in posterior["observed_data"].dims:
        raise TrustboError("loo leaves out missions; of a view by rate, give the posterior itself.")
    posterior = complete(posterior, model=model)
    measured = _measured(posterior)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missions may be refitted
        result = _by_draws(posterior, measured)
    model = model_of(posterior, model)
    left_out: dict[int, LeftOut] = {}
    refitted = np.zeros(len(measured), dtype=bool)
    if model is not None:
        left_out = dict(enumerate(by_hyperparameters(posterior, model) or []))
        for i, j in enumerate(measured):
            khat = left_out[j].khat if j in left_out else float(result.pareto_k[i])
            if not khat <= result.good_k:
                left_out[j], refitted[i] = by_refit(posterior, model, int(j)), True
    result = _replaced(result, {i: left_out[j] for i, j in enumerate(measured) if j in left_out},
                       _log_resolution(posterior)[measured], refitted)  # fmt: skip
    if result.warning:
        warnings.warn(
            f"Estimated shape parameter of Pareto distribution is greater than {result.good_k:.2f} "
            f"for missions {measured[~(result.pareto_k.values <= result.good_k)].tolist()}: their "
            "densities may be off; see the argument model=.",
            stacklevel=2,
        )
    return result


def _measured(posterior: xr.DataTree) -> np.ndarray:
    """Missions with a rate; TrustboError: fewer than two."""
    rates = posterior["observed_data"].to_dataset()["contact_rate"]
    has_rates = rates.notnull().any(("bound", "robot")).values
    if has_rates.sum() < 2:
        raise TrustboError(
            f"LOO leaves out one of several missions; {has_rates.sum()} of {len(has_rates)} have "
            "rates. Give a posterior of two at least."
        )
    return np.flatnonzero(has_rates)


def _by_draws(posterior: xr.DataTree, measured: np.ndarray) -> Any:
    """ELPDData by weights of draws."""
    (group,) = (name for name in LIKELIHOODS if name in posterior.children)
    log_p = posterior[group].to_dataset()["contact_rate"].isel(mission=measured)
    weight = weights_of(posterior)[measured]
    counted = np.flatnonzero(weight > 0.0)
    powers = log_p.isel(mission=counted) * xr.DataArray(weight[counted], dims="mission")
    elpd: Any = unweighted(_tree(posterior, powers), pointwise=True)
    # The posterior is already without a mission of weight 0: equal weights.
    log_weights = xr.full_like(log_p, -np.log(log_p.sizes["chain"] * log_p.sizes["draw"]))
    log_weights = log_weights.transpose(*elpd.log_weights.dims)
    log_weights[{"mission": counted}] = elpd.log_weights.values
    pareto_k = xr.zeros_like(log_p.isel(chain=0, draw=0, drop=True))
    pareto_k[counted] = elpd.pareto_k.values
    tree = _tree(posterior, log_p)
    return unweighted(tree, pointwise=True, log_weights=log_weights, pareto_k=pareto_k)


def _tree(posterior: xr.DataTree, log_likelihood: xr.DataArray) -> xr.DataTree:
    """Build the tree that `az.loo` reads, whose draws give the relative effective sample size."""
    return xr.DataTree.from_dict(
        {
            "posterior": posterior["posterior"].to_dataset(),
            "log_likelihood": log_likelihood.to_dataset(name="contact_rate"),
        }
    )


def _log_resolution(posterior: xr.DataTree) -> np.ndarray:
    """Log ratio of the probability of each mission's counts of ticks to the density of its rates.

    0 where the posterior's log-likelihoods are densities; shape (mission,).
    """
    batch = stack_missions(missions_of(posterior), pad=False)
    if posterior.attrs["log_likelihood_of"] != "ticks":
        return np.zeros(len(batch.contact_rate))
    family = FAMILIES[posterior.attrs["observation"]]
    return family.log_resolution(batch.contact_rate, batch.n_ticks).sum((1, 2))


def _replaced(
    result: Any, left_out: dict[int, LeftOut], log_resolution: np.ndarray, refitted: np.ndarray
) -> ELPDData:
    """ELPDData with the densities and k-hats of some missions replaced."""
    elpd_i, pareto_k, log_weights = (
        getattr(result, name).copy() for name in ("elpd_i", "pareto_k", "log_weights")
    )
    for i, one in left_out.items():
        elpd_i[i], pareto_k[i] = one.log_density + log_resolution[i], one.khat
        log_weights[{"mission": i}] = np.nan
    elpd_i, pareto_k = (a.assign_coords(refitted=("mission", refitted)) for a in (elpd_i, pareto_k))
    elpd = float(elpd_i.sum())
    changed = replace(
        result,
        elpd=elpd,
        se=float(np.sqrt(len(elpd_i) * elpd_i.var())),
        p=float(result.p + result.elpd - elpd),
        warning=bool((~(pareto_k <= result.good_k)).any()),
        elpd_i=elpd_i,
        pareto_k=pareto_k,
        log_weights=log_weights,
    )
    return cast(ELPDData, changed)
