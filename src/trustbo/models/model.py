"""The base of all trust models: numpyro model, likelihood, simulation, sufficient statistics."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar, Self

import jax
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from numpy.typing import ArrayLike

from trustbo.data import Mission
from trustbo.display import Rows, Summary
from trustbo.errors import ShapeError, TrustboError, require_choice
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Effect, Slots, rest_of
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.sampled import SampledDrift
from trustbo.models.exactness import why_not_exact
from trustbo.models.families import FAMILIES, Family, family_of
from trustbo.models.params import Params, assemble_params, check_params
from trustbo.models.place import bounds_of, places_of
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import draw
from trustbo.models.state_space.contact_rate import ModelRates, mission_log_likelihood
from trustbo.models.state_space.generate import TrustSample, draw_missions
from trustbo.models.ticks import broadcast_ticks, require_ticks, resolution, weigh_ticks
from trustbo.stacking import stack_missions

_STREAM = 0x6D697373  # of `simulate`, among all that a seed gives


@dataclass(frozen=True, repr=False)
class TrustModel(Summary, ABC):
    """Trust model; callable as a numpyro model, so that `MCMC(NUTS(model))` works.

    Attributes:
        priors: Prior of each parameter; by default those of the family of observations and of the
            names of the features, see `Priors.of`.
        observation: Family of observations: `"gaussian"`, the paper's; `"censored"`, rates of 0
            and 1 being limits; `"beta_binomial"`, ticks in contact out of `Bound.n_ticks` ticks,
            trust being a logit.
        place: Effects of places that awareness does not explain; None is the paper's model.

    Raises:
        TrustboError: A name is unknown, or robots that influence each other are to have effects of
            places.
    """

    priors: Priors = None  # pyright: ignore[reportAssignmentType]
    observation: str = "gaussian"
    place: PlaceEffect | None = None
    effects: ClassVar[tuple[Effect, ...]] = ()  # see `PooledTrust`
    memory: ClassVar[str] = "level"  # see `PooledTrust`

    def __post_init__(self) -> None:
        require_choice("observation", self.observation, FAMILIES)
        if self.priors is None:
            object.__setattr__(self, "priors", Priors.default(self.observation))
        elif not isinstance(self.priors, Priors):
            raise TrustboError(f"priors must be a trustbo.models.Priors; got {self.priors!r}.")
        if not isinstance(self.place, PlaceEffect | None):
            raise TrustboError(f"place must be a PlaceEffect or None; got {self.place!r}.")

    # --- defined by each model ---

    @abstractmethod
    def sample_params(self, n_robots: int, n_features: int) -> Params:
        """Sample statements of the parameters, assembled."""

    @property
    @abstractmethod
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of each parameter in a posterior."""

    @property
    def place_dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of the hyperparameters of places, where these have effects."""
        return {} if self.place is None else {name: () for name in self.place.names}

    @property
    def effect_dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of the hyperparameters of all effects, those of places among them."""
        return {name: () for effect in self.all_effects for name in effect.names}

    @property
    def all_effects(self) -> list[Effect]:
        """All effects, those of places first, as columns of the evidence."""
        return [*([] if self.place is None else [self.place]), *self.effects]

    @property
    def robot_sets(self) -> str:
        """Kind of the robots' parameters, by which samplers choose scores and an evidence.

        `"all"` robots share them, `"each"` has separate ones; these two have sufficient statistics.
        Those of `"pooled"` robots have a common distribution, `"coupled"` robots influence each
        other. Only NUTS takes any `"other"`.
        """
        return "other"

    @property
    def priors_are_independent(self) -> bool:
        """Whether each field of the parameters has an independent prior of that name."""
        return self.robot_sets in ("all", "each")

    def prior_terms(self, sites: Mapping[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """Field of `Priors` and values of each parameter with an independent prior, by label.

        Args:
            sites: Parameters of a posterior, leading axes (...), with the axes of `dims`.
        """
        return {name: (name, sites[name]) for name in self.dims if name not in self.effect_dims}

    def own_log_prior(self, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Log prior density (chain, draw), by label, of parameters without a field in `Priors`."""
        return {}

    def draw_prior(
        self, shape: tuple[int, int], n: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray] | None:
        """Draws of the parameters but those of effects, (draw, ...), by name.

        None where only the numpyro model can draw them, which takes long to compile.
        """
        if not self.priors_are_independent:
            return None
        priors = self.priors
        drawn = {
            name: draw(getattr(priors, name), (n, *size), rng)
            for name, size in self.sizes(*shape).items()
        }
        return priors.of_stationary(drawn, rest_of(drawn["beta0"], self.memory))

    def for_features(self, features: Sequence[str]) -> Self:
        """The model with default priors for features of these names; custom priors stay.

        See `Priors.of`. `fit` and campaigns call it.
        """
        if self.priors is not Priors.default(self.observation):
            return self
        return replace(self, priors=Priors.of(tuple(features), self.observation))

    def at_resolution(self, ticks: Mapping[float, float]) -> Self:
        """The model whose delta_v is no less than the resolution of rates of so many ticks.

        Without this floor the density of rates that fit perfectly, constant ones among them, would
        grow without bound as the noises go to 0.

        Args:
            ticks: Weight of the rates by their number of ticks.

        Raises:
            TrustboError: The prior of delta_v has next to no mass above the floor.
        """
        if not self.family.rounds:
            return self
        return replace(self, priors=self.priors.above_resolution(resolution(ticks)))

    def sizes(self, n_robots: int, n_features: int) -> dict[str, tuple[int, ...]]:
        """Shape of each parameter in a posterior, without those of effects."""
        length = {"robot": n_robots, "robot_": n_robots}
        length["feature"] = n_features
        dims = {name: axes for name, axes in self.dims.items() if name not in self.effect_dims}
        return {name: tuple(length[axis] for axis in axes) for name, axes in dims.items()}

    def options(self) -> dict[str, str]:
        """Options by name, without the priors and the effects, nor the usual memory."""
        others = ("priors", "place", "effects", *("memory",) * (self.memory == "level"))
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in others}

    def params(self, sites: Mapping[str, Any], n_features: int) -> Params:
        """Build parameters from values by name, leading axes (draw,) or none.

        Args:
            sites: Values with the axes of `dims`.
            n_features: Number of features.
        """
        return assemble_params(sites, self.x0, self.memory)

    # --- shared by all models ---

    @property
    def family(self) -> Family:
        """The family of observations."""
        return family_of(self.observation)

    @property
    def x0(self) -> dict[str, float]:
        """Mean and sd of trust before the first bound, by name."""
        return {name: float(getattr(self.priors, name)) for name in ("x0_mean", "x0_sd")}

    def __call__(
        self,
        awareness: Array,
        contact_rate: Array | None = None,
        *,
        n_ticks: Array | None = None,
        drift: Callable[[Any], Array] | None = None,
    ) -> None:
        """The numpyro model.

        Args:
            awareness: Shape (mission, bound, robot, feature).
            contact_rate: Shape (mission, bound, robot), NaN where not measured; None draws it.
            n_ticks: Ticks, of that shape; the beta-binomial family needs them.
            drift: Function of parameters, to what effects add to the drift, of that shape.
        """
        n_missions, n_bounds, n_robots, n_features = awareness.shape
        params, innovations = self.sample_params(n_robots, n_features), None
        if drift is not None:
            params: Any = params._replace(b=params.b + drift(params))  # pyright: ignore
        if not self.family.integrates_out:
            innovations = sample_innovations((n_bounds, n_missions, n_robots))
        rates = ModelRates(
            params,
            awareness,
            n_ticks=n_ticks,
            innovations=innovations,
            observation=self.observation,
        )
        with numpyro.plate("mission", n_missions):
            numpyro.sample("contact_rate", rates, obs=contact_rate)

    def numpyro_model(self, missions: Sequence[Mission]) -> Callable[[], None]:
        """The numpyro model of missions, as a function without arguments.

        With the effects of places and of robots, and the priors that `fit` takes for these
        missions: for a kernel of numpyro, SVI, or `numpyro.render_model`. Effects are sampled as
        white coefficients, and not integrated out as in `fit`, which is much faster. Call
        it, and the kernel, within `jax.enable_x64(True)`: effects need double precision.

        Raises:
            ShapeError: There are no missions, or they disagree on robots or features.
            TrustboError: An awareness value is NaN, or no rate was measured.
        """
        batch = stack_missions(missions)
        ticks = weigh_ticks(batch, np.ones(len(batch.contact_rate)))
        if not ticks:
            raise TrustboError("every contact rate is NaN: nothing was measured.")
        model = self.for_features(missions[0].features).at_resolution(ticks)
        require_ticks(model.family, batch)
        drift, shape = None, batch.contact_rate.shape
        if model.place is not None or model.effects:
            places = places_of(missions, model.place, shape)
            slots = Slots.of(batch, len(missions), missions[0].features, places=places)
            drift = SampledDrift(model.all_effects, slots, shape, model.memory)
        rates: Any = batch.awareness, batch.contact_rate
        return partial(model, *rates, n_ticks=batch.n_ticks, drift=drift)

    def log_likelihood(
        self, params: Params, missions: Sequence[Mission], *, seed: int = 0
    ) -> np.ndarray:
        """Log p(contact rates | parameters), latent trust integrated out; nats, (..., mission).

        Exact for Gaussian observations, else importance sampling over 32 antithetic trajectories by
        `seed`. A density of rates; for censored ones with mass at 0 and 1, for counts a
        probability. Parameters have leading axes (...,); a contact rate that is NaN was not
        measured.

        Raises:
            ShapeError: The parameters are for another number of features or robots.
            TrustboError: Awareness is NaN, a covariance is not positive definite, or n_ticks is
                missing where the family needs it.
        """
        batch = stack_missions(missions)
        check_params(params, batch.awareness.shape[2], batch.awareness.shape[3])
        require_ticks(self.family, batch)
        leading, flat = params.leading, params.flat()
        if params.places:
            flat = flat.on(bounds_of(missions, batch.contact_rate.shape[:2]))
        with own_settings():
            key = jax.random.key(seed)
            values = mission_log_likelihood(self.family, flat, *batch, key)
        return np.asarray(values)[:, : len(missions)].reshape(*leading, len(missions))

    def simulate(
        self,
        key: Array,
        params: Params,
        awareness: ArrayLike,
        n_ticks: ArrayLike | None = None,
    ) -> TrustSample:
        """Missions drawn from the model for given parameters, one draw.

        Args:
            key: Random key.
            params: Parameters without leading axes; where places have effects, those of the
                missions' bounds, `params.on(bounds)`.
            awareness: Shape (mission, bound, robot, feature).
            n_ticks: Ticks of each bound, of shape (mission, bound, robot) or broadcast to it; the
                beta-binomial family needs them.

        Raises:
            ShapeError: Awareness has other axes; parameters with leading axes, or of other robots
                or features.
            TrustboError: A covariance is not positive definite, or n_ticks is missing.
        """
        z = np.asarray(awareness, dtype=float)
        if z.ndim != 4 or params.leading:
            raise ShapeError(
                "awareness must be (mission, bound, robot, feature) and the parameters one draw; "
                f"got {z.shape}, and parameters with leading axes {params.leading}."
            )
        check_params(params, z.shape[2], z.shape[3])
        ticks = broadcast_ticks(self.family, n_ticks, z.shape[:3])
        one = params.map(lambda value, _: np.asarray(value, dtype=float)[None])
        # The last number: else key 0 would give the stream of `default_rng(0)`, which awareness
        # may well have been drawn from.
        rng = np.random.default_rng([*np.asarray(jax.random.key_data(key)).ravel(), _STREAM])
        drawn = draw_missions(self.family, one, z, ticks, rng)
        return TrustSample(*(values[0] for values in drawn))

    @property
    def why_not_exact(self) -> str | None:
        """Reason why the exact sampler cannot treat the model; None if it can."""
        return why_not_exact(self)

    def _rows(self) -> Rows:
        rows = [
            ("rates", self.observation),
            *((n, str(v)) for n, v in self.options().items() if n != "observation"),
            ("places", "no effects" if self.place is None else self.place.in_short()),
            *(("effects", effect.in_short()) for effect in self.effects),
            ("sampler", "exact" if self.why_not_exact is None else f"nuts: {self.why_not_exact}"),
        ]
        return rows

    def in_short(self) -> str:
        """Name, effects of places, family, and the options that differ from their defaults."""
        usual = {f.name: f.default for f in fields(self)}
        others = [
            f"{name} {value}"
            for name, value in self.options().items()
            if name not in ("observation", "parameters") and value != usual.get(name)
        ]
        return ", ".join([type(self).__name__, *self.nouns, self.observation, *others])

    @property
    def named_with_effects(self) -> str:
        """Name of the class, and what has effects."""
        effects = " and ".join(self.nouns)
        return type(self).__name__ + (f" with {effects}" if effects else "")

    @property
    def nouns(self) -> list[str]:
        """Plural of what has effects."""
        return ["places"] * (self.place is not None) + [e.noun for e in self.effects]

    def describe(self) -> str:
        """Text of the model's name and options."""
        listed = ", ".join(f'{name}="{value}"' for name, value in self.options().items())
        listed += "" if self.place is None else f", place={self.place}"
        listed += f", effects={list(self.effects)}" if self.effects else ""
        return f"{type(self).__name__}({listed})"


def sample(name: str, prior: dist.Distribution, shape: tuple[int, ...] = ()) -> Array:
    """A sample statement of independent parameters of that shape."""
    return numpyro.sample(name, prior.expand(shape).to_event(len(shape)))  # pyright: ignore


def sample_innovations(shape: tuple[int, int, int]) -> Array:
    """Sample statement of the innovations of latent trust, (bound, mission, robot)."""
    innovations = dist.Normal(0.0, 1.0).expand(shape).to_event(3)
    return numpyro.sample("innovations", innovations)  # pyright: ignore[reportReturnType]


def register[Model: TrustModel](cls: type[Model]) -> type[Model]:
    """Make a model a pytree, so that compiled samplers take its priors as data."""
    meta = [f.name for f in fields(cls) if f.name != "priors"]
    return jax.tree_util.register_dataclass(cls, data_fields=["priors"], meta_fields=meta)


def require_model(model: object) -> None:
    """Refuse anything but a trust model: TrustboError."""
    if not isinstance(model, TrustModel):
        raise TrustboError(f"model must be a trust model, e.g. PooledTrust(); got {model!r}.")
