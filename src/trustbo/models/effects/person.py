"""Effects of a person: start, level to which trust returns, and gains by outcomes.

A mission is a person, whose parts last as long as the mission. They are independent, each kind with
a separate sd,

    start ~ N(0, tau_start^2) at the first bound,   level ~ N(0, tau_level^2) at all bounds,
    gains ~ N(0, tau_gain^2), times the inputs of success and of failure.

A person has no other missions: these parts are no columns, but a term of the covariance of the
block, see `HumanTrust.signal`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import sparse

from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Effect, NextMission, Theta, register
from trustbo.models.slots import Slots

PARTS = ["start", "level", "success", "failure"]


@register
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

    def __post_init__(self) -> None:
        for name in self.names:
            require_positive(f"PersonEffect.{name}", getattr(self, name))

    def columns(self, slots: Slots) -> Any:
        """None, see the module."""
        return sparse.csr_array((slots.y.size, 0))

    def prior(self, theta: Theta, slots: Slots) -> tuple[Any, list[Any]]:
        """Of no columns."""
        return None, []

    def sds(self, theta: Theta) -> Any:
        """Sd of each part, (point, part)."""
        start, level, gain = (theta[name] for name in self.names)
        return namespace(start).stack([start, level, gain, gain], axis=1)

    def named(self, c: np.ndarray, theta: Theta, slots: Slots) -> dict[str, np.ndarray]:
        """Parts are drawn given trust, see `HumanTrust.persons`."""
        return {}

    def coefficients(
        self, values: Mapping[str, np.ndarray], theta: Theta, slots: Slots
    ) -> np.ndarray:
        """Of no columns."""
        return np.empty((len(theta["rest"]), 0))

    def ahead(
        self, values: Mapping[str, np.ndarray], theta: Theta, mission: NextMission
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.ahead`: refused, as a start is of one bound; see `predict_reports`."""
        raise TrustboError(
            "effects of persons are of reports: use trustbo.inference.predict_reports."
        )
