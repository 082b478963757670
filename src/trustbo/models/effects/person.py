"""Effects of a person: start, level to which trust returns, and gains by outcomes.

A mission is a person, whose effects last as long as the mission. Coefficients are independent, each
kind with a separate sd,

    start ~ N(0, tau_start^2) at the first bound,   level: (1 - beta0) N(0, tau_level^2) at all,
    gains ~ N(0, tau_gain^2), times the inputs of success and of failure.

A person has no other missions: the columns touch one block of the evidence each, and are integrated
out there (`inference.evidence.blocks`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy import sparse

from trustbo.errors import TrustboError, require_positive
from trustbo.models.effects.effect import (
    Columns,
    Effect,
    NextMission,
    Prior,
    Slots,
    Theta,
    register,
)

KINDS = ["start", "level", "success", "failure"]


@register
@dataclass(frozen=True)
class PersonEffect(Effect):
    """Effects of persons, who are missions.

    Attributes:
        tau_start: Scale of the half-normal prior of the sd of trust at the first bound.
        tau_level: Scale of that of the level to which trust returns.
        tau_gain: Scale of that of the gains by success and by failure.
        own: Whether persons have levels and gains; else their starts alone differ.
        success: Index of the feature that a person's gain by success multiplies; -1: none.
        failure: The same for failure.
        asymmetric: Whether both gains are apart; else one is minus the other.

    Raises:
        TrustboError: A scale is not positive.
    """

    tau_start: float = 0.3
    tau_level: float = 0.2
    tau_gain: float = 0.2
    own: bool = True
    success: int = -1
    failure: int = -1
    asymmetric: bool = True
    names = ("tau_start", "tau_level", "tau_gain")
    noun = "persons"
    variables: ClassVar = {"person": ("mission", "part")}
    coords: ClassVar = {"part": KINDS}

    def __post_init__(self) -> None:
        for name in ("tau_start", "tau_level", "tau_gain"):
            require_positive(f"PersonEffect.{name}", getattr(self, name))
        super().__post_init__()
        has_gains = self.own and max(self.success, self.failure) >= 0
        names = ("tau_start", *("tau_level",) * self.own, *("tau_gain",) * has_gains)
        object.__setattr__(self, "names", names)  # the others are of nothing

    def group(self, slots: Slots) -> "PersonColumns":
        """See `Effect.group`."""
        values = np.zeros((*slots.y.shape, len(KINDS)))
        values[:, 0, 0] = 1.0
        if self.own:
            values[:, :, 1] = 1.0
            gains = self.gains(slots.z)
            values[:, :, 2:] = gains
        return PersonColumns(values, slots.mission, slots.n_missions, self)

    def gains(self, z: np.ndarray) -> np.ndarray:
        """Inputs of the two gains (..., 2) of features (..., feature)."""
        none = np.zeros(z.shape[:-1])
        success = z[..., self.success] if self.success >= 0 else none
        failure = z[..., self.failure] if self.failure >= 0 else none
        if self.asymmetric:
            return np.stack([success, failure], axis=-1)
        return np.stack([success - failure, none], axis=-1)

    def in_short(self) -> str:
        """Text of what the effect is of."""
        return "of persons" if self.own else "of persons, their start"

    def ahead(
        self, values: Mapping[str, np.ndarray], theta: Theta, mission: NextMission
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.ahead`: refused, as a start is of one bound; see `predict_reports`."""
        raise TrustboError(
            "effects of persons are of reports: use trustbo.inference.predict_reports."
        )


class PersonColumns(NamedTuple):
    """Columns of each person, the parts of `KINDS` fastest."""

    values: np.ndarray  # (chain, bound, part)
    mission: np.ndarray  # (chain,)
    n_missions: int
    effect: PersonEffect
    joined = ()
    fades = False

    @property
    def n_columns(self) -> int:
        """Number of columns of a person."""
        return self.values.shape[2]

    @property
    def columns(self) -> Columns:
        """See `Group.columns`."""
        n, K, L = self.values.shape
        at = (self.mission[:, None, None] * L + np.arange(L)).repeat(K, axis=1).reshape(-1)
        start = np.arange(n * K + 1) * L
        return sparse.csr_array(
            (self.values.reshape(-1), at, start), shape=(n * K, self.n_missions * L)
        )

    def sds(self, theta: Theta) -> np.ndarray:
        """Sd of each part's coefficient, (point, part)."""
        start, rest = theta["tau_start"], np.abs(theta["rest"])
        none = np.zeros_like(start)
        level, gain = theta.get("tau_level", none), theta.get("tau_gain", none)
        other = gain if self.effect.asymmetric else none
        return np.stack([start, rest * level, gain, other], axis=1)

    def prior(self, theta: Theta) -> Prior:
        """Independent parts."""
        sd = np.tile(self.sds(theta), (1, self.n_missions))
        return Prior(np.zeros(sd.shape), sd)

    def name(
        self, c: np.ndarray, theta: Theta, rng: np.random.Generator | None = None
    ) -> dict[str, np.ndarray]:
        """Parts by person, (draw, mission, part); levels in units of stationary trust."""
        d = c.reshape(len(c), self.n_missions, -1).copy()
        d[:, :, 1] /= theta["rest"][:, None]
        return {"person": d}

    def coefficients(self, values: Mapping[str, np.ndarray], theta: Theta) -> np.ndarray:
        """See `ModelGroup.coefficients`."""
        d: Any = values["person"].copy()
        d[:, :, 1] *= theta["rest"][:, None]
        return d.reshape(len(d), -1)
