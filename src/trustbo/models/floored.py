"""A prior cut off below a floor: that of delta_v, below the resolution of the rates."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax, random
from numpyro.distributions import Distribution, constraints
from numpyro.distributions.transforms import Transform, biject_to


class _AboveFloor(type(constraints.greater_than(0.0))):
    """Constraint x > floor, whose unconstrained coordinate is log sqrt(x^2 - floor^2)."""


class _HypotTransform(Transform):
    """x -> sqrt(floor^2 + exp(2x)).

    A variance is then a floor plus exp(2x): the noises' coordinates see the sum of two variances.
    """

    domain = constraints.real  # pyright: ignore
    sign = 1  # pyright: ignore

    def __init__(self, low: Array) -> None:
        self.low = low

    @property
    def codomain(self) -> constraints.Constraint:  # pyright: ignore
        return _AboveFloor(self.low)

    def __call__(self, x: Array) -> Array:
        return jnp.hypot(self.low, jnp.exp(x))

    def _inverse(self, y: Array) -> Array:
        return 0.5 * (jnp.log(y - self.low) + jnp.log(y + self.low))

    def log_abs_det_jacobian(self, x: Array, y: Array, intermediates: object = None) -> Array:
        return 2.0 * x - jnp.log(y)

    def tree_flatten(self) -> tuple[object, object]:
        return (self.low,), (("low",), {})


@biject_to.register(_AboveFloor)
def _to_above_floor(constraint: _AboveFloor) -> Transform:
    return _HypotTransform(constraint.lower_bound)  # pyright: ignore[reportArgumentType]


class Floored(Distribution):
    """A prior of a standard deviation, given that it is at least `low`."""

    arg_constraints = {"low": constraints.positive}  # noqa: RUF012
    pytree_data_fields = ("base", "low", "log_above", "moment_below", "_support")

    def __init__(self, base: Distribution, low: float, below: tuple[float, float]) -> None:
        """Truncate `base` at `low`, given the moments of the part below.

        Args:
            base: Scalar prior on (0, inf) or part of it.
            low: Floor, above 0.
            below: Integrals of the density, and of x times the density, up to the floor.
        """
        self.base, self.low = base, np.asarray(low)
        self.log_above, self.moment_below = np.log1p(-below[0]), np.asarray(below[1])
        high = getattr(base.support, "upper_bound", None)
        self._support = _AboveFloor(self.low) if high is None else constraints.interval(low, high)
        super().__init__()

    @constraints.dependent_property(is_discrete=False, event_dim=0)  # pyright: ignore
    def support(self) -> constraints.Constraint:  # pyright: ignore
        """Numbers above the floor."""
        return self._support  # pyright: ignore

    @property
    def mean(self) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Mean, infinite where that of the prior is."""
        return (self.base.mean - self.moment_below) / jnp.exp(self.log_above)

    def log_prob(self, value: Array) -> Array:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Log density, normalised above the floor."""
        return jnp.where(value < self.low, -jnp.inf, self.base.log_prob(value) - self.log_above)

    def sample(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, key: Array, sample_shape: tuple[int, ...] = ()
    ) -> Array:
        """Draws, by rejection."""

        def again(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            key, x = carry
            key, now = random.split(key)
            return key, jnp.where(x < self.low, self.base.sample(now, sample_shape), x)

        start = (key, self.base.sample(key, sample_shape))
        return lax.while_loop(lambda carry: (carry[1] < self.low).any(), again, start)[1]  # pyright: ignore
