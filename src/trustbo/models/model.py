"""What all trust models share: the numpyro model, likelihood, simulation, prior prediction."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import xarray as xr
from jax import Array, lax
from numpy.typing import ArrayLike
from numpyro import handlers
from numpyro.distributions import constraints

from trustbo.data import Mission, default_features
from trustbo.errors import ShapeError, TrustboError, require_choice, require_whole
from trustbo.models import observation as families
from trustbo.models.observation import OBSERVATIONS, SSM, Observed
from trustbo.models.params import Params, check_params
from trustbo.models.priors import Priors
from trustbo.stacking import MissionBatch, stack_missions

RESPONSES = ("level", "change")
N_IMPORTANCE = 32


class ContactRate(dist.Distribution):
    """Joint distribution of a batch of missions' contact rates.

    Batch shape (mission,), event shape (bound, robot). A rate that is NaN counts as not measured.
    Latent trust is integrated out; of families other than the Gaussian, `log_prob` is a weight that
    depends on `noise` and averages to the density (see `observation`).
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("params", "awareness", "exposure", "noise", "weight", "pilot")
    pytree_aux_fields = ("observation", "lag", "shared")

    def __init__(
        self,
        params: Params,
        awareness: Array,
        *,
        exposure: Array | None = None,
        noise: Array | None = None,
        weight: Array | None = None,
        pilot: Array | None = None,
        observation: str = "gaussian",
        lag: float = 0.0,
        shared: bool = False,
    ) -> None:
        """Args as in `TrustModel.__call__`; `noise` and `pilot` are (bound, mission, robot)."""
        self.params, self.awareness, self.exposure = params, awareness, exposure
        self.noise, self.weight, self.pilot = noise, weight, pilot
        self.observation, self.lag, self.shared = observation, lag, shared
        super().__init__(awareness.shape[:1], awareness.shape[1:3])

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density in nats, times the mission's weight; shape (mission,)."""
        observed = self.observed(value)
        noise = jnp.zeros_like(observed.y) if self.noise is None else self.noise
        each = families.log_weight(
            self.observation, self.ssm(), observed, noise, shared=self.shared
        )
        return each.sum(1) * (1.0 if self.weight is None else self.weight)

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Contact rates, shape (*sample_shape, mission, bound, robot)."""
        keys = jax.random.split(key, sample_shape)

        def one(key: Array) -> Array:
            return jnp.swapaxes(self.simulate(key)[1], 0, 1)

        for _ in sample_shape:
            one = jax.vmap(one)
        return one(keys)

    def simulate(self, key: Array) -> tuple[Array, Array]:
        """Latent trust and contact rates, each (bound, mission, robot)."""
        like = self.awareness[..., 0] if self.exposure is None else self.exposure
        return families.simulate(self.observation, self.ssm(), jnp.swapaxes(like, 0, 1), key)

    def ssm(self) -> SSM:
        """The state space of all missions."""
        return self.params.ssm(self.awareness, self.lag)

    def observed(self, value: Array) -> Observed:
        """Rates and exposure, bound first."""
        exposure = jnp.full_like(value, jnp.nan) if self.exposure is None else self.exposure
        return Observed(jnp.swapaxes(value, 0, 1), jnp.swapaxes(exposure, 0, 1), self.pilot)


class TrustSample(NamedTuple):
    """Draws of latent trust and contact rate, each of shape (mission, bound, robot)."""

    trust: np.ndarray
    contact_rate: np.ndarray


@dataclass(frozen=True)
class TrustModel:
    """A trust model; itself a numpyro model, so that `MCMC(NUTS(model))` works.

    Attributes:
        priors: Prior of each parameter; by default those of the family of observations.
        observation: `"gaussian"`, the paper's; `"censored"`, rates of 0 and 1 being limits;
            `"beta_binomial"`, ticks in contact out of `Bound.exposure` ticks, trust being a logit.
        response: Whether the rate measures trust, `"level"`, or its `"change"` since the last bound.

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

    varies_by_robot: ClassVar[bool] = False
    """Whether coefficients vary by robot around common means; see `HierarchicalTrust`."""

    def sample_params(self, n_robots: int, n_features: int) -> Params:
        """Sample statements of the parameters; what they assemble to."""
        raise NotImplementedError

    def level(self, sites: Mapping[str, Array], mean_y: Array, mean_z: Array) -> dict[str, Array]:
        """By how much each intercept lies below the level trust has on average.

        Args:
            sites: The parameters as they are sampled.
            mean_y: Mean rate, or its logit.
            mean_z: Mean awareness, shape (feature,).

        Returns:
            By name of the intercept's site, the part of the mean level that others bring.
        """
        raise NotImplementedError

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of each parameter that a posterior has."""
        raise NotImplementedError

    # --- what all models share ---

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
        """
        n_missions, n_bounds, n_robots, n_features = awareness.shape
        params = self.sample_params(n_robots, n_features)
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
            raise TrustboError(_NO_EXPOSURE)
        ticks = np.broadcast_to(np.asarray(1.0 if exposure is None else exposure), z.shape[:3])
        with jax.enable_x64(True):
            params64 = type(params)(*(jnp.asarray(p, dtype=float) for p in params))
            drawn = _simulate(self.observation, self.lag, params64, z, ticks * 1.0, key)
        return TrustSample(*(np.swapaxes(np.asarray(a), 0, 1) for a in drawn))

    def prior_predictive(
        self,
        awareness: ArrayLike,
        *,
        exposure: ArrayLike | None = None,
        n_draws: int = 500,
        seed: int = 0,
    ) -> xr.DataTree:
        """What the priors say before any mission.

        Args:
            awareness: Shape (mission, bound, robot, feature).
            exposure: Ticks, broadcast to (mission, bound, robot); the beta-binomial family needs
                them.
            n_draws: How many draws.
            seed: Same seed, same draws.

        Returns:
            ArviZ DataTree with the groups `prior` and `prior_predictive` (contact_rate[chain, draw,
            mission, bound, robot]).

        Raises:
            ShapeError: Awareness of other axes.
            TrustboError: No exposure.
        """
        z = np.asarray(awareness, dtype=float)
        if z.ndim != 4:
            raise ShapeError(f"awareness must be (mission, bound, robot, feature); got {z.shape}.")
        if exposure is None and self.observation == "beta_binomial":
            raise TrustboError(_NO_EXPOSURE)
        ticks = np.broadcast_to(np.asarray(1.0 if exposure is None else exposure), z.shape[:3])
        require_whole("n_draws", n_draws, 1)
        with jax.enable_x64(True):
            keys = jax.random.split(jax.random.key(seed), n_draws)
            drawn = {k: np.asarray(v)[None] for k, v in prior_draws(self, z, ticks, keys).items()}
        dims = {**self.dims, "contact_rate": ("mission", "bound", "robot")}
        robots = [f"r{i + 1}" for i in range(z.shape[2])]
        coords = {
            "mission": np.arange(z.shape[0]),
            "bound": np.arange(1, z.shape[1] + 1),
            "robot": robots,
            "robot_": robots,
            "feature": list(default_features(z.shape[3])),
        }

        def group(names: Iterable[str]) -> xr.Dataset:
            variables = {n: (("chain", "draw", *dims[n]), drawn[n]) for n in names}
            used = {d for axes, _ in variables.values() for d in axes} & set(coords)
            index = {"chain": [0], "draw": np.arange(n_draws)}
            return xr.Dataset(variables, {d: coords[d] for d in coords if d in used} | index)

        groups = {"prior": group(self.dims), "prior_predictive": group(["contact_rate"])}
        return xr.DataTree.from_dict(groups)


def register(cls: type[TrustModel]) -> type[TrustModel]:
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
            f"mission {j}, bound {k + 1}, robot {i} has a contact rate but no exposure. {_NO_EXPOSURE}"
        )


_NO_EXPOSURE = (
    "The beta-binomial family counts ticks: give exposure, the number of ticks of each bound "
    "(Mission.from_arrays(..., exposure=...)), or use observation \"censored\"."
)


@partial(jax.jit, static_argnames=("observation", "lag"))
def mission_log_likelihood(
    observation: str,
    lag: float,
    params: Params,
    awareness: Array,
    contact_rate: Array,
    exposure: Array,
    key: Array,
) -> Array:
    """Log p(contact rates of each mission | draw), latent trust integrated out; (draw, mission)."""

    def one(p: Params) -> Array:
        rates = ContactRate(p, awareness, exposure=exposure, observation=observation, lag=lag)
        observed = rates.observed(contact_rate)
        # The same noise for every draw: what is compared does not differ by luck.
        return families.marginal_log_likelihood(
            observation, rates.ssm(), observed, key, N_IMPORTANCE
        )

    return lax.map(one, params, batch_size=256)


@partial(jax.jit, static_argnames=("observation", "lag"))
def _simulate(
    observation: str, lag: float, params: Params, awareness: Array, exposure: Array, key: Array
) -> tuple[Array, Array]:
    rates = ContactRate(params, awareness, exposure=exposure, observation=observation, lag=lag)
    return rates.simulate(key)


@jax.jit
def prior_draws(
    model: TrustModel, awareness: Array, exposure: Array, keys: Array
) -> dict[str, Array]:
    """Parameters and contact rates drawn from the prior, one set per key."""

    def one(key: Array) -> dict[str, Array]:
        seeded = handlers.seed(partial(model, joint=False), key)
        trace = handlers.trace(seeded).get_trace(awareness, exposure=exposure)
        names = (*model.dims, "contact_rate")
        return {name: trace[name]["value"] for name in names}

    return jax.vmap(one)(keys)
