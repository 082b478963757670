"""Residuals of rates for tables and figures, with bands that hold whole curves of replicates."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
import xarray as xr
from scipy import stats

from trustbo.criticism.departures import cell_columns
from trustbo.criticism.joint_normal import Data
from trustbo.criticism.prior_moments import Coefficients
from trustbo.criticism.score import Innovations
from trustbo.data import Mission

PROBABILITY = 0.95
LEVELS = (0.5, 0.8, 0.9, 0.95)
_N_CLASSES, _N_LAGS, _GRID = 5, 5, np.linspace(0.0, 1.0, 101)[1:-1]


def table_of_rates(
    missions: Sequence[Mission], data: Data, innovations: Innovations
) -> pd.DataFrame:
    """Row of each measured rate: its place in the missions, its prediction and its residual."""
    j, k, i = data.slots[data.seen].T
    cells = np.array([missions[a].bounds[b].cell for a, b in zip(j, k, strict=True)])
    before = innovations.L.copy()
    spread = np.diag(before).copy()
    np.fill_diagonal(before, 0.0)
    robot, e = np.array(missions[0].robots)[i], innovations.e[:, 0]
    place = {"mission": j, "bound": k + 1, "robot": robot, "row": cells[:, 0], "col": cells[:, 1]}
    expected = innovations.normal.mean + before @ innovations.white
    predicted = {"contact_rate": data.rates, "expected": expected, "sd": spread}
    return pd.DataFrame({**place, **predicted, "residual": e, "pit": stats.norm.cdf(e)})


def groups_of(
    rates: pd.DataFrame, missions: Sequence[Mission], data: Data, innovations: Innovations
) -> pd.DataFrame:
    """Mean residual of each mission, bound, robot, cell and class of expected rate.

    `band` is the half-width of the simultaneous 95 % band of all groups of a kind.
    """
    expected = rates["expected"].to_numpy()
    edges = np.quantile(expected, np.linspace(0.0, 1.0, _N_CLASSES + 1)[1:-1])
    names, columns = cell_columns(missions, data)
    classes, of_class = np.unique(np.searchsorted(edges, expected), return_inverse=True)
    levels = [round(float(expected[of_class == c].mean()), 2) for c in range(len(classes))]
    kinds: dict[str, tuple[np.ndarray, list]] = {}
    for name in ("mission", "bound", "robot"):
        labels, index = np.unique(rates[name].to_numpy(), return_inverse=True)
        kinds[name] = index, labels.tolist()
    kinds["cell"] = columns[data.seen].argmax(1), names
    kinds["contact"] = of_class, levels
    rows = []
    for kind, (index, labels) in kinds.items():
        member = index == np.arange(len(labels))[:, None]
        n = member.sum(1)
        means = member @ innovations.e / np.maximum(n, 1)[:, None]
        # Where parameters leave next to no residual, as at first bounds, it does not stand out.
        sd = np.maximum(means[:, 1:].std(1), 0.2 / np.sqrt(np.maximum(n, 1)))
        reach = np.quantile(np.abs(means[:, 1:] / sd[:, None]).max(0), PROBABILITY)
        rows += [
            (kind, label, int(n[g]), means[g, 0], reach * sd[g])
            for g, label in enumerate(labels)
            if n[g]
        ]
    groups = pd.DataFrame(rows, columns=["kind", "group", "n", "mean", "band"])
    outside = np.abs(groups["mean"].to_numpy()) > groups["band"].to_numpy()
    return groups.assign(stands_out=outside)


def curves_of(
    data: Data, innovations: Innovations, coefficients: Coefficients, draws: np.ndarray
) -> tuple[xr.Dataset, np.ndarray]:
    """Curves of PIT, autocorrelation and coverage, each with its band; and residuals one ahead.

    Args:
        data: Missions.
        innovations: Innovations.
        coefficients: Prior of the coefficients, for predictions one mission ahead.
        draws: White noise (rate, replicate).
    """
    mission, bound, robot = data.slots[data.seen].T
    e, curves = innovations.e, {}
    below = np.array([(e <= stats.norm.ppf(u)).mean(0) for u in _GRID]) - _GRID[:, None]
    curves["pit"] = ("u", below)
    shape = len(data.n_bounds), data.n_bounds.max(), data.n_robots, e.shape[1]
    full, there = np.zeros(shape), np.zeros((*shape[:3], 1))
    full[mission, bound, robot], there[mission, bound, robot] = e, 1.0
    lags = range(1, min(_N_LAGS, shape[1] - 1) + 1)
    products = [
        (full[:, lag:] * full[:, :-lag]).sum((0, 1, 2))
        / np.maximum((there[:, lag:] * there[:, :-lag]).sum(), 1.0)
        for lag in lags
    ]
    curves["autocorrelation"] = ("lag", np.array(products))
    levels = full.sum((1, 2)) / np.sqrt(np.maximum(there.sum((1, 2)), 1.0))
    apart = range(1, min(_N_LAGS, shape[0] - 1) + 1)
    between = [(levels[lag:] * levels[:-lag]).mean(0) / (levels**2).mean(0) for lag in apart]
    curves["autocorrelation_missions"] = ("mission_lag", np.array(between))
    ahead = _one_mission_ahead(data, innovations, coefficients, draws)
    later = mission > 0
    if later.any():
        inside = [(np.abs(ahead[later]) <= stats.norm.ppf(0.5 + 0.5 * p)).mean(0) for p in LEVELS]
        curves["coverage"] = ("level", np.array(inside))
    variables = {}
    for name, (axis, values) in curves.items():
        if not len(values):
            continue
        # beta0 and the noises leave next to no autocorrelation at the first lags.
        least = 0.5 / np.sqrt(len(e)) if name == "autocorrelation" else 1e-12
        centre, sd = values[:, 1:].mean(1), np.maximum(values[:, 1:].std(1), least)
        far = np.abs(values[:, 1:] - centre[:, None]) / sd[:, None]
        reach = np.quantile(far.max(0), PROBABILITY)
        variables[name] = (axis, values[:, 0])
        variables[f"{name}_low"] = (axis, centre - reach * sd)
        variables[f"{name}_high"] = (axis, centre + reach * sd)
    axes = {"u": _GRID, "lag": list(lags), "mission_lag": list(apart), "level": list(LEVELS)}
    used = {axis for axis, _ in variables.values()}
    return xr.Dataset(variables, {n: v for n, v in axes.items() if n in used}), ahead[:, 0]


def _one_mission_ahead(
    data: Data, innovations: Innovations, coefficients: Coefficients, draws: np.ndarray
) -> np.ndarray:
    """Standardised residuals given earlier missions, coefficients unknown: (rate, 1 + replicate).

    Noises and beta0 are those of the posterior, of all missions.
    """
    J = coefficients.jacobian
    L = np.linalg.cholesky(innovations.normal.cov + J @ coefficients.cov @ J.T)
    gap = data.y - innovations.normal.mean - J @ (coefficients.mean - coefficients.fitted)
    both = np.column_stack([np.linalg.solve(L, gap), draws])
    ahead, mission = np.empty_like(both), data.slots[data.seen, 0]
    for j in np.unique(mission):
        rows = mission == j
        block = L[np.ix_(rows, rows)]
        ahead[rows] = block @ both[rows] / np.linalg.norm(block, axis=1)[:, None]
    return ahead
