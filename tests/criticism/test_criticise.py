"""Criticism of a fitted model: residuals, calibrated tests, and the names of planted faults."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from references import dense_coupled, dense_log_likelihood
from scipy import stats

import trustbo as tb
from trustbo import Mission, TrustboError
from trustbo.criticism import criticise
from trustbo.criticism import joint_normal as dense
from trustbo.criticism.departures import departures
from trustbo.criticism.robots import finding_on_robots
from trustbo.criticism.score import Innovations, Outcome, derivatives, holm
from trustbo.inference import fit
from trustbo.inference.evidence import kalman_numpy
from trustbo.models import (
    CoupledParams,
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
    TrustParams,
)

_SOURCE = Path(__file__).resolve().parents[2] / "benchmarks" / "criticism.py"


@pytest.fixture(scope="module")
def planted():
    """Missions with a fault, as the benchmark draws them."""
    spec = importlib.util.spec_from_file_location("criticism_benchmark", _SOURCE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return lambda fault, seed=11: module.draw_missions(fault, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def with_places(planted):
    """Posterior and criticism of missions whose places matter, by a model without places."""
    posterior = fit(planted("place"), PooledTrust(), "exact", whole=False)
    return posterior, criticise(posterior, compare=False, n_replicates=200)


def missions_of_shape(n_missions, n_bounds, n_robots=2, n_features=2, seed=0):
    rng, found = np.random.default_rng(seed), []
    for _ in range(n_missions):
        path = [(0, k) for k in range(n_bounds + 1)]
        z = rng.uniform(size=(n_bounds, n_robots, n_features))
        found.append(Mission.from_arrays(path, z, rng.uniform(size=z.shape[:2])))
    return found


def log_normal(normal, y):
    return stats.multivariate_normal(normal.mean, normal.cov).logpdf(y)


def test_the_joint_normal_is_the_product_of_the_robots_densities():
    missions = missions_of_shape(2, 4)
    rates = missions[1].contact_rate.copy()
    rates[2, 1] = np.nan  # a gap
    missions[1] = Mission.from_arrays(missions[1].path, missions[1].awareness, rates)
    params = TrustParams(0.6, np.array([0.3, -0.2]), 0.1, 0.05, 0.08, 0.4, 0.3)
    data = dense.gather(missions, None)
    normal = dense.joint_normal(dense.Point(params, {}, 0.0, None), data)
    expected = sum(
        dense_log_likelihood(*params[:7], mission.awareness[:, i], mission.contact_rate[:, i])
        for mission in missions
        for i in range(2)
    )
    np.testing.assert_allclose(log_normal(normal, data.y), expected, rtol=1e-10)


def test_the_joint_normal_of_robots_that_influence_each_other():
    missions = missions_of_shape(2, 3)
    Q, R = np.array([[0.04, 0.01], [0.01, 0.03]]), np.array([[0.02, -0.01], [-0.01, 0.05]])
    B0, B = np.array([[0.5, 0.1], [-0.2, 0.4]]), np.array([0.3 * np.eye(2), 0.2 * np.ones((2, 2))])
    params = CoupledParams(B0, B, np.array([0.1, 0.0]), Q, R, 0.4, 0.3)
    data = dense.gather(missions, None)
    normal = dense.joint_normal(dense.Point(params, {}, None), data)
    expected = 0.0
    for mission in missions:
        drift = np.einsum("kim,mai->ka", mission.awareness, B) + params.b
        expected += dense_coupled(B0, drift, Q, R, 0.4, 0.3, mission.contact_rate)[0]
    np.testing.assert_allclose(log_normal(normal, data.y), expected, rtol=1e-10)


def test_effects_of_places_tie_missions_together():
    """Two missions of one bound each: both rates have the variance of s and e in common."""
    missions = missions_of_shape(2, 1)
    place = PlaceEffect()
    params = TrustParams(0.6, np.array([0.3, -0.2]), 0.1, 0.05, 0.08, 0.4, 0.3)
    data = dense.gather(missions, place)
    scales = {"tau_s": 0.3, "length_scale": 2.0, "tau_e": 0.4}
    normal = dense.joint_normal(dense.Point(params, scales, 0.0, None), data)
    own = 0.6**2 * 0.3**2 + 0.05**2 + 0.08**2
    np.testing.assert_allclose(normal.cov, 0.25 + own * np.eye(4), rtol=1e-12)


def test_effects_of_robots_tie_missions_of_one_robot_together():
    """Missions of one bound each: shares of sight times 1 - beta0, slow ones fading by .9."""
    rng, z = np.random.default_rng(0), np.array([[0.9, 0.5], [0.4, 0.8], [0.7, 0.3]])
    missions = [
        Mission.from_arrays([(0, 0), (0, 1)], one[None, :, None], rng.uniform(size=(1, 2)),
                            features=["line_of_sight"])
        for one in z
    ]  # fmt: skip
    params = TrustParams(0.6, np.array([0.3]), 0.1, 0.05, 0.08, 0.4, 0.3)
    data, scales = dense.gather(missions, None), {"tau_slow": 0.3, "tau_day": 0.2}
    normal = dense.joint_normal(dense.Point(params, scales, 0.0, 0.9), data)
    own = 0.6**2 * 0.3**2 + 0.05**2 + 0.08**2
    gap = np.abs(np.subtract.outer(np.arange(3), np.arange(3)))
    K = 0.4**2 * (0.3**2 * 0.9**gap + 0.2**2 * np.eye(3))
    expected = own * np.eye(6)
    for i in range(2):
        expected[i::2, i::2] += z[:, i, None] * K * z[:, i]
    np.testing.assert_allclose(normal.cov, expected, rtol=1e-12, atol=1e-15)


def less_contact(missions, robot, which, size=0.5):
    """Missions in some of which a robot's rates fall by a share of its line of sight."""
    worse = list(missions)
    for j in which:
        loss = size * worse[j].awareness[..., 2] * (np.arange(3) == robot)
        rates = np.clip(worse[j].contact_rate - loss, 0.0, 1.0)
        args = worse[j].path, worse[j].awareness, rates
        worse[j] = Mission.from_arrays(*args, features=worse[j].features)
    return worse


@pytest.mark.parametrize(
    ("which", "when"),
    [
        ([], ""),
        (range(9, 15), "r2 has .* less contact in full sight, from mission 9 on"),
        ([3, 8], "r2 has .* less contact in full sight, in missions 3 and 8"),
        ([12, 14], "r2 has .* less contact in full sight, in missions 12 and 14"),
        (range(15), "r2 has .* less contact in full sight, in all missions"),
    ],
    ids=["healthy", "dead from 9 on", "two bad days", "two late ones", "poor"],
)
def test_a_robot_is_named_with_its_missions(planted, which, when):
    missions = less_contact(planted("none"), 1, which)
    model = PooledTrust(effects=[PlaceEffect(), RobotEffect()])
    found = criticise(fit(missions, model, draws=250, whole=False), missions, compare=False)
    assert found.fault == ("robot in a mission" if when else "none")
    assert re.search(when, found.verdict)
    chosen = found.robots[found.robots["stands_out"]]
    assert set(zip(chosen["robot"], chosen["mission"], strict=True)) <= {("r2", j) for j in which}


@pytest.mark.parametrize(
    ("p", "when"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.97, 0.0, 0.99], "in missions 4 and 6"),
        ([0.0, 0.0, 0.0, 0.0, 0.97, 0.7, 0.99], "in missions 4 and 6"),
        ([0.0, 0.0, 0.0, 0.97, 0.7, 0.97, 0.99], "from mission 3 on"),
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.97, 0.99], "from mission 5 on"),
        ([0.0, 0.97, 0.0, 0.6, 0.97, 0.98, 0.99], "in mission 1 and from mission 4 on"),
        ([0.7, 0.6, 0.97, 0.7, 0.97, 0.8, 0.8], "in all missions"),
    ],
)
def test_a_robot_fails_from_a_mission_on_if_no_later_one_is_healthy(p, when):
    """Of three robots, the second stands out where p exceeds .95."""
    missions = missions_of_shape(7, 2, n_robots=3)
    p = np.outer(p, [0.0, 1.0, 0.0]).ravel()
    mission, robot = np.indices((7, 3)).reshape(2, -1)
    table = pd.DataFrame({
        "mission": mission, "robot": np.array(["r1", "r2", "r3"])[robot], "effect": -0.2 * p,
        "p_worse": p, "p_better": 0.0, "stands_out": p > 0.95,
    })  # fmt: skip
    (label, effect, sentence), _ = finding_on_robots(table, dense.gather(missions, None))
    assert label == "r2"
    assert effect < -0.19
    assert f"r2 has 0.20 less contact in full sight, {when}, than" in sentence.replace(
        "0.19", "0.20"
    )


def test_a_posterior_of_another_family_is_criticised_too(planted):
    missions = less_contact(planted("none"), 1, range(9, 15))
    model = PooledTrust(effects=[RobotEffect()], observation="censored")
    found = criticise(fit(missions, model, draws=100), compare=False)
    assert found.fault == "robot in a mission"
    assert "from mission 9 on" in found.verdict
    assert np.isfinite(found.table.loc["family", "p"])


def test_residuals_are_those_of_the_kalman_filter(planted):
    posterior = fit(planted("none"), PooledTrust(), "exact", whole=False)
    found = criticise(posterior, compare=False, n_replicates=100)
    point, _ = dense.posterior_point(posterior)
    data = dense.gather(planted("none"), None)
    point = dense.with_start(point, data)
    one = point.params.map(lambda value, _: np.asarray(value)[None])
    mean, sd = (a[0] for a in kalman_numpy.one_step(one, 0.0, data.batch))
    np.testing.assert_allclose(found.rates["expected"], mean.ravel(), rtol=1e-9)
    np.testing.assert_allclose(found.rates["sd"], sd.ravel(), rtol=1e-9)
    # The projection takes away what 7 parameters explain, of 495 rates.
    plain = (data.y - mean.ravel()) / sd.ravel()
    assert np.corrcoef(plain, found.rates["residual"])[0, 1] > 0.97


def test_p_values_of_the_right_model_are_uniform():
    """Rates drawn from one point; parameters are estimated by the step of scoring alone."""
    missions = missions_of_shape(8, 6)
    params = TrustParams(0.5, np.array([0.3, 0.2]), 0.1, 0.06, 0.06, 0.5, 0.2)
    point, data = dense.Point(params, {}, 0.0, None), dense.gather(missions, None)
    normal, by_parameter = dense.joint_normal(point, data), derivatives(point, data)
    tests, left_out = departures(missions, data, normal, point, None)
    assert left_out == {}
    rng, L, p = np.random.default_rng(0), np.linalg.cholesky(normal.cov), []
    for _ in range(100):
        y = normal.mean + L @ rng.standard_normal(len(data.y))
        found = Innovations.of_rates(normal, y, by_parameter, rng.standard_normal((len(y), 200)))
        p.append([found.test(each).p for each in tests])
    for name, each in zip((test.name for test in tests), np.transpose(p), strict=True):
        # Six departures: a KS p-value below 1e-3 would come by chance in one of 200 seeds.
        assert stats.kstest(each, "uniform").pvalue > 1e-3, name


@pytest.mark.parametrize(
    ("fault", "name", "words"),
    [
        ("robot", "robot in a mission", "contact in full sight, in all missions"),
        ("weights of a robot", "robot in a mission", "contact in full sight, in all missions"),
        ("turning point", "curvature", "the response to line_of_sight bends: it flattens"),
        ("saturation", "none", "too small to be a fault: curvature"),
        ("wrong sign", "prior", "line_of_sight has the wrong sign"),
        ("correlated robots", "correlation", "robots in one bound go together"),
        ("none", "none", "no fault is found by 6 checks"),
    ],
)
def test_a_planted_fault_is_named(planted, fault, name, words):
    posterior = fit(planted(fault), PooledTrust(), "exact", whole=False)
    found = criticise(posterior, compare=False, n_replicates=300)
    assert found.fault == name
    assert words in found.verdict


def test_a_place_is_named_and_explains_what_it_makes_go_together(with_places):
    found = with_places[1]
    assert found.fault == "place"
    assert "cells that stand out: (" in found.verdict
    assert "It explains what is found under" in found.verdict
    correlation = found.table.loc["correlation"]
    assert correlation["p_adjusted"] < 0.05 < correlation["p_after"]
    odd = found.groups[found.groups["stands_out"]]
    assert "cell" in set(odd["kind"])
    assert len(repr(found).splitlines()) <= 12


def test_other_models_are_criticised_for_what_they_lack(planted):
    missions = planted("place")
    with_place = fit(missions, PooledTrust(place=PlaceEffect()), "exact", whole=False)
    found = criticise(with_place, compare=False, n_replicates=200)
    assert "the model has effects of cells and bounds" in found.table.loc["place", "finding"]
    assert found.fault == "none"
    odd = planted("robot")
    for model in (HierarchicalTrust(), CoupledTrust(inter_robot="none")):
        posterior = fit(odd, model, "exact", whole=False, check=False)
        found = criticise(posterior, compare=False, n_replicates=200)
        assert found.fault == "robot in a mission"
        assert (found.table["p_adjusted"].dropna() > 0.05).all()


def test_each_component_of_a_model_is_ablated(with_places, planted):
    posterior, _ = with_places
    ablation = criticise(posterior, n_replicates=100).ablation
    assert list(ablation.index) == [
        "prior", "traversability", "visibility", "line_of_sight", "places",
    ]  # fmt: skip
    assert ablation.loc["line_of_sight", "value"] > 2.0 * ablation.loc["line_of_sight", "se"]
    assert ablation.loc["places", "value"] < -2.0 * ablation.loc["places", "se"]
    own = replace(tb.models.Priors(), x0_sd=0.2)
    mine = fit(planted("place")[:3], PooledTrust(own), "exact")
    said = criticise(mine, n_replicates=100).ablation.loc["comparison", "finding"]
    assert "give it again with model=" in said


def test_with_places_nothing_is_compared_that_needs_nuts(planted, monkeypatch):
    """It took minutes for what campaigns fit by default."""
    by_nuts = importlib.import_module("trustbo.inference.samplers.run")
    monkeypatch.setattr(by_nuts, "_sample_nuts", lambda *_, **__: pytest.fail("NUTS was asked"))
    missions, place = planted("place")[:6], tb.models.PlaceEffect()
    ablation = criticise(
        fit(missions, PooledTrust(place=place), "exact"), n_replicates=100
    ).ablation
    assert "without them" in ablation.loc["places", "finding"]


def test_what_cannot_be_criticised_says_why(with_places, planted):
    posterior, _ = with_places
    with pytest.raises(TrustboError, match=r"takes a posterior of trustbo\.fit; got dict"):
        criticise({})
    bare = posterior.copy()
    bare.attrs = {}
    with pytest.raises(TrustboError, match="lacks the attribute 'observation'"):
        criticise(bare)
    other = posterior.copy()
    other["posterior"] = other["posterior"].to_dataset().drop_vars("beta0")
    with pytest.raises(TrustboError, match="of a linear drift"):
        criticise(other)
    alone = posterior.copy()
    del alone["constant_data"]
    with pytest.raises(TrustboError, match="give the missions it was fitted to"):
        criticise(alone)
    alone = posterior.copy()
    alone.attrs = {k: v for k, v in posterior.attrs.items() if k != "observation"}
    with pytest.raises(TrustboError, match="lacks the attribute 'observation'"):
        criticise(alone)
    first = planted("none")[0]
    short = replace(first, path=first.path[:5], bounds=first.bounds[:4])
    alone = posterior.copy()
    del alone["constant_data"]
    with pytest.raises(TrustboError, match="12 rates are too few to criticise 9 parameters"):
        criticise(alone, [short])
    with pytest.raises(TrustboError, match="2475 rates are more than the 2000"):
        criticise(alone, planted("none") * 5)
    with pytest.raises(TrustboError, match="n_replicates must be a whole number from 100 on"):
        criticise(posterior, n_replicates=10)


def test_the_missions_are_those_of_the_posterior(with_places, planted):
    posterior, found = with_places
    missions = planted("place")
    quick = {"compare": False, "n_replicates": 200}
    given = criticise(posterior, missions, **quick)
    assert given.table.equals(found.table)
    with pytest.raises(TrustboError, match="is of 15 missions, and 14 are given"):
        criticise(posterior, missions[:14])
    with pytest.raises(TrustboError, match="mission 0 has other contact rates"):
        criticise(posterior, planted("none"))
    # One of a campaign says which of its missions it learned from.
    later = posterior.copy()
    later.attrs = posterior.attrs | {"missions": np.arange(1, 16)}
    assert criticise(later, [missions[3], *missions], **quick).verdict == found.verdict
    del later["constant_data"]
    with pytest.raises(TrustboError, match="learned from mission 16, and 14 are given"):
        criticise(later, missions[:14])


def test_the_finding_that_explains_the_others_is_named():
    """As for a robot of a poor detector, whose rates go together in a mission with the least p."""
    outcome = lambda log_p: Outcome(np.exp(log_p), log_p, "", 0.0)  # noqa: E731
    before = {"robot": -71.1, "correlation": -115.5, "family": -11.0, "change": -0.1}
    left = {
        "robot": {"correlation": -1.3, "family": -5.8, "change": -0.1},
        "correlation": {"robot": -101.8, "family": -15.7, "change": -0.2},
        "family": {},
    }
    before = {name: outcome(p) for name, p in before.items()}
    left = {name: {n: outcome(p) for n, p in each.items()} for name, each in left.items()}
    choose = importlib.import_module("trustbo.criticism.criticise")._most_explaining
    assert choose(before, left) == "robot"
    assert choose(before, {}) == "none"
    # Of two that leave nothing, the one of least p.
    left["correlation"] |= {"robot": outcome(-0.2), "family": outcome(-0.3)}
    left["robot"] |= {"family": outcome(-0.1)}
    assert choose(before, left) == "correlation"


def test_holm_adjusts_for_the_number_of_tests():
    np.testing.assert_allclose(holm(np.array([0.04, 0.01, 0.03])), [0.06, 0.03, 0.06])


def few(n, n_bounds):
    """Missions along a row, of random rates."""
    rng, path = np.random.default_rng(0), [(0, k) for k in range(n_bounds + 1)]
    shape = (n_bounds, 3)
    return [
        Mission.from_arrays(path, rng.uniform(size=(*shape, 2)), rng.uniform(0.3, 0.9, shape))
        for _ in range(n)
    ]


@pytest.mark.parametrize("missions", [few(1, 11), few(8, 1)], ids=["one mission", "one bound"])
def test_one_mission_and_missions_of_one_bound_have_figures_too(missions):
    found = tb.criticise(tb.fit(missions), compare=False, n_replicates=200)
    assert found.fault == "none"
    plt.close("all")


def test_rates_that_are_all_alike_are_refused():
    model = tb.models.PooledTrust(place=tb.models.PlaceEffect())
    path = [(0, k) for k in range(6)]
    same = [Mission.from_arrays(path, np.full((5, 3, 2), 0.5), np.ones((5, 3))) for _ in range(3)]
    with pytest.raises(tb.TrustboError, match="the rates are all but equal"):
        tb.criticise(tb.fit(same, model), compare=False)
