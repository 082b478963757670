"""Trust that a person reports: the state space of `PooledTrust` under outcomes, of many persons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple, NoReturn, Self, cast

import numpy as np
import numpyro.distributions as dist

from trustbo.display import Rows
from trustbo.errors import TrustboError
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Columns, Effect, Prior, Slots, Theta, dense_columns
from trustbo.models.effects.person import PersonEffect
from trustbo.models.effects.weights import FeatureColumns, Weights
from trustbo.models.families.censored import Censored
from trustbo.models.families.family import Family
from trustbo.models.model import register
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors
from trustbo.models.priors_numpy import draw
from trustbo.models.scales import Scale
from trustbo.stacking import MissionBatch

SUCCESS, FAILURE = "success", "failure"
"""Beginnings of the names of features that are inputs of outcomes."""


@register
@dataclass(frozen=True, repr=False)
class HumanTrust(PooledTrust):
    """Trust that a person reports: a base, and what outcomes left, which fades.

    x^k = base^k + d^k,  d^k = beta0 d^{k-1} + gains . inputs^k + eps_w,  d^0 = 0,

    base^k = b + weights . features^k + the person's level; the person's start is in d^1, own gains
    are in d^k. Inputs are the features whose names begin with `success` or `failure`: outcomes,
    which may be scaled by demands. A person is a mission, a step is a bound, and an asked task a
    row of it, as a robot is. `trustbo.logs.read_reports` makes such missions.

    Attributes:
        asymmetric: Whether successes and failures have separate gains; else a feature
            `failure...` has minus the weight of `success...` of the same ending.
        persons: Whether each person has a level and gains of a common distribution
            (`PersonEffect`); the start always is a person's own.
        scale: `"unit"`, numbers in [0, 1], 0 and 1 being limits; `"likert7"`, so many levels with
            cut points halfway between them, or `"ordinal7"`, with cut points that are learned:
            trust plus noise lies between the two of a report. Noise of levels is logistic, with
            sd delta_v.
        memory: Part that beta0 carries on: the `"deviation"` d from the base, or the `"level"` of
            trust, base included, as in the paper.
        inputs: Names of the features, comma-separated; `fit` fills them in.

    Raises:
        TrustboError: The scale is unknown, or the model has effects but `PersonEffect`, places or
            rates of changes.
    """

    memory: str = "deviation"
    asymmetric: bool = True
    persons: bool = True
    scale: str = "unit"
    inputs: str = ""

    def __post_init__(self) -> None:
        Scale.named(self.scale)
        object.__setattr__(self, "observation", "censored")  # on the unit scale; see `family`
        for name in ("asymmetric", "persons"):  # files have 0 and 1
            if (given := getattr(self, name)) not in (0, 1):
                raise TrustboError(f"{name} must be True or False; got {given!r}.")
            object.__setattr__(self, name, bool(given))
        if self.priors is None:
            object.__setattr__(self, "priors", _default_priors())
        given: Any = self.effects
        effects = [given] if isinstance(given, Effect) else [*given]
        others = [e for e in effects if not isinstance(e, PersonEffect)]
        if others or len(effects) > 1 or self.place is not None:
            raise TrustboError(
                "HumanTrust has effects of persons alone, and its reports are of trust; got "
                f"effects={self.effects!r}, place={self.place!r}."
            )
        first = cast(PersonEffect, effects[0]) if effects else PersonEffect()
        success, failure = (_first(self.names, start) for start in (SUCCESS, FAILURE))
        effect = replace(
            first, own=self.persons, success=success, failure=failure, asymmetric=self.asymmetric
        )
        object.__setattr__(self, "effects", (effect,))
        super().__post_init__()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the features."""
        return tuple(self.inputs.split(",")) if self.inputs else ()

    @cached_property
    def levels(self) -> Scale:
        """The scale of the reports."""
        return Scale.named(self.scale)

    @property
    def effect(self) -> PersonEffect:
        """The effects of persons."""
        return cast(PersonEffect, self.effects[0])

    @property
    def family(self) -> Family:
        """See `TrustModel.family`: levels give delta_v no floor."""
        return _LEVELS if self.levels.levels else super().family

    def for_features(self, features: Sequence[str]) -> Self:
        """The model with inputs of these names."""
        if any("," in name for name in features):
            raise TrustboError(f"names of inputs may have no comma; got {tuple(features)}.")
        return replace(self, inputs=",".join(features))

    def for_rates(self, batch: MissionBatch) -> tuple[Self, str]:
        """The model itself; TrustboError: reports are not on its scale."""
        self.levels.require(batch.contact_rate, batch.n_ticks)
        return self, "asked for"

    @property
    def robot_sets(self) -> str:
        """See `TrustModel.robot_sets`."""
        return "people"

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of the parameters of `PooledTrust`, and of the scores of free cut points."""
        return super().dims | {name: () for name in self.levels.names}

    def options(self) -> dict[str, Any]:
        """See `TrustModel.options`; files have no truth values, and any memory is theirs."""
        return {
            name: int(value) if isinstance(value, bool) else value
            for name, value in (super().options() | {"memory": self.memory}).items()
        }

    def sample_params(self, n_robots: int, n_features: int) -> NoReturn:
        """Refuse: TrustboError."""
        raise _no_program("numpyro model")

    def simulate(self, *args: Any, **options: Any) -> NoReturn:
        """Refuse: TrustboError."""
        raise _no_program("missions simulated for parameters")

    def log_likelihood(self, *args: Any, **options: Any) -> NoReturn:
        """Refuse: TrustboError."""
        raise _no_program("likelihoods of parameters")

    @property
    def lasting(self) -> tuple[np.ndarray, np.ndarray]:
        """Masks of what beta0 carries on: of shared columns, and of the parts of a person."""
        every = self.memory == "level"
        rows = _paired(self.names, max(len(self.names), 1), asymmetric=self.asymmetric)
        names = [*self.names, *[""] * (rows.shape[1] - len(self.names))]
        of_outcomes = np.array([name.startswith((SUCCESS, FAILURE)) for name in names])
        shared = (rows != 0.0) @ of_outcomes > 0
        return shared | every, np.array([True, every, True, True])

    def _rows(self) -> Rows:
        kept = [row for row in super()._rows() if row[0] not in ("rates", "scale", "places")]
        return [("reports", self.scale), *kept]

    @property
    def why_not_exact(self) -> str | None:
        """See `TrustModel.why_not_exact`: blocks of persons have an evidence."""
        return None

    def draw_prior(
        self, shape: tuple[int, int], n: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """See `TrustModel.draw_prior`."""
        names = ("beta0", "b", "delta_w", "delta_v")
        drawn = {name: draw(getattr(self.priors, name), (n,), rng) for name in names}
        group = self.shared(_no_slots(shape))
        c = group.mean + group.sd * rng.standard_normal((n, len(group.mean)))
        drawn["beta"] = group.name(c, {}, rng)["beta"]
        return drawn | {name: rng.standard_normal(n) for name in self.levels.names}

    def prior_terms(self, sites: Mapping[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`."""
        names = ("beta0", "beta", "b", "delta_w", "delta_v")
        return {name: (name, sites[name]) for name in names}

    def own_log_prior(self, sites: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """See `TrustModel.own_log_prior`: of the scores of cut points."""
        return {name: -0.5 * sites[name] ** 2 for name in self.levels.names}

    def weights_of(self, beta: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Shared coefficients (draw, column) of weights (draw, feature) and intercepts (draw,)."""
        rows = _paired(self.names, beta.shape[1], asymmetric=self.asymmetric)
        return np.column_stack([beta, b])[:, np.argmax(rows != 0.0, axis=1)]

    def shared(self, slots: Slots) -> "InputColumns":
        """Columns that all persons share."""
        group = cast(FeatureColumns, Weights(self.priors).group(slots))
        n = len(group.mean) - 1
        return InputColumns.of(group, _paired(self.names, n, asymmetric=self.asymmetric))


class InputColumns(NamedTuple):
    """Inputs, and 1; of symmetric ones a pair has one column."""

    columns: Columns
    mean: np.ndarray  # (column,)
    sd: np.ndarray
    weights: np.ndarray  # (column, feature + 1): the weights that a coefficient gives
    joined = ()
    fades = False

    @classmethod
    def of(cls, group: FeatureColumns, weights: np.ndarray) -> Self:
        """Columns of features, of which `weights` are formed."""
        first = np.argmax(weights != 0.0, axis=1)
        columns = dense_columns((group.columns @ weights.T)[None])
        return cls(columns, group.mean[first], group.sd[first], weights)

    def prior(self, theta: Theta) -> Prior:
        """Independent coefficients."""
        shape = len(theta["beta0"]), len(self.mean)
        return Prior(np.broadcast_to(self.mean, shape), np.broadcast_to(self.sd, shape))

    def name(self, c: np.ndarray, theta: Theta, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Weights beta (draw, feature) and intercept b (draw,)."""
        both = c @ self.weights
        return {"beta": both[:, :-1], "b": both[:, -1]}


@dataclass(frozen=True)
class _Levels(Censored):
    """Family of reports on a scale of levels, which are intervals, see `Scale`."""

    rounds: ClassVar[bool] = False


_LEVELS = _Levels()


@cache
def _default_priors() -> Priors:
    """Memory that lasts, gains of some tenths, and a start that is a person's own.

    Outcomes move a person's trust, little else does; reports slip more.
    """
    with own_settings():
        return Priors(
            beta0=dist.Beta(4.0, 1.5),
            beta=dist.Normal(0.0, 0.3),
            b=dist.Normal(0.5, 0.5),
            delta_w=dist.HalfNormal(0.03),
            delta_v=dist.HalfNormal(0.15),
            x0_mean=0.0,
            x0_sd=0.0,
        )


def _no_program(what: str) -> TrustboError:
    return TrustboError(
        f"HumanTrust has no {what}, as persons have effects: fit reports; the posterior has "
        "log_likelihood and posterior_predictive."
    )


def _first(names: Sequence[str], start: str) -> int:
    """Index of the first name with a beginning, -1 if there is none."""
    return next((m for m, name in enumerate(names) if name.startswith(start)), -1)


def _paired(names: Sequence[str], n: int, *, asymmetric: bool) -> np.ndarray:
    """Weights (column, feature + 1) that coefficients give, one for each feature or pair."""
    rows = np.eye(n + 1)
    if asymmetric:
        return rows
    kept = np.ones(n + 1, dtype=bool)
    for m, name in enumerate(names):
        if name.startswith(SUCCESS) and (other := FAILURE + name.removeprefix(SUCCESS)) in names:
            rows[m, names.index(other)] = -1.0
            kept[names.index(other)] = False
    return rows[kept]


def _no_slots(shape: tuple[int, int]) -> Slots:
    """Slots of one bound, for the priors of columns."""
    z, none = np.zeros((1, 1, shape[1])), np.zeros(1, dtype=int)
    return Slots(np.zeros((1, 1)), z, none, none, np.ones(1), 1, shape[0])
