"""Summary of a campaign or a result for display."""

import numpy as np
import xarray as xr

from trustbo.display import Rows
from trustbo.inference.samplers.convergence import GOOD_KHAT, MAX_RHAT

_DIAGNOSTICS = ("k_hat", "kish", "r_hat", "ess_bulk", "divergences")


def evidence_of(history: xr.Dataset) -> Rows:
    """Row of the diagnostics that show whether the last posterior is sound, if there is one."""
    last = {n: float(history[n].values[-1]) for n in _DIAGNOSTICS if n in history}
    if np.isfinite(last.get("k_hat", np.nan)):
        khat = f"k-hat {last['k_hat']:.2f} (good below {GOOD_KHAT:g})"
        text = f"importance sampling: {khat}, effective draws {last['kish']:.0f}"
        return [("posterior", text)]
    if np.isfinite(last.get("r_hat", np.nan)):
        rhat = f"R-hat {last['r_hat']:.3f} (good up to {MAX_RHAT:g})"
        ess = f"bulk ESS {last['ess_bulk']:.0f}, divergences {last['divergences']:.0f}"
        return [("posterior", f"NUTS: {rhat}, {ess}")]
    return []
