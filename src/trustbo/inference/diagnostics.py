"""Diagnostics of a posterior, and the limits beyond which `fit` refuses it."""

from collections.abc import Mapping

import arviz_base
import numpy as np
import xarray as xr
from arviz_stats import sampling_diagnostics

from trustbo.inference.draws import require_posterior

MAX_RHAT, MIN_ESS = 1.01, 400.0
"""Largest rank-normalised R-hat, and least bulk effective sample size, of NUTS."""


def diagnostics(posterior: xr.DataTree) -> dict[str, float]:
    """Diagnostics of the sampler.

    Returns:
        For importance sampling, whose draws are nearly independent, `k_hat` (good below 0.5) and
        `kish`, the effective number of points. For NUTS `r_hat` and `ess_bulk`, the worst over all
        parameters, and the number of `divergences`.

    Raises:
        TrustboError: No posterior of `fit`.
    """
    require_posterior("diagnostics", posterior)
    if posterior.attrs["sampler"] == "importance":
        return {name: float(posterior.attrs[name]) for name in ("k_hat", "kish")}
    sites = posterior["posterior"].to_dataset()
    diverging = posterior["sample_stats"].to_dataset()["diverging"].values
    return worst_of({str(n): a.values for n, a in sites.data_vars.items()}, diverging)


def worst_of(draws: Mapping[str, np.ndarray], diverging: np.ndarray) -> dict[str, float]:
    """The worst R-hat and bulk ESS of draws (chain, draw, ...) by name, and the divergences."""
    flat = {name: values.reshape(*values.shape[:2], -1) for name, values in draws.items()}
    # Constants of the model do not count.
    free = {name: v[:, :, np.ptp(v, axis=(0, 1)) > 0.0] for name, v in flat.items()}
    tree = arviz_base.from_dict({"posterior": {n: v for n, v in free.items() if v.size}})
    sites = tree["posterior"].to_dataset()
    r_hat, ess = sampling_diagnostics.rhat(sites), sampling_diagnostics.ess(sites, method="bulk")
    return {
        "r_hat": max(float(a.max()) for a in r_hat.data_vars.values()),
        "ess_bulk": min(float(a.min()) for a in ess.data_vars.values()),
        "divergences": int(diverging.sum()),
    }


def complaints_of(
    draws: Mapping[str, np.ndarray], diverging: np.ndarray
) -> tuple[dict[str, float], list[str]]:
    """Diagnostics of chains, see `worst_of`, and the limits that they exceed, in words."""
    found, complaints = worst_of(draws, diverging), []
    if not found["r_hat"] <= MAX_RHAT:  # NaN is a complaint too
        complaints.append(f"R-hat is {found['r_hat']:.3f} (at most {MAX_RHAT})")
    if not found["ess_bulk"] >= MIN_ESS:
        complaints.append(f"bulk ESS is {found['ess_bulk']:.0f} (at least {MIN_ESS:.0f})")
    if found["divergences"]:
        complaints.append(f"{found['divergences']} divergences")
    return found, complaints
