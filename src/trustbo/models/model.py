"""What all trust models share: the numpyro model, likelihood, simulation, prior prediction."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from numpy.typing import ArrayLike

from trustbo.data import Mission
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models import spectral
from trustbo.models.contact_rate import (
    ContactRate,
    TrustSample,
    mission_log_likelihood,
    simulate_missions,
)
from trustbo.models.gram import Statistics, require_forgetting, sufficient_statistics
from trustbo.models.observation import OBSERVATIONS
from trustbo.models.params import Params, TrustParams, check_params
from trustbo.models.priors import Priors
from trustbo.models.spectral import Spectrum
from trustbo.stacking import MissionBatch, stack_missions

RESPONSES = ("level", "change")


@dataclass(frozen=True)
class TrustModel(ABC):
    """A trust model; itself a numpyro model, so that `MCMC(NUTS(model))` works.

    Attributes:
        priors: Prior of each parameter; by default those of the family of observations.
        observation: `"gaussian"`, the paper's; `"censored"`, rates of 0 and 1 being limits;
            `"beta_binomial"`, ticks in contact out of `Bound.exposure` ticks, trust being a logit.
        response: Whether the rate measures trust, `"level"`, or its `"change"` over the bound.

    Raises:
        TrustboError: An unknown name, or `"change"` with the beta-binomial family.
    """

    priors: Priors = None  # pyright: ignore[reportAssignmentType]
    observation: str = "gaussian"
    response: str = "level"

    def __post_init__(self) -> None:
        require_choice("observation", self.observation, OBSERVATIONS)
        require_choice("response", self.response, RESPONSES)
        if self.observation == "beta_binomial" and self.response == "change":
            raise TrustboError(
                'response "change" is not a share of ticks: use observation "gaussian" or '
                '"censored".'
            )
        if self.priors is None:
            object.__setattr__(self, "priors", Priors.default(self.observation))
        elif not isinstance(self.priors, Priors):
            raise TrustboError(f"priors must be a trustbo.models.Priors; got {self.priors!r}.")

    # --- what a model defines ---

    @abstractmethod
    def sample_params(self, n_robots: int, n_features: int) -> Params:
        """Sample statements of the parameters; what they assemble to."""

    @abstractmethod
    def level(self, sites: Mapping[str, Array], mean_y: Array, mean_z: Array) -> dict[str, Array]:
        """By how much each intercept lies below the level trust has on average.

        Args:
            sites: The parameters as they are sampled.
            mean_y: Mean rate, or its logit.
            mean_z: Mean awareness, shape (feature,).

        Returns:
            By name of the intercept's site, the part of the mean level that others bring.
        """

    @property
    @abstractmethod
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of each parameter that a posterior has."""

    @property
    def robot_sets(self) -> str | None:
        """Whose parameters sufficient statistics are gathered of: `"all"` robots, or `"each"`.

        None where there are no such statistics: the exact sampler cannot treat the model.
        """
        return None

    # --- what all models share ---

    @property
    def x0(self) -> dict[str, float]:
        """Mean and sd of trust before the first bound, by name."""
        return {name: float(getattr(self.priors, name)) for name in ("x0_mean", "x0_sd")}

    @property
    def lag(self) -> float:
        """1 where the rate measures the change of trust, else 0."""
        return float(self.response == "change")

    def __call__(
        self,
        awareness: Array,
        contact_rate: Array | None = None,
        *,
        exposure: Array | None = None,
        weight: Array | None = None,
        shared: bool = False,
        joint: bool | None = None,
        pilot: Array | None = None,
        spectrum: Spectrum | None = None,
    ) -> None:
        """The numpyro model.

        Args:
            awareness: Shape (mission, bound, robot, feature).
            contact_rate: Shape (mission, bound, robot), NaN where not measured; None draws it.
            exposure: Ticks, of that shape; the beta-binomial family needs them.
            weight: Of each mission's log density, shape (mission,).
            shared: No rate is missing before the last of a mission.
            joint: Sample the noise that latent trust is made of; by default where it cannot be
                integrated out.
            pilot: See `observation.Observed`.
            spectrum: Sums over complete missions that the pooled Gaussian likelihood is taken from,
                in the place of `contact_rate`.
        """
        n_missions, n_bounds, n_robots, n_features = awareness.shape
        params = self.sample_params(n_robots, n_features)
        if spectrum is not None and isinstance(params, TrustParams):
            numpyro.factor("contact_rate", spectral.log_likelihood(params, spectrum, self.lag))
            return
        noise = None
        if self.observation != "gaussian" if joint is None else joint:
            shape = (n_bounds, n_missions, n_robots)
            noise = numpyro.sample("noise", dist.Normal(0.0, 1.0).expand(shape).to_event(3))
        rates = ContactRate(
            params,
            awareness,
            exposure=exposure,
            noise=noise,
            weight=weight,
            pilot=pilot,
            observation=self.observation,
            lag=self.lag,
            shared=shared,
        )
        with numpyro.plate("mission", n_missions):
            numpyro.sample("contact_rate", rates, obs=contact_rate)

    def log_likelihood(
        self, params: Params, missions: Sequence[Mission], *, seed: int = 0
    ) -> np.ndarray:
        """Log p(contact rates | parameters), latent trust integrated out.

        Exact for Gaussian observations, else importance sampling over 32 antithetic trajectories.
        A density of rates; for censored ones with mass at 0 and 1, for counts a probability.

        Args:
            params: Parameters with leading axes (...,).
            missions: The missions; a contact rate that is NaN was not measured.
            seed: Of the importance sampling.

        Returns:
            Nats, shape (..., mission).

        Raises:
            ShapeError: Parameters of another number of features or robots.
            TrustboError: Awareness that is NaN, a covariance that is not positive definite, or no
                exposure where the family needs it.
        """
        batch = stack_missions(missions)
        check_params(params, batch.awareness.shape[2], batch.awareness.shape[3])
        require_exposure(self, batch)
        leading = params.leading
        with jax.enable_x64(True):
            key = jax.random.key(seed)
            data = (batch.awareness, batch.contact_rate, batch.exposure)
            values = mission_log_likelihood(self.observation, self.lag, params.flat(), *data, key)
        return np.asarray(values)[:, : len(missions)].reshape(*leading, len(missions))

    def simulate(
        self,
        key: Array,
        params: Params,
        awareness: ArrayLike,
        exposure: ArrayLike | None = None,
    ) -> TrustSample:
        """Missions drawn from the model for given parameters.

        Args:
            key: Random key.
            params: Parameters without leading axes.
            awareness: Shape (mission, bound, robot, feature).
            exposure: Ticks of each bound, of shape (mission, bound, robot) or broadcast to it; the
                beta-binomial family needs them.

        Raises:
            ShapeError: Awareness of other axes, parameters with leading axes, or parameters of
                another number of features or robots.
            TrustboError: A covariance that is not positive definite, or no exposure.
        """
        z = np.asarray(awareness, dtype=float)
        if z.ndim != 4 or params.leading:
            raise ShapeError(
                "awareness must be (mission, bound, robot, feature) and the parameters one draw; "
                f"got {z.shape}, and parameters with leading axes {params.leading}."
            )
        check_params(params, z.shape[2], z.shape[3])
        if exposure is None and self.observation == "beta_binomial":
            raise TrustboError(NO_EXPOSURE)
        ticks = np.broadcast_to(np.asarray(1.0 if exposure is None else exposure), z.shape[:3])
        with jax.enable_x64(True):
            params64 = type(params)(*(jnp.asarray(p, dtype=float) for p in params))
            drawn = simulate_missions(self.observation, self.lag, params64, z, ticks * 1.0, key)
        return TrustSample(*(np.swapaxes(np.asarray(a), 0, 1) for a in drawn))

    def update(
        self,
        statistics: Statistics | None,
        missions: Sequence[Mission],
        *,
        forgetting: float = 1.0,
    ) -> Statistics:
        """Sufficient statistics with more missions, for `sample_statistics`.

        Args:
            statistics: Of earlier missions; None for none.
            missions: The new ones.
            forgetting: How much the earlier ones still count, in (0, 1].

        Raises:
            ShapeError: Missions of another number of robots or features.
            TrustboError: A model without such statistics, or a factor outside (0, 1].
        """
        self.require_exact()
        require_forgetting(forgetting)
        new = self.gather(stack_missions(missions))
        if statistics is None:
            return new
        if len(statistics) != len(new):
            raise ShapeError(
                f"the statistics are of {len(statistics)} robots, the missions have {len(new)}."
            )
        return tuple(
            old.scaled(forgetting) + more for old, more in zip(statistics, new, strict=True)
        )

    def gather(self, batch: MissionBatch, weight: np.ndarray | None = None) -> Statistics:
        """Sufficient statistics of a batch, each mission weighted."""
        args = (self.priors.x0_mean, self.lag, weight)
        if self.robot_sets == "all":
            return (sufficient_statistics(batch, *args),)
        n_robots = batch.contact_rate.shape[2]
        apart = [MissionBatch(*(a[:, :, i : i + 1] for a in batch)) for i in range(n_robots)]
        return tuple(sufficient_statistics(one, *args) for one in apart)

    def require_exact(self) -> None:
        """Refuse a model that has no sufficient statistics.

        Raises:
            TrustboError: Observations that are not Gaussian, or robots that share some parameters
                only, or influence each other.
        """
        if self.robot_sets is None or self.observation != "gaussian":
            raise TrustboError(
                'sampler "exact" needs Gaussian observations, and PooledTrust or '
                f'CoupledTrust(inter_robot="none"); got {self.describe()}. Use sampler="nuts".'
            )

    def describe(self) -> str:
        """The model's name and options."""
        options = [f.name for f in fields(self) if f.name != "priors"]
        listed = ", ".join(f'{name}="{getattr(self, name)}"' for name in options)
        return f"{type(self).__name__}({listed})"


def sample(name: str, prior: dist.Distribution, shape: tuple[int, ...] = ()) -> Array:
    """A sample statement of independent parameters of that shape."""
    return numpyro.sample(name, prior.expand(shape).to_event(len(shape)))  # pyright: ignore


def register[Model: TrustModel](cls: type[Model]) -> type[Model]:
    """Make a model a pytree, so that compiled samplers take its priors as data."""
    meta = [f.name for f in fields(cls) if f.name != "priors"]
    return jax.tree_util.register_dataclass(cls, data_fields=["priors"], meta_fields=meta)


def require_exposure(model: TrustModel, batch: MissionBatch) -> None:
    """Refuse missions without ticks if the model counts them.

    Raises:
        TrustboError: A measured rate has no exposure.
    """
    if model.observation != "beta_binomial":
        return
    without = ~np.isnan(batch.contact_rate) & ~(batch.exposure >= 1.0)
    if without.any():
        j, k, i = np.argwhere(without)[0]
        raise TrustboError(
            f"mission {j}, bound {k + 1}, robot {i} has a contact rate but no exposure. "
            f"{NO_EXPOSURE}"
        )


NO_EXPOSURE = (
    "The beta-binomial family counts ticks: give exposure, the number of ticks of each bound "
    '(Mission.from_arrays(..., exposure=...)), or use observation "censored".'
)
