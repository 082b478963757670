"""A plan: a path and its expected trust, value and exactness."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from trustbo.data import Cell

QUANTILES = (0.05, 0.25, 0.75, 0.95)
"""Quantiles of `Plan.bands`: ends of the 90 % and of the 50 % band."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A path with its expected trust, value and exactness.

    Attributes:
        path: Cells, start first.
        positions: Centres of the cells, shape (cell, 2), x and y in CRS metres.
        length: Length from centre to centre, m.
        trust: Expected trust after each bound, shape (bound, robot).
        bands: Quantiles of expected trust over draws of the parameters, shape (quantile, bound,
            robot), see `QUANTILES`; equal to `trust` where the plan is for one draw.
        value: Value of the objective, to be maximised (see `OBJECTIVES`): for lost_contact, minus
            the bounds' worth of contact expected to be lost, with trust capped at 1.
        success: Product over the bounds of sigma(team's trust): the probability that all succeed.
        objective: Name of the objective.
        exact: True if no admissible path is better.
        bound: Upper bound on the value of any admissible path; `value` where exact, NaN for a given
            path.
        revisits: Number of bounds that enter a cell again.
        engine: Engine that found the path, "networkx" or "numba"; or "given".
        seconds: Time of the search, s.
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
    """Convert a plan to plain lists and numbers."""
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in vars(plan).items()
    }


def plan_from_record(record: dict[str, Any]) -> Plan:
    """Convert the record of `plan_to_record` to a plan."""
    values: dict[str, Any] = dict(record)
    for name in ("positions", "trust", "bands"):
        values[name] = np.array(record[name])
    values["path"] = tuple((row, col) for row, col in record["path"])
    return Plan(**values)
