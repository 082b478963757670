"""Effect of a robot in a mission, with a lasting, a slow and a mission-specific part.

For example, a broken detector stays broken, but rain ends. The stationary trust of robot i in
mission m has the additional term l d[i, m], where l is the predicted line of sight. The effects d
of different robots are independent. Over missions, they have the covariance

    cov(d[i, m], d[i, m']) = tau_lasting^2 + tau_slow^2 rho^|m - m'| + tau_mission^2 [m = m'].
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import numpyro.distributions as dist
from numpy.random import Generator
from scipy import sparse

from trustbo.errors import require_positive, require_share
from trustbo.models.effects.effect import LEAST, Effect, Theta, Values
from trustbo.models.observations import Observations
from trustbo.models.scores import Pair
from trustbo.statespace.matrices import namespace


@dataclass(frozen=True)
class RobotEffect(Effect):
    """Effect of a robot in a mission, proportional to the predicted line of sight.

    The drift of robot i in a bound of mission m, with the predicted line of sight l_im, is ::

        u_im = ... + (1 - beta0) l_im d_im

    The effects d_im are in units of stationary trust, that is, of a contact rate, or of a logit for
    the family `"beta_binomial"`: where l_im is 1, stationary trust is higher by d_im. The factor
    1 - beta0 is 1 if the model has `memory="deviation"`, and 1 - B0_ii for `CoupledTrust`, where
    d_im also acts on other robots through B0. Effects of different robots are independent. Over
    missions, they have the covariance ::

        cov(d_im, d_im') = tau_lasting^2 + tau_slow^2 rho^|m - m'| + tau_mission^2 [m = m']

    Without a feature that predicts line of sight, l_im is 1, so the effect is constant during a
    mission.

    Attributes:
        tau_slow: Scale of the half-normal prior on the standard deviation of the slow part.
        tau_mission: Scale of the half-normal prior on the sd of the mission-specific part.
        rho: Correlation of the slow part between consecutive missions.
        tau_lasting: Scale of the half-normal prior on the sd of the part that is the same in all
            missions. With 0, there is no such part.

    Raises:
        TrustboError: If a scale is not positive, `tau_lasting` is negative, or rho is not between 0
            and 1.

    Example:
        >>> model = tb.models.PooledTrust(effects=[tb.models.RobotEffect(rho=0.99)])
        >>> posterior = tb.fit(missions, model)
        >>> posterior["robots"]["robot_effect"].mean(("chain", "draw"))  # (mission, robot)
    """

    tau_slow: float = 0.2
    tau_mission: float = 0.2
    rho: float = 0.9
    tau_lasting: float = 0.3
    names = ("tau_slow", "tau_mission")
    group = "robots"
    variables: ClassVar = {"robot_effect": ("mission", "robot")}

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "rho", require_share("RobotEffect.rho", self.rho, ends=False))
        lasting = require_positive("RobotEffect.tau_lasting", self.tau_lasting, or_zero=True)
        object.__setattr__(self, "tau_lasting", lasting)

    def hyperpriors(self) -> dict[str, dist.Distribution]:
        """See `Effect.hyperpriors`."""
        priors = super().hyperpriors()
        if self.tau_lasting > 0.0:
            priors["tau_lasting"] = dist.HalfNormal(self.tau_lasting)
        return priors

    def pairs(self, observations: Observations) -> list[Pair]:
        """See `Effect.pairs`."""
        return [Pair("tau_slow", "tau_mission")]

    def design(self, observations: Observations) -> Any:
        """Return line of sight in one column per robot and mission; the mission varies fastest."""
        n_missions = observations.n_missions
        n_robots = observations.n_robots
        mission, _, robot = np.indices(observations.contact_rate.shape)
        where = (robot * n_missions + mission).ravel()
        at = np.arange(len(where)), where
        return sparse.csr_array(
            (observations.line_of_sight.ravel(), at), shape=(len(where), n_robots * n_missions)
        )

    def prior(self, theta: Theta, observations: Observations) -> tuple[Any, list[Any]]:
        """Return independent priors for the robots, as a single array if their gain is equal."""
        inverse_gain = theta["inverse_gain"]
        lasting, slow, mission = self._variances(theta)
        value, vector = _correlation_eigen(self.rho, observations.n_missions)
        Q = (vector / (slow * value + mission)[:, None]) @ vector.T

        # The lasting part adds a constant to the covariance (Sherman-Morrison formula).
        q = Q.sum(-1)
        gain = lasting / (1.0 + lasting * q.sum(-1, keepdims=True))
        Q = Q - (gain * q)[:, :, None] * q[:, None]

        if inverse_gain.ndim == 1:
            return None, [Q / inverse_gain[:, None, None] ** 2] * observations.n_robots
        return None, [Q / of_robot[:, None, None] ** 2 for of_robot in inverse_gain.T]

    def to_variables(self, c: np.ndarray, theta: Theta, observations: Observations) -> Values:
        """Return `robot_effect` (draw, mission, robot), the effects d on stationary trust."""
        d = c.reshape(len(c), observations.n_robots, observations.n_missions) / _inverse_gain(theta)
        return {"robot_effect": np.swapaxes(d, 1, 2)}

    def coefficients(self, values: Values, theta: Theta, observations: Observations) -> np.ndarray:
        """See `Effect.coefficients`."""
        d = np.swapaxes(values["robot_effect"], 1, 2) * _inverse_gain(theta)
        return d.reshape(len(d), -1)

    def predict_next(
        self, values: Values, theta: Theta, n: int, rng: Generator | None
    ) -> np.ndarray:
        """See `Effect.predict_next`; the next effect d is drawn given d in all n missions.

        If there are no missions, it is drawn from the prior.
        """
        C = self._covariance(theta, n)
        lasting, slow, mission = self._variances(theta)
        k = lasting + slow * self.rho ** np.arange(n, 0, -1)  # covariance of the next d with the n

        gain = np.linalg.solve(C, k[..., None])[..., 0]
        d = np.einsum("nm,nmi->ni", gain, values["robot_effect"])
        if rng is not None:
            of_one = (lasting + slow + mission)[:, 0]
            variance = np.maximum(of_one - (gain * k).sum(1), 0.0)  # rounding may make it < 0
            d = d + np.sqrt(variance)[:, None] * rng.standard_normal(d.shape)

        return _inverse_gain(theta)[..., 0] * d

    def _covariance(self, theta: Theta, n: int) -> Any:
        """Compute the covariance (point, mission, mission) of one robot's effects d."""
        lasting, slow, mission = (variance[..., None] for variance in self._variances(theta))
        return lasting + slow * _correlation(self.rho, n) + mission * np.eye(n)

    def _variances(self, theta: Theta) -> list[Any]:
        """Return the variances (point, 1) of the lasting, slow and mission-specific parts."""
        xp = namespace(theta["tau_slow"])
        variances = [xp.maximum(theta[name], LEAST)[:, None] ** 2 for name in self.names]
        lasting = (
            theta["tau_lasting"][:, None] ** 2 if "tau_lasting" in theta else 0.0 * variances[0]
        )
        return [lasting, *variances]


def _correlation(rho: float, n: int) -> np.ndarray:
    """Compute the correlation (mission, mission) of the slow part."""
    mission = np.arange(n)
    return rho ** np.abs(mission[:, None] - mission)


@lru_cache(8)
def _correlation_eigen(rho: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the eigenvalues and eigenvectors of the correlation of the slow part."""
    value, vector = np.linalg.eigh(_correlation(rho, n))
    return np.maximum(value, 0.0), vector


def _inverse_gain(theta: Theta) -> np.ndarray:
    """Return the drift (draw, robot or 1, 1) that raises stationary trust by 1."""
    inverse_gain = theta["inverse_gain"]
    return inverse_gain.reshape(len(inverse_gain), -1, 1)
