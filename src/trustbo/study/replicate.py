"""Does a model hold on another log? Fits to one, scores on the others, and simple baselines."""

import importlib.util
import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import expit, ndtr
from scipy.stats import norm

from trustbo.data import Mission
from trustbo.errors import TrustboError, require_choice, require_package
from trustbo.inference.fit import fit
from trustbo.inference.score import score, summarize_scores
from trustbo.models.model import TrustModel, require_model
from trustbo.stacking import require_same_team

_LEAST_SD = 1e-3
_COLUMNS = ["r2", "mean_log_score", "low", "high", "behind", "behind_low", "behind_high",
            "coverage_50", "coverage_90", "n"]  # fmt: skip
_N_BOOTSTRAP = 1000


class Forecast(NamedTuple):
    """Normal forecasts of rates one bound ahead, NaN where there is none."""

    mean: np.ndarray  # (bound, robot)
    sd: np.ndarray  # (bound, robot)


Baseline = Callable[[Sequence[Mission], Sequence[Mission]], list[Forecast]]
"""Learns from missions, and forecasts each of others bound by bound."""


OfLog = Sequence[Mission] | Callable[[str], Sequence[Mission]]
"""Missions of a log, or a function to them of the name of the log fitted to."""


def replicate(
    missions: Mapping[str, OfLog],
    models: Mapping[str, TrustModel] | Sequence[TrustModel],
    *,
    baselines: Sequence[str] | None = None,
    seed: int = 0,
) -> pd.DataFrame:
    """Fit to the missions of each log, and score one bound ahead on those of every other.

    Rates of all bounds but the first of each mission are scored, as some baselines need one before;
    forecasts of a bound are given all rates before it.

    Args:
        missions: Missions by the name of their log, of the same robots and features; or functions
            of the name of the log fitted to, where features too are learned there, as by a sensor.
        models: Trust models by name, or several, which have the names of their kinds.
        baselines: Names of `BASELINES`; by default all whose packages are there.
        seed: Seed of the fits and scores.

    Returns:
        Table with a row for each (model, fitted to, scored on), the best mean log score first:
        `r2`, `mean_log_score` (nats, of counts of ticks where all rates have them) with the ends
        `low` and `high` of its 95 % interval; how far `behind` that of the best on the same logs it
        is, with `behind_low` and `behind_high`; `coverage_50`, `coverage_90` and `n`, the number of
        rates. Intervals are of a bootstrap over blocks of bounds that follow each other, in all
        missions at once, as those of a log with several leads are of the same time.

    Raises:
        TrustboError: Fewer than two logs, no models, an unknown baseline, or a missing package.
        ShapeError: Logs of different robots or features.
    """
    if len(missions) < 2:
        raise TrustboError(
            "a replication needs the missions of two logs at least, {name: missions}; got "
            f"{list(missions)}. Cut one by Log.between, or its missions into two parts."
        )
    for model in models.values() if isinstance(models, Mapping) else models:
        require_model(model)
    named = models if isinstance(models, Mapping) else {m.in_short(): m for m in models}
    chosen = _chosen(baselines)
    rows = {}
    for one, other in itertools.permutations(missions, 2):
        learned, ahead = (list(_of_log(missions[name], one)) for name in (one, other))
        require_same_team([*learned, *ahead])
        scored = {}
        for name, model in named.items():
            posterior = fit(learned, model, seed=seed, progress=False)
            scored[name] = _of_posterior(posterior, ahead, seed)
        for name in chosen:
            scored[name] = _of_forecasts(BASELINES[name](learned, ahead), ahead, seed)
        intervals = _intervals({name: scores[-1] for name, scores in scored.items()}, seed)
        for name, scores in scored.items():
            rows[name, one, other] = summarize_scores(*scores) | intervals[name]
    index = pd.MultiIndex.from_tuples(rows, names=["model", "fitted to", "scored on"])
    table = pd.DataFrame(list(rows.values()), index=index, columns=_COLUMNS)
    return table.sort_values("mean_log_score", ascending=False)


def _of_log(missions: OfLog, learned: str) -> Sequence[Mission]:
    return missions(learned) if callable(missions) else missions


def _of_posterior(posterior: object, ahead: Sequence[Mission], seed: int) -> np.ndarray:
    """Arguments of `summarize_scores`, (4, mission, bound, robot), first bounds left out."""
    scores = score(posterior, ahead, filtered=True, seed=seed).isel(bound=slice(1, None))  # pyright: ignore
    return np.stack([scores[name].values for name in ("contact_rate", "mean", "pit", "log_score")])


def _intervals(scores: Mapping[str, np.ndarray], seed: int) -> dict[str, dict[str, float]]:
    """Ends of the mean log score, and distance to the best with its ends, by name.

    Scores are (mission, bound, robot); blocks of bounds are drawn alike for all names.
    """
    for name, values in scores.items():
        if not np.isfinite(values).any():
            raise TrustboError(f"{name} forecasts no rate: give logs of more than one bound.")
    rng, n_bounds = np.random.default_rng(seed), max(v.shape[1] for v in scores.values())
    length = math.ceil(n_bounds ** (1 / 3))
    starts = rng.integers(n_bounds, size=(_N_BOOTSTRAP, -(-n_bounds // length), 1))
    drawn = (starts + np.arange(length)) % n_bounds
    drawn = drawn.reshape(_N_BOOTSTRAP, -1)[:, :n_bounds]
    means, found = {}, {}
    for name, values in scores.items():
        total, count = np.nansum(values, axis=(0, 2)), np.isfinite(values).sum((0, 2))
        by_draw = total[drawn].sum(1) / np.maximum(count[drawn].sum(1), 1)
        means[name] = total.sum() / count.sum(), by_draw
    best = max(means, key=lambda name: means[name][0])
    for name, (mean, by_draw) in means.items():
        low, high = np.quantile(by_draw, (0.025, 0.975))
        behind = np.quantile(means[best][1] - by_draw, (0.025, 0.975))
        found[name] = {"low": low, "high": high, "behind": means[best][0] - mean,
                       "behind_low": behind[0], "behind_high": behind[1]}  # fmt: skip
    return found


def _of_forecasts(forecasts: Sequence[Forecast], ahead: Sequence[Mission], seed: int) -> np.ndarray:
    """The same of normal forecasts: counts of ticks have the mass around them, the rest at 0 and 1.

    That is more than a normal density gives a rate at a limit: baselines are censored too.
    """
    rng = np.random.default_rng(seed)
    most = max(len(mission.bounds) for mission in ahead)
    out = np.full((4, len(ahead), most - 1, len(ahead[0].robots)), np.nan)
    counted = all(np.isfinite(m.n_ticks[np.isfinite(m.contact_rate)]).all() for m in ahead)
    for j, (mission, (mean, sd)) in enumerate(zip(ahead, forecasts, strict=True)):
        y, half = mission.contact_rate, 0.5 / mission.n_ticks
        sd = np.maximum(sd, _LEAST_SD)
        if counted:
            with np.errstate(invalid="ignore"):
                below = np.where(y - half <= 0.0, 0.0, ndtr((y - half - mean) / sd))
                upto = np.where(y + half >= 1.0, 1.0, ndtr((y + half - mean) / sd))
            log_score = np.log(np.maximum(upto - below, 1e-12))
            pit = below + rng.random(y.shape) * (upto - below)
        else:
            log_score, pit = norm.logpdf(y, mean, sd), ndtr((y - mean) / sd)
        of_one = np.stack([y, np.clip(mean, 0.0, 1.0), pit, log_score])
        of_one[:, np.isnan(y) | np.isnan(mean)] = np.nan
        out[:, j, : len(y) - 1] = of_one[:, 1:]
    return out


def persistence(learned: Sequence[Mission], ahead: Sequence[Mission]) -> list[Forecast]:
    """The last rate of the same robot, with the sd of its errors."""
    error = np.concatenate([np.diff(m.contact_rate, axis=0).ravel() for m in learned])
    sd = float(np.sqrt(np.nanmean(error**2)))
    forecasts = []
    for mission in ahead:
        last = _before(mission.contact_rate)
        forecasts.append(Forecast(last, np.full(last.shape, sd)))
    return forecasts


def ridge(learned: Sequence[Mission], ahead: Sequence[Mission]) -> list[Forecast]:
    """Ridge regression (scikit-learn) on features, the last ones, the last rate and the robot.

    Features outside [0, 1] enter as log odds and as chances. The penalty is chosen by leaving out.
    """
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    wide = _unbounded(learned)
    tables = [_lagged(mission, wide) for mission in learned]
    x, y = np.concatenate([t[0] for t in tables]), np.concatenate([t[1] for t in tables])
    kept = np.isfinite(x).all(1) & np.isfinite(y)
    model = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 3, 13))).fit(x[kept], y[kept])
    sd = float(np.std(y[kept] - model.predict(x[kept])))
    forecasts = []
    for mission in ahead:
        x, _ = _lagged(mission, wide)
        known, mean = np.isfinite(x).all(1), np.full(len(x), np.nan)
        if known.any():
            mean[known] = model.predict(x[known])
        mean = mean.reshape(mission.contact_rate.shape)
        forecasts.append(Forecast(mean, np.full(mean.shape, sd)))
    return forecasts


def unobserved_components(learned: Sequence[Mission], ahead: Sequence[Mission]) -> list[Forecast]:
    """AR(1) and noise around a regression on features (statsmodels' UnobservedComponents).

    Parameters are common to all robots, of maximum likelihood.
    """
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    wide, gap = _unbounded(learned), max(len(m.bounds) for m in learned)
    series, regressors = [], []
    for mission in learned:
        z, y = _inputs(mission, wide), mission.contact_rate
        for i in np.flatnonzero(np.isfinite(y).any(0)):
            # Bounds not measured between two series, over which an AR(1) forgets.
            series.append(np.append(y[:, i], np.full(gap, np.nan)))
            regressors.append(np.vstack([z[:, i], np.zeros((gap, z.shape[2]))]))

    def model(y: np.ndarray, z: np.ndarray) -> UnobservedComponents:
        exog = np.column_stack([np.ones(len(y)), z])
        return UnobservedComponents(y, irregular=True, autoregressive=1, exog=exog)

    y, z = np.concatenate(series), np.concatenate(regressors)
    seen = np.isfinite(y)
    start = np.linalg.lstsq(np.column_stack([np.ones(seen.sum()), z[seen]]), y[seen], rcond=None)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its optimiser's, of convergence
        fitted: Any = model(y, z).fit(start_params=[0.01, 0.005, 0.3, *start], disp=0, maxiter=60)
        params = fitted.params
    forecasts = []
    for mission in ahead:
        z, y = _inputs(mission, wide), mission.contact_rate
        mean, sd = np.full((2, *y.shape), np.nan)
        for i in np.flatnonzero(np.isfinite(y).any(0)):
            found = model(y[:, i], z[:, i]).filter(params).get_prediction()
            mean[:, i], sd[:, i] = found.predicted_mean, np.sqrt(found.var_pred_mean)
        forecasts.append(Forecast(mean, sd))
    return forecasts


BASELINES: dict[str, Baseline] = {
    "persistence": persistence,
    "ridge": ridge,
    "unobserved_components": unobserved_components,
}
"""Forecasts that a model should beat."""
_PACKAGES = {"unobserved_components": "statsmodels"}


def _chosen(baselines: Sequence[str] | None) -> tuple[str, ...]:
    """Baselines, by default those whose packages are installed."""
    if baselines is None:
        return tuple(n for n in BASELINES if importlib.util.find_spec(_PACKAGES.get(n, "sklearn")))
    for name in baselines:
        require_choice("baseline", name, BASELINES)
        if package := _PACKAGES.get(name):
            require_package(f"baseline {name!r} needs", package, package)
    return tuple(baselines)


def _before(values: np.ndarray) -> np.ndarray:
    """Values of the bound before, the latest that is known; NaN at the first, (bound, ...)."""
    k = np.arange(len(values)).reshape(-1, *(1,) * (values.ndim - 1))
    latest = np.maximum.accumulate(np.where(np.isnan(values), 0, k), axis=0)
    known = np.take_along_axis(values, latest, axis=0)
    return np.concatenate([np.full((1, *values.shape[1:]), np.nan), known[:-1]])


def _unbounded(missions: Sequence[Mission]) -> np.ndarray:
    """Features with values outside [0, 1], (feature,)."""
    z = np.concatenate([m.awareness.reshape(-1, m.awareness.shape[-1]) for m in missions])
    return (np.nanmin(z, axis=0) < 0.0) | (np.nanmax(z, axis=0) > 1.0)


def _inputs(mission: Mission, unbounded: np.ndarray) -> np.ndarray:
    """Features, and the chances of those that are unbounded, (bound, robot, input)."""
    z = mission.awareness
    return np.concatenate([z, expit(z[..., unbounded])], axis=-1)


def _lagged(mission: Mission, unbounded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inputs of a regression on what is known before each bound (row, column), and rates."""
    z, y = _inputs(mission, unbounded), mission.contact_rate
    who = np.broadcast_to(np.eye(y.shape[1]), (*y.shape, y.shape[1]))
    x = np.concatenate([z, _before(z), _before(y)[..., None], who], axis=-1)
    return x.reshape(-1, x.shape[-1]), y.ravel()
