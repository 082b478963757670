"""Trust models: their parameters, priors and effects, and the state space that they share."""

from trustbo.errors import moved_names
from trustbo.models import backend as backend  # first: it loads numpyro

# isort: split
from trustbo.models.coupled import CoupledTrust
from trustbo.models.drift import DriftTrust
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.model import TrustModel
from trustbo.models.params import CoupledParams, RobotParams, TrustParams
from trustbo.models.place import PlaceEffect
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors
from trustbo.models.state_space.contact_rate import ContactRate

__all__ = [
    "ContactRate",
    "CoupledParams",
    "CoupledTrust",
    "DriftTrust",
    "HierarchicalTrust",
    "PlaceEffect",
    "PooledTrust",
    "Priors",
    "RobotParams",
    "TrustModel",
    "TrustParams",
]
__dir__ = __all__.copy  # completion lists public names alone

# Names of version 0.2, by the room that has them now.
__getattr__ = moved_names(__name__, {
    "trustbo.criticism": ("Criticism", "criticise"),
    "trustbo.hazard": ("CAUSES", "BoundRisk", "Hazard", "LostMission", "fit_hazard"),
    "trustbo.inference": (
        "TrustFilter", "by_rate", "complete",
        "diagnostics", "fit", "loo", "moment_matched", "params_of", "place_maps", "prior_from",
        "prior_predictive", "sample_prior", "sample_statistics", "sbc",
    ),
})  # fmt: skip
