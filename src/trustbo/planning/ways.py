"""Ways between two cells of which none is better than another in every respect.

A way is judged by three numbers: the contact that it is expected to lose, the probability that the
team does not arrive, and its length. A way is left out if another one is at least as good in all of
them (Pareto set). Each way is the exact optimum of a weighted sum of the three.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pandas as pd

from trustbo.data import Station, path_text
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError
from trustbo.models.draws import Draws
from trustbo.planning.evaluation import evaluated
from trustbo.planning.given import mean_and_draws_of
from trustbo.planning.plan import Plan
from trustbo.planning.planner import Planner
from trustbo.planning.problem import Problem
from trustbo.workspace import Workspace
from trustbo.workspace.moves import MOVES

_NAMES = "recommended", "best contact", "safest", "shortest"
"""Names of the ways with the smallest price, and with the smallest of each number."""
MOST = 6
"""Largest number of ways that are listed."""
_COSTS_OF_FAILURE = (1e-6, 0.3, 1.0, 3.0, 10.0, 1e4)
"""Costs of a failure in the weighted sums, as multiples of the bounds of a shortest path.

The smallest decides between ways that are equal otherwise."""
_COSTS_OF_LENGTH = (1e-6, 0.03, 0.1, 0.3, 1.0, 1e4)
"""Costs of the length of a cell's side, in bounds of contact."""
_TIE = 1e-9
"""Difference up to which two numbers count as equal."""


@dataclass(frozen=True, eq=False, repr=False)
class Ways(Summary):
    """Ways between two cells, from the least to the most contact lost.

    Attributes:
        plans: Plan of each way.
        numbers: Contact lost (bounds), failure probability and length (m) of each way, shape (way,
            3).
        cost_of_failure: Cost of a failure in plans, in bounds.

    Example:
        >>> ways = result.ways((9, 0), (0, 9))
        >>> ways.to_frame()[["name", "contact_lost", "p_arrive", "metres"]]
    """

    plans: tuple[Plan, ...]
    numbers: np.ndarray
    cost_of_failure: float

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, k: int) -> Plan:
        return self.plans[k]

    def _rows(self) -> Rows:
        table = self.to_frame()
        columns = ["name", "contact_lost", "p_arrive", "metres"]
        return [
            (
                f"way {k}",
                f"{lost:.2f} bounds of contact lost, arrival {arrival:.3f}, {metres:.0f} m"
                + (f": {name}" if name else ""),
            )
            for k, name, lost, arrival, metres in table[columns].itertuples()
        ]

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row for each way, numbered from 0.

        The columns are `name` ("recommended" for the least price, "best contact", "safest",
        "shortest" or several of them), `bounds`, `metres`, `contact_lost` (bounds, if no bound
        fails), `p_arrive`, `price` (contact lost plus the cost of a failure times its probability),
        `path` and, with several sets, `posts`.
        """
        price = self.numbers[:, 0] + self.cost_of_failure * self.numbers[:, 1]
        names: list[list[str]] = [[] for _ in self.plans]
        for what, column in zip(_NAMES, [price, *self.numbers.T], strict=True):
            names[int(np.argmin(column))].append(what)

        plans = self.plans
        table = pd.DataFrame(
            {
                "name": [", ".join(own) for own in names],
                "bounds": [len(plan.path) - 1 for plan in plans],
                "metres": self.numbers[:, 2],
                "contact_lost": self.numbers[:, 0],
                "p_arrive": 1.0 - self.numbers[:, 1],
                "price": price,
                "path": [path_text(plan.path) for plan in plans],
            },
            index=pd.RangeIndex(len(plans), name="way"),
        )
        if any(plan.post_sets for plan in plans):
            table["posts"] = [" ".join(plan.post_sets) for plan in plans]
        return table


def limits_table(plans: Mapping[float, Plan]) -> pd.DataFrame:
    """Return a table with a row for each plan, keyed by the change of the slope limit, degrees."""
    rows = [
        {
            "bounds": len(plan.path) - 1,
            "metres": plan.length,
            "contact_lost": plan.contact_lost,
            "p_arrive": plan.p_arrive,
            "value": plan.value,
            "path": path_text(plan.path),
        }
        for plan in plans.values()
    ]
    return pd.DataFrame(rows, index=pd.Index(list(plans), name="degrees"))


def ways_of(planner: Planner, belief: Draws, most: int = MOST) -> Ways:
    """Find at most `most` ways; see the module.

    Args:
        planner: Planner with the objective lost_contact, and the risk of bounds, if known.
        belief: Draws of the parameters, as for `Planner.plan`.
        most: Largest number of ways. The one with the least price, and the best one in each
            respect, are always listed.

    Raises:
        TrustboError: The objective is not lost_contact.
        InfeasibleError: No path respects `max_failure`.
    """
    problem = planner.problem
    if not problem.objective.of_contact:
        raise TrustboError(
            "ways are compared by the contact that they lose, but the objective is "
            f"{problem.objective.name!r}; use objective='lost_contact'."
        )

    workspace = planner.workspace
    lengths = _lengths(workspace)
    side = min(workspace.grid.cell_height, workspace.grid.cell_width)
    mean, draws = mean_and_draws_of(belief, workspace)
    recursion = problem.searched(mean)

    shortest = problem.paths.shortest
    costs = {0.0}
    if problem.risk is not None:
        costs = {*_COSTS_OF_FAILURE, problem.cost_of_failure / shortest}
    found: dict[tuple[Station, ...], None] = {}  # in order
    for of_failure, of_length in product(sorted(costs), _COSTS_OF_LENGTH):
        weighted = replace(
            problem,
            failure_cost=of_failure * shortest,
            bound_cost=problem.bound_cost + of_length / side * lengths,
        )
        _, _, paths = weighted.best(recursion)
        found[weighted.paths.cells(paths[0])] = None

    plans = [evaluated(problem, stations, mean, None, None) for stations in found]
    numbers = np.array([_numbers_of(problem, plan) for plan in plans])
    chosen = _some(numbers, problem.cost_of_failure, most)
    with_bands = tuple(evaluated(problem, plans[k].stations, mean, draws, None) for k in chosen)
    return Ways(with_bands, numbers[chosen], problem.cost_of_failure)


def _numbers_of(problem: Problem, plan: Plan) -> tuple[float, float, float]:
    """Return the contact lost, the failure probability and the length of a plan."""
    p_fail = 0.0 if problem.risk is None else problem.risk.failure(plan.stations)
    return problem.contact_lost(plan.stations, plan.value), p_fail, plan.length


def _lengths(workspace: Workspace) -> np.ndarray:
    """Return the length of each move between the centres of cells, shape (move, 1, 1), m."""
    sides = np.array([workspace.grid.cell_height, workspace.grid.cell_width])
    return np.hypot(*(np.array(MOVES) * sides).T)[:, None, None]


def _some(numbers: np.ndarray, cost_of_failure: float, most: int) -> np.ndarray:
    """Choose ways that no other one beats, at most `most`, in the order of contact lost.

    The one with the least price and the best in each respect are chosen first, then those that are
    farthest from the chosen ones.

    Args:
        numbers: Contact lost, failure probability and length, shape (way, 3).
        cost_of_failure: Cost of a failure, in bounds.
        most: Largest number of ways.
    """
    at_least = (numbers[:, None] <= numbers + _TIE).all(-1)  # (way, other): as good in all
    beaten = (at_least & (numbers[:, None] < numbers - _TIE).any(-1)).any(0)
    kept = np.flatnonzero(~beaten)
    points = numbers[kept]
    cheapest = int(np.argmin(points[:, 0] + cost_of_failure * points[:, 1]))
    points = (points - points.min(0)) / np.maximum(np.ptp(points, axis=0), _TIE)

    chosen = [*dict.fromkeys([cheapest, *points.argmin(0).tolist()])]
    while len(chosen) < min(most, len(kept)):
        away = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(1)
        chosen.append(int(away.argmax()))
    ways = kept[chosen]
    return ways[np.lexsort(numbers[ways].T[::-1])]
