"""Trust models and their inference."""

from trustbo.models import backend as backend  # first: it loads numpyro

# isort: split
from trustbo.models.by_rate import by_rate
from trustbo.models.coupled import CoupledTrust
from trustbo.models.criticise import Criticism, criticise
from trustbo.models.drift import DriftTrust
from trustbo.models.exposures import CAUSES, LostMission
from trustbo.models.filter import TrustFilter, TrustForecast, TrustState
from trustbo.models.fit import fit
from trustbo.models.hazard import Hazard, fit_hazard
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.likelihood.contact_rate import ContactRate
from trustbo.models.likelihood.generate import TrustSample
from trustbo.models.loo import loo
from trustbo.models.model import TrustModel
from trustbo.models.params import (
    CoupledParams,
    DriftParams,
    RobotParams,
    TrustParams,
    params_of,
)
from trustbo.models.place import PlaceEffect
from trustbo.models.place_maps import place_maps
from trustbo.models.pooled import PooledTrust
from trustbo.models.posterior_groups import complete
from trustbo.models.prior_from import prior_from
from trustbo.models.prior_predictive import prior_predictive, sample_prior
from trustbo.models.priors import Priors
from trustbo.models.risk import BoundRisk
from trustbo.models.samplers.convergence import diagnostics
from trustbo.models.sbc import sbc
from trustbo.models.updating import ExactPosterior, moment_matched, sample_statistics

__all__ = [
    "CAUSES",
    "BoundRisk",
    "ContactRate",
    "CoupledParams",
    "CoupledTrust",
    "Criticism",
    "DriftParams",
    "DriftTrust",
    "ExactPosterior",
    "Hazard",
    "HierarchicalTrust",
    "LostMission",
    "PlaceEffect",
    "PooledTrust",
    "Priors",
    "RobotParams",
    "TrustFilter",
    "TrustForecast",
    "TrustModel",
    "TrustParams",
    "TrustSample",
    "TrustState",
    "by_rate",
    "complete",
    "criticise",
    "diagnostics",
    "fit",
    "fit_hazard",
    "loo",
    "moment_matched",
    "params_of",
    "place_maps",
    "prior_from",
    "prior_predictive",
    "sample_prior",
    "sample_statistics",
    "sbc",
]
__dir__ = __all__.copy  # completion lists public names alone
