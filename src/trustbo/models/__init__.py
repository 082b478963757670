"""Trust models: their parameters, priors and effects, and the state space that they share."""

from trustbo.models import backend as backend  # first: it loads numpyro

# isort: split
from trustbo.models.coupled import CoupledTrust
from trustbo.models.default import default_model
from trustbo.models.drift import DriftTrust
from trustbo.models.effects.person import PersonEffect
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.params import CoupledParams, RobotParams, TrustParams
from trustbo.models.people import HumanTrust
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors
from trustbo.renamed import moved

__all__ = [
    "CoupledParams",
    "CoupledTrust",
    "DriftTrust",
    "HierarchicalTrust",
    "HumanTrust",
    "PersonEffect",
    "PlaceEffect",
    "PooledTrust",
    "Priors",
    "RobotEffect",
    "RobotParams",
    "TrustParams",
    "default_model",
]
__dir__ = __all__.copy  # completion lists public names alone

# Names of version 0.2.
__getattr__ = moved(
    __name__,
    {
        "trustbo.criticism": ["criticise"],
        "trustbo.criticism.criticise": ["Criticism"],
        "trustbo.hazard": ["Hazard", "fit_hazard"],
        "trustbo.hazard.exposures": ["CAUSES", "LostMission"],
        "trustbo.hazard.risk": ["BoundRisk"],
        "trustbo.inference": [
            "TrustFilter", "by_rate", "complete", "diagnostics", "fit", "loo", "params_of",
            "place_maps", "prior_from", "prior_predictive", "sample_prior", "sample_statistics",
            "sbc",
        ],
        "trustbo.inference.filter": ["TrustForecast", "TrustState"],
        "trustbo.inference.updating": ["ExactPosterior", "moment_matched"],
        "trustbo.models.model": ["TrustModel"],
        "trustbo.models.params": ["DriftParams"],
        "trustbo.models.state_space.contact_rate": ["ContactRate"],
        "trustbo.models.state_space.generate": ["TrustSample"],
    },
)  # fmt: skip
