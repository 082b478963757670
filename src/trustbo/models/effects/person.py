"""Effects of a person: start, level to which trust returns, and gains by outcomes.

A mission is a person, whose parts last as long as the mission. They are independent, each kind with
a separate sd,

    start ~ N(0, tau_start^2) at the first bound,   level ~ N(0, tau_level^2) at all bounds,
    gains ~ N(0, tau_gain^2), times the inputs of success and of failure.

A person has no other missions: these parts are no columns, but a term of the covariance of the
block, see `HumanTrust.signal`.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Effect, Theta

PARTS = ["start", "level", "success", "failure"]


@dataclass(frozen=True)
class PersonEffect(Effect):
    """Effects of persons, who are missions.

    Attributes:
        tau_start: Scale of the half-normal prior of the sd of trust at the first bound.
        tau_level: Scale of that of the level to which trust returns.
        tau_gain: Scale of that of the gains by success and by failure.

    Raises:
        TrustboError: A scale is not positive.
    """

    tau_start: float = 0.3
    tau_level: float = 0.2
    tau_gain: float = 0.2
    names = ("tau_start", "tau_level", "tau_gain")
    noun = "persons"
    variables: ClassVar = {"person": ("mission", "part")}
    coords: ClassVar = {"part": PARTS}

    def sds(self, theta: Theta) -> Any:
        """Sd of each part, (point, part)."""
        start, level, gain = (theta[name] for name in self.names)
        return namespace(start).stack([start, level, gain, gain], axis=1)
