"""Posteriors whose labels xarray has put in another order, wherever they meet arrays."""

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from missions import walking_missions
from worlds import random_cells

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference import TrustFilter, params_of
from trustbo.inference.order import as_fitted
from trustbo.models import ContactRate, CoupledTrust

PATH = [(4, 0), (3, 1), (2, 2), (1, 3), (0, 4)]
QUIET = {"seed": 0, "check": False, "progress": False}


def of_robots(awareness, contact_rate=None):
    """Each robot has weights of its own, whose axes are in an unusual order."""
    n_robots, n_features = awareness.shape[2:]
    with numpyro.plate("features", n_features, dim=-2), numpyro.plate("robot", n_robots, dim=-1):
        weight = numpyro.sample("weight", dist.Normal(0.2, 0.3))
    drift = (awareness * weight.T).sum(-1)
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(drift, 0.4, 0.3, 0.3)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


@pytest.fixture(scope="module")
def workspace():
    return random_cells(n=5)


@pytest.fixture(scope="module")
def missions(workspace):
    return [
        tb.Mission.from_arrays(
            one.path,
            one.awareness,
            one.contact_rate,
            robots=workspace.team.names,
            features=workspace.features,
        )
        for one in walking_missions(0)
    ]


@pytest.fixture(scope="module", params=["default", "coupled", "function"])
def posterior(request, missions, workspace):
    model = {"default": None, "coupled": CoupledTrust(), "function": of_robots}[request.param]
    n_draws = 10 if request.param == "function" else 25
    return tb.fit(missions, model, workspace=workspace, draws=n_draws, **QUIET)


def shuffled(posterior, seed):
    """The posterior with all entries and axes of each group in a random order of its own."""
    rng = np.random.default_rng(seed)
    groups = {}
    for name, group in posterior.children.items():
        given = group.to_dataset()
        order = {dim: rng.permutation(n) for dim, n in given.sizes.items()}
        groups[name] = given.isel(order).transpose(*rng.permutation(list(given.dims)))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = posterior.attrs
    return tree


def found_with(posterior, missions, workspace):
    """What the filter, planner, score, check and forecasts of ArviZ find with a posterior."""
    rng = np.random.default_rng(0)
    z, y = rng.uniform(size=(4, 3, 2)), rng.uniform(size=3)
    found = {}
    for name, on in {"filter": None, "filter on a map": workspace}.items():
        trust = TrustFilter(posterior, workspace=on, max_draws=20)
        trust.update(z[0], y, bound=PATH[:2])
        found[name] = np.concatenate([*trust.state, trust.predict(z[1:], PATH[1:]).draws.ravel()])

    planner = tb.Planner(workspace, PATH[0], PATH[-1])
    plan = planner.plan(posterior)
    found["plan"] = np.concatenate([np.ravel(plan.path), plan.bands.ravel(), [plan.value]])
    found["maps"] = planner.maps(posterior, n_draws=10).to_dataarray().values
    found["robots"] = planner.robot_maps(posterior).to_dataarray().values
    found["paths of draws"] = planner.plan_draws(posterior, n_draws=10).paths

    scores = tb.inference.score(posterior, missions[:2])
    found["score"] = np.stack([scores[name].values for name in ("mean", "pit", "log_score")])
    by_rate = tb.inference.by_rate(posterior)
    found["by rate"] = by_rate["log_likelihood"].to_dataset()["contact_rate"].values
    found["predicted"] = by_rate["posterior_predictive"].to_dataset()["contact_rate"].values
    return found


@pytest.fixture(scope="module")
def expected(posterior, missions, workspace):
    return found_with(posterior, missions, workspace)


@pytest.mark.parametrize("seed", [1, 2])
def test_any_order_of_labels_gives_the_same(posterior, expected, missions, workspace, seed):
    found = found_with(shuffled(posterior, seed), missions, workspace)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


def test_a_posterior_is_read_in_the_order_of_its_fit(posterior):
    """Also where the axis of robots or features has another name, such as that of a plate."""
    for tree in (posterior, shuffled(posterior, 4)):
        found = as_fitted("the test", tree)["posterior"].to_dataset()
        xr.testing.assert_equal(found, posterior["posterior"].to_dataset())


def test_checks_and_curves_do_not_depend_on_the_order(posterior):
    turned = shuffled(posterior, 3)
    right, found = tb.check(posterior), tb.check(turned)
    assert found.table.equals(right.table)
    if len(right.robots):
        np.testing.assert_allclose(found.robots["effect"], right.robots["effect"], rtol=1e-12)
    pairs = zip(tb.plots.trust_curves(posterior, 1), tb.plots.trust_curves(turned, 1), strict=True)
    for one, other in pairs:
        assert one.get_title() == other.get_title()
        for line, twin in zip(one.get_lines(), other.get_lines(), strict=True):
            np.testing.assert_array_equal(line.get_xydata(), twin.get_xydata())


def test_one_group_in_another_order_is_enough(posterior, expected, missions, workspace):
    """Draws of different groups belong together by their labels."""
    turned = posterior.copy()
    group = posterior["posterior"].to_dataset()
    turned["posterior"] = xr.DataTree(group.isel(draw=slice(None, None, -1)))
    found = found_with(turned, missions, workspace)
    np.testing.assert_allclose(found["plan"], expected["plan"], rtol=1e-9)
    np.testing.assert_allclose(found["score"], expected["score"], rtol=1e-9)


def test_posteriors_of_robots_in_different_orders_are_comparable(missions):
    turned = [one.in_order(one.robots[::-1], one.features, ()) for one in missions]
    options = {"model": tb.models.PooledTrust(), "latent": False, "draws": 25, **QUIET}
    posteriors = [
        tb.inference.add_latent(tb.fit(one, **options), one) for one in (missions, turned)
    ]
    posteriors[1] = shuffled(posteriors[1], 4)
    table = tb.compare({"one": posteriors[0], "other": posteriors[1]}, progress=False)
    assert table["elpd_diff"].abs().max() < 0.5


def test_missing_and_further_robots_are_named(posterior, workspace):
    for robots in ([0, 1], [0, 1, 2, 2]):
        other = posterior.map_over_datasets(
            lambda group, some=robots: group.isel(robot=some) if "robot" in group.dims else group
        )
        with pytest.raises(TrustboError, match="robots"):
            params_of(other, workspace)


@pytest.fixture(scope="module")
def truth(missions, workspace):
    """Parameters of three robots, with names."""
    model = tb.models.HierarchicalTrust()
    tree = tb.fit(missions, model, workspace=workspace, draws=5, latent=False, **QUIET)
    return params_of(tree)


def test_parameters_of_a_posterior_are_put_in_the_order_of_a_workspace(truth, workspace):
    """Without a workspace, parameters are in the order of the fit and know its names."""
    names = workspace.team.names[::-1]
    turned = tb.Workspace.from_awareness(
        workspace.awareness.isel(robot=[2, 1, 0], feature=[1, 0]).values,
        team=tb.Team(3, names=names),
        features=workspace.features[::-1],
    )
    right = tb.Planner(workspace, PATH[0], PATH[-1]).plan(truth)
    found = tb.Planner(turned, PATH[0], PATH[-1]).plan(truth)
    assert found.path == right.path
    np.testing.assert_allclose(found.trust[:, ::-1], right.trust, rtol=1e-12)

    simulators = [tb.simulation.ModelSimulator(on, truth.mean()) for on in (workspace, turned)]
    assert simulators[1].params.robots == names
    own, other = (simulator.params.beta for simulator in simulators)
    np.testing.assert_array_equal(other, own[:, ::-1, ::-1])
    other = tb.Workspace.from_awareness(
        workspace.awareness.values, team=tb.Team(3, names=tuple("xyz"))
    )
    with pytest.raises(TrustboError, match="robots"):
        tb.Planner(other, PATH[0], PATH[-1]).plan(truth)


def test_labelled_fields_of_parameters_are_read_by_name(truth, workspace):
    one = truth.draw(0)
    labels = {"robot": list(workspace.team.names), "feature": list(workspace.features)}
    beta = xr.DataArray(one.beta, labels, ("draw", "robot", "feature"))
    turned = one.replace(beta=beta.isel(robot=[2, 0, 1], feature=[1, 0]).transpose())
    planner = tb.Planner(workspace, PATH[0], PATH[-1])
    assert planner.plan(turned).value == planner.plan(one).value
    with pytest.raises(TrustboError, match="beta"):
        one.replace(robots=None, beta=beta)  # the order of arrays without names is unknown
    with pytest.raises(TrustboError, match="slope"):
        one.replace(beta=beta.assign_coords(feature=["slope", "canopy"]))


SOME_DRAWS = {
    "first half dropped": (slice(12, None), "posterior"),
    "every second one": (slice(None, None, 2), "posterior"),
    "last ones dropped": (slice(0, 20), "places"),
    "one draw": ([7], "posterior"),
    "dropped and reversed": (slice(20, 5, -1), "places"),
}


@pytest.mark.parametrize(("draws", "group"), SOME_DRAWS.values(), ids=SOME_DRAWS)
def test_draws_of_groups_are_matched_by_their_labels(missions, workspace, draws, group):
    posterior = tb.fit(missions, workspace=workspace, draws=25, **QUIET)
    planner = tb.Planner(workspace, (4, 0), (0, 4))
    joined = ["posterior", "places", "robots"]

    def trust(groups):
        some = posterior.copy()
        for name in groups:
            some[name] = xr.DataTree(posterior[name].to_dataset().isel(draw=draws))
        return planner.trust(some, "r2", (2, 2)).mean().item()

    assert trust([group]) == pytest.approx(trust(joined), abs=1e-12)


@pytest.mark.parametrize("label", [lambda k: k + 1000, lambda k: 0, lambda k: k + 0.5])
def test_groups_without_common_draws_are_refused(missions, workspace, label):
    posterior = tb.fit(missions, workspace=workspace, draws=25, **QUIET)
    other = posterior["posterior"].to_dataset()
    other = other.assign_coords(draw=[label(k) for k in range(other.sizes["draw"])])
    posterior["posterior"] = xr.DataTree(other)
    with pytest.raises(TrustboError, match="draw"):
        params_of(posterior, workspace)
