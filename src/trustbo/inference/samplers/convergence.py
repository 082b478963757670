"""Convergence diagnostics of a posterior, and the limits beyond which it is refused."""

from collections.abc import Mapping

import arviz_base
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


def complaints_of(params: Mapping[str, np.ndarray], stats: Mapping[str, np.ndarray]) -> list[str]:
    """Limits exceeded by the draws, parameter by parameter; empty if none."""
    sites = arviz_base.from_dict({"posterior": params})["posterior"].to_dataset()
    complaints = []
    for name, (worst, fewest) in convergence(sites).items():
        if not worst <= MAX_RHAT:  # NaN is a complaint too
            complaints.append(f"R-hat of {name} is {worst:.3f} (limit {MAX_RHAT})")
        if not fewest >= MIN_ESS:
            complaints.append(f"bulk ESS of {name} is {fewest:.0f} (at least {MIN_ESS:.0f})")
    n_divergences = int(stats["diverging"].sum())
    if n_divergences:
        complaints.append(f"{n_divergences} divergences")
    return complaints


def complaints_of_means(
    params: Mapping[str, np.ndarray],
    at_points: Mapping[str, np.ndarray],
    weight: np.ndarray,
    limit: float = 0.3,
) -> list[str]:
    """Parameters whose mean is far from that of weighted points; empty if there are none.

    Chains that start at different modes and do not meet have a large R-hat. It does not detect a
    mode that all chains left in their warm-up; the points, half of which are spread wide, do.

    Args:
        params: Draws, each (chain, draw, ...).
        at_points: Parameters at weighted points, each (point, ...), by the same names.
        weight: Weight of each point, sum 1.
        limit: Largest distance, in sd; points of an effective number of 200 have an error of .07.
    """
    complaints = []
    for name, values in at_points.items():
        mean = np.tensordot(weight, values, 1)
        sd = np.sqrt(np.tensordot(weight, (values - mean) ** 2, 1))
        off = np.max(np.abs(params[name].mean((0, 1)) - mean) / np.maximum(sd, 1e-12))
        if not off <= limit:
            complaints.append(
                f"the mean of {name} is {off:.2f} sd from that of importance sampling "
                f"(limit {limit})"
            )
    return complaints
