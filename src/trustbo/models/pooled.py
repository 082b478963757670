"""The paper's pooled trust model, equations (3)-(4)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpyro.distributions import Distribution

from trustbo.errors import require_choice, require_switch
from trustbo.models.effects.effect import Theta
from trustbo.models.effects.weights import Weights
from trustbo.models.model import TrustModel
from trustbo.models.observations import Observations
from trustbo.statespace import StateSpace
from trustbo.statespace.form import independent_robots


@dataclass(frozen=True, repr=False)
class PooledTrust(TrustModel):
    """Model with one set of parameters for all robots, equations (3)-(4).

    The trust x_k in a robot and its contact rate y_k in bound k are ::

        x_k = beta0 x_{k-1} + beta . z_k + b + delta_w w_k
        y_k = x_k + g_k delta_v v_k

    with the awareness z_k and independent standard normal w_k and v_k. In the paper, g_k is 1. By
    default, it depends on the predicted line of sight, if there is such a feature; see
    `Priors.f_v`.

    Attributes:
        memory: Quantity carried over between bounds: `"level"` for trust, as in the paper, or
            `"deviation"` for the deviation of trust from the mean given features and effects.
        shared_noise: Whether the rates of all robots in a bound share the noise delta_s s_k, where
            s_k is standard normal.

    Example:
        >>> posterior = tb.fit(missions, tb.models.PooledTrust(family="beta_binomial"))
        >>> posterior["posterior"]["beta"].mean(("chain", "draw"))
    """

    memory: str = "level"  # pyright: ignore[reportIncompatibleVariableOverride]
    shared_noise: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("memory", self.memory, ("level", "deviation"))
        shared_noise = require_switch("shared_noise", self.shared_noise)
        object.__setattr__(self, "shared_noise", shared_noise)

    @property
    def weights(self) -> Weights:
        """See `TrustModel.weights`."""
        return Weights(self.priors)

    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, Distribution]:
        """See `TrustModel.hyperpriors`."""
        names = ["beta0", "delta_w", "delta_v"]
        if self.scales_noise:
            names.append("f_v")
        if self.shared_noise:
            names.append("delta_s")
        return {name: getattr(self.priors, name) for name in names}

    def derived(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """See `TrustModel.derived`."""
        beta0 = values["beta0"]
        if self.memory == "level":
            inverse_gain = 1.0 - beta0
        else:
            inverse_gain = 0.0 * beta0 + 1.0  # ones, in NumPy or JAX
        return {**values, "inverse_gain": inverse_gain}

    @property
    def scales_noise(self) -> bool:
        """See `TrustModel.scales_noise`."""
        return self.priors.f_v is not None and self.likelihood.gaussian and not self.shared_noise

    @property
    def joint(self) -> bool:
        """See `TrustModel.joint`."""
        return self.shared_noise

    @property
    def exchangeable(self) -> bool:
        """See `TrustModel.exchangeable`."""
        return self.shared_noise

    def carried(self, observations: Observations) -> bool | np.ndarray:
        """See `TrustModel.carried`."""
        return self.memory == "level"

    def state_space(self, theta: Theta, n_robots: int) -> StateSpace:
        """See `TrustModel.state_space`; a deviation from the mean initially has mean 0."""
        return independent_robots(
            theta["beta0"],
            theta["delta_w"],
            theta["delta_v"],
            x0_mean=self.x0["x0_mean"] if self.memory == "level" else 0.0,
            x0_sd=self.x0["x0_sd"],
            delta_s=theta["delta_s"] if self.shared_noise else None,
            n_members=n_robots if self.joint else 1,
        )

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """See `TrustModel.dims`."""
        axes = {"beta0": (), "beta": ("feature",), "b": (), "delta_w": (), "delta_v": (), "f_v": ()}
        if self.shared_noise:
            axes["delta_s"] = ()
        return axes
