"""Summary of a campaign or a result for display."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.display.card import Card
from trustbo.inference.samplers.convergence import GOOD_KHAT, MAX_RHAT

_DIAGNOSTICS = ("k_hat", "kish", "r_hat", "ess_bulk", "divergences")


def summary_of(
    title: str,
    rows: Sequence[tuple[str, str]],
    settings: Mapping[str, Any],
    history: xr.Dataset,
) -> Card:
    """Summary with the diagnostics of the last posterior and the settings."""
    rows = [*rows, *_evidence(history)]
    options = [(name, str(value)) for name, value in settings.items() if len(str(value)) < 200]
    return Card(title, rows, {"options": options})


def _evidence(history: xr.Dataset) -> list[tuple[str, str]]:
    """Row of the diagnostics that show whether the last posterior is sound, if there is one."""
    last = {n: float(history[n].values[-1]) for n in _DIAGNOSTICS if n in history}
    if np.isfinite(last.get("k_hat", np.nan)):
        khat = f"k-hat {last['k_hat']:.2f} (good below {GOOD_KHAT:g})"
        text = f"exact: {khat}, Kish size {last['kish']:.0f}; R-hat and ESS are no evidence"
        return [("posterior", text)]
    if np.isfinite(last.get("r_hat", np.nan)):
        rhat = f"R-hat {last['r_hat']:.3f} (good up to {MAX_RHAT:g})"
        ess = f"bulk ESS {last['ess_bulk']:.0f}, divergences {last['divergences']:.0f}"
        return [("posterior", f"NUTS: {rhat}, {ess}")]
    return []
