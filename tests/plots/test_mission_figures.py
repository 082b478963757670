"""Trust of each robot along a mission: bands, medians and rates are the posterior's."""

import numpy as np
import pytest

import trustbo as tb


def test_bands_and_rates_are_those_of_the_posterior(result):
    axes = tb.plots.mission_trust(result.posterior, 0)
    drawn = result.posterior["latent"]["trust"].isel(mission=0)
    measured = result.missions[0].contact_rate
    assert [ax.get_title() for ax in axes] == ["r1", "r2", "r3"]
    for i, ax in enumerate(axes):
        n = len(measured)
        own = drawn.isel(robot=i, bound=slice(n)).values.reshape(-1, n)
        outer, inner = (band.get_paths()[0].vertices[:, 1] for band in ax.collections)
        low, high = np.quantile(own, (0.05, 0.95), axis=0)
        assert set(np.round(np.r_[low, high], 9)) <= set(np.round(outer, 9))
        low, high = np.quantile(own, (0.25, 0.75), axis=0)
        assert set(np.round(np.r_[low, high], 9)) <= set(np.round(inner, 9))
        median, rates = ax.lines
        np.testing.assert_allclose(median.get_ydata(), np.median(own, axis=0))
        np.testing.assert_array_equal(rates.get_ydata(), measured[:, i])
        np.testing.assert_array_equal(rates.get_xdata(), np.arange(1, n + 1))


def test_the_last_mission_is_shown_unless_another_is_asked_for(result):
    for mission in (-1, 1):
        axes = tb.plots.mission_trust(result.posterior, mission)
        rates = np.transpose([ax.lines[1].get_ydata() for ax in axes])
        np.testing.assert_array_equal(rates, result.missions[1].contact_rate)
    with pytest.raises(tb.TrustboError, match="mission must be one of 2, from -2 to 1; got 2"):
        tb.plots.mission_trust(result.posterior, 2)
    with pytest.raises(tb.TrustboError, match=r"has no latent trust; .*complete\(posterior"):
        tb.plots.mission_trust(tb.fit(result.missions, sampler="exact", whole=False))


def test_a_short_mission_ends_where_it_ended():
    rng = np.random.default_rng(0)
    long, short = [(0, k) for k in range(7)], [(0, k) for k in range(2)]
    missions = [
        tb.Mission.from_arrays(path, rng.uniform(size=(n, 2, 2)), rng.uniform(0.4, 0.9, (n, 2)))
        for path, n in ((long, 6), (short, 1))
    ]
    posterior = tb.fit(missions, sampler="exact")
    ax = tb.plots.mission_trust(posterior, 1)[0]
    np.testing.assert_array_equal(ax.lines[1].get_xdata(), [1])
    # One bound's band is wide enough to be seen.
    assert np.ptp(ax.collections[0].get_paths()[0].vertices[:, 0]) > 0.5


def test_a_plan_s_bands_are_its_own(result):
    plan, names = result.plan, result.workspace.team.names
    axes = tb.plots.plan_trust(plan, names)
    assert [ax.get_title() for ax in axes] == list(names)
    for i, ax in enumerate(axes):
        np.testing.assert_allclose(ax.lines[0].get_ydata(), plan.trust[:, i])
        outer, inner = (band.get_paths()[0].vertices[:, 1] for band in ax.collections)
        for ends, drawn in (([0, 3], outer), ([1, 2], inner)):
            assert set(np.round(plan.bands[ends, :, i].ravel(), 9)) <= set(np.round(drawn, 9))
    rates = np.array([[0.5, 0.6, 0.7]])  # the mission ended after one bound
    for ax, rate in zip(tb.plots.plan_trust(plan, names, rates), rates[0], strict=True):
        drawn = ax.lines[1].get_ydata()
        np.testing.assert_array_equal(drawn[np.isfinite(drawn)], [rate])


def test_a_plan_of_other_robots_is_refused(result):
    with pytest.raises(tb.ShapeError, match="the plan has 3 robots; got the names"):
        tb.plots.plan_trust(result.plan, ["a", "b"])
    with pytest.raises(tb.ShapeError, match=r"contact_rate must be \(\d, 3\).*got shape \(2, 4\)"):
        tb.plots.plan_trust(result.plan, result.workspace.team.names, np.zeros((2, 4)))
