"""The paper's pooled trust model, equations (3)-(4)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpyro.distributions import Distribution
from scipy.linalg import helmert

from trustbo.errors import TrustboError, require_choice
from trustbo.models.backend import namespace
from trustbo.models.contact_rate import ContactRate
from trustbo.models.effects.effect import Theta
from trustbo.models.effects.weights import Weights
from trustbo.models.model import TrustModel
from trustbo.models.signal import Layout, Signal, powers
from trustbo.models.slots import Slots


@dataclass(frozen=True, repr=False)
class PooledTrust(TrustModel):
    """Model with one set of parameters for all robots, equations (3)-(4).

    x_k = beta0 x_{k-1} + beta . z_k + b + delta_w w_k,  y_k = x_k + delta_v v_k

    Attributes:
        memory: Quantity carried over between bounds: `"level"` for trust, as in the paper, or
            `"deviation"` for the deviation of trust from the mean given features and effects.
        shared_noise: Whether the rates of all robots in a bound share the noise delta_s s_k, where
            s_k is standard normal.
    """

    memory: str = "level"  # pyright: ignore[reportIncompatibleVariableOverride]
    shared_noise: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("memory", self.memory, ("level", "deviation"))
        if self.shared_noise not in (0, 1):
            raise TrustboError(f"shared_noise must be True or False; got {self.shared_noise!r}.")
        object.__setattr__(self, "shared_noise", bool(self.shared_noise))

    @property
    def weights(self) -> Weights:
        """See `TrustModel.weights`."""
        return Weights(self.priors)

    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, Distribution]:
        """See `TrustModel.hyperpriors`."""
        names = ("beta0", "delta_w", "delta_v", *("delta_s",) * self.shared_noise)
        return {name: getattr(self.priors, name) for name in names}

    def derived(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """See `TrustModel.derived`."""
        beta0 = values["beta0"]
        rest = 1.0 - beta0 if self.memory == "level" else 0.0 * beta0 + 1.0
        return {**values, "rest": rest}

    def layout(self, slots: Slots, *, contrasts: bool = True) -> Layout:
        """Make one block per robot; if noise is shared, one per contrast of robots or per mission.

        Helmert contrasts of the robots' rates are independent if all robots are measured.
        """
        n = slots.n_robots
        if not self.shared_noise or n == 1:
            return Layout(slots.y.shape)
        seen = ~np.isnan(slots.y)
        if contrasts and self.family.gaussian and (seen.all(2) == seen.any(2)).all():
            return Layout(slots.y.shape, rotation=helmert(n, full=True))
        return Layout(slots.y.shape, joint=True)

    def signal(self, theta: Theta, slots: Slots, layout: Layout) -> Signal:
        """Compute trust at all bounds, with the response T = (1 - beta0 Lag)^-1 to the drift."""
        xp: Any = namespace(theta["beta0"])
        n, K = slots.n_robots, slots.n_bounds
        beta0, delta_w = theta["beta0"][:, None], theta["delta_w"][:, None, None]
        T = powers(theta["beta0"], K)
        start = beta0 ** np.arange(1, K + 1)
        S = delta_w**2 * (T @ xp.swapaxes(T, 1, 2))
        S = S + self.x0["x0_sd"] ** 2 * start[:, :, None] * start[:, None, :]
        m = self.x0["x0_mean"] * start
        if self.memory == "deviation":  # x - u is carried over, and has mean 0 at first
            m, T = 0.0 * m, xp.broadcast_to(xp.eye(K), T.shape)
        m, T, S = m[:, None], T[:, None], S[:, None]
        sd = theta["delta_v"][:, None, None]
        if not self.shared_noise:
            return Signal(m, T, S, sd)
        noise = theta["delta_s"][:, None, None, None] ** 2 * xp.eye(K)
        if layout.joint:
            m, T, S = xp.repeat(m, n, axis=2), xp.kron(T, np.eye(n)), xp.kron(S, np.eye(n))
            return Signal(m, T, S, sd, xp.kron(noise, np.ones((n, n))))
        if n == 1:
            return Signal(m, T, S, sd, noise)
        first = np.array([1.0, 0.0])[:, None]  # only the mean of robots has m and noise
        return Signal(np.sqrt(n) * first * m, T, S, sd, n * first[..., None] * noise)

    def rates(self, theta: Theta, drift: Any) -> ContactRate | None:
        """See `TrustModel.rates`."""
        if self.shared_noise or not self.family.gaussian:
            return None
        beta0, x0 = theta["beta0"][0], self.x0
        if self.memory == "deviation":
            xp = namespace(drift)
            first = xp.full_like(drift[:, :1], x0["x0_mean"])
            drift = drift - beta0 * xp.concatenate([first, drift[:, :-1]], axis=1)
        return ContactRate(drift, beta0, theta["delta_w"][0], theta["delta_v"][0], **x0)

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """See `TrustModel.dims`."""
        axes = {"beta0": (), "beta": ("feature",), "b": (), "delta_w": (), "delta_v": ()}
        return axes | ({"delta_s": ()} if self.shared_noise else {})
