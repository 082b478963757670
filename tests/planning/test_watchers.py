"""Shares of time with at least k watchers, against enumeration and closed forms."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.models import TrustParams
from trustbo.planning import at_least, contact_dependence

ENDS = (4, 0), (0, 4)
PATH = ((4, 0), (3, 1), (2, 2), (1, 3), (0, 4))


@pytest.fixture(scope="module")
def workspace():
    z = np.random.default_rng(3).uniform(size=(3, 8, 5, 5, 2))
    return tb.Workspace.from_awareness(z, cell_size=20.0)


def test_two_robots_have_the_closed_forms_of_independent_and_dependent_contact():
    np.testing.assert_allclose(at_least([0.3, 0.8], 0.0), [1.0 - 0.7 * 0.2, 0.3 * 0.8])
    np.testing.assert_allclose(at_least([0.3, 0.8], 1.0), [0.8, 0.3])
    np.testing.assert_allclose(at_least([0.3], 0.5), [0.3])


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_independent_contact_is_the_sum_over_all_outcomes(n):
    p = np.random.default_rng(n).uniform(size=(4, n))
    expected = np.zeros((4, n))
    for outcome in itertools.product((0, 1), repeat=n):
        share = np.prod(np.where(outcome, p, 1.0 - p), axis=1)
        expected[:, : sum(outcome)] += share[:, None]
    np.testing.assert_allclose(at_least(p, 0.0), expected, rtol=1e-12)


@pytest.mark.parametrize("dependence", [0.0, 0.3, 1.0])
def test_shares_keep_the_mean_rate_and_decrease_with_the_number_of_watchers(dependence):
    p = np.random.default_rng(0).uniform(size=(50, 4))
    shares = at_least(p, dependence)
    np.testing.assert_allclose(shares.sum(-1), p.sum(-1))  # the expected number of watchers
    assert (np.diff(shares, axis=-1) <= 0.0).all()
    assert (shares >= 0.0).all()
    assert (shares <= 1.0).all()

    better = np.minimum(p + 0.1 * np.eye(4)[2], 1.0)
    assert (at_least(better, dependence) >= shares - 1e-12).all()
    fewer = at_least(p[:, :3], dependence)
    assert (fewer <= shares[:, :3] + 1e-12).all()


def test_dependence_makes_at_least_one_watcher_less_likely():
    p = np.random.default_rng(0).uniform(size=(50, 3))
    apart, together = at_least(p, 0.0), at_least(p, 1.0)
    assert (together[:, 0] <= apart[:, 0]).all()
    assert (together[:, 2] >= apart[:, 2]).all()


@pytest.mark.parametrize("rates", [[1.2, 0.5], [np.nan, 0.5], 0.5])
def test_wrong_rates_are_refused(rates):
    with pytest.raises(TrustboError, match="rates"):
        at_least(rates)


def recorded(weight, n_bounds, n_ticks=400, n_robots=3):
    """A mission whose contact at ticks is a mixture with a given weight."""
    rng = np.random.default_rng(0)
    contact = []
    for _ in range(n_bounds):
        p = rng.uniform(0.2, 0.9, n_robots)
        same = rng.random((n_ticks, 1)) < weight
        u = np.where(same, rng.random((n_ticks, 1)), rng.random((n_ticks, n_robots)))
        contact.append(u < p)
    path = [(0, k) for k in range(n_bounds + 1)]
    z = np.full((n_bounds, n_robots, 1), 0.5)
    mission = tb.Mission.from_arrays(path, z, [values.mean(0) for values in contact])
    return replace(mission, contact=tuple(contact))


@pytest.mark.parametrize("weight", [0.0, 0.4, 1.0])
def test_the_dependence_of_drawn_contact_is_found(weight):
    mission = recorded(weight, 100)
    assert contact_dependence([mission]) == pytest.approx(weight, abs=0.03)
    assert contact_dependence([mission.of_robots(["r1", "r3"])]) == pytest.approx(weight, abs=0.05)


def test_little_known_contact_leaves_the_usual_dependence():
    assert contact_dependence([]) == 0.4
    unknown = replace(recorded(1.0, 1), contact=())
    assert contact_dependence([unknown]) == 0.4
    assert contact_dependence([recorded(1.0, 2).of_robots(["r2"])]) == 0.4

    few, many = (contact_dependence([recorded(1.0, n)]) for n in (1, 20))
    assert 0.4 < few < many <= 1.0


def test_the_table_of_a_path_has_the_rates_of_the_robots_that_go(workspace):
    params = TrustParams(0.4, np.array([0.3, 0.2]), 0.1, 1e-6, 1e-6, 0.3, 1e-6)
    params = params.replace(features=workspace.features)
    some = workspace.of_robots(["r1", "r3"])
    planner = tb.Planner(some, *ENDS)
    table = planner.watchers(PATH, params, missions=[recorded(0.0, 200)])
    assert [*table] == ["rate_r1", "rate_r3", "at_least_one", "at_least_two"]
    assert table.index.tolist() == [1, 2, 3, 4]

    # Without noise, rates are the expected trust.
    trust = planner.evaluate(PATH, params).trust
    np.testing.assert_allclose(table[["rate_r1", "rate_r3"]], trust, atol=1e-4)
    w = contact_dependence([recorded(0.0, 200)])
    shares = at_least(trust, w)
    np.testing.assert_allclose(table[["at_least_one", "at_least_two"]], shares, atol=1e-4)


def test_a_robot_alone_is_never_two(workspace):
    params = TrustParams(0.4, np.array([0.3, 0.2]), 0.1, 0.1, 0.1)
    table = tb.Planner(workspace.of_robots(["r2"]), *ENDS).watchers(PATH, params)
    np.testing.assert_array_equal(table["at_least_one"], table["rate_r2"])
    assert (table["at_least_two"] == 0.0).all()


def test_the_noise_that_robots_share_makes_rates_dependent(workspace):
    given = {"beta0": 0.0, "beta": [0.0, 0.0], "b": 0.5, "delta_w": 1e-6}
    alone = TrustParams(**given, delta_v=0.2)
    shared = TrustParams(**given, delta_v=1e-6, delta_s=0.2)
    planner = tb.Planner(workspace, *ENDS)
    tables = [planner.watchers(PATH, params).mean() for params in (alone, shared)]
    rates = [f"rate_r{i}" for i in (1, 2, 3)]
    np.testing.assert_allclose(tables[0][rates], tables[1][rates], atol=0.02)
    assert tables[1]["at_least_one"] < tables[0]["at_least_one"]

    again = planner.watchers(PATH, shared)
    other = planner.watchers(PATH, shared, seed=1)
    np.testing.assert_array_equal(again, planner.watchers(PATH, shared))
    assert not np.array_equal(again, other)


def test_trust_at_the_current_cell_is_where_rates_begin(workspace):
    params = TrustParams(0.9, np.array([0.0, 0.0]), 0.05, 1e-6, 1e-6, 0.5, 1e-6)
    rest = tb.Planner(workspace, *ENDS).from_cell((3, 1), x0=[0.2, 0.5, 0.8])
    table = rest.watchers(PATH[1:], params)
    expected = rest.evaluate(PATH[1:], params).trust
    np.testing.assert_allclose(table[["rate_r1", "rate_r2", "rate_r3"]], expected, atol=1e-4)
