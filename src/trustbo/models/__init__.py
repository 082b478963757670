"""Trust models and their inference."""

from trustbo.models.calibration import sbc
from trustbo.models.filter import TrustFilter, TrustState
from trustbo.models.fit import diagnostics, fit, sample_prior
from trustbo.models.pooled import ContactRate, PooledTrust, TrustParams, TrustSample, pooled_trust
from trustbo.models.priors import Priors

__all__ = [
    "ContactRate",
    "PooledTrust",
    "Priors",
    "TrustFilter",
    "TrustParams",
    "TrustSample",
    "TrustState",
    "diagnostics",
    "fit",
    "pooled_trust",
    "sample_prior",
    "sbc",
]
