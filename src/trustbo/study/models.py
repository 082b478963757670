"""What the runs of a study learn: trust models as plain settings."""

from dataclasses import asdict, dataclass
from typing import ClassVar

from trustbo import models
from trustbo.errors import require_choice
from trustbo.study.parts import Part


@dataclass(frozen=True, kw_only=True)
class Model(Part):
    """A trust model with its default priors, or `"zheng2023"`'s."""

    observation: str = "gaussian"
    response: str = "level"
    priors: str = "default"
    make: ClassVar[type[models.TrustModel]]

    def __post_init__(self) -> None:
        require_choice("priors", self.priors, ("default", "zheng2023"))
        self.model()

    def model(self) -> models.TrustModel:
        """The model."""
        own = asdict(self)
        vague = own.pop("priors") == "zheng2023"
        return self.make(models.Priors.zheng2023() if vague else None, **own)  # pyright: ignore


@dataclass(frozen=True, kw_only=True)
class Pooled(Model):
    """`models.PooledTrust`."""

    kind, make = "pooled", models.PooledTrust


@dataclass(frozen=True, kw_only=True)
class Hierarchical(Model):
    """`models.HierarchicalTrust`."""

    kind, make = "hierarchical", models.HierarchicalTrust


@dataclass(frozen=True, kw_only=True)
class Coupled(Model):
    """`models.CoupledTrust`."""

    kind, make = "coupled", models.CoupledTrust
    inter_robot: str = "full"


MODELS = (Pooled, Hierarchical, Coupled)
