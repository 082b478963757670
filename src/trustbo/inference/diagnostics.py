"""Diagnostics of a sampler, and the limits beyond which `fit` raises an error."""

from collections.abc import Mapping

import arviz_base
import numpy as np
import xarray as xr
from arviz_stats import sampling_diagnostics

from trustbo.inference.posterior import require_fitted

MAX_RHAT = 1.01
"""Largest rank-normalised R-hat that is accepted for NUTS."""
MIN_ESS = 400.0
"""Smallest bulk effective sample size that is accepted for NUTS."""
NUTS_NAMES = ("r_hat", "ess_bulk", "divergences")
"""Names of the diagnostics of NUTS."""
_STATISTICS = {
    "num_steps": "n_steps",
    "diverging": "diverging",
    "accept_prob": "acceptance_rate",
    "energy": "energy",
    "potential_energy": "lp",
}
"""ArviZ names of NumPyro's sampling statistics."""
FIELDS = tuple(_STATISTICS)
"""NumPyro's names of the sampling statistics that posteriors contain."""


def diagnostics(posterior: xr.DataTree) -> dict[str, float]:
    """Return the diagnostics of the sampler that drew a posterior.

    Returns:
        For importance sampling, `k_hat`, which is good below 0.5, and the effective number of
        points `kish`. For NUTS, the worst `r_hat` and `ess_bulk` over all hyperparameters, and the
        number of `divergences`.

    Raises:
        TrustboError: If the posterior is not from `fit`.
    """
    attrs = require_fitted("diagnostics", posterior).attrs
    names = ("k_hat", "kish") if attrs["sampler"] == "importance" else NUTS_NAMES
    return {name: float(attrs[name]) for name in names}


def statistics_of(fields: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the sampling statistics of NumPyro under the names of ArviZ."""
    stats = {ours: fields[theirs] for theirs, ours in _STATISTICS.items()}
    stats["lp"] = -stats["lp"]  # NumPyro's potential is -log density
    return stats


def complaints_of(
    draws: Mapping[str, np.ndarray],
    diverging: np.ndarray,
    *,
    max_rhat: float = MAX_RHAT,
    min_ess: float = MIN_ESS,
    max_divergences: int = 0,
) -> tuple[dict[str, float], list[str]]:
    """Compute the NUTS diagnostics of draws (chain, draw, ...), and list the failed checks.

    A failed check names the worst variable.
    """
    flat = {  # in a DataTree, "/" separates groups
        name.replace("/", "."): values.reshape(*values.shape[:2], -1)
        for name, values in draws.items()
    }

    # Parameters that are constant in the model have no diagnostics.
    free = {name: v[:, :, np.ptp(v, axis=(0, 1)) > 0.0] for name, v in flat.items()}
    free = {name: v for name, v in free.items() if v.size}

    worst = np.nan
    least = np.nan
    of_worst = of_least = ""
    if free:  # otherwise, a single chain has not moved at all
        parameters = arviz_base.from_dict({"posterior": free})["posterior"].to_dataset()
        r_hat = sampling_diagnostics.rhat(parameters)
        ess = sampling_diagnostics.ess(parameters, method="bulk")
        worst, of_worst = max(
            (float(values.max()), f" of {name}") for name, values in r_hat.items()
        )
        least, of_least = min((float(values.min()), f" of {name}") for name, values in ess.items())
    divergences = int(diverging.sum())

    complaints = []
    if not worst <= max_rhat:  # also true for NaN
        complaints.append(f"R-hat{of_worst} is {worst:.3f} (limit {max_rhat})")
    if not least >= min_ess:
        complaints.append(f"bulk ESS{of_least} is {least:.0f} (minimum {min_ess:.0f})")
    if divergences > max_divergences:
        complaints.append(f"{divergences} transitions diverged (limit {max_divergences})")
    return dict(zip(NUTS_NAMES, (worst, least, divergences), strict=True)), complaints
