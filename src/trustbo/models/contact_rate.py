"""The state-space model as a NumPyro distribution, for built-in and custom models."""

from typing import Any, Self

import jax
import jax.numpy as jnp
import numpyro.distributions as dist
from jax import Array, lax, random
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from trustbo.errors import OldName, TrustboError
from trustbo.statespace import Inputs, StateSpace, kalman
from trustbo.statespace.form import independent_robots
from trustbo.statespace.matrices import apply, root


class ContactRate(dist.Distribution):
    """Distribution of contact rates given the drift, equations (3)-(4), with trust integrated out.

    x_k = beta0 x_{k-1} + drift_k + delta_w w_k, y_k = x_k + delta_v v_k, x_0 ~ N(x0_mean, x0_sd^2)

    The batch shape is (mission,) and the event shape is (bound, robot). NaN marks unmeasured rates.
    `drift` may be any function of awareness and other sampled parameters:

    >>> drift = level + most * (1.0 - jnp.exp(-rise * awareness[..., 1]))
    >>> with numpyro.plate("mission", len(drift)):
    ...     rates = ContactRate(drift, beta0, delta_w, delta_v)
    ...     numpyro.sample("contact_rate", rates, obs=contact_rate)

    For robots that influence each other or share noise, see `ContactRate.from_space`.
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("inputs", "space")

    @jax.numpy_rank_promotion("allow")
    def __init__(
        self,
        drift: Array,
        beta0: ArrayLike,
        delta_w: ArrayLike,
        delta_v: ArrayLike,
        x0_mean: ArrayLike = 0.5,
        x0_sd: ArrayLike = 0.5,
    ) -> None:
        """Set the drift and the parameters.

        Args:
            drift: Drift of trust in each bound, shape (mission, bound, robot).
            beta0: Autoregression coefficient, shape () or (robot,).
            delta_w: Standard deviation of the process noise, shape () or (robot,).
            delta_v: Standard deviation of the observation noise, shape () or (robot,).
            x0_mean: Mean of trust before the first bound, shape ().
            x0_sd: Standard deviation of trust before the first bound, shape ().

        Raises:
            TrustboError: The drift or a parameter has another shape.
        """
        values = {"beta0": beta0, "delta_w": delta_w, "delta_v": delta_v}
        values = {name: jnp.asarray(value) for name, value in values.items()}
        drift = jnp.asarray(drift)
        if drift.ndim != 3:
            raise TrustboError(
                f"drift must have the shape (mission, bound, robot); got {drift.shape}. For one "
                "mission, give drift[None]."
            )

        n_robots = drift.shape[2]
        for name, value in values.items():
            if value.ndim and value.shape[-1] not in (1, n_robots):
                raise TrustboError(
                    f"{name} must have the shape () or ({n_robots},), as drift is of the shape "
                    f"(mission, bound, robot) = {drift.shape}; got {value.shape}."
                )

        space = independent_robots(
            values["beta0"].reshape(1, -1),
            values["delta_w"].reshape(1, -1),
            values["delta_v"].reshape(1, -1),
            jnp.asarray(x0_mean),
            jnp.asarray(x0_sd),
        )
        self._set(space, Inputs(drift))

    of = OldName("from_space")

    @classmethod
    def from_space(cls, space: StateSpace, inputs: Inputs) -> Self:
        """Return the distribution for any state-space form.

        Args:
            space: Parameters at one point.
            inputs: Drift and offset, each with shape (mission, bound, robot) or ().
        """
        self = cls.__new__(cls)
        self._set(space, inputs)
        return self

    def _set(self, space: StateSpace, inputs: Inputs) -> None:
        """Set the parameters, and the inputs (mission, bound, group, member)."""
        drift, offset = jnp.broadcast_arrays(*(jnp.asarray(value, float) for value in inputs))
        shape = drift.shape
        grouped = *shape[:2], shape[2] // space.n_members, space.n_members

        self.inputs = Inputs(drift.reshape(grouped), offset.reshape(grouped))
        self.space = space
        dist.Distribution.__init__(self, shape[:1], shape[1:])

    @jax.numpy_rank_promotion("allow")
    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Compute the log density (mission,) of each mission with the Kalman filter.

        Raises TrustboError unless `value` has the shape (mission, bound, robot) of the drift.
        """
        drift, offset = self.inputs
        n_missions, n_bounds, n_groups, n_members = drift.shape
        shape = n_missions, n_bounds, n_groups * n_members
        if jnp.shape(value) != shape:
            raise TrustboError(
                "contact rates must have the shape (mission, bound, robot) of the drift, "
                f"{shape}; got {jnp.shape(value)}."
            )

        rates = jnp.reshape(value, drift.shape)
        by_bound = tuple(jnp.swapaxes(a, 0, 1) for a in (rates, drift, offset))

        def step(belief: kalman.Belief, bound: Any) -> tuple[kalman.Belief, Array]:
            y, u, o = bound
            predicted = kalman.predict(self.space, belief, Inputs(u, o))
            return kalman.update(self.space, predicted, y, y, kalman.GaussianRates())

        start = jax.tree.map(
            lambda a: jnp.broadcast_to(a.astype(float), (n_missions, *a.shape[1:])),
            kalman.initial(self.space, n_groups),
        )
        return lax.scan(step, start, by_bound)[1].sum(0)

    @jax.numpy_rank_promotion("allow")
    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Draw contact rates with shape `(*sample_shape, mission, bound, robot)`."""
        space = self.space
        drift, offset = self.inputs
        shape = *sample_shape, *drift.shape
        w, v, s, e = (random.normal(k, shape) for k in random.split(key, 4))

        d = space.initial_mean + apply(root(space.initial_cov), e[..., 0, :, :])
        rates = []
        for k in range(drift.shape[1]):  # equations (1) and (2)
            noise = apply(root(space.process_cov), w[..., k, :, :])
            d = kalman.step(space.transition, d, drift[:, k]) + noise

            f = d + offset[:, k]
            if space.shared_cov is not None:
                f = f + apply(root(space.shared_cov), s[..., k, :, :])
            rates.append(f + space.noise_sd * v[..., k, :, :])

        drawn = jnp.stack(rates, axis=-3)
        return drawn.reshape(*sample_shape, *self.batch_shape, *self.event_shape)
