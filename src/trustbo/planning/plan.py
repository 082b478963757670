"""A plan: a path and what is expected of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from trustbo.data import Cell

QUANTILES = (0.05, 0.25, 0.75, 0.95)
"""Of `Plan.bands`: the ends of the 90 % and of the 50 % band."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A path and what is expected of it.

    Attributes:
        path: Cells, start first.
        positions: Their centres, shape (cell, 2), x and y in CRS metres.
        length: From centre to centre, m.
        trust: Expected trust after each bound, shape (bound, robot).
        bands: Quantiles of expected trust over draws of the parameters, shape (quantile, bound,
            robot), see `QUANTILES`; equal to `trust` where the plan is for one draw.
        value: The objective, to be maximised (see `OBJECTIVES`).
        success: Product over the bounds of sigma(team's trust): the probability that all succeed.
        objective: The objective's name.
        exact: Whether no admissible path is better.
        bound: Largest value that any admissible path can have; `value` where exact, NaN for a path
            that was given.
        revisits: How often the path enters a cell again.
        engine: What found it: "networkx", "numba", or "given".
        seconds: How long that took.
    """

    path: tuple[Cell, ...]
    positions: np.ndarray
    length: float
    trust: np.ndarray
    bands: np.ndarray
    value: float
    success: float
    objective: str
    exact: bool
    bound: float
    revisits: int
    engine: str
    seconds: float


def plan_to_record(plan: Plan) -> dict[str, Any]:
    """A plan as plain lists and numbers."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(plan).items()
    }


def plan_from_record(record: dict[str, Any]) -> Plan:
    """The plan that `plan_to_record` laid out."""
    values: dict[str, Any] = dict(record)
    for name in ("positions", "trust", "bands"):
        values[name] = np.array(record[name])
    values["path"] = tuple((row, col) for row, col in record["path"])
    return Plan(**values)
