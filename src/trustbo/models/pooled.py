"""The paper's one-robot form (3)-(4): all robots share one set of parameters."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from trustbo.errors import TrustboError, require_choice
from trustbo.models.effects.effect import EFFECTS, MEMORIES, Effect
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.model import TrustModel, register, sample
from trustbo.models.params import DeviationParams, TrustParams


@register
@dataclass(frozen=True, repr=False)
class PooledTrust(TrustModel):
    """One set of parameters for all robots, equations (3)-(4).

    Attributes:
        effects: Effects that add to trust: `PlaceEffect()`, of which `place` is the short form, and
            `RobotEffect()`, of each robot in each mission, and any that is registered.
        memory: Quantity that lasts between bounds: trust, `"level"`, as in the paper, or its
            `"deviation"` from what features and effects expect at a bound. NUTS has it for
            Gaussian rates alone.

    Raises:
        TrustboError: An effect is unknown, or of a kind that the model already has.
    """

    effects: tuple[Effect, ...] = ()  # pyright: ignore[reportIncompatibleVariableOverride]
    memory: str = "level"  # pyright: ignore[reportIncompatibleVariableOverride]

    def __post_init__(self) -> None:
        one = isinstance(self.effects, Effect)
        effects: tuple[Any, ...] = (self.effects,) if one else tuple(self.effects)
        kinds = [type(effect).__name__ for effect in effects]
        if unknown := [e for e in effects if not isinstance(e, (PlaceEffect, *EFFECTS.values()))]:
            raise TrustboError(
                f"effects must be of PlaceEffect() and {', '.join(f'{n}()' for n in EFFECTS)}, "
                f"or of a class that is registered; got {unknown[0]!r}."
            )
        places = [effect for effect in effects if isinstance(effect, PlaceEffect)]
        if len(places) + (self.place is not None) > 1 or len(set(kinds)) < len(kinds):
            raise TrustboError(
                f"effects must be of different kinds; got {effects!r} and place={self.place!r}."
            )
        if places:
            object.__setattr__(self, "place", places[0])
        others = tuple(effect for effect in effects if not isinstance(effect, PlaceEffect))
        object.__setattr__(self, "effects", others)
        require_choice("memory", self.memory, MEMORIES)
        super().__post_init__()

    def sample_params(self, n_robots: int, n_features: int) -> TrustParams:
        """Sample statements of beta0, beta, b, delta_w and delta_v."""
        priors = self.priors
        beta0 = sample("beta0", priors.beta0)
        carried = beta0 if self.memory == "level" else jnp.zeros_like(beta0)
        kind = TrustParams if self.memory == "level" else DeviationParams
        return kind(
            beta0=beta0,
            beta=sample("beta", priors.weights(carried), (n_features,)),
            b=sample("b", priors.intercept(carried)),
            delta_w=sample("delta_w", priors.delta_w),
            delta_v=sample("delta_v", priors.delta_v),
            x0_mean=priors.x0_mean,
            x0_sd=priors.x0_sd,
        )

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of beta0, beta, b, delta_w and delta_v."""
        axes = {"beta0": (), "beta": ("feature",), "b": (), "delta_w": (), "delta_v": ()}
        return axes | self.effect_dims

    @property
    def robot_sets(self) -> str:
        """See `TrustModel.robot_sets`."""
        return "all"
