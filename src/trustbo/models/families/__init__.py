"""Families of observations: distributions of a contact rate given trust, one file each.

To add one, write its file after `gaussian` (trust integrates out), `censored` (a filter that
completes rates) or `beta_binomial` (any log-concave distribution, by its derivatives), and list it
here.
"""

from trustbo.models.families.beta_binomial import BetaBinomial
from trustbo.models.families.censored import Censored
from trustbo.models.families.family import Family, Observed
from trustbo.models.families.gaussian import Gaussian

FAMILIES: dict[str, Family] = {
    family.name: family for family in (Gaussian(), Censored(), BetaBinomial())
}


def family_of(observation: str) -> Family:
    """Family of a model's `observation`."""
    return FAMILIES[observation]


__all__ = ["FAMILIES", "Family", "Observed", "family_of"]
