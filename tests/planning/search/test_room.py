"""Labels find room: more lengths of paths than the arrays of labels had rows."""

import numpy as np
import pytest

from trustbo.models import TrustParams
from trustbo.planning import Planner
from trustbo.workspace import Workspace


@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
@pytest.mark.parametrize("within_risk", [True, False])
def test_hundreds_of_lengths_of_paths_are_planned_as_a_few_are(family, within_risk):
    """In lost contact a loop never pays, so that more lengths change no plan."""
    rng = np.random.default_rng(4)
    workspace = Workspace.from_awareness(rng.uniform(size=(1, 8, 3, 3, 2)))
    p_fail = rng.uniform(0.0, 0.05, (8, 3, 3))
    params = TrustParams(0.5, np.array([0.6, 0.3]), -0.2, 0.1, 0.1)

    def plan(max_bounds):
        planner = Planner(
            workspace, (2, 0), (0, 2), max_bounds=max_bounds, observation=family, engine="numba"
        )
        return planner.with_risk(p_fail if within_risk else None).plan(params)

    few = plan("shortest+4")
    for extra in (253, 254, 255, 300, 509, 510, 511, 1100):
        many = plan(f"shortest+{extra}")
        assert (many.path, many.value, many.exact) == (few.path, few.value, True)
