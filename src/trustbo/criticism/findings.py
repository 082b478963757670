"""Findings of tests in words."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

from trustbo.criticism.departures import Departure, cell_columns
from trustbo.criticism.joint_normal import Data
from trustbo.criticism.prior_moments import Coefficients, estimate
from trustbo.criticism.score import Innovations, Outcome, judge
from trustbo.data import Mission
from trustbo.display.card import joined

_MOST_CELLS = 3
_LEVEL = 0.05
_SKEWNESS, _KURTOSIS = 0.5, 1.0  # of residuals, from which on they matter


def family_test(innovations: Innovations) -> Outcome:
    """Test the residuals for a normal shape, by their third and fourth moments."""
    moments = np.array([(innovations.e**power).mean(0) for power in (3, 4)])
    sd = moments[:, 1:].std(1, keepdims=True)
    z = (moments - moments[:, 1:].mean(1, keepdims=True)) / sd
    log_p = np.log(2.0) + stats.norm.logsf(np.abs(z))
    return judge(["skewness", "tails"], z[:, 0], log_p[:, 0], log_p[:, 1:])


def shape_of(innovations: Innovations) -> tuple[float, float]:
    """Skewness and excess kurtosis of the residuals."""
    e = innovations.e[:, 0]
    return float(stats.skew(e)), float(stats.kurtosis(e))


def changes_plans(innovations: Innovations) -> bool:
    """Whether the residuals' shape is far enough from the normal one to matter for plans."""
    skewness, kurtosis = shape_of(innovations)
    return abs(skewness) > _SKEWNESS or abs(kurtosis) > _KURTOSIS


def coverage_row(curves: xr.Dataset) -> tuple[str, float, float, float, float, str]:
    """Row of the coverage of predictions one mission ahead."""
    if "coverage" not in curves:
        return "", np.nan, np.nan, np.nan, np.nan, "not known: there is one mission."
    share, low, high = (
        float(curves[name].sel(level=0.9)) for name in ("coverage", "coverage_low", "coverage_high")
    )
    where = "within" if low <= share <= high else "outside"
    return "90 %", share, np.nan, np.nan, np.nan, (
        f"{share:.0%} of the rates lie in 90 % intervals given earlier missions, {where} the band "
        f"of {low:.0%} to {min(high, 1.0):.0%}."
    )  # fmt: skip


def finding(
    name: str,
    outcome: Outcome,
    innovations: Innovations,
    data: Data,
    missions: Sequence[Mission],
    tests: Sequence[Departure],
    coefficients: Coefficients,
) -> str:
    """Sentence on the finding of a test."""
    mission, _, robot = data.slots.T
    label, one = outcome.label, np.ones(len(data.slots))
    if name == "place":
        return _of_places(label, innovations, data, missions, tests)
    if name == "robot":
        here = (robot == missions[0].robots.index(label)) * one
        shift = _shift(innovations, here)
        return f"{label} differs from the other robots: {shift} of trust per bound on average."
    if name == "change":
        starts = np.arange(2, len(missions) - 1)
        effect, se = innovations.estimate((mission[:, None] >= starts) * 1.0)
        start = starts[np.argmax(np.abs(effect / se))] if label == "drift" else int(label)
        shift = _shift(innovations, (mission >= start) * one)
        return f"from mission {start} on (counted from 0) trust changes by {shift} per bound."
    if name == "curvature":
        (test,) = (departure for departure in tests if departure.name == name)
        (effect,), _ = innovations.estimate(test.effects[label])
        bend = "flattens (saturates)" if effect < 0.0 else "steepens"
        return f"the response to {label} bends: it {bend} as {label} grows."
    if name == "prior":
        mean, cov = estimate(innovations, coefficients)
        i = coefficients.labels.index(label.removeprefix("sign of "))
        by_rates = f"{mean[i]:.2f} +- {np.sqrt(cov[i, i]):.2f}"
        prior = f"{coefficients.mean[i]:.2f} +- {np.sqrt(coefficients.cov[i, i]):.2f}"
        what = "has the wrong sign" if label.startswith("sign") else "conflicts with its prior"
        return (
            f"{coefficients.labels[i]} {what}: {by_rates} by the rates alone, {prior} by the prior."
        )
    if name == "correlation":
        return f"noise is correlated: {label} go together beyond what the model says."
    limits = ((data.y <= 0.0) | (data.y >= 1.0)).mean()
    end = f"; {limits:.0%} of the rates are 0 or 1, try observation='auto'" if limits else ""
    skewness, kurtosis = shape_of(innovations)
    shape = f"{label}: skewness {skewness:.2f}, excess kurtosis {kurtosis:.2f}"
    return f"residuals are not normal ({shape}){end}."


def _of_places(
    label: str,
    innovations: Innovations,
    data: Data,
    missions: Sequence[Mission],
    tests: Sequence[Departure],
) -> str:
    (test,) = (departure for departure in tests if departure.name == "place")
    sd = np.sqrt(innovations.size_of(test.sources[label]))
    names, columns = cell_columns(missions, data)
    effect, se = innovations.estimate(columns)
    z = effect / se
    limit = stats.norm.isf(0.5 * _LEVEL / len(names))
    strong = [i for i in np.argsort(-np.abs(z)) if np.abs(z[i]) > limit]
    sentence = f"trust depends on {label} beyond awareness, sd {sd:.2g} per bound"
    if not strong:
        return f"{sentence}; no single cell stands out."
    cells = ", ".join(f"{names[i]} {effect[i]:+.2f} +- {se[i]:.2f}" for i in strong[:_MOST_CELLS])
    more = f", and {len(strong) - _MOST_CELLS} more" if len(strong) > _MOST_CELLS else ""
    return f"{sentence}; cells that stand out: {cells}{more}."


def _shift(innovations: Innovations, column: np.ndarray) -> str:
    (effect,), (se,) = innovations.estimate(column[:, None])
    return f"{effect:+.3f} +- {se:.3f}"


def verdict_of(fault: str, table: pd.DataFrame, wrong: Sequence[str]) -> str:
    """Verdict in words from the rows of the checks, and those in which something is found."""
    checks = [str(name) for name in table.index]
    adjusted, after = (table[name].to_numpy(dtype=float) for name in ("p_adjusted", "p_after"))
    n = int(np.isfinite(adjusted).sum())
    if fault == "none":
        return f"no fault is found by {n} checks, at a level of 5 % for all together."
    verdict = f"{fault}: {table['finding'].to_numpy()[checks.index(fault)]}"
    others = [i for i, name in enumerate(checks) if name in wrong and name != fault]
    gone = [checks[i] for i in others if after[i] * len(others) > _LEVEL]
    left = [checks[i] for i in others if not after[i] * len(others) > _LEVEL]
    if gone:
        verdict += f" It explains what is found under {joined(gone)}."
    if left:
        verdict += f" It does not explain what is found under {joined(left)}."
    return verdict
