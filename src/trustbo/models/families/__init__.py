"""Families of observations: distributions of a contact rate given trust, one file each.

To add one, write its file after `gaussian` (trust integrates out), `censored` (a filter that
completes rates) or `beta_binomial` (any log-concave distribution, by its derivatives), and list it
here.
"""

import numpy as np

from trustbo.models.families.beta_binomial import BetaBinomial
from trustbo.models.families.censored import Censored
from trustbo.models.families.family import Family, Observed
from trustbo.models.families.gaussian import Gaussian

FAMILIES: dict[str, Family] = {
    family.name: family for family in (Gaussian(), Censored(), BetaBinomial())
}

AUTO = "auto"
"""Name of automatic choice by the rates, see `choose`; Gaussian until there are rates."""
PILED_UP = 0.05
"""Share of rates at 0 or 1 from which a Gaussian family is unsuitable."""


def family_of(observation: str) -> Family:
    """Family of a model's `observation`."""
    return FAMILIES["gaussian" if observation == AUTO else observation]


def choose(rates: np.ndarray) -> tuple[str, str]:
    """Family that suits measured rates (any shape, NaN where not measured), and the reason.

    Never counts, even where ticks are recorded: line of sight correlates the ticks of a bound
    (`benchmarks/families.py`).
    """
    seen = rates[~np.isnan(rates)]
    share = float(np.mean((seen <= 0.0) | (seen >= 1.0))) if len(seen) else 0.0
    family = "gaussian" if share < PILED_UP else "censored"
    return family, f"{share:.0%} of the rates are 0 or 1"


__all__ = ["AUTO", "FAMILIES", "Family", "Observed", "choose", "family_of"]
