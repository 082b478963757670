"""Predictions of people's reports from a posterior of `HumanTrust`."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import softmax

from trustbo.arrays import evenly_spaced
from trustbo.data import Mission, levels_of
from trustbo.errors import (
    TrustboError,
    require_choice,
    require_count,
    require_switch,
    require_whole,
)
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.classes import OfClass
from trustbo.inference.density import JointDraws
from trustbo.inference.order import as_fitted
from trustbo.inference.posterior import is_of_people
from trustbo.inference.stored import read_posterior
from trustbo.models.families import Family
from trustbo.models.model import TrustModel
from trustbo.parallel import computing
from trustbo.stacking import require_same_team
from trustbo.statespace import kalman
from trustbo.statespace.blocks import each
from trustbo.streams import stream

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of predictions."""
_LEAST_MASS = 1e-300
"""Smallest probability of a report; its logarithm is finite."""
_CLOSE = 1e-12
"""Rounding error of a cumulative probability."""
_FINE = 1e6
"""Answers are rounded to multiples of 1 / `_FINE` to hide rounding errors."""


@computing()
def predict_reports(
    posterior: xr.DataTree,
    missions: Iterable[Mission],
    *,
    given: str = "earlier",
    fitted: bool = False,
    n_draws: int = 2000,
    seed: int = 0,
    model: TrustModel | None = None,
) -> xr.Dataset:
    """Predict each report of fitted or new people from the earlier reports of the same person.

    The person's trust is filtered under each draw of the population parameters. Moments are matched
    after each report (see `TrustFilter`), which is exact for reports strictly between 0 and 1 on
    the unit scale. Reports at the same bound are not used to predict each other.

    Args:
        posterior: Posterior of `HumanTrust`.
        missions: One mission per person; NaN reports are also predicted.
        given: `"earlier"` to use the earlier reports of the person, or `"none"` to use no reports.
        fitted: Whether the posterior was fitted to the earlier reports of these persons. If so,
            these reports do not change the weights of the population parameters again.
        n_draws: Maximum number of draws of the population parameters.
        seed: Random seed.
        model: Model of the posterior; needed if the priors are custom.

    Returns:
        Dataset over (mission, bound, robot). `report` and the predicted `mean` and `quantile` (also
        over `level`) are on the answer scale, such as 1 to 7. `log_score` is the log probability of
        the report in nats; on the unit scale, it is the log density except at 0 and 1. With levels,
        `probability` is the probability of each `answer`. The attributes are `mae`, the mean
        absolute error of medians, `mean_log_score`, and `coverage_90`, the coverage of central 90 %
        intervals.

    Raises:
        TrustboError: If the posterior is not of `HumanTrust`, or the missions have different inputs
            or a different scale.

    Example:
        >>> people = tb.logs.read_reports("answers.csv", outcome="outcome", scale="likert7")
        >>> posterior = tb.fit(people)
        >>> tb.inference.predict_reports(posterior, people, fitted=True).attrs["mae"]
    """
    require_switch("fitted", fitted)
    posterior = as_fitted("predict_reports", posterior)
    if not is_of_people(posterior):
        raise TrustboError(
            "predict_reports needs a posterior of HumanTrust; got a posterior of "
            f"{posterior.attrs.get('model')}. Use trustbo.inference.score for contact rates."
        )
    missions = require_same_team(missions)
    require_choice("given", given, ("earlier", "none"))
    seed = require_whole("seed", seed, 0)
    n_draws = require_count("n_draws", n_draws)

    of_fit, draws = read_posterior(posterior, model=model)
    if missions[0].features != of_fit.observations.features:
        raise TrustboError(
            f"the posterior was fitted to the inputs {of_fit.observations.features}, but the "
            f"missions have {missions[0].features}; give missions with the same inputs as the "
            "posterior."
        )

    target = ClassTarget(of_fit.model, of_fit.model.observations(missions))
    draws = draws.at(evenly_spaced(len(draws.c), n_draws))
    ahead = _ahead(target, draws, given == "earlier")
    log_weight = _log_weights(ahead.log_p)
    if fitted or given == "none":
        log_weight = np.zeros(log_weight.shape)

    levels = levels_of(posterior.attrs["scale"])
    sd = draws.theta["delta_v"][:, None, None]
    found = []
    for j in range(len(missions)):
        person = Person(
            weight=softmax(log_weight[:, j], axis=0),
            mean=ahead.mean[:, j],
            var=ahead.var[:, j],
            sd=sd,
            report=target.observations.contact_rate[j],
            ticks=target.observations.n_ticks[j],
        )
        rng = stream(seed, "reports", j)
        found.append(_prediction(person, target.model.likelihood, levels, rng))

    out = {name: np.stack([one[name] for one in found]) for name in found[0]}
    lengths = [len(mission.bounds) for mission in missions]
    for j, n_bounds in enumerate(lengths):
        for values in out.values():
            values[j, n_bounds:] = np.nan
    for name in ("mean", "quantile"):
        out[name] = _answer_of(out[name], levels)
    report = _answer_of(target.observations.contact_rate, levels)
    return _dataset(report, out, levels, missions[0].robots)


class Person(NamedTuple):
    """Reports of a person, and the trust before each of them under each draw."""

    weight: np.ndarray  # of each draw, (draw, bound, 1)
    mean: np.ndarray  # of trust, (draw, bound, robot)
    var: np.ndarray  # of trust, (draw, bound, robot)
    sd: np.ndarray  # of a report given trust, (draw, 1, 1)
    report: np.ndarray  # (bound, robot), NaN where there is none
    ticks: np.ndarray  # (bound, robot)


def _ahead(target: ClassTarget, draws: JointDraws, earlier: bool) -> kalman.Ahead:
    """Predict trust (draw, mission, bound, robot) from the earlier reports of each person."""
    observations = target.observations
    layout = target.density.layout
    y = layout.rows(observations.contact_rate)
    if not earlier:
        y = np.full(y.shape, np.nan)
    ticks = layout.rows(observations.n_ticks)

    parts = []
    source = OfClass(target, draws)
    for given in source.given(np.arange(source.n_draws)):
        cov = each(given.predictor.covariance, source.label)
        sd = draws.theta["delta_v"][given.some, None, None]
        parts.append(
            kalman.one_step_ahead(
                given.mean, cov, sd, y, ticks, source.likelihood, observations.n_robots
            )
        )
    joined = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return kalman.Ahead(*(layout.unstack(values) for values in joined))


def _log_weights(log_p: np.ndarray) -> np.ndarray:
    """Return the log weights (draw, mission, bound, 1) of draws given the reports before a bound.

    `log_p` (draw, mission, bound, robot) are the log masses of the reports.
    """
    of_bound = log_p.sum(-1, keepdims=True)
    return of_bound.cumsum(2) - of_bound


def _prediction(
    person: Person, likelihood: Family, levels: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Predict the reports of a person; return arrays (bound, robot, ...) by name."""

    def probability(report: np.ndarray | float) -> np.ndarray:
        log_mass, _, _ = likelihood.moment_match(
            report, person.ticks, person.mean, person.var, person.sd
        )
        return (person.weight * np.exp(log_mass)).sum(0)

    of_report = np.log(np.maximum(probability(person.report), _LEAST_MASS))
    found = {"log_score": np.where(np.isnan(person.report), np.nan, of_report)}

    if levels:  # the probability of each answer is known
        answers = np.arange(levels) / (levels - 1.0)
        mass = np.stack([probability(answer) for answer in answers], axis=-1)
        mass = np.maximum(mass, _LEAST_MASS) / mass.sum(-1, keepdims=True)
        below = mass.cumsum(-1)[..., None, :] < np.array(QUANTILES)[:, None] - _CLOSE
        which = np.minimum(below.sum(-1), levels - 1)
        return found | {"mean": mass @ answers, "quantile": answers[which], "probability": mass}

    # Otherwise, draw a report from each draw of trust, for weighted quantiles.
    trust = person.mean + np.sqrt(person.var) * rng.standard_normal(person.mean.shape)
    drawn = likelihood.sample(trust, person.sd, person.ticks, rng)
    weight = np.broadcast_to(person.weight, drawn.shape)
    quantile = np.quantile(drawn, QUANTILES, axis=0, weights=weight, method="inverted_cdf")
    return found | {"mean": (weight * drawn).sum(0), "quantile": np.moveaxis(quantile, 0, -1)}


def _dataset(
    report: np.ndarray, out: dict[str, np.ndarray], levels: int, robots: Sequence[str]
) -> xr.Dataset:
    """Collect predictions in a dataset, with summaries as attributes."""
    axes = {"quantile": ("level",), "probability": ("answer",)}
    dims = ("mission", "bound", "robot")
    variables = {"report": (dims, report)}
    variables |= {name: ((*dims, *axes.get(name, ())), values) for name, values in out.items()}

    coords: dict[str, Any] = {
        "mission": np.arange(len(report)),
        "bound": np.arange(1, report.shape[1] + 1),
        "robot": list(robots),
        "level": list(QUANTILES),
    }
    if levels:
        coords["answer"] = np.arange(1, levels + 1)

    is_given = ~np.isnan(report)
    y = report[is_given]
    low, _, median, _, high = (out["quantile"][..., i][is_given] for i in range(len(QUANTILES)))
    attrs: dict[str, Any] = {"n": len(y)}
    if len(y):
        attrs["mae"] = float(np.abs(y - median).mean())
        attrs["mean_log_score"] = float(out["log_score"][is_given].mean())
        attrs["coverage_90"] = float(((low <= y) & (y <= high)).mean())
    return xr.Dataset(variables, coords, attrs)


def _answer_of(report: Any, levels: int) -> Any:
    """Convert reports in [0, 1] to answers from 1 to `levels`, if there are levels."""
    if not levels:
        return report
    return np.round(report * (levels - 1.0) * _FINE) / _FINE + 1.0
