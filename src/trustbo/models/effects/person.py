"""Effects of a person: initial trust, level to which trust returns, and gains from outcomes.

A mission is a person. The coefficients of a person are independent, each kind with a separate sd,

    start ~ N(0, tau_start^2) at the first bound,   level ~ N(0, tau_level^2) at all bounds,
    gains ~ N(0, tau_gain^2), times the inputs of success and of failure.

As a person has no other missions, the coefficients are a term in the covariance of the block
instead of columns, see `HumanTrust.signal`.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Effect, Theta

PARTS = ["start", "level", "success", "failure"]


@dataclass(frozen=True)
class PersonEffect(Effect):
    """Effects of persons, each stored as a mission.

    Attributes:
        tau_start: Scale of the half-normal prior of the sd of trust at the first bound.
        tau_level: Scale of the half-normal prior of the sd of the level to which trust returns.
        tau_gain: Scale of the half-normal prior of the sd of the gains from success and failure.

    Raises:
        TrustboError: If a scale is not positive.
    """

    tau_start: float = 0.3
    tau_level: float = 0.2
    tau_gain: float = 0.2
    names = ("tau_start", "tau_level", "tau_gain")
    noun = "persons"
    variables: ClassVar = {"person": ("mission", "part")}
    coords: ClassVar = {"part": PARTS}

    def sds(self, theta: Theta) -> Any:
        """Sd of each coefficient, (point, part)."""
        start, level, gain = (theta[name] for name in self.names)
        return namespace(start).stack([start, level, gain, gain], axis=1)
