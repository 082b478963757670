"""Trust models, with their parameters, priors, effects and common state-space form."""

from trustbo.models import backend as backend  # imported first because it loads numpyro

# isort: split
from trustbo.models.contact_rate import ContactRate
from trustbo.models.coupled import CoupledTrust
from trustbo.models.default import default_model
from trustbo.models.effects.effect import Effect
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.hierarchical import HierarchicalTrust
from trustbo.models.params import CoupledParams as CoupledParams
from trustbo.models.params import RobotParams as RobotParams
from trustbo.models.params import TrustParams
from trustbo.models.people import HumanTrust
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors

__all__ = [
    "ContactRate",
    "CoupledTrust",
    "Effect",
    "HierarchicalTrust",
    "HumanTrust",
    "PlaceEffect",
    "PooledTrust",
    "Priors",
    "RobotEffect",
    "TrustParams",
    "default_model",
]
__dir__ = __all__.copy  # tab completion lists only public names
