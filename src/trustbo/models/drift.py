"""Trust model with a custom drift: a function of awareness and sampled parameters."""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from jax import Array
from numpyro import handlers

from trustbo.errors import TrustboError
from trustbo.models.backend import own_settings
from trustbo.models.drift_form import Drift, DriftForm, name_of
from trustbo.models.drift_parameters import (
    Axes,
    listed_axes,
    prior_text,
    require_names,
    split_prior,
    traced_axes,
)
from trustbo.models.model import TrustModel, sample
from trustbo.models.params import DriftParams
from trustbo.models.priors_numpy import draw, quantile_at


@jax.tree_util.register_pytree_node_class
@dataclass(frozen=True, repr=False, init=False)
class DriftTrust(TrustModel):
    """Trust x^k = beta0 x^{k-1} + u^k + eps_w, u = `drift(z, **theta)` a custom function.

    Rates are as in (4), and trust integrates out as it does in `PooledTrust`, whose drift is
    z @ beta + b. All robots share beta0 and the noises, whose priors are those of `priors`.

    Attributes:
        drift: JAX function of one bound: awareness z (robot, feature), and each parameter by its
            name; it gives u (robot,). It must be finite for all awareness in [0, 1].
        parameters: Prior of each parameter, by name: a scalar numpyro distribution, or a pair of it
            and an axis, `"robot"` or `"feature"`, for independent ones along it. Or a function of
            (n_robots, n_features) with `numpyro.sample` statements, that returns the parameters by
            name, each (), (robot,), (feature,) or (robot, feature).

    Raises:
        TrustboError: The drift takes a parameter without a prior, or lacks one with a prior; a name
            that the model uses; or no prior.
    """

    drift: Callable[..., Any]
    parameters: Mapping[str, Any] | Callable[[int, int], Mapping[str, Any]]

    def __init__(
        self,
        drift: Callable[..., Any],
        parameters: Mapping[str, Any] | Callable[[int, int], Mapping[str, Any]],
        **options: Any,
    ) -> None:
        """Take the function, its parameters, and options of `TrustModel` by name."""
        super().__init__(**options)
        object.__setattr__(self, "drift", drift)
        object.__setattr__(self, "parameters", parameters)
        if not callable(drift):
            raise TrustboError(f"drift must be a function drift(z, ...); got {drift!r}.")
        require_names(drift, *self._axes)
        self.form.keep()

    @cached_property
    def _axes(self) -> tuple[Axes, Axes]:
        """Axes of the drift's arguments, and of the sample sites, by name."""
        parameters = self.parameters
        return traced_axes(parameters) if callable(parameters) else listed_axes(parameters)

    @cached_property
    def form(self) -> DriftForm:
        """The function and the axes of its arguments."""
        return DriftForm(self.drift, tuple(self._axes[0].items()))

    def tree_flatten(self) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Priors as data of compiled code, all else static."""
        listed, how = {}, self.parameters
        if not callable(how):
            listed = {name: split_prior(name, given)[0] for name, given in how.items()}
            how = self.form.axes
        return (self.priors, listed), (
            self.observation, self.response, self.place, self.drift, how,
        )  # fmt: skip

    @classmethod
    def tree_unflatten(cls, static: tuple[Any, ...], data: tuple[Any, ...]) -> Self:
        """Rebuild the model without checks, as values may be tracers."""
        model = object.__new__(cls)
        (priors, listed), (*options, drift, how) = data, static
        if not callable(how):
            how = {name: (listed[name], *axes) for name, axes in how}
        names = [f.name for f in fields(cls)]
        for name, value in zip(names, (priors, *options, drift, how), strict=True):
            object.__setattr__(model, name, value)
        return model

    # --- the numpyro model ---

    def sample_params(self, n_robots: int, n_features: int) -> DriftParams:
        """Sample statements of beta0, the drift's parameters, delta_w and delta_v."""
        priors = self.priors
        return DriftParams(
            beta0=sample("beta0", priors.beta0),
            drift=Drift(self.form, self._sample_theta(n_robots, n_features), n_features),
            delta_w=sample("delta_w", priors.delta_w),
            delta_v=sample("delta_v", priors.delta_v),
            x0_mean=priors.x0_mean,
            x0_sd=priors.x0_sd,
        )

    def _sample_theta(self, n_robots: int, n_features: int) -> dict[str, Array]:
        """Sample statements of the drift's parameters."""
        size = {"robot": n_robots, "feature": n_features}
        if not callable(self.parameters):
            split = {name: split_prior(name, given) for name, given in self.parameters.items()}
            return {
                name: sample(name, prior, tuple(size[axis] for axis in axes))
                for name, (prior, axes) in split.items()
            }
        theta = {name: jnp.asarray(v) for name, v in self.parameters(n_robots, n_features).items()}
        for name in theta.keys() - self._axes[1].keys():
            numpyro.deterministic(name, theta[name])
        return theta

    def params(self, sites: Mapping[str, Any], n_features: int) -> DriftParams:
        """See `TrustModel.params`."""
        values = dict(sites)
        try:
            theta = {name: np.asarray(values[name], float) for name, _ in self.form.axes}
            beta0, delta_w, delta_v = (values[name] for name in ("beta0", "delta_w", "delta_v"))
        except KeyError as error:
            raise TrustboError(
                f"parameter {error} is missing; {self.describe()} needs {', '.join(self.dims)}."
            ) from None
        drift = Drift(self.form, theta, n_features)
        return DriftParams(beta0, drift, delta_w, delta_v, **self.x0)

    # --- what the library asks a model ---

    @property
    def dims(self) -> Axes:
        """Axes of beta0, the drift's parameters, delta_w and delta_v."""
        arguments, sites = self._axes
        axes = sites | arguments
        return {"beta0": (), **axes, "delta_w": (), "delta_v": (), **self.place_dims}

    @property
    def robot_sets(self) -> str:
        """See `TrustModel.robot_sets`."""
        return "drift"

    @cached_property
    def why_not_exact(self) -> str | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Reason against normal scores: rates not Gaussian, or a prior without quantiles."""
        return super().why_not_exact or self._why_no_scores

    @cached_property
    def _why_no_scores(self) -> str | None:
        try:
            with own_settings():
                n = self.n_scores(5, 7)
                jax.eval_shape(lambda z: self.at_scores(z, 5, 7), jnp.zeros(n))
        except (NotImplementedError, ImportError, TypeError, ValueError):
            return "a prior of its drift's parameters has no quantiles, or is no scalar"
        return None

    @property
    def why_no_statistics(self) -> str:
        """See `TrustModel.why_no_statistics`."""
        return "its drift is a function of your own"

    def n_scores(self, n_robots: int, n_features: int) -> int:
        """Number of scores of the drift's parameters, see `at_scores`."""
        size = {"robot": n_robots, "feature": n_features}
        return sum(int(np.prod([size[a] for a in axes])) for axes in self._axes[1].values())

    def at_scores(
        self, z: Array, n_robots: int, n_features: int
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """Arguments of the drift, and all its parameters, by name, at normal scores (score,).

        Each parameter is the quantile of its prior, given those before it, at Phi(score).
        """
        rest = z

        def quantile(site: dict[str, Any]) -> Array | None:
            nonlocal rest
            if site["type"] != "sample":
                return None
            n = int(np.prod(site["fn"].shape()))
            scores, rest = rest[:n].reshape(site["fn"].shape()), rest[n:]
            return quantile_at(site["fn"], scores)

        with handlers.trace() as trace, handlers.substitute(substitute_fn=quantile):
            theta = self._sample_theta(n_robots, n_features)
        names = self._axes[1] | self._axes[0]
        return theta, {name: trace[name]["value"] for name in names}

    def parameters_at(self, z: np.ndarray, shape: tuple[int, int]) -> dict[str, np.ndarray]:
        """The drift's parameters at scores (point, score), by name, see `at_scores`."""
        with own_settings():
            parameters = _parameters_at(self, z, shape)
        return {name: np.asarray(value) for name, value in parameters.items()}

    def draw_prior(
        self, shape: tuple[int, int], n: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray] | None:
        """See `TrustModel.draw_prior`: from scores, which compile faster than random numbers."""
        if self._why_no_scores is not None:
            return None
        names = ("beta0", "delta_w", "delta_v")
        draws = self.parameters_at(rng.standard_normal((n, self.n_scores(*shape))), shape)
        return {name: draw(getattr(self.priors, name), (n,), rng) for name in names} | draws

    def for_features(self, features: Any) -> Self:
        """The model itself: no prior depends on names of features."""
        return self

    def options(self) -> dict[str, str]:
        """Options by name, function and parameters as text."""
        parameters = self.parameters
        text = (
            name_of(parameters)
            if callable(parameters)
            else "; ".join(map(prior_text, parameters, parameters.values()))
        )
        return {
            "observation": self.observation,
            "response": self.response,
            "drift": self.form.name,
            "parameters": text,
        }

    def check(self, sites: Mapping[str, np.ndarray], shape: tuple[int, int]) -> None:
        """See `TrustModel.check`: the drift has to be finite for any awareness in [0, 1]."""
        drift = self.params(sites, shape[1]).drift
        rng = np.random.default_rng(0)
        z = np.stack([np.zeros(shape), np.ones(shape), *rng.uniform(size=(6, *shape))])
        some = drift.map(lambda value, _: value[:100])
        try:
            _require_indices(some, z[2])
            drifts = some.values(z, many=True)
        except TrustboError:
            raise
        except jax.errors.JAXTypeError as error:
            raise TrustboError(
                f"the drift {self.form.name} cannot be compiled: "
                f"{str(error).splitlines()[0].rstrip('.')}. Use jax.numpy in place of NumPy, and "
                "jnp.where in place of if."
            ) from error
        except Exception as error:
            raise TrustboError(
                f"the drift {self.form.name} fails for awareness (robot, feature) = {shape}: "
                f"{type(error).__name__}: {error}"
            ) from error
        bad = ~np.isfinite(drifts)
        if bad.any():
            draw, k, robot = np.argwhere(bad)[0]
            theta = ", ".join(f"{n} = {np.asarray(v[draw])}" for n, v in some.theta.items())
            raise TrustboError(
                f"the drift {self.form.name} is {drifts[draw, k, robot]} at awareness "
                f"{z[k, robot].round(3).tolist()} with {theta}; it must be finite for all "
                "awareness in [0, 1] and all parameters that their priors give."
            )

    def marks(self, shape: tuple[int, int]) -> dict[str, Any]:
        """See `TrustModel.marks`: `find_drift` identifies the function by them."""
        return {"drift_shape": list(shape), "drift_mark": self.form.mark(shape)}

    def prior_terms(self, sites: Mapping[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`: the drift's parameters are in `own_log_prior`."""
        return {name: (name, sites[name]) for name in ("beta0", "delta_w", "delta_v")}

    def own_log_prior(self, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """See `TrustModel.own_log_prior`."""
        size = {"robot": 1, "feature": 1}
        for name, axes in self._axes[1].items():
            size |= dict(zip(axes, sites[name].shape[2:], strict=True))
        flat = {name: sites[name].reshape(-1, *sites[name].shape[2:]) for name in self._axes[1]}

        def one(values: dict[str, Array]) -> dict[str, Array]:
            program = handlers.substitute(self._sample_theta, values)
            trace = handlers.trace(program).get_trace(size["robot"], size["feature"])
            return {n: trace[n]["fn"].log_prob(trace[n]["value"]).sum() for n in values}

        with own_settings():
            log_densities = jax.jit(jax.vmap(one))(flat)
        shape = sites["beta0"].shape
        return {name: np.asarray(value).reshape(shape) for name, value in log_densities.items()}


@partial(jax.jit, static_argnames="shape")
def _parameters_at(model: DriftTrust, z: Array, shape: tuple[int, int]) -> dict[str, Array]:
    return jax.vmap(lambda one: model.at_scores(one, *shape)[1])(z)


def _require_indices(drift: Drift, z: np.ndarray) -> None:
    """Refuse an index out of range: IndexError. NumPy does, JAX takes the last entry instead."""
    theta = {name: np.asarray(value)[0] for name, value in drift.theta.items()}
    with contextlib.suppress(AttributeError, TypeError, ValueError), np.errstate(all="ignore"):
        with own_settings():
            drift.form(z, theta)
