"""Kinds of cases, which decide the search that plans them."""

import numpy as np
import pytest

from trustbo.models import RobotParams, TrustParams
from trustbo.planning import Planner
from trustbo.planning.search.case import Case
from trustbo.workspace import Workspace

WORKSPACE = Workspace.from_awareness(np.random.default_rng(0).uniform(size=(2, 4, 4, 1)))
ALIKE = TrustParams(0.5, np.array([0.4]), 0.1, 0.1, 0.1)
UNLIKE = RobotParams(np.array([0.3, 0.6]), np.full((2, 1), 0.4), np.zeros(2), *np.full((2, 2), 0.1))


@pytest.mark.parametrize(
    ("objective", "params", "options", "kind"),
    [
        ("terminal", ALIKE, {}, "sum"),
        ("mean", UNLIKE, {}, "sum"),
        ("mean", ALIKE, {"team": "min"}, "vector"),
        ("lost_contact", ALIKE, {}, "sum"),
        ("lost_contact", ALIKE, {"observation": "censored"}, "history"),
        ("success", ALIKE, {}, "history"),
        ("bottleneck", ALIKE, {}, "history"),
        ("success", UNLIKE, {}, "vector"),
        ("stationary", UNLIKE, {"team": "min"}, "free"),
    ],
)
def test_the_search_of_an_objective_follows_from_its_trust_and_its_paths(
    objective, params, options, kind
):
    planner = Planner(WORKSPACE, (3, 0), (0, 3), objective, **options)
    dynamics = planner.problem.dynamics(params).flat()
    assert Case(planner.paths, dynamics, planner.problem.objective).kind == kind
