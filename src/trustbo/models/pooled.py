"""The paper's one-robot form (3)-(4): every robot shares one set of parameters."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import xarray as xr
from jax import Array
from numpy.typing import ArrayLike
from numpyro.distributions import constraints

from trustbo.data import Mission
from trustbo.errors import ShapeError
from trustbo.models import statespace
from trustbo.models.priors import Priors
from trustbo.models.statespace import ScalarSSM
from trustbo.stacking import stack_missions

Numbers = Any
"""A float, a NumPy array, or a JAX array or tracer."""


class TrustParams(NamedTuple):
    """Parameters of the pooled model; leading axes (...,) such as (draw,) are shared by all."""

    beta0: Numbers
    """Autoregression, shape (...,)."""
    beta: Numbers
    """Weights, shape (..., feature)."""
    b: Numbers
    """Intercept, shape (...,)."""
    delta_w: Numbers
    """Standard deviation of the process noise, shape (...,)."""
    delta_v: Numbers
    """Standard deviation of the observation noise, shape (...,)."""
    x0_mean: Numbers = 0.5
    """Mean of trust before the first bound, shape () or (...,)."""
    x0_sd: Numbers = 0.5
    """Its standard deviation, shape () or (...,)."""

    @classmethod
    def from_posterior(cls, posterior: xr.DataTree) -> Self:
        """All draws of a posterior, chains joined: leading axis (draw,)."""
        draws = posterior["posterior"].to_dataset().stack(sample=("chain", "draw"))
        arrays = {name: draws[name].transpose("sample", ...).values for name in SITES}
        return cls(**arrays, **{n: posterior.attrs[n] for n in cls._fields[5:]})

    def draw(self, index: int) -> Self:
        """One draw out of many, with its leading axis dropped."""
        return self._replace(
            **{
                name: np.asarray(value)[index]
                for name, value in zip(self._fields, self, strict=True)
                if np.ndim(value) > (name == "beta")
            }
        )

    def mean(self) -> Self:
        """Mean over all leading axes."""
        beta = np.asarray(self.beta)
        means = {name: float(np.mean(v)) for name, v in zip(self._fields, self, strict=True)}
        return self._replace(**means | {"beta": beta.reshape(-1, beta.shape[-1]).mean(0)})


SITES = TrustParams._fields[:5]
"""The parameters that have a posterior, as their sample sites are called."""


class ContactRate(dist.Distribution):
    """Joint distribution of a batch of missions' contact rates, latent trust integrated out.

    Batch shape (mission,), event shape (bound, robot). A rate that is NaN counts as not measured.
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("params", "awareness")

    def __init__(self, params: TrustParams, awareness: Array) -> None:
        self.params, self.awareness = params, awareness
        super().__init__(awareness.shape[:1], awareness.shape[1:3])

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density in nats, shape (mission,)."""
        filtered = statespace.kalman_filter(self.ssm(), jnp.swapaxes(value, 0, 1))
        return filtered.log_likelihood.sum((0, 2))

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Contact rates, shape (*sample_shape, mission, bound, robot)."""
        keys = jax.random.split(key, sample_shape)

        def one(key: Array) -> Array:
            return jnp.swapaxes(statespace.simulate(self.ssm(), key)[1], 0, 1)

        for _ in sample_shape:
            one = jax.vmap(one)
        return one(keys)

    def ssm(self) -> ScalarSSM:
        """The state space of every robot of every mission; sequence axes (mission, robot)."""
        p = self.params
        drift = jnp.swapaxes(self.awareness @ p.beta + p.b, 0, 1)
        return ScalarSSM(p.beta0, drift, p.delta_w, p.delta_v, p.x0_mean, p.x0_sd)


def pooled_trust(awareness: Array, priors: Priors, contact_rate: Array | None = None) -> None:
    """Trust dynamics (3)-(4) of the paper, latent trust integrated out; a numpyro model.

    Args:
        awareness: Shape (mission, bound, robot, feature).
        priors: Prior of each parameter.
        contact_rate: Shape (mission, bound, robot), NaN where not measured; None draws it.
    """
    n_missions, _, _, n_features = awareness.shape
    params = TrustParams(
        beta0=numpyro.sample("beta0", priors.beta0),
        beta=numpyro.sample("beta", priors.beta.expand((n_features,)).to_event(1)),
        b=numpyro.sample("b", priors.b),
        delta_w=numpyro.sample("delta_w", priors.delta_w),
        delta_v=numpyro.sample("delta_v", priors.delta_v),
        x0_mean=priors.x0_mean,
        x0_sd=priors.x0_sd,
    )
    with numpyro.plate("mission", n_missions):
        numpyro.sample("contact_rate", ContactRate(params, awareness), obs=contact_rate)


class TrustSample(NamedTuple):
    """Draws of latent trust and contact rate, each of shape (mission, bound, robot)."""

    trust: np.ndarray
    contact_rate: np.ndarray


@dataclass(frozen=True)
class PooledTrust:
    """One set of parameters for all robots, equations (3)-(4).

    Attributes:
        priors: Prior of each parameter.
    """

    priors: Priors = field(default_factory=lambda: Priors())

    def log_likelihood(self, params: TrustParams, missions: Sequence[Mission]) -> np.ndarray:
        """Log p(contact rates | parameters), latent trust integrated out.

        Args:
            params: Parameters with leading axes (...,).
            missions: The missions; a contact rate that is NaN was not measured.

        Returns:
            Nats, shape (..., mission).

        Raises:
            ShapeError: `params.beta` has not one weight per feature.
            TrustboError: An awareness value is NaN.
        """
        batch = stack_missions(missions)
        check_features(params, batch.awareness.shape[-1])
        leading = np.shape(params.beta)[:-1]
        flat = broadcast_params(params, leading)
        with jax.enable_x64(True):
            values = mission_log_likelihood(flat, batch.awareness, batch.contact_rate)
        return np.asarray(values)[:, : len(missions)].reshape(*leading, len(missions))

    def simulate(self, key: Array, params: TrustParams, awareness: ArrayLike) -> TrustSample:
        """Missions drawn from the model for given parameters.

        Args:
            key: Random key.
            params: Parameters without leading axes.
            awareness: Shape (mission, bound, robot, feature).

        Raises:
            ShapeError: Awareness of other axes, parameters with leading axes, or `params.beta` has
                not one weight per feature.
        """
        z = np.asarray(awareness, dtype=float)
        if z.ndim != 4 or np.ndim(params.beta0):
            raise ShapeError(
                "awareness must be (mission, bound, robot, feature) and the parameters one draw; "
                f"got {z.shape}, and beta0 of shape {np.shape(params.beta0)}."
            )
        check_features(params, z.shape[-1])
        with jax.enable_x64(True):
            params64 = TrustParams(*(jnp.asarray(p, dtype=float) for p in params))
            x, y = statespace.simulate(ContactRate(params64, jnp.asarray(z)).ssm(), key)
        return TrustSample(*(np.swapaxes(np.asarray(a), 0, 1) for a in (x, y)))


def check_features(params: TrustParams, n_features: int) -> None:
    """Refuse weights that do not match the features.

    Raises:
        ShapeError: The number of features differs from that of `params.beta`.
    """
    n_weights = np.shape(params.beta)[-1] if np.ndim(params.beta) else 0
    if n_weights != n_features:
        raise ShapeError(f"params.beta has {n_weights} weights, but awareness has {n_features} "
                         "features.")  # fmt: skip


def broadcast_params(params: TrustParams, leading: tuple[int, ...]) -> TrustParams:
    """Every parameter with one leading axis (draw,), float64."""
    n = int(np.prod(leading))
    return TrustParams(
        *(
            np.broadcast_to(
                np.asarray(value, dtype=float),
                leading + np.shape(params.beta)[-1:] * (name == "beta"),
            ).reshape(n, *np.shape(params.beta)[-1:] * (name == "beta"))
            for name, value in zip(params._fields, params, strict=True)
        )
    )


@jax.jit
def mission_log_likelihood(params: TrustParams, awareness: Array, contact_rate: Array) -> Array:
    """Log p(contact rates of each mission | draw), latent trust integrated out; (draw, mission)."""
    return jax.vmap(lambda p: ContactRate(p, awareness).log_prob(contact_rate))(params)
