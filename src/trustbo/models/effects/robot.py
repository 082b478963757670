"""Effects of a robot in a mission: a part that stays, and a bad day.

A damaged detector stays; rain is gone tomorrow. The drift of robot i at the bounds of mission m has
a further term l d[i, m], l its predicted line of sight, and d, in units of stationary trust,
independent between robots with covariance over missions

    cov(d[i, m], d[i, m']) = tau_slow^2 rho^|m - m'| + tau_day^2 [m = m'].
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy import sparse

from trustbo.errors import TrustboError, require_positive
from trustbo.models.backend import namespace
from trustbo.models.effects.effect import (
    Columns,
    Effect,
    Fading,
    NextMission,
    Prior,
    Slots,
    Theta,
    hypot,
    register,
    share_of,
)


@register
@dataclass(frozen=True)
class RobotEffect(Effect):
    """Effect of a robot in a mission, proportional to its line of sight.

    Without a feature that predicts line of sight, the effect is a constant of the mission.

    Attributes:
        tau_slow: Scale of the half-normal prior of the sd of what stays.
        tau_day: Scale of the half-normal prior of the sd of what is gone the next mission.
        rho: Correlation of what stays between one mission and the next.

    Raises:
        TrustboError: A scale is not positive, or rho is not between 0 and 1.
    """

    tau_slow: float = 0.2
    tau_day: float = 0.2
    rho: float = 0.9
    names = ("tau_slow", "tau_day")
    noun = "robots"
    variables: ClassVar = {"robot_effect": ("mission", "robot")}

    def __post_init__(self) -> None:
        for name in self.names:
            require_positive(f"RobotEffect.{name}", getattr(self, name))
        if not 0.0 < self.rho < 1.0:
            raise TrustboError(f"RobotEffect.rho must be between 0 and 1; got {self.rho!r}.")

    def group(self, slots: Slots) -> "RobotColumns":
        """See `Effect.group`."""
        index = slots.robot * slots.n_missions + slots.mission
        size = slots.n_robots * slots.n_missions
        where = np.repeat(index, slots.y.shape[1])
        start = np.arange(len(where) + 1)
        columns = sparse.csr_array(
            (slots.line_of_sight.ravel(), where, start), shape=(len(where), size)
        )
        return RobotColumns(columns, self.rho, (slots.n_robots, slots.n_missions))

    def in_short(self) -> str:
        """Text of what the effect is of."""
        return "of robots by mission"

    def ahead(
        self, values: Mapping[str, np.ndarray], theta: Theta, mission: NextMission
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `Effect.ahead`."""
        d, sd = next_mission(values["robot_effect"], theta, self.rho)
        if mission.rng is not None:
            d = d + sd[:, None] * mission.rng.standard_normal(d.shape)
        return mission.by_sight(theta["rest"][:, None] * d)


class RobotColumns(NamedTuple):
    """Line of sight of one robot in one mission, for each pair of them, the mission fastest."""

    columns: Columns
    rho: float
    shape: tuple[int, int]  # robots, missions
    fades = True

    @property
    def joined(self) -> list[slice]:
        """Missions of each robot."""
        n_robots, n = self.shape
        return [slice(i * n, i * n + n) for i in range(n_robots)]

    def prior(self, theta: Theta) -> Prior:
        """Robots alike and independent."""
        n_robots, n_missions = self.shape
        scale, fading = _correlation(theta, self.rho, n_missions)
        xp: Any = namespace(scale)
        sd = xp.abs(theta["rest"]) * scale
        sds = xp.broadcast_to(sd[:, None], (len(sd), n_robots * n_missions))
        return Prior(np.zeros(sds.shape), sds, [fading] * n_robots)

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Effects d on stationary trust, robot_effect (draw, mission, robot)."""
        d = (c / theta["rest"][:, None]).reshape(len(c), *self.shape)
        return {"robot_effect": np.swapaxes(d, 1, 2)}

    def coefficients(self, values: Mapping[str, np.ndarray], theta: Theta) -> np.ndarray:
        """See `ModelGroup.coefficients`."""
        d = np.swapaxes(values["robot_effect"], 1, 2)
        return theta["rest"][:, None] * d.reshape(len(d), -1)


def next_mission(effect: np.ndarray, theta: Theta, rho: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean (draw, robot) and sd (draw,) of d in the mission that follows those of some draws.

    Args:
        effect: Effects d, (draw, mission, robot).
        theta: Hyperparameters tau_slow and tau_day, (draw,).
        rho: Correlation of what stays.
    """
    n_missions = effect.shape[1]
    scale, fading = _correlation(theta, rho, n_missions)
    C, k = fading.correlation(), fading.share[:, None] * rho ** np.arange(n_missions, 0, -1)
    gain = np.linalg.solve(C, k[..., None])[..., 0]
    left = np.maximum(1.0 - (gain * k).sum(1), 0.0)
    return np.einsum("nm,nmi->ni", gain, effect), scale * np.sqrt(left)


def _correlation(theta: Theta, rho: float, n_missions: int) -> tuple[np.ndarray, Fading]:
    """Sd (point,) and correlation of d; never singular, as rho < 1."""
    slow, day = theta["tau_slow"], theta["tau_day"]
    scale = hypot(slow, day)
    return scale, Fading(share_of(slow, scale), rho, n_missions)
