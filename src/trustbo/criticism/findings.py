"""Findings of tests in words."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

from trustbo.criticism.departures import Departure, cell_columns
from trustbo.criticism.joint_normal import Data
from trustbo.criticism.prior_moments import Coefficients, estimate
from trustbo.criticism.score import Innovations, Outcome, judge
from trustbo.data import Mission
from trustbo.display import joined

_MOST_CELLS = 3
_LEVEL = 0.05
LEAST = {"place": 0.05, "curvature": 0.05, "prior": 0.05, "correlation": 0.2, "family": 0.05}
"""Size of each departure from which on it is a fault, see `size_of`."""
IN_CONTACT = "place", "curvature", "prior"
"""Departures whose sizes are of trust, and those from which on they are faults of contact."""


def family_test(innovations: Innovations) -> Outcome:
    """Test the residuals for a normal shape, by their third and fourth moments."""
    moments = np.array([(innovations.e**power).mean(0) for power in (3, 4)])
    sd = moments[:, 1:].std(1, keepdims=True)
    z = (moments - moments[:, 1:].mean(1, keepdims=True)) / sd
    log_p = np.log(2.0) + stats.norm.logsf(np.abs(z))
    return judge(["skewness", "tails"], z[:, 0], log_p[:, 0], log_p[:, 1:])


def size_of(
    outcome: Outcome,
    test: Departure | None,
    innovations: Innovations,
    coefficients: Coefficients,
) -> float:
    """Size of the departure that a test has the strongest evidence of.

    Of places, a bent response and a weight of the wrong sign: root mean square of what they add to
    the expected rates; of a conflict with the prior: that of the distance of rates expected given
    those before, by the coefficients' estimates and by the posterior. Of correlation: its share of
    the variance of a rate given the rates before. Of the family: distance of the share of rates in
    90 % intervals, one bound ahead, from 90 %.

    Args:
        outcome: Outcome of the test.
        test: Departure; None for those that are not, the prior and the family.
        innovations: Innovations.
        coefficients: Coefficients, for the prior.
    """
    label = outcome.label
    if label in ("skewness", "tails"):
        inside = np.abs(innovations.e[:, 0]) <= stats.norm.ppf(0.95)
        return float(abs(inside.mean() - 0.9))
    if test is None:
        mean, _ = estimate(innovations, coefficients)
        if label.startswith("sign of "):
            i = coefficients.labels.index(label.removeprefix("sign of "))
            return float(abs(mean[i]) * coefficients.jacobian[:, i].std())
        shift = innovations.X[:, coefficients.columns] @ (mean - coefficients.fitted)
        return float(np.sqrt(((np.diag(innovations.L) * shift) ** 2).mean()))
    if label in test.effects:
        (effect,), _ = innovations.estimate(test.effects[label])
        left = innovations.left_of(test.effects[label])
        return float(abs(effect) * np.sqrt((left**2).mean()))
    U = test.sources[label]
    variance = innovations.size_of(U) * np.diag(U).mean()
    if test.name == "place":
        return float(np.sqrt(variance))
    return float(variance / (variance + (np.diag(innovations.L) ** 2).mean()))


def coverage_row(curves: xr.Dataset) -> tuple[object, ...]:
    """Row of the coverage of predictions one mission ahead."""
    if "coverage" not in curves:
        return "", *[np.nan] * 6, "not known: there is one mission."
    share, low, high = (
        float(curves[name].sel(level=0.9)) for name in ("coverage", "coverage_low", "coverage_high")
    )
    where = "within" if low <= share <= high else "outside"
    return "90 %", share, *[np.nan] * 5, (
        f"{share:.0%} of the rates lie in 90 % intervals given earlier missions, {where} the band "
        f"of {low:.0%} to {min(high, 1.0):.0%}."
    )  # fmt: skip


def finding(
    name: str,
    outcome: Outcome,
    innovations: Innovations,
    data: Data,
    missions: Sequence[Mission],
    tests: Mapping[str, Departure],
    coefficients: Coefficients,
) -> str:
    """Sentence on the finding of a test."""
    label = outcome.label
    if name == "place":
        return _of_places(tests[name].sources[label], label, innovations, data, missions)
    if name == "curvature":
        (effect,), _ = innovations.estimate(tests[name].effects[label])
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
    cut = (data.rates <= 0.0) | (data.rates >= 1.0)
    limits = (cut & (data.y == data.rates)).mean()  # of rates that are taken as they are
    end = f"; {limits:.0%} of the rates are 0 or 1, try observation='censored'" if limits else ""
    e = innovations.e[:, 0]
    shape = f"{label}: skewness {stats.skew(e):.2f}, excess kurtosis {stats.kurtosis(e):.2f}"
    return f"residuals are not normal ({shape}){end}."


def _of_places(
    source: np.ndarray,
    label: str,
    innovations: Innovations,
    data: Data,
    missions: Sequence[Mission],
) -> str:
    sd = np.sqrt(innovations.size_of(source))
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


def verdict_of(fault: str, table: pd.DataFrame, wrong: Sequence[str]) -> str:
    """Verdict in words from the rows of the checks, and those in which a fault is found."""
    checks = [str(name) for name in table.index]
    size, limit, p, after = (
        table[name].to_numpy(dtype=float) for name in ("size", "limit", "p_adjusted", "p_after")
    )
    if fault == "none":
        small = [name for name, one in zip(checks, p, strict=True) if one <= _LEVEL]
        end = f"; too small to be a fault: {joined(small)}." if small else "."
        return f"no fault is found by {np.isfinite(size - limit).sum()} checks{end}"
    verdict = f"{fault}: {table['finding'].to_numpy()[checks.index(fault)]}"
    others = [i for i, name in enumerate(checks) if name in wrong and name != fault]
    gone = [checks[i] for i in others if after[i] * len(others) > _LEVEL]
    left = [checks[i] for i in others if not after[i] * len(others) > _LEVEL]
    for names, what in ((gone, "It explains"), (left, "It does not explain")):
        verdict += f" {what} what is found under {joined(names)}." if names else ""
    return verdict
