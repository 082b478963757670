"""Base class of trust models: priors, a state-space form, and a NumPyro program."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions import Distribution
from scipy import sparse

from trustbo.data import Mission
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_choice, require_list, require_switch
from trustbo.models.contact_rate import ContactRate
from trustbo.models.effects.effect import Effect, Theta, sample_coefficients
from trustbo.models.effects.weights import Weights
from trustbo.models.families import FAMILIES, Family
from trustbo.models.observations import Observations, require_ticks
from trustbo.models.priors import Priors, as_text
from trustbo.models.scores import NormalScores
from trustbo.models.sight_scale import scale_at, variation
from trustbo.stacking import require_same_team
from trustbo.statespace import Inputs, StateSpace
from trustbo.statespace.blocks import Layout, LinearPredictor
from trustbo.statespace.matrices import namespace
from trustbo.workspace import Workspace

MODELS: dict[str, type["TrustModel"]] = {}
"""Model classes by name, to read models from files."""
_PRIOR_OF = {
    "tau_beta": "tau",
    "tau_b": "tau",
    "partial_w": "concentration",
    "partial_v": "concentration",
}
"""Fields of `Priors` whose hyperparameters have other names."""
ROUNDING_SD = 12.0**-0.5
"""Standard deviation of the error of rounding to multiples of 1."""
_JITTER = 1e-13  # added to the covariance of trust, which rounding could make singular


@dataclass(frozen=True, repr=False)
class TrustModel(Summary, ABC):
    """Base class of trust models.

    A subclass defines `weights`, `hyperpriors`, `derived`, `state_space` (the equation) and `dims`.
    If robots depend on each other, it also defines `joint`. Hyperparameters must include `delta_w`
    and `delta_v`, and `dims` must list every parameter that planning needs.

    Attributes:
        priors: Prior on each parameter. The default depends on the observation family and the
            feature names; see `Priors.from_features`.
        family: Observation family: `"gaussian"` as in the paper, `"censored"` for rates that are
            censored at 0 and 1, or `"beta_binomial"` for the number of ticks in contact out of
            `Bound.n_ticks`, with trust on the logit scale.
        effects: Effects on the drift, such as `PlaceEffect()` for places and `RobotEffect()` for
            each robot in each mission. The paper's models have no effects.

    Raises:
        TrustboError: If `family` is unknown, or if `effects` contains a wrong or repeated class.
    """

    priors: Priors = None  # pyright: ignore[reportAssignmentType]
    family: str = "gaussian"
    effects: tuple[Effect, ...] = ()
    memory: ClassVar[str] = "level"  # see `PooledTrust`

    def __init_subclass__(cls) -> None:
        MODELS[cls.__name__] = cls

    def __post_init__(self) -> None:
        require_choice("family", self.family, FAMILIES)
        if self.priors is None:
            object.__setattr__(self, "priors", Priors.default(self.family))
        elif not isinstance(self.priors, Priors):
            raise TrustboError(f"priors must be a trustbo.models.Priors; got {self.priors!r}.")

        given: Any = self.effects
        if isinstance(given, Effect):
            given = [given]
        effects = tuple(require_list("effects", given, Effect, "give objects like PlaceEffect()"))
        if len({type(effect) for effect in effects}) < len(effects):
            raise TrustboError(f"effects must be of different classes; got {effects!r}.")
        object.__setattr__(self, "effects", effects)

    # --- defined by each model ---

    @property
    @abstractmethod
    def weights(self) -> Weights:
        """The effect with the feature weights and the intercept."""

    @abstractmethod
    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, Distribution]:
        """Return the priors on the parameters that are not integrated out, by name."""

    @abstractmethod
    def derived(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Convert hyperparameters to those of `state_space`, and add `inverse_gain`; see `Theta`.

        `values` are hyperparameters (point, ...) by name, as in `hyperpriors` or in a posterior.
        """

    @abstractmethod
    def state_space(self, theta: Theta, n_robots: int) -> StateSpace:
        """Return the model's equation at each theta, in NumPy or JAX.

        The axis `group` has length 1. If `joint` is true, the group contains all robots.
        """

    @property
    @abstractmethod
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of each parameter in a posterior by name, excluding parameters of effects."""

    # --- overridden by some models ---

    @property
    def joint(self) -> bool:
        """Whether robots depend on each other given the parameters and coefficients."""
        return False

    @property
    def exchangeable(self) -> bool:
        """Whether robots depend on each other only through equal, shared noise."""
        return False

    @property
    def scales_noise(self) -> bool:
        """Whether the noise depends on the predicted line of sight; see `Priors.f_v`."""
        return False

    def carried(self, observations: Observations) -> bool | np.ndarray:
        """Return which inputs are carried over to later bounds (see `statespace`).

        The result is True for all columns, False for none, or a mask (column,).
        """
        return True

    def random_effects(self, theta: Theta, observations: Observations) -> Inputs | None:
        """Return inputs (point, mission, row, effect) of effects that belong to one mission each.

        The effects are standard normal and are integrated out with trust, so they have no columns.
        """
        return None

    # --- shared by all models ---

    def layout(self, observations: Observations, *, contrasts: bool = True) -> Layout:
        """Arrange rates in blocks; if `contrasts` is false, each row is the rate of one robot."""
        require_switch("contrasts", contrasts)
        return Layout.from_rates(
            observations.contact_rate,
            joint=self.joint,
            exchangeable=self.exchangeable and contrasts and self.likelihood.gaussian,
            carried=self.carried(observations),
            apart=type(self).random_effects is not TrustModel.random_effects,
        )

    def linear_predictor(
        self, theta: Theta, observations: Observations, layout: Layout
    ) -> LinearPredictor:
        """Compute trust at all bounds from the state-space form, in NumPy or JAX."""
        space = self.state_space(theta, observations.n_robots)
        noise = self.noise_scale(theta, observations)
        random = self.random_effects(theta, observations)
        return LinearPredictor.from_space(space, layout, random, noise)

    def noise_scale(self, theta: Theta, observations: Observations) -> Any:
        """Return the factor (point, mission, bound, 1) of the noise of rates, or 1."""
        if not self.scales_noise:
            return 1.0
        sight = observations.line_of_sight.mean(-1, keepdims=True)
        return scale_at(variation(sight), theta["f_v"][:, None, None, None])

    @property
    def terms(self) -> tuple[Effect, ...]:
        """Feature weights and effects, in the order of their columns in the design matrix."""
        return self.weights, *self.effects

    @property
    def effect_dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of the effects' hyperparameters by name; all are scalars."""
        return {name: () for effect in self.effects for name in effect.hyperpriors()}

    @property
    def likelihood(self) -> Family:
        """The observation family, which is the likelihood of a contact rate given trust."""
        return FAMILIES[self.family]

    @property
    def x0(self) -> dict[str, float]:
        """Mean and standard deviation of trust before the first bound, by name."""
        return {name: float(getattr(self.priors, name)) for name in ("x0_mean", "x0_sd")}

    def all_hyperpriors(self, observations: Observations) -> dict[str, Distribution]:
        """Return the priors on all hyperparameters by name; those of effects come last."""
        priors = self.hyperpriors(observations.n_robots, observations.awareness.shape[3])
        return priors | {n: p for e in self.effects for n, p in e.hyperpriors().items()}

    def scores(self, observations: Observations) -> NormalScores:
        """Return the normal scores of all hyperparameters."""
        pairs = [pair for effect in self.effects for pair in effect.pairs(observations)]
        return NormalScores(self.all_hyperpriors(observations), pairs)

    def theta(self, values: Mapping[str, Any], resolution: float) -> dict[str, Any]:
        """Convert hyperparameters, named as in `all_hyperpriors`, to `theta` of `state_space`.

        Noise with standard deviation `resolution` is added to `delta_v` in quadrature. Without this
        noise, the density of rates that can be fitted perfectly, such as constant rates, would be
        unbounded. For the same reason, the floor `f_v` is raised such that the noise is nowhere
        less than the error of rounding to whole ticks.
        """
        if self.likelihood.adds_noise:
            noise = values["delta_v"]
            noise = namespace(noise).hypot(noise, resolution)
            values = {**values, "delta_v": noise}
        if self.scales_noise:
            least = (ROUNDING_SD * resolution / values["delta_v"]) ** 2
            values = {**values, "f_v": scale_at(least, values["f_v"])}
        return self.derived(values)

    def noise_without(
        self, values: Mapping[str, np.ndarray], resolution: float
    ) -> dict[str, np.ndarray]:
        """Return noises without what `theta` added, as their priors apply to them.

        `values` are parameters (draw, ...) by name. The result contains `delta_v` and, if the model
        has it, `f_v`.
        """
        delta_v = values["delta_v"]
        if not self.likelihood.adds_noise:
            return {"delta_v": delta_v}

        # Rounding can make the differences of the squares slightly negative.
        own = np.sqrt(np.maximum((delta_v - resolution) * (delta_v + resolution), 0.0))
        if "f_v" not in values:
            return {"delta_v": own}

        least = (ROUNDING_SD * resolution / delta_v) ** 2
        square = (values["f_v"] ** 2 - least) / (1.0 - least)
        return {"delta_v": own, "f_v": np.sqrt(np.maximum(square, 0.0))}

    def prior_terms(
        self, parameters: Mapping[str, np.ndarray]
    ) -> dict[str, tuple[str, np.ndarray]]:
        """Return further terms of the log prior by label, each as (field of `Priors`, values)."""
        return {name: (name, parameters[name]) for name in ("beta", "b")}

    def observations(
        self, missions: Iterable[Mission], workspace: Workspace | None = None
    ) -> Observations:
        """Collect the rates and features of missions, and the data that the effects need.

        Raises:
            TrustboError: If there are no missions; robots or features differ between missions; an
                awareness value is NaN; a measured rate lacks the n_ticks that the family needs; or
                a path jumps or leaves the workspace.
        """
        missions = require_same_team(missions)
        observations = Observations.from_missions(missions)
        require_ticks(self.likelihood, observations.contact_rate, observations.n_ticks)
        for effect in self.effects:
            observations = effect.add_data(observations, missions, workspace)
        return observations

    def for_features(self, features: Sequence[str]) -> Self:
        """Return the model with its priors, or the default priors, for these features in order.

        `fit` and campaigns call this method; see `Priors.from_features`. Raises TrustboError if the
        priors are for other features.
        """
        priors = self.priors
        if priors.by_feature:
            priors = Priors.from_features(tuple(features), self.family)

        priors = priors.in_order_of(features)
        of_rates = self.likelihood.adds_noise
        effects = [e.for_features(features, of_rates=of_rates) for e in self.effects]
        if priors is self.priors and effects == list(self.effects):
            return self
        return replace(self, priors=priors, effects=effects)

    def program(self, observations: Observations) -> None:
        """Run the model as a NumPyro program, for a kernel such as `NUTS(model.program)`.

        All variables are sampled, but trust is integrated out if rates are Gaussian. Call this
        method within `jax.enable_x64(True)`, because effects need float64. As in `fit`, the default
        priors depend on the features.
        """
        of_features = self.for_features(observations.features)
        if of_features is not self:
            return of_features.program(observations)

        values = {
            name: numpyro.sample(name, prior.to_event(len(prior.batch_shape)))
            for name, prior in self.all_hyperpriors(observations).items()
        }
        values = {name: jnp.asarray(value)[None] for name, value in values.items()}
        theta: Any = self.theta(values, observations.resolution)

        drawn = sample_coefficients(self.terms, theta, observations)
        c: Any = numpyro.deterministic("coefficients", drawn)
        U: Any = sparse.hstack([effect.design(observations) for effect in self.terms], format="csr")

        if self.likelihood.gaussian:
            carried = np.broadcast_to(self.carried(observations), U.shape[1:])
            dense = U.toarray()
            shape = observations.contact_rate.shape
            inputs = Inputs(
                drift=((dense * carried) @ c).reshape(shape),
                offset=((dense * ~carried) @ c).reshape(shape),
                noise=jnp.broadcast_to(self.noise_scale(theta, observations), (1, *shape))[0],
            )
            space = self.state_space(theta, observations.n_robots)
            rates = ContactRate.from_space(space, inputs, observations.n_ticks)
            with numpyro.plate("mission", observations.n_missions):
                numpyro.sample("contact_rate", rates, obs=observations.contact_rate)
            return

        layout = self.layout(observations, contrasts=False)
        predictor: Any = self.linear_predictor(theta, observations, layout)
        u = (layout.design(U).toarray() @ c).reshape(len(layout.label), -1)
        y = layout.rows(observations.contact_rate)
        ticks = layout.rows(observations.n_ticks)

        # Trust is its mean plus a Cholesky factor times white noise, which is easier to sample.
        jitter = _JITTER * jnp.eye(y.shape[1])
        root = jnp.linalg.cholesky(predictor.covariance[0] + jitter)
        white = dist.Normal(0.0, 1.0).expand(y.shape).to_event(2)
        e: Any = numpyro.sample("trust_noise", white)
        mean = predictor.mean[0] + (predictor.response[0] @ u[..., None])[..., 0]
        f = numpyro.deterministic("linear_predictor", mean + (root @ e[..., None])[..., 0])

        seen = ~np.isnan(y)
        rates = np.where(seen, y, 0.5)
        counts = np.where(ticks > 0.0, ticks, 1.0)
        log_p = self.likelihood.log_prob(rates, counts, f, predictor.noise_sd[0])
        numpyro.factor("contact_rate", jnp.where(seen, log_p, 0.0).sum())

    def options(self) -> dict[str, Any]:
        """Return the options by name, except priors, effects and `memory` if it is "level"."""
        left_out = {"priors", "effects"}
        if self.memory == "level":
            left_out.add("memory")
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}

    def _rows(self) -> Rows:
        return [
            ("rates", self.family),
            *((n, str(v)) for n, v in self.options().items() if n != "family"),
            *((f"effect of {effect.group}", str(effect)) for effect in self.effects),
            *self._rows_of_priors(),
        ]

    def _rows_of_priors(self) -> Rows:
        """Return the priors that the model uses; those of effects are listed with the effects."""
        hyperpriors = self.hyperpriors(2, 1)
        used = {"beta", "b", "x0_mean", "x0_sd", *hyperpriors}
        used |= {_PRIOR_OF[name] for name in hyperpriors if name in _PRIOR_OF}
        texts = self.priors.describe()
        own = [name for name in hyperpriors if name not in texts and name not in _PRIOR_OF]

        rows = []
        if self.priors.by_feature:
            used -= {"beta0", "beta", "b"}
            names = "beta0, beta, b" + ", f_v" * self.likelihood.gaussian
            rows.append((f"prior of {names}", "by the features, see Priors.from_features"))

        for name, text in texts.items():
            if name in used:
                of_limit = self.priors.stationary and name in ("beta", "b")
                rows.append((f"prior of {name}{' / (1 - beta0)' * of_limit}", text))

        options = self.options()  # options show their own priors, if any
        return [
            *rows,
            *((f"prior of {n}", as_text(hyperpriors[n])) for n in own if n not in options),
        ]

    def in_short(self) -> str:
        """Return a short text with the class, effects, family and non-default options."""
        defaults = {f.name: f.default for f in fields(self)}
        others = [
            f"{name} {value}"
            for name, value in self.options().items()
            if name != "family" and value != defaults.get(name)
        ]
        return ", ".join(
            [type(self).__name__, *(e.group for e in self.effects), self.family, *others]
        )
