"""The paper as printed: its model, its sampler, its cost, and its awareness of cells."""

import numpy as np
import pytest
from scipy.special import expit
from worlds import hillside

import trustbo as tb


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_terrain(hillside(), (3, 3), **tb.paper.WORKSPACE)


def test_awareness_is_of_cells_and_of_the_paper_s_two_composites(workspace):
    z = workspace.awareness
    np.testing.assert_array_equal(z.max(("robot", "move")), z.min(("robot", "move")))
    assert workspace.features == ("traversability", "visibility")
    of = {name: set(index.signs) for name, index in workspace.composites.items()}
    assert of == {
        "traversability": {"slope", "roughness", "tri", "step_height"},
        "visibility": {"canopy_height", "canopy_cover", "openness"},
    }


@pytest.mark.slow
def test_a_campaign_learns_equations_3_and_4_by_nuts_and_plans_by_equation_6(workspace):
    result = tb.iterate(
        workspace, (2, 0), (0, 2), n_iterations=1, progress=False,
        fit={"draws": 300, "warmup": 150}, **tb.paper.CAMPAIGN,
    )  # fmt: skip
    posterior = result.posterior
    assert posterior.attrs["sampler"] == "nuts"
    assert set(posterior["posterior"].data_vars) == {"beta0", "beta", "b", "delta_w", "delta_v"}
    assert not {"places", "robots"} & set(posterior.children)
    trust = result.plan.trust[-1]  # of each robot, at the goal
    assert result.plan.value == pytest.approx(expit(np.mean(trust)), rel=1e-6)


def test_the_first_path_is_of_one_draw_of_the_prior(workspace):
    first = [tb.Campaign(workspace, (2, 0), (0, 2), seed=s, **tb.paper.CAMPAIGN) for s in (0, 1)]
    a, b = (campaign.belief.beta for campaign in first)
    assert a.shape == (1, 2)
    assert (a != b).all()
