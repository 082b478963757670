"""Families of observations: the law of a contact rate given trust, one object and one file each.

To add one, write its file after `gaussian` (trust integrates out), `censored` (a filter that
completes rates) or `beta_binomial` (any log-concave law, by its derivatives), and list it here.
"""

import numpy as np

from trustbo.models.likelihood.families.beta_binomial import BetaBinomial
from trustbo.models.likelihood.families.censored import Censored
from trustbo.models.likelihood.families.family import Family, Observed
from trustbo.models.likelihood.families.gaussian import Gaussian
from trustbo.models.likelihood.families.student_t import StudentT

FAMILIES: dict[str, Family] = {
    family.name: family for family in (Gaussian(), Censored(), BetaBinomial(), StudentT())
}

AUTO = "auto"
"""Word for the family that suits the rates, see `choose`; Gaussian until there are rates."""
PILED_UP = 0.05
"""Share of rates at 0 or 1 from which on they are no Gaussian ones."""


def family_of(observation: str) -> Family:
    """Family of a model's `observation`."""
    return FAMILIES["gaussian" if observation == AUTO else observation]


def choose(rates: np.ndarray, n_ticks: np.ndarray, *, change: bool = False) -> tuple[str, str]:
    """Family that suits measured rates, and the reason.

    Args:
        rates: Contact rates, any shape, NaN where not measured.
        n_ticks: Ticks, of that shape, NaN where not known.
        change: Whether rates measure changes of trust, which are no share of ticks.
    """
    seen = ~np.isnan(rates)
    share = float(np.mean((rates[seen] <= 0.0) | (rates[seen] >= 1.0))) if seen.any() else 0.0
    reason = f"{share:.0%} of the rates are 0 or 1"
    if share < PILED_UP:
        return "gaussian", reason
    if not change and (n_ticks[seen] >= 1.0).all():
        return "beta_binomial", f"{reason}, and ticks are known"
    return "censored", reason


__all__ = ["AUTO", "FAMILIES", "Family", "Observed", "choose", "family_of"]
