"""Trust models and their inference."""

from trustbo.models.calibration import sbc
from trustbo.models.coupled import CoupledTrust
from trustbo.models.filter import TrustFilter, TrustState
from trustbo.models.fit import fit, sample_prior
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.model import ContactRate, TrustModel, TrustSample
from trustbo.models.params import CoupledParams, RobotParams, TrustParams, params_of
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors
from trustbo.models.sampling import diagnostics

__all__ = [
    "ContactRate",
    "CoupledParams",
    "CoupledTrust",
    "HierarchicalTrust",
    "PooledTrust",
    "Priors",
    "RobotParams",
    "TrustFilter",
    "TrustModel",
    "TrustParams",
    "TrustSample",
    "TrustState",
    "diagnostics",
    "fit",
    "params_of",
    "sample_prior",
    "sbc",
]
