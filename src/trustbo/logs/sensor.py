"""Chance that a sensor detects a robot in a tick, given the geometry: logistic regression.

Range and bearing bend through cubic splines, the other variables are linear, and what hides a robot
counts more at a distance. The share of ticks that a window has by this chance is the feature that
explains most of contact (`missions_of`): what trust then adds is the robot, and what lasts.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from sklearn.compose import ColumnTransformer
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import SplineTransformer, StandardScaler

from trustbo.display import Rows, Summary, number
from trustbo.errors import TrustboError, require_whole, unknown

VARIABLES = ("range", "bearing", "hidden", "turning", "speed", "passes")
_BENT = ("range", "bearing")
_KNOTS, _PENALTY = 8, 10.0  # chosen by ticks left out of one log
_LEAST = 5  # ticks with contact, and without, of each fold


class Sensor(Summary):
    """Chance of detection by the geometry of a pair.

    Attributes:
        variables: Variables of `geometry` that it depends on.
        pipeline: Fitted scikit-learn pipeline, with the columns of `variables` and hidden x range.
    """

    def __init__(
        self,
        variables: Sequence[str],
        pipeline: Pipeline,
        geometry: xr.Dataset,
        left_out: xr.DataArray,
    ) -> None:
        """Hold a pipeline, the data it was fitted to, and chances by fits that left them out."""
        self.variables, self.pipeline = tuple(variables), pipeline
        self._geometry, self._left_out = geometry, left_out

    def predict(self, geometry: xr.Dataset) -> xr.DataArray:
        """Chance of detection, (watcher, seen, time), in [0, 1]; NaN where it is NaN in the data.

        Ticks that the sensor was fitted to have the chance by fits to the others, a fifth of the
        time left out at once: the whole fit would promise more than holds of other logs.

        Args:
            geometry: Dataset of `geometry`.

        Raises:
            TrustboError: A variable is missing.
        """
        if geometry is self._geometry:
            return self._left_out
        table, known = _table(geometry, self.variables)
        return _back(geometry, known, self.pipeline.predict_proba(table)[:, 1])

    @cached_property
    def log_score(self) -> float:
        """Mean log score of contact in a tick, of ticks left out, nats."""
        p = np.clip(self._left_out.values, 1e-9, 1.0 - 1e-9)
        contact = self._geometry["contact"].values
        return float(np.nanmean(contact * np.log(p) + (1.0 - contact) * np.log1p(-p)))

    def _rows(self) -> Rows:
        geometry = self._geometry
        contact = float(geometry["contact"].mean())
        alone = contact * np.log(contact) + (1.0 - contact) * np.log1p(-contact)
        rows = [
            ("depends on", ", ".join(self.variables)),
            ("fitted to", f"{int(geometry['contact'].count())} ticks, {contact:.1%} with contact"),
            ("log score", f"{number(self.log_score)} nats a tick of ticks left out"),
            ("", f"{number(alone)} of the share of contact alone"),
        ]
        return rows


def fit_sensor(
    geometry: xr.Dataset, variables: Sequence[str] | None = None, *, folds: int = 5
) -> Sensor:
    """Fit the chance of detection by logistic regression (scikit-learn).

    Args:
        geometry: Dataset of `logs.geometry`.
        variables: Names of `VARIABLES` to use; by default all that the geometry has.
        folds: Number of stretches of time that are left out in turn, see `Sensor.predict`.

    Raises:
        TrustboError: An unknown variable, a geometry without contact, or fewer than five ticks with
            contact, or without, in all folds but one.
    """
    there = [name for name in VARIABLES if name in geometry]
    chosen = there if variables is None else list(variables)
    for name in chosen:
        if name not in there:
            raise unknown("variable of the geometry", name, there)
    require_whole("folds", folds, 2)
    table, known = _table(geometry, chosen)
    contact = geometry["contact"].values[known] > 0.0
    time = np.broadcast_to(np.arange(known.shape[2]), known.shape)[known]
    fold = time * folds // known.shape[2]
    for k in range(folds):
        counts = np.bincount(contact[fold != k].astype(int), minlength=2)
        if counts.min() < _LEAST:
            raise TrustboError(
                f"a sensor needs {_LEAST} ticks with contact and without in all parts of the log "
                f"but one of {folds}; without part {k + 1} it has {counts[1]} with and {counts[0]} "
                "without. Give a longer log, or fewer folds."
            )
    left_out = np.empty(len(table))
    for k in range(folds):
        fit = _pipeline(chosen).fit(table[fold != k], contact[fold != k])
        left_out[fold == k] = fit.predict_proba(table[fold == k])[:, 1]
    whole = _pipeline(chosen).fit(table, contact)
    return Sensor(chosen, whole, geometry, _back(geometry, known, left_out))


def _pipeline(variables: Sequence[str]) -> Pipeline:
    """Splines of range and |bearing|, other columns unchanged, and a logistic regression."""
    bent = [i for i, name in enumerate(variables) if name in _BENT]
    splines = SplineTransformer(_KNOTS, extrapolation="constant", include_bias=False)
    others: Any = StandardScaler()
    columns = ColumnTransformer([("bent", splines, bent)], remainder=others)
    return make_pipeline(columns, LogisticRegression(C=_PENALTY, max_iter=3000))


def _table(geometry: xr.Dataset, variables: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the ticks that are known, and which are, (watcher, seen, time)."""
    if missing := [name for name in variables if name not in geometry]:
        raise TrustboError(
            f"the geometry lacks {', '.join(missing)}; it has {', '.join(map(str, geometry))}."
        )
    known = np.isfinite(geometry["range"].values)
    columns = [geometry[name].values[known] for name in variables]
    columns = [abs(c) if n == "bearing" else c for n, c in zip(variables, columns, strict=True)]
    if {"hidden", "range"} <= {*variables}:
        columns.append(columns[variables.index("hidden")] * columns[variables.index("range")])
    return np.column_stack(columns), known


def _back(geometry: xr.Dataset, known: np.ndarray, values: np.ndarray) -> xr.DataArray:
    """Values of known ticks over (watcher, seen, time)."""
    chance = np.full(known.shape, np.nan)
    chance[known] = values
    return geometry["contact"].copy(data=chance).rename("chance")
