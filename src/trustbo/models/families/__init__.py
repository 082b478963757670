"""Observation families, which are distributions of a contact rate given trust."""

from trustbo.models.families.beta_binomial import BetaBinomial
from trustbo.models.families.censored import Censored
from trustbo.models.families.family import Family
from trustbo.models.families.gaussian import Gaussian
from trustbo.models.families.levels import Levels

FAMILIES: dict[str, Family] = {
    family.name: family for family in (Gaussian(), Censored(), BetaBinomial())
}

__all__ = ["FAMILIES", "Family", "Levels"]
