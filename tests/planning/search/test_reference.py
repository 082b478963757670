"""The networkx engine by itself: against all walks."""

import numpy as np
import pytest
from references import path_value, walks

from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.planning.search.case import Case
from trustbo.planning.search.reference import plan_networkx
from trustbo.workspace import Workspace

PARAMS = TrustParams(0.6, np.array([0.9, -0.7]), 0.1, 0.1, 0.1, x0_mean=0.3)


def random_case(seed, objective, max_bounds):
    rng = np.random.default_rng(seed)
    passable = rng.uniform(size=(4, 4)) > 0.15
    passable[3, 0] = passable[0, 3] = True
    awareness = rng.uniform(size=(2, 4, 4, 2))
    workspace = Workspace.from_awareness(awareness, passable)
    planner = Planner(workspace, (3, 0), (0, 3), objective, max_bounds=max_bounds)
    return planner, awareness, passable


@pytest.mark.parametrize("objective", ["terminal", "mean", "success", "bottleneck", "stationary"])
@pytest.mark.parametrize("max_bounds", [5, "shortest+2"])
def test_the_reference_finds_the_best_of_all_walks(objective, max_bounds):
    for seed in range(4):
        planner, awareness, passable = random_case(seed, objective, max_bounds)
        admissible = planner.paths
        u = [{tuple(cell): float(z[tuple(cell)] @ PARAMS.beta + PARAMS.b)
              for cell in np.argwhere(passable)} for z in awareness]  # fmt: skip
        every = walks(
            passable.tolist(), (3, 0), (0, 3), admissible.longest, u_turns=admissible.u_turns
        )
        values = {path: path_value(objective, path, u, 0.6, 0.3) for path in every}
        case = Case(admissible, planner.problem.dynamics(PARAMS).flat(), planner.problem.objective)
        best = plan_networkx(case)
        path = tuple(divmod(int(cell), 4) for cell in best.paths[0] if cell >= 0)
        np.testing.assert_allclose(values[path], max(values.values()), rtol=1e-12)


def test_many_draws_are_planned_each_by_itself():
    planner, _, _ = random_case(1, "success", 5)
    sd = np.full(2, 0.1)
    draws = TrustParams(np.array([0.6, 0.2]), np.array([[0.9, -0.7], [-3.0, 4.0]]), sd, sd, sd)

    def paths(params):
        dynamics = planner.problem.dynamics(params).flat()
        return plan_networkx(Case(planner.paths, dynamics, planner.problem.objective)).paths

    together = paths(draws)
    for d in range(2):
        (alone,) = paths(draws.draw(d))
        np.testing.assert_array_equal(together[d][together[d] >= 0], alone)
    assert (together[0] != together[1]).any()
