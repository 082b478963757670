"""Check of a fitted model: planted faults stand out, and nothing does without one."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr

import trustbo as tb
from trustbo.models import CoupledTrust, PlaceEffect, PooledTrust, RobotEffect

HOW_TO = Path(__file__).parents[2] / "docs/howto/your-own-model.md"
MODEL = PooledTrust(effects=(PlaceEffect(), RobotEffect()))


def drawn(seed=0, *, robot=0.0, place=0.0, slope=0.8, n_missions=8):
    """Missions over a line of cells, of rates that follow line of sight, with planted effects."""
    rng, path = np.random.default_rng(seed), [(0, k) for k in range(9)]
    missions = []
    for j in range(n_missions):
        z = rng.uniform(size=(8, 3, 1))
        rate = 0.5 + slope * (z[..., 0] - 0.5) + 0.03 * rng.normal(size=(8, 3))
        rate[:, 1] += robot * z[:, 1, 0] * (j >= n_missions // 2)
        rate[4] += place
        rate = np.clip(rate, 0.0, 1.0)
        missions.append(tb.Mission.from_arrays(path, z, rate, features=["line_of_sight"]))
    return missions


def checked(missions, model=MODEL, **options):
    return tb.check(tb.fit(missions, model, progress=False, **options))


def test_nothing_stands_out_where_nothing_is_wrong():
    found = checked(drawn())

    assert not found.table["stands_out"].any()
    assert not found.robots["stands_out"].any()


def test_a_robot_that_degrades_stands_out_from_then_on():
    found = checked(drawn(robot=-0.5))

    odd = found.robots[found.robots["stands_out"]]
    assert found.table.loc["robots", "label"] == "r2"
    assert set(zip(odd["mission"], odd["robot"], strict=True)) == {(j, "r2") for j in range(5, 9)}


def two_robots(seed, *, detection):
    """Missions of two robots; the detector of r2 works in a share of all cases."""
    rng, path = np.random.default_rng(seed), [(0, k) for k in range(9)]
    missions = []
    for _ in range(6):
        z = rng.uniform(size=(8, 2, 1))
        rate = (0.2 + 0.7 * z[..., 0]) * np.array([1.0, detection]) + 0.03 * rng.normal(size=(8, 2))
        missions.append(
            tb.Mission.from_arrays(path, z, np.clip(rate, 0.0, 1.0), features=["line_of_sight"])
        )
    return missions


def test_of_two_robots_one_with_a_poor_detector_stands_out_beside_the_other():
    found = checked(two_robots(0, detection=0.6))

    assert found.robots["stands_out"].all()
    both = found.robots.pivot(index="mission", columns="robot", values="effect")
    np.testing.assert_allclose(both["r1"], -both["r2"])
    assert (both["r2"] < -0.2).all()
    row = found.table.loc["robots"]
    assert (row["label"], row["stands_out"]) == ("r2", True)
    assert row["size"] == both["r2"].min()
    assert "r1" in row["finding"]


def test_two_alike_robots_do_not_stand_out():
    assert not checked(two_robots(1, detection=1.0)).robots["stands_out"].any()


def test_a_place_with_less_contact_stands_out():
    found = checked(drawn(place=-0.35))

    assert found.table.loc["places", "stands_out"]
    assert found.table.loc["places", "label"] == "(0, 5)"
    assert found.table.loc["places", "size"] < -0.1


def test_a_robot_that_is_poor_on_the_only_path_stands_out():
    """Its losses differ between bounds, so they look like effects of the robot in each bound."""
    rng = np.random.default_rng(0)
    path = [(0, k) for k in range(7)]
    mean = np.ones((6, 3))
    mean[:, 1] = 0.82, 0.77, 0.84, 0.8, 0.93, 0.79
    missions = [
        tb.Mission.from_arrays(
            path,
            np.ones((6, 3, 1)),
            np.clip(mean + 0.01 * rng.normal(size=(6, 3)), 0.0, 1.0),
            features=["line_of_sight"],
        )
        for _ in range(9)
    ]
    posterior = tb.fit(missions, MODEL, progress=False)

    effect = posterior["robots"]["robot_effect"].mean(("chain", "draw")).sel(robot="r2")
    assert abs(float(effect.mean())) < 0.15  # of a mean loss of 0.175: not of the robot alone
    assert tb.check(posterior).table.loc["robots", "label"] == "r2"
    assert tb.check(posterior).table.loc["robots", "stands_out"]


def test_a_shift_that_all_places_share_does_not_stand_out():
    """It cannot be told from the intercept, which the prior holds back here."""
    held = tb.models.Priors(
        b=dist.Normal(0.0, 0.01), beta=dist.Normal(1.0, 0.02), beta0=dist.Beta(1.0, 50.0)
    )
    model = PooledTrust(held, effects=(PlaceEffect(),))
    posterior = tb.fit(drawn(slope=0.6), model, progress=False)

    assert (posterior["places"]["place"].mean(("chain", "draw")) > 0.1).all()
    assert not tb.check(posterior).table.loc["places", "stands_out"]


def test_place_effects_on_logits_are_reported_as_contact():
    counted = [
        tb.Mission.from_arrays(
            m.path, m.awareness, np.round(50 * m.contact_rate) / 50, features=m.features, n_ticks=50
        )
        for m in drawn(place=-0.35)
    ]
    model = PooledTrust(family="beta_binomial", effects=(PlaceEffect(),))
    found = checked(counted, model, draws=250)

    assert found.table.loc["places", "label"] == "(0, 5)"
    assert -0.6 < found.table.loc["places", "size"] < -0.1


@pytest.mark.parametrize("model", [PooledTrust(), CoupledTrust()], ids=["pooled", "coupled"])
def test_a_weight_of_the_wrong_sign_stands_out(model):
    found = checked(drawn(slope=-0.8), model, draws=250)

    assert found.table.loc["weights", "stands_out"]
    assert found.table.loc["weights", "label"] == "line_of_sight"
    assert found.table.loc["weights", "size"] < 0.0


def test_intervals_of_a_campaign_that_are_too_narrow_stand_out():
    """Posteriors of quiet missions predict noisy ones."""
    quiet, rng = drawn(n_missions=6), np.random.default_rng(1)
    noisy = [
        tb.Mission.from_arrays(
            m.path, m.awareness, rng.uniform(size=m.contact_rate.shape), features=m.features
        )
        for m in quiet
    ]
    posteriors = [tb.fit(quiet, PooledTrust(), progress=False)] * 6

    assert not tb.check(posteriors, quiet).table.loc["coverage", "stands_out"]
    assert tb.check(posteriors, noisy).table.loc["coverage", "stands_out"]


def test_intervals_that_are_too_narrow_only_in_new_bounds_stand_out():
    """Rates are as predicted in bounds that were driven before, and noisy in the others."""
    rng = np.random.default_rng(1)
    n_repeated, missions, expected = 6, [], []
    for j, mission in enumerate(drawn(n_missions=6)):
        start = [(0, k) for k in range(1 + n_repeated)]
        new = [(1 + j, k) for k in range(len(mission.path) - len(start))]
        rates = mission.contact_rate.copy()
        rates[n_repeated:] = rng.uniform(size=rates[n_repeated:].shape)
        expected.append(
            tb.Mission.from_arrays(
                start + new, mission.awareness, mission.contact_rate, features=mission.features
            )
        )
        missions.append(replace(expected[-1], contact_rate=rates))

    posteriors = [tb.fit(expected, PooledTrust(), progress=False)] * 6
    table = tb.check(posteriors, missions).table
    pit = tb.inference.score(posteriors, missions)["pit"].values
    is_inside = np.abs(pit - 0.5) <= 0.45
    share = is_inside[:, n_repeated:].mean()  # of missions of the same length

    assert table.loc["new bounds", "stands_out"]
    assert table.loc["new bounds", "size"] == pytest.approx(share - 0.9)
    assert f"contain {share:.0%} of 30 rates" in table.loc["new bounds", "finding"]
    assert "too narrow" in table.loc["new bounds", "finding"]
    assert not tb.check(posteriors, expected).table.loc["new bounds", "stands_out"]


def test_a_bound_is_new_until_a_rate_was_measured_in_it():
    """Bounds lead from a cell to a cell; those that a mission has planned may be new."""
    rng = np.random.default_rng(0)

    def mission(path, rates, status="ok"):
        z = rng.uniform(0.4, 0.6, size=(len(rates), 3, 1))
        y = np.repeat(np.array(rates)[:, None], 3, axis=1)
        return tb.Mission.from_arrays(path, z, y, status=status, features=["line_of_sight"])

    usual = [(3, 0), (2, 1), (1, 2), (0, 3)]
    other = [(3, 0), (2, 0), (1, 1), (0, 2), (0, 3)]
    between = [(3, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 3)]  # three bounds are new
    driven = [
        mission(usual, [0.5, 0.5, 0.5]),
        mission(other, [0.5, 0.5], status="aborted"),
        mission(other, [0.5, 0.5, 0.0, 0.0]),  # two bounds are new, and far from predictions
        mission(between, [0.5, 0.0, 0.0, 0.0, 0.5]),
    ]
    posteriors = [tb.fit(driven[:2], PooledTrust(), progress=False)] * 4
    table = tb.check(posteriors, driven).table

    # Of seven new bounds, the two of the mission that was aborted are as predicted.
    assert "29% of 21 rates" in table.loc["new bounds", "finding"]
    assert not table.loc["new bounds", "stands_out"]  # three missions are too few


def test_coverage_is_not_tested_without_rates():
    first, other = drawn(n_missions=2)
    blank = np.full(other.contact_rate.shape, np.nan)
    other = tb.Mission.from_arrays(other.path, other.awareness, blank, features=other.features)
    posteriors = [tb.fit([first, *more], PooledTrust(), progress=False) for more in ([], [other])]

    found = tb.check(posteriors).table.loc["coverage"]
    assert not found["stands_out"]
    assert "not tested" in found["finding"]


def test_a_campaign_without_a_mission_has_nothing_to_check():
    workspace = tb.Workspace.from_awareness(np.full((2, 2, 2, 2), 0.5))
    with pytest.raises(tb.TrustboError, match="nothing has been learned"):
        tb.check(tb.Campaign(workspace, (1, 0), (0, 1)))


def test_what_is_no_posterior_of_contact_is_refused():
    for nothing in ({}, []):
        with pytest.raises(tb.TrustboError):
            tb.check(nothing)


def test_posteriors_of_a_campaign_read_from_files_are_checked(tmp_path):
    terrain = tb.terrain.synthetic_terrain((40.0, 30.0), 2.0, seed=0, relief=3.0)
    workspace = tb.Workspace.from_terrain(terrain, (4, 3))
    tb.iterate(
        workspace, (3, 0), (0, 2), n_iterations=3, seed=1, progress=False, directory=tmp_path / "c"
    )

    result = tb.load_result(tmp_path / "c")
    given = tb.check(list(result.posteriors), missions=result.missions)
    found = tb.check(result.posteriors)
    assert found.table.equals(given.table)
    assert tb.check(result).table.equals(given.table)
    assert "%" in found.table.loc["coverage", "finding"]

    one = tb.inference.score(result.posteriors)
    other = tb.inference.score(list(result.posteriors), result.missions)
    assert one.equals(other)


def rates_of(drift, contact_rate, effects=(), beta0=None):
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0)) if beta0 is None else beta0
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.1))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.1))
    with numpyro.plate("mission", len(drift)):
        rates = tb.models.ContactRate(drift, beta0, delta_w, delta_v, effects=effects)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def of_places(awareness, contact_rate=None):
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    rates_of(weight * awareness[..., 0], contact_rate, [PlaceEffect().sample()])


def of_places_with_known_memory(awareness, contact_rate=None):
    weight = numpyro.sample("weight", dist.Normal(0.3, 0.3))
    rates_of(weight * awareness[..., 0], contact_rate, [PlaceEffect().sample()], beta0=0.4)


def with_one_beta(awareness, contact_rate=None):
    beta = numpyro.sample("beta", dist.Normal(0.3, 0.3))
    rates_of(beta * awareness[..., 0], contact_rate)


def with_signed_weights(awareness, contact_rate=None):
    """Weights whose axis of features comes first."""
    shape = awareness.shape[3], awareness.shape[2]
    prior = dist.Normal(0.5, 0.3).expand(shape).to_event(2)
    beta = numpyro.sample("beta", prior, infer={"event_dims": ["feature", "robot"]})
    rates_of(0.7 + (awareness * beta.T).sum(-1), contact_rate, beta0=0.2)


def test_a_place_with_less_contact_stands_out_in_a_function_with_its_memory():
    found = checked(drawn(place=-0.35), of_places).table.loc["places"]
    same = checked(drawn(place=-0.35)).table.loc["places"]

    assert (found["label"], found["stands_out"]) == ("(0, 5)", True)
    assert abs(found["size"] - same["size"]) < 0.05


def test_places_are_not_tested_in_a_function_with_unknown_memory():
    found = checked(drawn(place=-0.35), of_places_with_known_memory)

    assert "beta0" in found.table.loc["places", "finding"]
    assert "places" in found.verdict


@pytest.fixture(scope="module")
def of_one_beta():
    return tb.fit(drawn(n_missions=2), with_one_beta, progress=False)


@pytest.mark.parametrize("dims", [None, (), ("beta_dim_0",), ("robot",)])
def test_weights_are_not_tested_without_weights_of_features(of_one_beta, dims):
    """`beta` is missing, one number, a vector of a function, or one number of each robot."""
    posterior = of_one_beta.copy()
    for group in ("posterior", "prior"):
        variables = posterior[group].to_dataset()
        beta = variables["beta"]
        variables = variables.drop_vars("beta")
        if dims is not None:
            variables["beta"] = beta.expand_dims(dict.fromkeys(dims, 3), -1) if dims else beta
        posterior[group] = xr.DataTree(variables)

    found = tb.check(posterior).table.loc["weights"]
    assert "no variable 'beta' with the dim 'feature'" in found["finding"]
    assert not found["stands_out"]


def test_a_weight_of_the_wrong_sign_stands_out_in_a_function():
    found = checked(drawn(slope=-0.8), with_signed_weights).table.loc["weights"]

    assert (found["label"], found["stands_out"]) == ("line_of_sight", True)


def test_the_verdict_says_what_was_not_tested(of_one_beta):
    untested = "robots, places, weights, coverage and new bounds were not tested."
    assert tb.check(of_one_beta).verdict == untested

    # Both missions have the same path, so none of their bounds is new.
    found = tb.check([of_one_beta, of_one_beta], drawn(n_missions=2))
    assert found.verdict.endswith("; robots, places, weights and new bounds were not tested.")

    found = tb.check(tb.fit(drawn(robot=-0.5), MODEL, progress=False))
    assert found.verdict.startswith("r2")
    assert found.verdict.endswith("; coverage and new bounds were not tested.")


@pytest.mark.slow
def test_all_models_of_the_how_to_are_checked():
    namespace = {"__name__": "__main__"}
    for block in re.findall(r"^```python\n(.*?)^```", HOW_TO.read_text(), flags=re.S | re.M):
        if "tb.load_result" not in block:
            exec(block, namespace)

    workspace = namespace["workspace"]
    for name in ("saturating", "by_robot", "by_cell", "by_mission", "with_effects"):
        campaign = tb.iterate(
            workspace, (4, 0), (0, 4), model=namespace[name], simulator=namespace["simulator"],
            n_iterations=3, fit={"draws": 300, "check": False}, progress=False,
        )  # fmt: skip
        found = tb.check(campaign)
        is_tested = ~found.table["finding"].str.startswith("not tested")
        assert is_tested["coverage"]
        assert is_tested["robots"] == is_tested["places"] == (name == "with_effects")
