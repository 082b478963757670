"""The paper's coupled form (1)-(2): robots that influence each other."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
import numpyro
from jax import Array
from numpyro.distributions import Distribution, LKJCholesky

from trustbo.errors import TrustboError, require_choice
from trustbo.models.model import TrustModel, register, sample
from trustbo.models.params import CoupledParams, Params, RobotParams
from trustbo.models.priors_numpy import draw, draw_lkj_cholesky

INTER_ROBOT = ("full", "none")


@register
@dataclass(frozen=True, repr=False)
class CoupledTrust(TrustModel):
    """Trust model with separate parameters for each robot, equations (1)-(2).

    Attributes:
        inter_robot: `"full"`, the paper's: matrices B0 and B_m, shrunk towards their diagonals by
            `Priors.coupling`, and covariances diag(sd) LKJ diag(sd). `"none"`: diagonals only,
            robots apart.
    """

    inter_robot: str = "full"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("inter_robot", self.inter_robot, INTER_ROBOT)
        if self.place is not None and self.inter_robot == "full":
            raise TrustboError(
                f'effects of places need inter_robot="none"; got {self.inter_robot!r}. Give '
                "place=None."
            )

    def sample_params(self, n_robots: int, n_features: int) -> Params:
        """Sample statements; see the class for the coupling of the robots."""
        if self.inter_robot == "full":
            return self._sample_full(n_robots, n_features)
        priors, robot = self.priors, (n_robots,)
        beta0 = sample("beta0", priors.beta0, robot)
        return RobotParams(
            beta0=beta0,
            beta=sample("beta", priors.weights(beta0), (n_robots, n_features)),
            b=sample("b", priors.intercept(beta0), robot),
            delta_w=sample("delta_w", priors.delta_w, robot),
            delta_v=sample("delta_v", priors.delta_v, robot),
            x0_mean=priors.x0_mean,
            x0_sd=priors.x0_sd,
        )

    def _sample_full(self, n_robots: int, n_features: int) -> CoupledParams:
        priors, off = self.priors, n_robots * (n_robots - 1)
        beta0 = sample("B0_diagonal", priors.beta0, (n_robots,))
        B0 = _matrix(beta0, sample("B0_coupling", priors.coupling, (off,)))
        # (robot, feature): a prior that differs by feature has it last.
        diagonal = sample("B_diagonal", priors.weights(beta0), (n_robots, n_features)).T
        B = _matrix(diagonal, sample("B_coupling", priors.coupling, (n_features, off)))
        return CoupledParams(
            B0=numpyro.deterministic("B0", B0),
            B=numpyro.deterministic("B", B),
            b=sample("b", priors.intercept(beta0), (n_robots,)),
            Delta_w=self._covariance("w", priors.delta_w, n_robots),
            Delta_v=self._covariance("v", priors.delta_v, n_robots),
            x0_mean=priors.x0_mean,
            x0_sd=priors.x0_sd,
        )

    def _covariance(self, noise: str, sd_prior: Distribution, n_robots: int) -> Array:
        sd = sample(f"delta_{noise}", sd_prior, (n_robots,))
        factor = jnp.eye(n_robots)
        if n_robots > 1 and self._correlates(noise):
            lkj = LKJCholesky(n_robots, self.priors.concentration)
            factor = jnp.asarray(numpyro.sample(f"corr_{noise}", lkj))
        factor = sd[:, None] * factor
        return jnp.asarray(numpyro.deterministic(f"Delta_{noise}", factor @ factor.T))

    def draw_prior(
        self, shape: tuple[int, int], n: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """See `TrustModel.draw_prior`."""
        (n_robots, n_features), priors = shape, self.priors
        shapes = {"beta": (n_robots, n_features)}
        drawn = priors.of_stationary({
            name: draw(getattr(priors, name), (n, *shapes.get(name, (n_robots,))), rng)
            for name in RobotParams._fields[:5]
        })  # fmt: skip
        if self.inter_robot != "full":
            return drawn
        off, diagonal = n_robots * (n_robots - 1), np.swapaxes(drawn["beta"], 1, 2)
        return {
            "B0": _matrix(drawn["beta0"], draw(priors.coupling, (n, off), rng)),
            "B": _matrix(diagonal, draw(priors.coupling, (n, n_features, off), rng)),
            "b": drawn["b"],
            "Delta_w": self._draw_covariance("w", drawn["delta_w"], rng),
            "Delta_v": self._draw_covariance("v", drawn["delta_v"], rng),
        }

    def _draw_covariance(self, noise: str, sd: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        factor = np.eye(sd.shape[-1])
        if self._correlates(noise):
            factor = draw_lkj_cholesky(self.priors.concentration, sd.shape, rng)
        factor = sd[..., None] * factor
        return factor @ np.swapaxes(factor, 1, 2)

    def _correlates(self, noise: str) -> bool:
        # Rates that are independent given trust have noise without correlations.
        return noise == "w" or self.family.correlates

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of the matrices, or of each robot's coefficients if robots are apart."""
        if self.inter_robot == "full":
            return {name: CoupledParams.AXES[name] for name in CoupledParams._fields[:5]}
        return {name: RobotParams.AXES[name] for name in RobotParams._fields[:5]} | self.place_dims

    def prior_terms(self, sites: Mapping[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`: diagonals, off-diagonals and noises, correlations apart."""
        if self.inter_robot == "none":
            return super().prior_terms(sites)
        n = sites["b"].shape[-1]
        off = ~np.eye(n, dtype=bool)
        diagonal = {name: np.einsum("...ii->...i", sites[name]) for name in sites if name != "b"}
        return {
            "B0": ("beta0", diagonal["B0"]),
            "B0_coupling": ("coupling", sites["B0"][..., off]),
            "B": ("beta", np.swapaxes(diagonal["B"], -1, -2)),
            "B_coupling": ("coupling", sites["B"][..., off]),
            "b": ("b", sites["b"]),
            "delta_w": ("delta_w", np.sqrt(diagonal["Delta_w"])),
            "delta_v": ("delta_v", np.sqrt(diagonal["Delta_v"])),
        }

    @property
    def robot_sets(self) -> str:
        """See `TrustModel.robot_sets`."""
        return "each" if self.inter_robot == "none" else "coupled"


def _matrix(diagonal: Any, off_diagonal: Any) -> Any:
    """Square matrices of a diagonal (..., robot) and the other entries, row by row."""
    xp = np if isinstance(diagonal, np.ndarray) else jnp
    n = diagonal.shape[-1]
    place = np.diag(np.arange(n))
    place[~np.eye(n, dtype=bool)] = np.arange(n, n * n)
    return xp.concatenate([diagonal, off_diagonal], axis=-1)[..., place]
