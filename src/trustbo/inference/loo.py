"""Leave-one-mission-out cross-validation of any posterior, weighted ones among them."""

import warnings
from typing import Any, cast

import numpy as np
import xarray as xr
from arviz_stats.loo import loo as unweighted
from arviz_stats.utils import ELPDData

from trustbo.errors import TrustboError
from trustbo.inference.posterior_groups import LIKELIHOODS, complete
from trustbo.inference.posterior_tree import require_posterior


def loo(posterior: xr.DataTree) -> ELPDData:
    """Expected log predictive density of a mission left out, by Pareto-smoothed importance weights.

    A posterior with weights w_j holds p(y_j | parameters)^w_j, so that leaving mission j out takes
    importance ratios p(y_j | parameters)^-w_j; `az.loo` assumes power 1, and refuses such a
    posterior. Without weights the result is that of `az.loo`. Missions without any rate have
    nothing to predict and are left out of the sum.

    Args:
        posterior: DataTree from `fit`.

    Returns:
        ArviZ's `ELPDData`, pointwise, for `az.compare({name: loo(posterior), ...})`.

    Raises:
        TrustboError: Fewer than two missions have rates, a view `by_rate`; or see `complete`.
    """
    posterior = require_posterior("loo", posterior)
    if "observed_data" in posterior.children and "rate" in posterior["observed_data"].dims:
        raise TrustboError("loo leaves out missions; of a view by rate, give the posterior itself.")
    posterior = complete(posterior)
    (group,) = (name for name in LIKELIHOODS if name in posterior.children)
    log_p = posterior[group].to_dataset()["contact_rate"]
    rates = posterior["observed_data"].to_dataset()["contact_rate"]
    measured = rates.notnull().any(("bound", "robot")).values
    weight = np.broadcast_to(posterior.attrs.get("weights", 1.0), measured.shape)[measured]
    log_p = log_p.isel(mission=np.flatnonzero(measured))
    if len(weight) < 2:
        raise TrustboError(
            f"LOO leaves out one of several missions; {len(weight)} of {len(measured)} have rates. "
            "Give a posterior of two at least."
        )
    counted = np.flatnonzero(weight > 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the second call warns again
        powers = log_p.isel(mission=counted) * xr.DataArray(weight[counted], dims="mission")
        elpd: Any = unweighted(_tree(posterior, powers), pointwise=True)
    # The posterior is already without a mission of weight 0: equal weights.
    log_weights = xr.full_like(log_p, -np.log(log_p.sizes["chain"] * log_p.sizes["draw"]))
    log_weights = log_weights.transpose(*elpd.log_weights.dims)
    log_weights[{"mission": counted}] = elpd.log_weights.values
    pareto_k = xr.zeros_like(log_p.isel(chain=0, draw=0, drop=True))
    pareto_k[counted] = elpd.pareto_k.values
    tree = _tree(posterior, log_p)
    result = unweighted(tree, pointwise=True, log_weights=log_weights, pareto_k=pareto_k)
    return cast(ELPDData, result)


def _tree(posterior: xr.DataTree, log_likelihood: xr.DataArray) -> xr.DataTree:
    """Build the tree that `az.loo` reads, whose draws give the relative effective sample size."""
    return xr.DataTree.from_dict(
        {
            "posterior": posterior["posterior"].to_dataset(),
            "log_likelihood": log_likelihood.to_dataset(name="contact_rate"),
        }
    )
