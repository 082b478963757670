"""Trust in real time against Bayes' rule written out over the draws."""

import numpy as np
import pytest
import xarray as xr
from dense_families import likelihood, on_a_grid, trust_with_one_limit, with_one_limit
from dense_statespace import mission_of_params, trust_of_params
from every_model import KINDS, draws_of
from missions import N_TICKS, OF_FAMILY, counted_missions, random_params
from scipy import stats

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference import TrustFilter, fit, params_of
from trustbo.models import HierarchicalTrust, PooledTrust, TrustParams


@pytest.fixture(scope="module")
def posterior(missions):
    return fit(missions, PooledTrust(), seed=1)


def mixture(n_draws=4, seed=0):
    rng = np.random.default_rng(seed)
    draws = [random_params(rng) for _ in range(n_draws)]
    names = draws[0].values
    return TrustParams(**{name: np.concatenate([d.values[name] for d in draws]) for name in names})


PATH = [(0, 0), (1, 1), (1, 2), (2, 1), (2, 2)]


def mission_seen(n_robots=3, seed=1):
    """Awareness and rates along `PATH`, some of which were not measured."""
    rng = np.random.default_rng(seed)
    shape = len(PATH) - 1, n_robots
    z, y = rng.uniform(size=(*shape, 2)), rng.uniform(0.05, 0.95, shape)
    y[1, 0] = np.nan
    y[2] = np.nan
    return z, y


def averaged(weight, means, covs):
    """Mean and standard deviation of trust over weighted draws."""
    mean = weight @ means
    var = np.diagonal(covs, axis1=-2, axis2=-1)
    return mean, np.sqrt(weight @ (var + (means - mean) ** 2))


def weights_of(log_density):
    weight = np.exp(log_density - np.max(log_density))
    return weight / weight.sum()


@pytest.mark.parametrize("kind", KINDS)
def test_after_each_bound_trust_is_its_exact_posterior(kind):
    params = draws_of(kind)
    z, y = mission_seen()
    dense = mission_of_params(params, z, PATH)
    live = TrustFilter(params, n_robots=3)
    for k in range(len(z)):
        state = live.update(z[k], y[k], PATH[k : k + 2])
        until = np.where(np.arange(len(z))[:, None] <= k, y, np.nan)
        weight = weights_of(dense.log_density(until))
        mean, sd = averaged(weight, *dense.trust_given(until))
        now = slice(3 * k, 3 * k + 3)
        np.testing.assert_allclose(live.weights, weight, rtol=1e-9)
        np.testing.assert_allclose(state.mean, mean[now], rtol=1e-9)
        np.testing.assert_allclose(state.sd, sd[now], rtol=1e-9)
    assert live.n_bounds == len(z)


@pytest.mark.parametrize("kind", KINDS)
def test_trust_ahead_is_that_of_the_joint_normal(kind):
    params = draws_of(kind)
    z, y = mission_seen()
    y[2:] = np.nan
    live = TrustFilter(params, n_robots=3)
    for k in range(2):
        live.update(z[k], y[k], PATH[k : k + 2])
    ahead = live.predict(z[2:], PATH[2:])

    dense = mission_of_params(params, z, PATH)
    mean, sd = averaged(weights_of(dense.log_density(y)), *dense.trust_given(y))
    np.testing.assert_allclose(ahead.mean.ravel(), mean[6:], rtol=1e-9)
    np.testing.assert_allclose(ahead.sd.ravel(), sd[6:], rtol=1e-9)


@pytest.mark.parametrize("limit", [0.0, 1.0])
@pytest.mark.parametrize("kind", KINDS)
def test_a_censored_rate_after_others_inside_is_followed_exactly(kind, limit):
    """Moments are matched, which is exact for the last rate, that of the last robot."""
    params = draws_of(kind)
    z, y = mission_seen()
    y[-1, -1] = limit
    live = TrustFilter(params.replace(family="censored"), n_robots=3)
    for k in range(len(z)):
        state = live.update(z[k], y[k], PATH[k : k + 2])

    each = list(zip(*mission_of_params(params, z, PATH), strict=True))
    flat = y.ravel()
    weight = weights_of([with_one_limit(mean, rate_cov, flat) for mean, _, rate_cov in each])
    given = [trust_with_one_limit(*moments, flat) for moments in each]
    mean, sd = averaged(weight, *(np.stack(moments) for moments in zip(*given, strict=True)))
    np.testing.assert_allclose(live.weights, weight, rtol=1e-9)
    np.testing.assert_allclose(state.mean, mean[-3:], rtol=1e-9)
    np.testing.assert_allclose(state.sd, sd[-3:], rtol=1e-9)


def test_predicting_is_updating_with_nothing_measured():
    params = mixture()
    rng = np.random.default_rng(2)
    z = rng.uniform(size=(5, 3, 2))
    live = TrustFilter(params, n_robots=3)
    live.update(z[0], rng.uniform(size=3))
    ahead = live.predict(z[1:])
    before = live.state
    assert ahead.mean.shape == ahead.sd.shape == (4, 3)
    np.testing.assert_array_equal(live.state.mean, before.mean)  # predicting changes nothing
    for k in range(4):
        state = live.update(z[k + 1], np.full(3, np.nan))
        np.testing.assert_allclose(state.mean, ahead.mean[k], rtol=1e-12)
        np.testing.assert_allclose(state.sd, ahead.sd[k], rtol=1e-12)


def test_a_posterior_brings_its_robots_and_a_reset_starts_over(posterior):
    live = TrustFilter(posterior, max_draws=500)
    assert np.shape(live.params.beta) == (500, 2)
    first = live.update(np.full((3, 2), 0.5), [0.7, 0.8, 0.9])
    assert first.mean.shape == (3,)
    assert first.mean[0] < first.mean[1] < first.mean[2]
    live.reset()
    assert live.n_bounds == 0
    again = live.update(np.full((3, 2), 0.5), [0.7, 0.8, 0.9])
    np.testing.assert_array_equal(again.mean, first.mean)


def test_bad_input_is_named():
    params = mixture()
    with pytest.raises(TrustboError, match="got None"):
        TrustFilter(None)
    with pytest.raises(TrustboError, match="n_robots"):
        TrustFilter(params)
    live = TrustFilter(params, n_robots=3)
    good = np.full((3, 2), 0.5)
    with pytest.raises(
        TrustboError, match=r"awareness must be \(3 robots, 2 features\); got shape"
    ):
        live.update(good[:2], [0.5, 0.5, 0.5])
    with pytest.raises(TrustboError, match=r"contact_rate must have shape \(3,\)"):
        live.update(good, [0.5, 0.5])
    with pytest.raises(TrustboError, match=r"contact_rate: \[2\] = 1.5 is outside \[0, 1\]"):
        live.update(good, [0.5, 0.5, 1.5])
    with pytest.raises(TrustboError, match="awareness must not be NaN"):
        live.update(good * np.nan, [0.5, 0.5, 0.5])
    with pytest.raises(TrustboError, match=r"awareness must be \(bound, 3 robots"):
        live.predict(good)
    assert live.n_bounds == 0


def test_impossible_values_leave_the_filter_as_it_was(posterior):
    """Trust of 44 is what a filter says that takes 85 for the contact of a tick."""
    params = mixture()
    live, good = TrustFilter(params, n_robots=3), np.full((3, 2), 0.5)
    with pytest.raises(TrustboError, match=r"awareness: \[0, 0\] = 80 is outside"):
        live.update(good * 160, [0.5] * 3)
    with pytest.raises(TrustboError, match="awareness must be an array of numbers"):
        live.update("high", [0.5] * 3)
    with pytest.raises(TrustboError, match=r"awareness: \[1, 0, 0\] = -1 is outside"):
        live.predict([good, good - 1.5])
    with pytest.raises(TrustboError, match=r"n_ticks of a bound: \[0\] = 0 must be a whole"):
        live.update(good, [0.5] * 3, n_ticks=0)
    with pytest.raises(TrustboError, match="contact_rate"):
        live.update(good, [0.5] * 3, n_ticks=25)
    with pytest.raises(TrustboError, match="n_ticks of a bound must be"):
        live.update(good, [0.5] * 3, n_ticks=[4, 4])
    assert 0.0 < live.update(good, [1.0, 0.0, np.nan]).mean[0] < 1.5
    for most in (0, 2.5):
        with pytest.raises(TrustboError, match="max_draws must be a whole number"):
            TrustFilter(params, 3, max_draws=most)


def test_bounds_that_cannot_be_are_named():
    params = mixture()
    params = params.replace(place=np.zeros((4, 1, 5, 6)))
    live, z, y = TrustFilter(params, n_robots=3), np.full((3, 2), 0.5), [0.5] * 3
    for bound, message in {
        ((0, 0), (-1, 0)): r"\(-1, 0\) is outside the grid of 5 rows and 6 columns",
        ((4, 0), (5, 0)): r"\(5, 0\) is outside the grid",
        ((0.0, 0.5), (1, 0)): r"path\[0\] must be two whole numbers \(row, col\); got \(0.0, 0.5\)",
        ((0, 0), (2, 0)): "no bound leads from",
        (2, 0): r"two whole numbers \(row, col\); got 2",
        ((0, 0),): "must have 2 cells",
    }.items():
        with pytest.raises(TrustboError, match=message):
            live.update(z, y, bound)
    with pytest.raises(TrustboError, match="must have 3 cells"):
        live.predict([z, z], [(0, 0), (0, 1)])
    assert live.n_bounds == 0
    np.testing.assert_array_equal(live.predict([z], np.array([(4, 4), (4, 5)])).mean.shape, (1, 3))


def constant(p, n=2):
    """The same parameters as draws."""
    return p.draw(np.zeros(n, int))


@pytest.mark.parametrize("family", ["censored", "beta_binomial"])
def test_families_are_followed_to_the_trust_of_a_grid(family):
    """Moments are matched bound by bound: within .05 sd of the exact posterior.

    The weight of a draw is compared with that of one whose trust has no noise.
    """
    p = OF_FAMILY[family]
    other = p.replace(delta_w=1e-5, x0_sd=1e-5)
    z, y, _ = counted_missions(family)
    live = TrustFilter(constant(p), n_robots=1)
    two = {name: np.concatenate([p.values[name], other.values[name]]) for name in p.values}
    compared = TrustFilter(TrustParams(**two, family=family), n_robots=1)
    for j in range(len(y)):
        live.reset()
        compared.reset()
        for k in range(5):
            state = live.update(z[j, k], y[j, k], n_ticks=N_TICKS)
            compared.update(z[j, k], y[j, k], n_ticks=N_TICKS)
        expected, mean, sd = on_a_grid(family, p, z[j, :, 0], y[j, :, 0], n_ticks=N_TICKS)
        assert abs(state.mean[0] - mean) < 0.05 * sd
        assert abs(state.sd[0] / sd - 1.0) < 0.05
        trust = trust_of_params(other, z[j])[:, 0]
        of_other = sum(
            np.log(likelihood(family, y[j, k, 0], N_TICKS, trust[k], other.delta_v))
            for k in np.flatnonzero(~np.isnan(y[j, :, 0]))
        )
        ratio = np.log(compared.weights[0] / compared.weights[1])
        assert abs(ratio - (expected - of_other)) < 0.03


def test_counts_need_their_numbers_of_ticks():
    counting = TrustFilter(constant(OF_FAMILY["beta_binomial"]), 2)
    with pytest.raises(TrustboError, match="The beta-binomial family counts ticks"):
        counting.update(np.full((2, 2), 0.5), [1.0, 1.0])
    with pytest.raises(TrustboError, match="n_ticks"):
        counting.update(np.full((2, 2), 0.5), [1.0, 1.0], n_ticks=[np.nan, 20.0])
    counting.update(np.full((2, 2), 0.5), [np.nan, 1.0], n_ticks=[np.nan, 20.0])


@pytest.mark.parametrize("family", ["gaussian", "censored", "beta_binomial"])
def test_coupled_robots_without_a_coupling_are_robots_apart(family):
    p, rng, eye = OF_FAMILY[family], np.random.default_rng(1), np.eye(2)[None]
    coupled = TrustParams(
        B0=p.beta0 * eye,
        B=p.beta[..., None, None] * np.eye(2),
        b=np.full((1, 2), p.b),
        Delta_w=p.delta_w**2 * eye,
        Delta_v=p.delta_v**2 * eye,
        x0_mean=p.x0_mean,
        x0_sd=p.x0_sd,
        family=family,
    )
    together = TrustFilter(coupled)
    apart = TrustFilter(constant(p, 1), 2)
    for y in ([1.0, 0.5], [0.0, np.nan], [0.9, 1.0]):
        z = rng.uniform(size=(2, 2))
        one, other = (live.update(z, y, n_ticks=N_TICKS) for live in (together, apart))
        np.testing.assert_allclose(one.mean, other.mean, rtol=1e-7)
        np.testing.assert_allclose(one.sd, other.sd, rtol=1e-7)
    ahead = together.predict(rng.uniform(size=(3, 2, 2)))
    assert ahead.rate.shape == ahead.rate_low.shape == (3, 2)


def test_rates_ahead_have_the_interval_of_the_model():
    rng, n = np.random.default_rng(3), 4000
    p = OF_FAMILY["gaussian"]
    live = TrustFilter(constant(p, n), 2, max_draws=n)
    live.update(rng.uniform(size=(2, 2)), [0.4, 0.8])
    ahead = live.predict(rng.uniform(size=(3, 2, 2)))
    law = stats.norm(ahead.mean, np.hypot(ahead.sd, p.delta_v))
    # 4000 draws: 5 standard errors of a mean, and of a 5 % quantile (2.1 times as wide).
    error = 5 * law.std() / np.sqrt(n)
    assert (np.abs(ahead.rate - ahead.mean) < error).all()
    assert (np.abs(ahead.rate_low - law.ppf(0.05)) < 2.2 * error).all()
    assert (np.abs(ahead.rate_high - law.ppf(0.95)) < 2.2 * error).all()
    cut = TrustFilter(constant(OF_FAMILY["censored"], n), 2, max_draws=n)
    for _ in range(6):
        cut.update(np.ones((2, 2)), [1.0, 1.0])
    assert (cut.predict(np.ones((1, 2, 2))).rate_high == 1.0).all()


def test_a_campaign_s_posterior_of_parameters_alone_is_followed():
    rng = np.random.default_rng(0)
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(2, 4, 4, 2)))
    campaign = tb.Campaign(workspace, (3, 0), (0, 3), model=PooledTrust())
    path = campaign.ask().path
    shape = len(path) - 1, 2
    z, y = rng.uniform(size=(*shape, 2)), rng.uniform(size=shape)
    whole = campaign.tell(tb.Mission.from_arrays(path, z, y))
    alone = TrustFilter(campaign.posteriors[-1])
    assert alone.state.mean.shape == (2,)
    expected = TrustFilter(params_of(whole), 2).update(z[0], y[0])
    np.testing.assert_array_equal(alone.update(z[0], y[0]).mean, expected.mean)


def test_a_filter_reads_robots_and_features_by_name(missions):
    """A posterior in another order, and labelled awareness and rates, change nothing."""
    workspace = tb.Workspace.from_awareness(np.zeros((3, 2, 2, 2)))
    posterior = fit(missions, HierarchicalTrust(), draws=100)
    turned = posterior.isel(
        feature=[1, 0], robot=[2, 0, 1], robot_=[2, 0, 1], missing_dims="ignore"
    )
    z, y = np.random.default_rng(3).uniform(size=(3, 2)), np.array([0.2, 0.5, 0.9])
    names = {"robot": list(workspace.team.names), "feature": list(workspace.features)}
    expected = TrustFilter(posterior).update(z, y)

    by_workspace = TrustFilter(turned, workspace=workspace).update(z, y)
    np.testing.assert_allclose(by_workspace.mean, expected.mean, rtol=1e-12)

    labelled = xr.DataArray(z, names, ("robot", "feature"))
    rates = dict(zip(names["robot"], y, strict=True))
    for given in (turned, params_of(turned)):
        by_label = TrustFilter(given).update(labelled, rates)  # in the order of the fit
        np.testing.assert_array_equal(by_label.mean, expected.mean)

    other = tb.Workspace.from_awareness(np.zeros((3, 2, 2, 2)), features=("slope", "canopy"))
    with pytest.raises(TrustboError, match="features"):
        TrustFilter(posterior, workspace=other)
    unnamed = params_of(posterior).replace(robots=None, features=None)
    with pytest.raises(TrustboError, match="awareness"):
        TrustFilter(unnamed).update(labelled, y)


@pytest.mark.parametrize(
    "cut",
    [
        lambda tree: tree.isel(chain=0),
        lambda tree: tree.mean("draw", keep_attrs=True),
        lambda tree: tree.isel(draw=slice(0, 0)),
    ],
    ids=["one chain", "means", "no draws"],
)
def test_a_posterior_needs_chains_and_draws(posterior, cut):
    with pytest.raises(TrustboError, match="draw"):
        TrustFilter(cut(posterior))


def test_variables_of_one_s_own_do_not_matter(posterior):
    own = posterior.copy()
    own["posterior"]["threshold"] = xr.DataArray(0.3)
    own["posterior"]["trust"] = posterior["posterior"]["b"] * np.nan
    assert params_of(own).values.keys() == params_of(posterior).values.keys()
    np.testing.assert_array_equal(params_of(own).b, params_of(posterior).b)
