"""Custom drift: its function, the axes of its parameters, and their values.

A file cannot hold a function. A posterior stores its name and its values at one point: the function
is searched among those that this process has built a model with, and identified by these values.
Nothing that a file names is imported.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from trustbo.errors import ShapeError, TrustboError
from trustbo.models.backend import own_settings

_LEAST = 16  # bounds evaluated at once; more in powers of two, so that compiled code is reused
_KNOWN: dict[str, list["DriftForm"]] = {}


@dataclass(frozen=True)
class DriftForm:
    """Function u = `drift(z, **theta)` of one bound, z (robot, feature), u (robot,).

    Attributes:
        function: JAX function.
        axes: Axes, `"robot"` and `"feature"`, of each argument but z, by name.
    """

    function: Callable[..., Any]
    axes: tuple[tuple[str, tuple[str, ...]], ...]

    @property
    def name(self) -> str:
        """Module and name of the function."""
        return name_of(self.function)

    def keep(self) -> Self:
        """Remember the form, for posteriors to find it."""
        forms = _KNOWN.setdefault(self.name, [])
        if self not in forms:
            forms.append(self)
        return self

    def __call__(self, z: Any, theta: Mapping[str, Any]) -> Any:
        """Drift of one bound; ShapeError: it has another shape than (robot,)."""
        u = self.function(z, **theta)
        if jnp.shape(u) != z.shape[:1]:
            raise ShapeError(
                f"the drift {self.name} must give one number for each robot, shape "
                f"({z.shape[0]},), for z (robot, feature) = {z.shape}; it gives {jnp.shape(u)}."
            )
        return u

    def mark(self, shape: tuple[int, int]) -> list[float]:
        """Drift of each robot at one point of awareness (robot, feature): its fingerprint."""

        def ramp(low: float, high: float, shape: tuple[int, ...]) -> np.ndarray:
            return np.linspace(low, high, int(np.prod(shape))).reshape(shape)

        size = {"robot": shape[0], "feature": shape[1]}
        theta = {
            name: ramp(0.3 + 0.1 * i, 0.8 + 0.1 * i, tuple(size[axis] for axis in axes))
            for i, (name, axes) in enumerate(self.axes)
        }
        return Drift(self, theta, shape[1]).values(ramp(0.05, 0.95, (1, *shape)))[0].tolist()


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Drift:
    """Function with values of its parameters.

    Attributes:
        form: Function.
        theta: Values by name, leading axes (...,) such as (draw,).
        n_features: Number of features.
    """

    form: DriftForm = field(metadata={"static": True})
    theta: Mapping[str, Any]
    n_features: int = field(metadata={"static": True})

    def map(self, function: Callable[[Any, int], Any]) -> Self:
        """Apply a function to each value and the number of its trailing axes."""
        theta = {name: function(self.theta[name], len(axes)) for name, axes in self.form.axes}
        return replace(self, theta=theta)

    def at(self, z: Array) -> Array:
        """Drift of bounds (..., robot, feature) given one draw, as part of compiled code."""
        flat = z.reshape(-1, *z.shape[-2:])
        return jax.vmap(lambda one: self.form(one, self.theta))(flat).reshape(z.shape[:-1])

    def values(self, z: np.ndarray, *, many: bool = False) -> np.ndarray:
        """Drift of bounds z (bound, robot, feature), NaN where awareness is, (bound, robot).

        Args:
            z: Awareness, or with `many` that of each draw, (draw, bound, robot, feature).
            many: Whether values have the leading axis (draw,); the result then has it.
        """
        n, missing = z.shape[-3], np.isnan(z).any(-1)
        more = max(_LEAST, 1 << max(n - 1, 0).bit_length()) - n
        padding = [(0, 0)] * (z.ndim - 3) + [(0, more), (0, 0), (0, 0)]
        # Not NaN, which a function might not pass on.
        padded = np.pad(np.where(np.isnan(z), 0.5, z), padding)
        with own_settings():
            theta = {name: jnp.asarray(value, float) for name, value in self.theta.items()}
            each_own = z.ndim == 4
            drifts = np.asarray(_values(self.form, theta, padded, many=many, each_own=each_own))
        return np.where(missing, np.nan, drifts[..., :n, :])

    def require(self, n_robots: int | None, n_features: int) -> None:
        """Refuse awareness of other sizes: ShapeError."""
        if n_features != self.n_features:
            raise ShapeError(
                f"the drift {self.form.name} is of {self.n_features} features, but awareness has "
                f"{n_features}."
            )
        for name, axes in self.form.axes:
            shape = np.shape(self.theta[name])
            if "robot" in axes and n_robots is not None:
                size = shape[len(shape) - len(axes) + axes.index("robot")]
                if size != n_robots:
                    raise ShapeError(
                        f"parameter {name} of the drift {self.form.name} is of {size} robots, but "
                        f"the missions have {n_robots}."
                    )


@partial(jax.jit, static_argnames=("form", "many", "each_own"))
def _values(
    form: DriftForm, theta: Mapping[str, Array], z: Array, *, many: bool, each_own: bool
) -> Array:
    def one(theta: Mapping[str, Array], z: Array) -> Array:
        return jax.vmap(lambda bound: form(bound, theta))(z)

    return jax.vmap(one, (0, 0 if each_own else None))(theta, z) if many else one(theta, z)


def find_drift(about: Mapping[Any, Any], sites: Mapping[str, np.ndarray]) -> Drift:
    """Drift of a posterior, from its attributes and draws (draw, ...).

    TrustboError: this process has made no model with that function, or it gives other values.
    """
    n_robots, n_features = (int(n) for n in about["drift_shape"])
    name, shape = about["drift"], (n_robots, n_features)
    for form in reversed(_KNOWN.get(name, [])):
        if sites.keys() >= dict(form.axes).keys():
            mark, kept = form.mark(shape), np.ravel(about["drift_mark"])
            if np.allclose(mark, kept, rtol=1e-6, equal_nan=True):
                return Drift(
                    form, {argument: sites[argument] for argument, _ in form.axes}, shape[1]
                )
    reason = "gives other values by now" if name in _KNOWN else "is not known here"
    raise TrustboError(
        f"the drift {name} of the posterior {reason}: first make its DriftTrust again, with the "
        "function and the parameters that it was fitted with."
    )


def name_of(function: object) -> str:
    """Module and name of a custom function."""
    qualname = getattr(function, "__qualname__", type(function).__name__)
    return f"{getattr(function, '__module__', '')}:{qualname}"
