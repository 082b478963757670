"""Predictions of people's reports from a posterior of `HumanTrust`."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission, levels_of
from trustbo.errors import TrustboError, require_choice, require_count, require_whole
from trustbo.inference.density import Density, JointDraws
from trustbo.inference.draws import QUANTILES, as_fitted, is_of_people, read_posterior
from trustbo.inference.latent import predictors
from trustbo.models.model import TrustModel
from trustbo.parallel import computing
from trustbo.stacking import require_same_team
from trustbo.statespace.blocks import each
from trustbo.streams import stream

_ALIKE = 16
"""Number of draws of a fitted person's trust per draw of the population parameters."""
_JITTER = 1e-12
"""Number added to the covariance of a person's trust."""
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

    The earlier reports determine the weights of draws of the person's start, level and gains.
    Reports at the same bound are not used to predict each other.

    Args:
        posterior: Posterior of `HumanTrust`.
        missions: One mission per person; NaN reports are also predicted.
        given: `"earlier"` to use the earlier reports of the person, or `"none"` to use no reports.
        fitted: Whether the posterior was fitted to the earlier reports of these persons. If so,
            these reports do not change the weights of the population parameters again.
        n_draws: Maximum number of draws of a person's trust.
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
    ahead = Density(of_fit.model, of_fit.model.observations(missions))

    # For a fitted person, earlier reports reweight only the copies of each draw among themselves.
    copies = _ALIKE if fitted else 1
    some = np.unique(np.linspace(0, len(draws.c) - 1, max(1, n_draws // copies)).astype(int))
    draws = draws.at(np.repeat(some, copies))
    alike = _ALIKE if fitted else len(some)

    levels = levels_of(posterior.attrs["scale"])
    shape = ahead.observations.contact_rate.shape
    out = {name: np.full(shape, np.nan) for name in ("mean", "log_score")}
    out["quantile"] = np.full((*shape, len(QUANTILES)), np.nan)
    if levels:
        out["probability"] = np.full((*shape, levels), np.nan)
    for j, mission in enumerate(missions):
        rng = stream(seed, "reports", j)
        person = _of_person(ahead, draws, j, given == "earlier", alike, rng)
        for (k, i), weight, center, var in person:
            if k < len(mission.bounds):
                found = _prediction(ahead, (j, k, i), weight, center, var, draws, levels, rng)
                for name, value in found.items():
                    out[name][j, k, i] = value

    for name in ("mean", "quantile"):
        out[name] = _answer_of(out[name], levels)
    report = _answer_of(ahead.observations.contact_rate, levels)
    return _dataset(report, out, levels, missions[0].robots)


def _of_person(
    ahead: Density, draws: JointDraws, j: int, earlier: bool, alike: int, rng: np.random.Generator
) -> Iterator[tuple[tuple[int, int], np.ndarray, np.ndarray, np.ndarray]]:
    """Yield (bound, robot), draw weights, and mean and variance of trust for each report.

    The person's trust is drawn row by row given the reports so far. Each run of `alike` draws has
    the same total weight.
    """
    observations = ahead.observations
    likelihood = ahead.model.likelihood
    sd = draws.theta["delta_v"]
    _, n_bounds, n_robots = observations.contact_rate.shape
    y = observations.contact_rate[j].ravel()
    ticks = observations.n_ticks[j].ravel()

    # Trust of the person in each draw is normal, with this mean and root of the covariance.
    means = []
    roots = []
    for _, _, predictor, of_all in predictors(ahead, draws):
        means.append(of_all[:, j])
        cov = each(predictor.covariance, ahead.blocks.label)
        cov = np.broadcast_to(cov, (len(of_all), *cov.shape[1:]))[:, j % cov.shape[1]]
        roots.append(np.linalg.cholesky(cov + _JITTER * np.eye(cov.shape[-1])))
    mean = np.concatenate(means)
    root = np.concatenate(roots)

    white = np.zeros(mean.shape)
    log_weight = np.zeros(len(mean))
    for k in range(n_bounds):
        runs = log_weight.reshape(-1, alike)
        weight = np.exp(runs - np.logaddexp.reduce(runs, axis=1, keepdims=True)).ravel()
        known = k * n_robots if earlier else 0  # rows of the reports that may be used
        for i in range(n_robots):
            r = k * n_robots + i
            center = mean[:, r] + (root[:, r, :known] * white[:, :known]).sum(1)
            var = (root[:, r, known : r + 1] ** 2).sum(1)
            yield (k, i), weight / len(runs), center, var

            # Draw trust given all reports so far, including reports at the same bound.
            a = mean[:, r] + (root[:, r, :r] * white[:, :r]).sum(1)
            d = root[:, r, r]
            white[:, r] = rng.standard_normal(len(mean))
            if earlier and not np.isnan(y[r]):
                f, log_mass = likelihood.draw(y[r], ticks[r], a, d**2, sd, rng)
                white[:, r] = (f - a) / d
                log_weight = log_weight + log_mass


def _prediction(
    ahead: Density,
    slot: tuple[int, int, int],
    weight: np.ndarray,
    center: np.ndarray,
    var: np.ndarray,
    draws: JointDraws,
    levels: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Predict a report given trust ~ N(center, var) in each draw, with weights (draw,)."""
    likelihood = ahead.model.likelihood
    sd = draws.theta["delta_v"]
    y = ahead.observations.contact_rate[slot]
    ticks = ahead.observations.n_ticks[slot]

    found: dict[str, Any] = {}
    if not np.isnan(y):
        log_mass, _, _ = likelihood.moment_match(y, ticks, center, var, sd)
        found["log_score"] = np.log(max(weight @ np.exp(log_mass), _LEAST_MASS))

    if levels:  # the probability of each answer is known
        answers = np.arange(levels) / (levels - 1.0)
        log_masses = [
            likelihood.moment_match(answer, ticks, center, var, sd)[0] for answer in answers
        ]
        mass = weight @ np.exp(np.stack(log_masses, axis=1))
        mass = np.maximum(mass, _LEAST_MASS) / mass.sum()
        which = np.searchsorted(np.cumsum(mass) - _CLOSE, QUANTILES)
        quantile = answers[np.minimum(which, levels - 1)]
        return found | {"mean": mass @ answers, "quantile": quantile, "probability": mass}

    # Otherwise, draw a report from each draw of trust, for weighted quantiles.
    trust = center + np.sqrt(var) * rng.standard_normal(len(var))
    drawn = likelihood.sample(trust, sd, ticks, rng)

    order = np.argsort(drawn)
    which = np.searchsorted(np.cumsum(weight[order]), QUANTILES)
    quantile = drawn[order][np.minimum(which, len(drawn) - 1)]
    return found | {"mean": weight @ drawn, "quantile": quantile}


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
