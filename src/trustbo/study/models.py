"""Trust models of studies, as plain settings."""

from dataclasses import asdict, dataclass
from typing import ClassVar

from trustbo import models
from trustbo.errors import require_choice
from trustbo.study.parts import Part


@dataclass(frozen=True, kw_only=True)
class Model(Part):
    """Trust model with its default priors, or those of `"zheng2023"`."""

    observation: str = "gaussian"
    response: str = "level"
    priors: str = "default"
    make: ClassVar[type[models.TrustModel]]

    def __post_init__(self) -> None:
        require_choice("priors", self.priors, ("default", "zheng2023"))
        self.model()

    def model(self) -> models.TrustModel:
        """Make the model."""
        own = asdict(self)
        vague = own.pop("priors") == "zheng2023"
        return self.make(models.Priors.zheng2023() if vague else None, **own)  # pyright: ignore


@dataclass(frozen=True, kw_only=True)
class Pooled(Model):
    """Settings of `models.PooledTrust`."""

    kind, make = "pooled", models.PooledTrust


@dataclass(frozen=True, kw_only=True)
class Hierarchical(Model):
    """Settings of `models.HierarchicalTrust`."""

    kind, make = "hierarchical", models.HierarchicalTrust


@dataclass(frozen=True, kw_only=True)
class Coupled(Model):
    """Settings of `models.CoupledTrust`."""

    kind, make = "coupled", models.CoupledTrust
    inter_robot: str = "full"


MODELS = (Pooled, Hierarchical, Coupled)
