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
    trust = result.plan().trust[-1]  # of each robot, at the goal
    assert result.plan().value == pytest.approx(expit(np.mean(trust)), rel=1e-6)


def test_the_first_path_is_of_one_draw_of_the_prior(workspace):
    first = [tb.Campaign(workspace, (2, 0), (0, 2), seed=s, **tb.paper.CAMPAIGN) for s in (0, 1)]
    a, b = (campaign.belief.beta for campaign in first)
    assert a.shape == (1, 2)
    assert (a != b).all()


def test_rates_drawn_from_the_prior_are_mostly_contact_rates(workspace):
    def share(priors):
        model = tb.models.PooledTrust(priors)
        draws = tb.inference.sample_prior(model, n_features=2, n_draws=2000, seed=0)
        rng = np.random.default_rng(1)
        x = rng.normal(0.5, 0.5, 2000)
        rates = []
        for z in workspace.along([(2, 0), (1, 1), (0, 2), (0, 1), (0, 0)])[:, 0]:
            x = draws.beta0 * x + draws.beta @ z + draws.b + draws.delta_w * rng.normal(size=2000)
            rates.append(x + draws.delta_v * rng.normal(size=2000))
        return np.mean((np.array(rates) >= 0.0) & (np.array(rates) <= 1.0))

    assert share(tb.models.Priors.for_cells()) > 0.75
    assert share(tb.models.Priors.default("gaussian")) < 0.4


def test_no_feature_has_a_sign_under_the_prior_for_cells():
    for family, middle in (("gaussian", 0.5), ("beta_binomial", 0.0)):
        mean, sd = tb.models.Priors.for_cells(family).coefficients(2)
        np.testing.assert_allclose(mean, [0.0, 0.0, middle])
        assert (sd > 0.0).all()


def test_a_campaign_of_the_paper_is_resumed_without_its_model(workspace, tmp_path):
    settings = {**tb.paper.MEAN_TRUST, "sampler": "importance"}
    tb.iterate(
        workspace, (2, 0), (0, 2), n_iterations=1, progress=False, directory=tmp_path, **settings
    )
    resumed = tb.resume(tmp_path, n_iterations=2, progress=False)
    assert resumed.model.priors.describe() == settings["model"].priors.describe()
    assert resumed.settings["objective"] == "mean"
    trust = resumed.plan().trust
    assert resumed.plan().value == pytest.approx(float(np.mean(trust)), rel=1e-6)
