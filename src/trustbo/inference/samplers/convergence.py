"""Convergence diagnostics of a posterior, and the limits beyond which it is refused."""

import numpy as np
import xarray as xr
from arviz_stats import sampling_diagnostics

from trustbo.inference.posterior_tree import require_posterior

MAX_RHAT, MIN_ESS = 1.01, 400.0
"""Largest rank-normalised R-hat, and least bulk effective sample size, of NUTS."""
GOOD_KHAT, MAX_KHAT = 0.5, 0.7
"""Pareto shape of the exact sampler's weights: good below the first, refused above the second."""


def diagnostics(posterior: xr.DataTree) -> dict[str, float]:
    """Convergence diagnostics of a posterior.

    Returns:
        `r_hat` and `ess_bulk`, the worst over all parameters, and `divergences` for NUTS. `k_hat`
        (good below 0.5) and `kish`, the effective number of points, for the exact sampler, whose
        draws are nearly independent.

    Raises:
        TrustboError: No posterior of `fit`.
    """
    require_posterior("diagnostics", posterior)
    if posterior.attrs["sampler"] == "exact":
        return {name: posterior.attrs[name] for name in ("k_hat", "kish")}
    by_site = convergence(posterior["posterior"].to_dataset())
    return {
        "r_hat": max(rhat for rhat, _ in by_site.values()),
        "ess_bulk": min(ess for _, ess in by_site.values()),
        "divergences": int(posterior["sample_stats"].to_dataset()["diverging"].sum()),
    }


def convergence(sites: xr.Dataset) -> dict[str, tuple[float, float]]:
    """The worst R-hat and the least bulk ESS of each parameter."""
    with np.errstate(invalid="ignore"):
        rhat, ess = sampling_diagnostics.rhat(sites), sampling_diagnostics.ess(sites, method="bulk")
    diagnostics_of = {}
    for name, draws in sites.data_vars.items():
        # A value that never moves is a constant of the model, such as an absent correlation.
        free = np.ptp(draws.values, axis=(0, 1)) > 0.0
        if free.any():
            worst = float(rhat[name].values[free].max())
            diagnostics_of[str(name)] = (worst, float(ess[name].values[free].min()))
    return diagnostics_of
