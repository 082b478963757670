"""Self-reported trust of people, modelled as in `PooledTrust`, with outcomes as inputs."""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import numpyro.distributions as dist

from trustbo.data import levels_of
from trustbo.display import Rows
from trustbo.errors import TrustboError, require_choice, require_positive
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Theta
from trustbo.models.families import FAMILIES, Family, Levels
from trustbo.models.observations import Observations
from trustbo.models.pooled import PooledTrust
from trustbo.models.priors import Priors
from trustbo.statespace import Inputs
from trustbo.statespace.matrices import namespace

SUCCESS = "success"
FAILURE = "failure"
"""Prefixes of the names of outcome features."""
SDS = "tau_start", "tau_level", "tau_gain"
"""Names of the standard deviations of the personal coefficients."""


@dataclass(frozen=True, repr=False)
class HumanTrust(PooledTrust):
    """Model of self-reported trust as a base level plus decaying effects of past outcomes.

    Trust x^k of a person at step k is ::

        x^k = base^k + d^k
        base^k = b + weights . features^k + personal level
        d^k = beta0 d^{k-1} + gains . inputs^k + delta_w w^k,    d^0 = 0

    The personal start enters d^1, and personal gains enter d^k. Start, level and gains are
    independent, with mean 0 and standard deviations tau_start, tau_level and tau_gain. Since each
    person has only one mission, these coefficients are part of the covariance of trust and have no
    columns. Inputs are outcomes: features whose names begin with `success` or `failure`, possibly
    scaled by task demands. A person is stored as a mission, a step as a bound, and a rated task as
    a robot, as in `trustbo.logs.read_reports`.

    Attributes:
        scale: `"unit"` for numbers in [0, 1], censored at 0 and 1; or, for example, `"likert7"` for
            seven levels, with cut points halfway between the levels and logistic noise with sd
            delta_v.
        tau_start: Scale of the half-normal prior on the standard deviation of personal starts.
        tau_level: Scale of the half-normal prior on the standard deviation of personal levels.
        tau_gain: Scale of the half-normal prior on the standard deviation of personal gains.

    Raises:
        TrustboError: If the scale is unknown, a tau is not positive, an effect is given, or the
            family or the memory is changed.

    Example:
        >>> people = tb.logs.read_reports("answers.csv", outcome="outcome", scale="likert7")
        >>> posterior = tb.fit(people, tb.models.HumanTrust(scale="likert7", tau_gain=0.1))
        >>> posterior["posterior"]["beta"].mean(("chain", "draw"))  # after success and failure
    """

    family: str = "censored"  # only on the unit scale; see `likelihood`
    memory: str = "deviation"
    scale: str = "unit"
    tau_start: float = 0.3
    tau_level: float = 0.2
    tau_gain: float = 0.2

    def __post_init__(self) -> None:
        levels_of(self.scale)
        require_choice("HumanTrust.family", self.family, ["censored"])
        require_choice("HumanTrust.memory", self.memory, ["deviation"])
        if self.priors is None:
            object.__setattr__(self, "priors", _default_priors())
        super().__post_init__()

        for name in SDS:
            number = require_positive(f"HumanTrust.{name}", getattr(self, name))
            object.__setattr__(self, name, number)

        if self.effects or self.shared_noise:
            raise TrustboError(
                f"HumanTrust allows neither effects nor shared_noise; got effects={self.effects!r}."
            )

    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, dist.Distribution]:
        """See `TrustModel.hyperpriors`; also includes the sds of the personal coefficients."""
        sds = {name: dist.HalfNormal(getattr(self, name)) for name in SDS}
        return super().hyperpriors(n_robots, n_features) | sds

    @cached_property
    def likelihood(self) -> Family:  # pyright: ignore
        """See `TrustModel.likelihood`."""
        levels = levels_of(self.scale)
        return Levels(levels) if levels else FAMILIES["censored"]

    def observations(self, missions: Any, workspace: Any = None) -> Observations:
        """See `TrustModel.observations`; raise TrustboError if the scale of the reports differs."""
        observations = super().observations(missions, workspace)

        levels = levels_of(self.scale)
        wanted = levels - 1.0 if levels else np.nan
        bad = ~np.isnan(observations.contact_rate) & ~np.isclose(
            observations.n_ticks, wanted, equal_nan=True
        )
        if bad.any():
            raise TrustboError(
                f"HumanTrust(scale={self.scale!r}) needs reports with n_ticks = {wanted:g} (number "
                "of levels minus 1, or nan on the unit scale); got n_ticks = "
                f"{observations.n_ticks[bad][0]:g}. Give the same scale to read_reports and "
                "HumanTrust."
            )

        return observations

    @property
    def joint(self) -> bool:
        """See `TrustModel.joint`; true, because personal effects appear in all reports."""
        return True

    @property
    def exchangeable(self) -> bool:
        """See `TrustModel.exchangeable`."""
        return False

    def carried(self, observations: Observations) -> np.ndarray:
        """See `TrustModel.carried`; outcomes are carried over, but the base level is not."""
        outcomes = [name.startswith((SUCCESS, FAILURE)) for name in observations.features]
        return np.array([*outcomes, False])

    def random_effects(self, theta: Theta, observations: Observations) -> Inputs:
        """See `TrustModel.random_effects`.

        Each person has four effects: a start, a level, a gain from success and a gain from failure.
        """
        shape = *observations.contact_rate.shape, 4
        carried = np.zeros(shape)
        carried[:, 0, :, 0] = 1.0  # start
        for i, prefix in ((2, SUCCESS), (3, FAILURE)):
            named = [m for m, name in enumerate(observations.features) if name.startswith(prefix)]
            if named:
                carried[..., i] = observations.awareness[..., named[0]]

        level = np.zeros(shape)
        level[..., 1] = 1.0

        start_sd, level_sd, gain_sd = (theta[name] for name in SDS)
        xp = namespace(start_sd)
        sds = xp.stack([start_sd, level_sd, gain_sd, gain_sd], axis=1)[:, None, None]
        by_row = observations.n_missions, -1, 4
        return Inputs(drift=carried.reshape(by_row) * sds, offset=level.reshape(by_row) * sds)

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """See `TrustModel.dims`."""
        return super().dims | dict.fromkeys(SDS, ())

    def _rows(self) -> Rows:
        kept = [row for row in super()._rows() if row[0] not in ("rates", "scale")]
        return [("reports", self.scale), *kept]


@cache
def _default_priors() -> Priors:
    """Make default priors with long memory and gains of a few tenths.

    Trust changes mainly with outcomes. `tau_start` replaces the prior on x_0.
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
