"""Families of observations: the law of a contact rate given trust, one object and one file each.

To add one, write its file after `gaussian` (trust integrates out), `censored` (a filter that
completes rates) or `beta_binomial` (any log-concave law, by its derivatives), and list it here.
"""

from trustbo.models.likelihood.families.beta_binomial import BetaBinomial
from trustbo.models.likelihood.families.censored import Censored
from trustbo.models.likelihood.families.family import Family, Observed
from trustbo.models.likelihood.families.gaussian import Gaussian

FAMILIES: dict[str, Family] = {
    family.name: family for family in (Gaussian(), Censored(), BetaBinomial())
}

__all__ = ["FAMILIES", "Family", "Observed"]
