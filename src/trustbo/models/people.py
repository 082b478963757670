"""Self-reported trust of many persons: the state space of `PooledTrust`, driven by outcomes."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, cast

import numpy as np
import numpyro.distributions as dist

from trustbo.data import levels_of
from trustbo.display import Rows
from trustbo.errors import TrustboError
from trustbo.models.backend import namespace, own_settings
from trustbo.models.effects.effect import Effect, Theta
from trustbo.models.effects.person import PARTS, PersonEffect
from trustbo.models.families import FAMILIES, Family, Levels
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors
from trustbo.models.signal import Layout, Signal, powers
from trustbo.models.slots import Slots

SUCCESS, FAILURE = "success", "failure"
"""Prefixes of the names of features that are outcomes."""


@dataclass(frozen=True, repr=False)
class HumanTrust(PooledTrust):
    """Self-reported trust: a base level plus decaying effects of past outcomes.

    x^k = base^k + d^k,  d^k = beta0 d^{k-1} + gains . inputs^k + delta_w w^k,  d^0 = 0,

    base^k = b + weights . features^k + the person's level; the person's start enters d^1, and the
    person's gains enter d^k. Inputs are the features whose names begin with `success` or `failure`:
    outcomes, which may be scaled by demands. A person is stored as a mission, a step as a bound,
    and a rated task as a robot. `trustbo.logs.read_reports` makes such missions.

    Attributes:
        scale: `"unit"`, numbers in [0, 1], censored at 0 and 1; or `"likert7"`, seven levels with
            cut points halfway between them, and logistic noise with sd delta_v.

    Raises:
        TrustboError: If the scale is unknown, or there are effects other than `PersonEffect`.
    """

    memory: str = "deviation"
    scale: str = "unit"

    def __post_init__(self) -> None:
        levels_of(self.scale)
        object.__setattr__(self, "observation", "censored")  # on the unit scale; see `family`
        if self.priors is None:
            object.__setattr__(self, "priors", _default_priors())
        if not self.effects:
            object.__setattr__(self, "effects", (PersonEffect(),))
        super().__post_init__()
        if [type(effect) for effect in self.effects] != [PersonEffect] or self.shared_noise:
            raise TrustboError(
                f"HumanTrust has effects of persons alone; got effects={self.effects!r}."
            )

    @property
    def columns(self) -> tuple[Effect, ...]:
        """See `TrustModel.columns`: only weights, see `effects.person`."""
        return (self.weights,)

    @cached_property
    def family(self) -> Family:  # pyright: ignore
        """See `TrustModel.family`."""
        levels = levels_of(self.scale)
        return Levels(levels) if levels else FAMILIES["censored"]

    @property
    def effect(self) -> PersonEffect:
        """The effects of persons."""
        return cast(PersonEffect, self.effects[0])

    def slots(self, missions: Any, workspace: Any = None) -> Slots:
        """See `TrustModel.slots`; raises TrustboError if reports are not on the scale."""
        slots, levels = super().slots(missions, workspace), levels_of(self.scale)
        wanted = levels - 1.0 if levels else np.nan
        bad = ~np.isnan(slots.y) & ~np.isclose(slots.n_ticks, wanted, equal_nan=True)
        if bad.any():
            raise TrustboError(
                f"HumanTrust(scale={self.scale!r}) needs reports with n_ticks = {wanted:g} (levels "
                f"less 1), but some have {slots.n_ticks[bad][0]:g}: give the same scale to "
                "read_reports and to HumanTrust."
            )
        return slots

    def layout(self, slots: Slots, *, contrasts: bool = True) -> Layout:
        """See `TrustModel.layout`: a block is a person, with outcomes and the base as inputs."""
        outcomes = [name.startswith((SUCCESS, FAILURE)) for name in slots.features]
        split = np.array([*outcomes, False])  # what beta0 carries on
        return Layout(slots.y.shape, joint=True, split=split, apart=True)

    def signal(self, theta: Theta, slots: Slots, layout: Layout) -> Signal:
        """Trust of all bounds: first the inputs that decay with beta0, then the others."""
        xp: Any = namespace(theta["beta0"])
        lasting = self._lasting(theta, slots)
        parts = self.parts(theta, slots)
        S = theta["delta_w"][:, None, None] ** 2 * (lasting @ xp.swapaxes(lasting, 1, 2))
        S = S[:, None] + parts @ xp.swapaxes(parts, 2, 3)
        base = xp.broadcast_to(np.eye(lasting.shape[1]), lasting.shape)
        T = xp.concatenate([lasting, base], axis=2)[:, None]
        m = 0.0 * lasting[:, None, :, 0]
        return Signal(m, T, S, theta["delta_v"][:, None, None])

    def _lasting(self, theta: Theta, slots: Slots) -> Any:
        """Share of the input at one row that remains at another row, (point, row, row)."""
        xp: Any = namespace(theta["beta0"])
        return xp.kron(powers(theta["beta0"], slots.n_bounds), np.eye(slots.n_robots))

    def parts(self, theta: Theta, slots: Slots) -> Any:
        """Effect of a person's standardised coefficients on trust, (point, mission, row, part)."""
        carried, level = np.zeros((2, *slots.y.shape, len(PARTS)))
        carried[:, 0, :, 0] = 1.0  # start
        level[..., 1] = 1.0
        for i, name in ((2, SUCCESS), (3, FAILURE)):
            first = next((m for m, f in enumerate(slots.features) if f.startswith(name)), None)
            if first is not None:
                carried[..., i] = slots.z[..., first]
        carried, level = (a.reshape(slots.n_missions, -1, len(PARTS)) for a in (carried, level))
        parts = self._lasting(theta, slots)[:, None] @ carried + level
        return parts * self.effect.sds(theta)[:, None, None]

    def persons(
        self, theta: Theta, off: np.ndarray, slots: Slots, rng: np.random.Generator
    ) -> np.ndarray:
        """Draws of the persons' coefficients (draw, mission, part) given their trust.

        `off` (draw, mission, row) is trust minus its mean given the columns.
        """
        W, S = self.parts(theta, slots), self.signal(theta, slots, self.layout(slots)).S
        gain = np.swapaxes(np.linalg.solve(S + 1e-12 * np.eye(S.shape[-1]), W), 2, 3)
        center = np.einsum("djpr,djr->djp", gain, off)
        cov = np.eye(len(PARTS)) - gain @ W
        values, vectors = np.linalg.eigh(cov)
        white = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
        unit = center + np.einsum("djpq,djq->djp", vectors, white)
        return unit * self.effect.sds(theta)[:, None]

    def _rows(self) -> Rows:
        kept = [row for row in super()._rows() if row[0] not in ("rates", "scale")]
        return [("reports", self.scale), *kept]


@cache
def _default_priors() -> Priors:
    """Default priors: long memory, gains of some tenths, and a separate start for each person.

    Trust changes mainly with outcomes, and reports are noisier than contact rates.
    """
    with own_settings():
        return Priors(
            beta0=dist.Beta(4.0, 1.5),
            beta=dist.Normal(0.0, 0.3),
            b=dist.Normal(0.5, 0.5),
            delta_w=dist.HalfNormal(0.03),
            delta_v=dist.HalfNormal(0.15),
            x0_mean=0.0,
            x0_sd=0.0,
        )
