"""The state-space model as a NumPyro distribution, for built-in and custom models."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax import Array, lax, random
from jax.typing import ArrayLike
from numpyro.distributions import constraints

from trustbo.display import joined
from trustbo.errors import TrustboError, require_list
from trustbo.models.effects.effect import Effect, SampledEffect
from trustbo.models.observations import median_resolution
from trustbo.statespace import Inputs, StateSpace, kalman
from trustbo.statespace.form import coupled_robots, independent_robots
from trustbo.statespace.matrices import apply, root


class DriftMismatchError(TrustboError):
    """Error for an argument of `ContactRate` whose shape does not fit that of the drift.

    Attributes:
        drift: Shape of the drift, which may be the one that is wrong.
    """

    def __init__(self, message: str, drift: tuple[int, ...] = ()) -> None:
        super().__init__(message)
        self.drift = drift


class ParameterShapeError(DriftMismatchError):
    """Error for a parameter of `ContactRate` that has neither one value nor one of each robot."""


class ContactRate(dist.Distribution):
    """Distribution of contact rates given the drift, with trust integrated out.

    Trust x_k and contact rates y_k in bound k are ::

        d_k = beta0 d_{k-1} + drift_k + delta_w w_k,    d_0 ~ N(x0_mean, x0_sd^2)
        x_k = d_k + offset_k
        y_k = x_k + noise_scale_k delta_v v_k + delta_s s_k

    These are equations (3)-(4) of the paper, in which noise_scale is 1. If beta0, delta_w or
    delta_v is a matrix, they are (1)-(2). The batch shape is (mission,) and the event shape is
    (bound, robot). NaN marks rates that were not measured.

    To define your own model, pass `tb.fit` or `tb.Campaign` a function with this distribution at
    the site `contact_rate`. `drift` can be any JAX function of the inputs and of sampled variables.

    The function is called with the inputs that its parameters name: awareness (mission, bound,
    robot, feature); contact_rate, n_ticks and duration in s (mission, bound, robot); cell (mission,
    bound, 2), with rows and columns; bound (mission, bound, 3), with moves, rows and columns; and
    features, the names of the features. Missions and bounds are padded; in the padding, rates are
    NaN, indices are -1, and other inputs are 0. Ticks and durations that are not known, for example
    before a mission, are NaN. For planning, the drift of a bound may depend only on the awareness,
    cell and move of this bound. Sample variables that differ between missions within the plate of
    missions.

    Example:
        >>> def saturating(awareness, features, contact_rate=None):
        ...     sight = awareness[..., features.index("line_of_sight")]
        ...     rise = numpyro.sample("rise", dist.HalfNormal(0.5))
        ...     with numpyro.plate("robot", awareness.shape[2]):
        ...         level = numpyro.sample("level", dist.Normal(0.2, 0.2))
        ...     beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
        ...     delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.1))
        ...     delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.1))
        ...     drift = level + rise * (1.0 - jnp.exp(-5.0 * sight))
        ...     with numpyro.plate("mission", len(awareness)):
        ...         rates = tb.models.ContactRate(drift, beta0, delta_w, delta_v)
        ...         numpyro.sample("contact_rate", rates, obs=contact_rate)
        >>> posterior = tb.fit(missions, saturating)
    """

    support = constraints.independent(constraints.real, 2)  # pyright: ignore
    pytree_data_fields = ("inputs", "n_ticks", "space", "theta")
    pytree_aux_fields = ("adds_resolution", "effects")

    @jax.numpy_rank_promotion("allow")
    def __init__(
        self,
        drift: ArrayLike,
        beta0: ArrayLike,
        delta_w: ArrayLike,
        delta_v: ArrayLike,
        x0_mean: ArrayLike = 0.5,
        x0_sd: ArrayLike = 0.5,
        *,
        offset: ArrayLike = 0.0,
        delta_s: ArrayLike | None = None,
        n_ticks: ArrayLike | None = None,
        noise_scale: ArrayLike = 1.0,
        effects: Sequence[SampledEffect] = (),
    ) -> None:
        """Set the inputs of bounds and the parameters.

        Args:
            drift: Drift of trust in each bound, shape (mission, bound, robot).
            beta0: Autoregression coefficient, shape () or (robot,), or the matrix B0 (robot,
                robot), whose entry (i, j) is the influence of robot j on robot i.
            delta_w: Standard deviation of the process noise, shape () or (robot,), or the
                covariance matrix (robot, robot).
            delta_v: Standard deviation of the observation noise, shape () or (robot,), or the
                covariance matrix (robot, robot).
            x0_mean: Mean of trust before the first bound, shape () or (robot,).
            x0_sd: Standard deviation of trust before the first bound, shape () or (robot,).
            offset: Input that affects the trust of one bound only, shape () or that of `drift`. A
                model with an offset cannot plan. For memory of deviations, pass all inputs as
                `offset`, with a drift of zeros and x0_mean = 0.
            delta_s: Standard deviation of the noise s that all robots share, shape (), or None.
            n_ticks: Number of ticks of each rate, in the shape of `drift`. A model function passes
                its input `n_ticks`; other values are refused in fits. As in model classes, noise
                with the resolution of the rates (the median of 1 / n_ticks) is then added to
                `delta_v`. Without it, the density is unbounded if all rates can be fitted
                perfectly, for example if all are 1. If every measured rate has a tick count,
                `log_prob` refers to the tick counts, like the log-likelihoods of `fit`; otherwise,
                it is the log density of the rates.
            noise_scale: Factor g of each rate's own noise, shape () or that of `drift`, for noise
                that depends on the bound; see `Priors.f_v`. For planning, it may depend on the same
                inputs as the drift.
            effects: Effects that are added to the drift, such as `[PlaceEffect().sample(),
                RobotEffect().sample()]`. `fit` integrates them out, and then draws them. As they
                belong to several missions, `log_prob` and `sample` are not defined.

        Raises:
            TrustboError: If the drift or a parameter has the wrong shape; if there are effects,
                and an offset, or a matrix as beta0 or noise; or if there is a noise_scale, and a
                matrix as delta_v.
        """
        u = jnp.asarray(drift, float)
        _require_axes(u)
        of_bounds = {"offset": offset, "n_ticks": n_ticks, "noise_scale": noise_scale}
        for name, value in of_bounds.items():
            if value is not None and np.shape(value) not in ((), u.shape):
                raise DriftMismatchError(
                    f"{name} must have the shape (mission, bound, robot) = {u.shape} of the drift; "
                    f"got {np.shape(value)}.",
                    u.shape,
                )

        if delta_s is not None and np.size(delta_s) != 1:
            raise TrustboError(f"delta_s must be one number; got the shape {np.shape(delta_s)}.")

        matrices = {"beta0": beta0, "delta_w": delta_w, "delta_v": delta_v}
        values = {name: _checked(name, v, u.shape, True) for name, v in matrices.items()}
        is_scaled = not (isinstance(noise_scale, int | float) and noise_scale == 1)
        if is_scaled and values["delta_v"].ndim == 2:
            raise TrustboError(
                "noise_scale cannot be combined with a matrix as delta_v, because robots share "
                "this noise; leave one out."
            )
        x0 = {"x0_mean": x0_mean, "x0_sd": x0_sd}
        x0 = {name: _checked(name, v, u.shape, False)[None] for name, v in x0.items()}

        if any(value.ndim == 2 for value in values.values()):
            space = _coupled(values, x0, delta_s, u.shape[2])
        else:
            shared = None if delta_s is None else jnp.reshape(jnp.asarray(delta_s, float), (1,))
            space = independent_robots(
                *(value.reshape(1, -1) for value in values.values()),
                **x0,
                delta_s=shared,
                n_members=1 if shared is None else u.shape[2],
            )
        self._set(space, Inputs(u, offset, noise_scale), n_ticks)
        self.adds_resolution = n_ticks is not None
        self.noises = delta_w, delta_v
        if effects:
            if not (isinstance(offset, int | float) and offset == 0):
                raise TrustboError("effects cannot be combined with an offset; leave one out.")
            self.effects, self.theta = _read_effects(effects, values)

    @classmethod
    def from_space(
        cls, space: StateSpace, inputs: Inputs, n_ticks: ArrayLike | None = None
    ) -> Self:
        """Return the distribution for any state-space form.

        Args:
            space: Parameters at one point.
            inputs: Drift and offset, each with shape (mission, bound, robot) or ().
            n_ticks: Number of ticks of each rate, to whose counts `log_prob` refers. The noise of
                `space` must include that of their resolution.
        """
        self = cls.__new__(cls)
        self._set(space, inputs, n_ticks)
        return self

    def _set(self, space: StateSpace, inputs: Inputs, n_ticks: ArrayLike | None) -> None:
        """Set the parameters, and the inputs (mission, bound, group, member)."""
        given = jnp.broadcast_arrays(*(jnp.asarray(value, float) for value in inputs))
        shape = given[0].shape
        grouped = *shape[:2], shape[2] // space.n_members, space.n_members

        self.inputs = Inputs(*(value.reshape(grouped) for value in given))
        self.n_ticks = None if n_ticks is None else jnp.broadcast_to(jnp.asarray(n_ticks), shape)
        self.space = space
        self.adds_resolution = False
        self.noises: tuple[Any, ...] = ()  # arguments delta_w and delta_v, where they are known
        self.effects: tuple[Effect, ...] = ()
        self.theta: dict[str, Any] = {}  # hyperparameters of the effects; see `effects.Theta`
        dist.Distribution.__init__(self, shape[:1], shape[1:])

    def _require_no_effects(self, what: str) -> None:
        """Raise TrustboError if there are effects, which belong to several missions."""
        if self.effects:
            raise TrustboError(
                f"a ContactRate with effects has no {what} of single missions; fit the function "
                "with trustbo.fit, which integrates the effects out and draws rates."
            )

    @property
    def space_with_resolution(self) -> StateSpace:
        """State space of the rates: `space` with the noise of their resolution."""
        if not self.adds_resolution:
            return self.space
        return self.space.with_noise(median_resolution(self.n_ticks))

    def given(self, effects: ArrayLike) -> "ContactRate":
        """Return the distribution given the effects on the drift (mission, bound, robot)."""
        drift = self.inputs.drift
        inputs = self.inputs._replace(drift=drift + jnp.reshape(jnp.asarray(effects), drift.shape))
        flat = Inputs(*(value.reshape(*value.shape[:2], -1) for value in inputs))
        return ContactRate.from_space(self.space_with_resolution, flat, self.n_ticks)

    def log_resolution(self, value: Array) -> Array:
        """Compute the log ratio (mission,) of the probability of tick counts to a density.

        One tick has the width 1 / n_ticks. The ratio is 0 if a measured rate has no tick count.
        """
        if self.n_ticks is None:
            return jnp.zeros(self.batch_shape)

        is_measured = ~jnp.isnan(value)
        is_counted = self.n_ticks > 0.0
        every = (is_counted | ~is_measured).all()
        ratio = jnp.where(is_measured & is_counted, -jnp.log(self.n_ticks), 0.0).sum((1, 2))
        return jnp.where(every, ratio, 0.0)

    @jax.numpy_rank_promotion("allow")
    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Compute the log density (mission,) of each mission with the Kalman filter.

        With `n_ticks`, it is the log probability of the tick counts.

        Raises TrustboError if there are effects, or unless `value` has the shape (mission, bound,
        robot) of the drift.
        """
        self._require_no_effects("density")
        n_missions, n_bounds, n_groups, n_members = self.inputs.drift.shape
        shape = n_missions, n_bounds, n_groups * n_members
        if jnp.shape(value) != shape:
            raise TrustboError(
                "contact rates must have the shape (mission, bound, robot) of the drift, "
                f"{shape}; got {jnp.shape(value)}."
            )

        rates = jnp.reshape(value, self.inputs.drift.shape)
        by_bound = tuple(jnp.swapaxes(a, 0, 1) for a in (rates, *self.inputs))

        space = self.space_with_resolution

        def step(belief: kalman.Belief, bound: Any) -> tuple[kalman.Belief, Array]:
            y, *inputs = bound
            predicted = kalman.predict(space, belief, Inputs(*inputs))
            no_ticks = y  # any array of this shape
            return kalman.update(space, predicted, y, no_ticks, kalman.GaussianRates())

        start = jax.tree.map(
            lambda a: jnp.broadcast_to(a.astype(float), (n_missions, *a.shape[1:])),
            kalman.initial(space, n_groups),
        )
        return lax.scan(step, start, by_bound)[1].sum(0) + self.log_resolution(value)

    @jax.numpy_rank_promotion("allow")
    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Draw contact rates with shape `(*sample_shape, mission, bound, robot)`.

        Raises TrustboError if there are effects.
        """
        self._require_no_effects("draws")
        space = self.space_with_resolution
        shape = *sample_shape, *self.inputs.drift.shape
        w, v, s, e = (random.normal(k, shape) for k in random.split(key, 4))

        def step(d: Array, bound: Any) -> tuple[Array, Array]:  # equations (1) and (2)
            u, o, g, process, shared, own = bound
            d = kalman.step(space.transition, d, u) + apply(root(space.process_cov), process)
            f = d + o
            if space.shared_cov is not None:
                f = f + apply(root(space.shared_cov), shared)
            return d, f + g * space.noise_sd * own

        def by_bound(values: Array) -> Array:
            return jnp.moveaxis(values, -3, 0)

        d = space.initial_mean + apply(root(space.initial_cov), e[..., 0, :, :])
        bounds = tuple(by_bound(values) for values in (*self.inputs, w, s, v))
        _, rates = lax.scan(step, jnp.broadcast_to(d, e[..., 0, :, :].shape), bounds)

        drawn = jnp.moveaxis(rates, 0, -3)
        return drawn.reshape(*sample_shape, *self.batch_shape, *self.event_shape)


def _read_effects(
    effects: Sequence[SampledEffect], values: Mapping[str, Array]
) -> tuple[tuple[Effect, ...], dict[str, Any]]:
    """Return effects and their hyperparameters by name, with `inverse_gain`; see `Theta`."""
    remedy = "give objects like PlaceEffect().sample()"
    given = require_list("effects", effects, SampledEffect, remedy)
    kinds = [type(one.effect).__name__ for one in given]
    if len(set(kinds)) < len(kinds):
        raise TrustboError(f"effects must be of different classes; got {joined(kinds)}.")

    matrices = [name for name, value in values.items() if value.ndim == 2]
    if matrices:
        raise TrustboError(
            f"effects need a {matrices[0]} of the shape () or (robot,); got a matrix."
        )

    inverse_gain = 1.0 - values["beta0"]
    theta = {name: value for one in given for name, value in one.values.items()}
    theta["inverse_gain"] = inverse_gain[0] if inverse_gain.shape == (1,) else inverse_gain
    return tuple(one.effect for one in given), theta


def _require_axes(drift: Array) -> None:
    """Raise TrustboError unless a drift has the axes of missions, bounds and robots."""
    remedy = {
        2: " For one mission, give drift[None]. If the axis of the robots is missing, add it: "
        "drift[..., None] + jnp.zeros(n_robots).",
        4: " Sum over the features, for example awareness @ weights.",
    }
    if drift.ndim != 3:
        raise TrustboError(
            f"drift must have the shape (mission, bound, robot); got {drift.shape}."
            f"{remedy.get(drift.ndim, '')}"
        )


def _checked(name: str, value: ArrayLike, shape: tuple[int, ...], may_be_matrix: bool) -> Array:
    """Return a parameter as an array of floats; raise TrustboError if its shape is wrong.

    `shape` is that of the drift.
    """
    n_robots = shape[2]
    array = jnp.asarray(value, float)
    allowed: list[tuple[int, ...]] = [(), (1,), (n_robots,)]
    if may_be_matrix:
        allowed.append((n_robots, n_robots))
    if array.shape not in allowed:
        shapes = f"() or ({n_robots},)"
        if may_be_matrix:
            shapes = f"(), ({n_robots},) or ({n_robots}, {n_robots})"
        raise ParameterShapeError(
            f"{name} must have the shape {shapes}, as the drift has {n_robots} robots; got "
            f"{array.shape}.",
            shape,
        )
    return array


def _coupled(
    values: dict[str, Array], x0: dict[str, Array], delta_s: ArrayLike | None, n_robots: int
) -> StateSpace:
    """Return the form of robots that influence each other or have correlated noise."""
    identity = jnp.eye(n_robots)

    def matrix(name: str, *, squared: bool) -> Array:
        value = values[name]
        if value.ndim == 2:
            return value
        return identity * (value**2 if squared else value)

    noise = matrix("delta_v", squared=True)
    if delta_s is not None:
        noise = noise + jnp.reshape(jnp.asarray(delta_s, float), ()) ** 2
    return coupled_robots(
        matrix("beta0", squared=False)[None],
        matrix("delta_w", squared=True)[None],
        noise[None],
        x0["x0_mean"],
        x0["x0_sd"],
    )
