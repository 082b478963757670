"""Importance sampling from adapted mixtures, against densities whose moments are known."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from scipy import stats

import trustbo as tb
from trustbo.inference.agreed import Chart, sample_charts
from trustbo.inference.functions.coordinates import Coordinates
from trustbo.inference.mixture import Mixture
from trustbo.inference.search import Visited, lost_modes
from trustbo.models import ContactRate
from trustbo.models.backend import own_settings

RNG = np.random.default_rng(0)
BROAD = 3.0 * RNG.standard_normal((500, 2))
"""Start that is wider than the densities, like draws of a prior."""


def only(log_density, start=BROAD):
    """One chart, from one start."""
    return [Chart(log_density, [start], to_first=lambda x: x, from_first=lambda x: x)]


def moments(found):
    mean = found.weight @ found.x
    return mean, np.sqrt(found.weight @ (found.x - mean) ** 2)


def test_a_normal_density_has_its_moments_and_its_evidence():
    cov = np.array([[0.04, 0.03], [0.03, 0.09]])
    law = stats.multivariate_normal([1.0, -2.0], cov)
    found = sample_charts(only(lambda x: np.atleast_1d(law.logpdf(x) + 5.0)), seed=1)
    mean, sd = moments(found)
    error = np.sqrt(np.diag(cov) / found.kish)
    assert found.complaints == ()
    assert found.kish > 1000.0
    assert (np.abs(mean - [1.0, -2.0]) < 5.0 * error).all()
    np.testing.assert_allclose(sd, np.sqrt(np.diag(cov)), rtol=0.1)
    assert found.log_evidence == pytest.approx(5.0, abs=0.05)


def two_modes(x):
    """A fifth of the probability is in a mode that is far from the other one."""
    parts = [
        np.log(share) + stats.multivariate_normal(center, 0.01).logpdf(x)
        for share, center in ((0.8, [2.0, 0.0]), (0.2, [-2.0, 1.0]))
    ]
    return np.atleast_1d(np.logaddexp(*parts))


def test_both_modes_have_their_shares():
    found = sample_charts(only(two_modes), seed=1)
    assert found.complaints == ()
    assert found.weight[found.x[:, 0] < 0.0].sum() == pytest.approx(0.2, abs=0.03)
    assert found.log_evidence == pytest.approx(0.0, abs=0.1)


def test_runs_that_find_different_modes_do_not_agree(monkeypatch):
    """Each run is led to another mode, where it alone would be content."""
    led = iter(([2.0, 0.0], [-2.0, 1.0]) * 3)

    def at_modes(log_density, starts):
        return Mixture.single(np.array(next(led)), 0.1 * np.eye(2))

    def search(log_density, starts, wanted, rng):
        return at_modes(log_density, starts), 0.0

    monkeypatch.setattr("trustbo.inference.agreed.at_modes", at_modes)
    monkeypatch.setattr("trustbo.inference.agreed.search", search)
    monkeypatch.setattr("trustbo.inference.agreed._PRIOR_SCALE", 0.1)  # it would find the other
    monkeypatch.setattr(
        "trustbo.inference.agreed.lost_modes", lambda *_: np.empty((0, 2))
    )  # so too
    found = sample_charts(only(two_modes), seed=1)
    assert any("standard deviations" in one for one in found.complaints)
    assert any("evidences" in one for one in found.complaints)


FIRST_MODE = Mixture.single(np.array([2.0, 0.0]), 0.1 * np.eye(2))


def test_visited_points_show_a_mode_that_the_search_has_lost():
    visited = Visited(BROAD, two_modes(BROAD), log_evidence=np.log(0.8))
    found = lost_modes(visited, FIRST_MODE, two_modes)
    assert len(found)
    assert (found[:, 0] < 0.0).all()


def test_points_in_the_tails_of_a_mode_are_in_no_other_mode():
    """Cauchy tails are far above those of the mixture."""

    def cauchy(x):
        return stats.cauchy([2.0, 0.0], 0.1).logpdf(x).sum(1)

    visited = Visited(BROAD, cauchy(BROAD), log_evidence=0.0)
    assert (visited.log_p - FIRST_MODE.log_density(BROAD)).max() > 10.0
    assert len(lost_modes(visited, FIRST_MODE, cauchy)) == 0


def funnel(x):
    """Eight variables that are normal with the standard deviation exp(s), and s ~ N(0, 1.5^2)."""
    s = x[:, 0]
    return stats.norm(0.0, 1.5).logpdf(s) + stats.norm(0.0, np.exp(s)[:, None]).logpdf(
        x[:, 1:]
    ).sum(1)


def as_deviations(x):
    return np.column_stack([x[:, 0], x[:, 1:] / np.exp(x[:, :1])])


def of_deviations(x):
    return np.column_stack([x[:, 0], x[:, 1:] * np.exp(x[:, :1])])


def test_points_of_two_charts_are_those_of_one_density():
    """In deviations, the funnel is a normal density; in the other chart, it is hard."""
    log_p = stats.norm(0.0, 1.5).logpdf
    start = np.column_stack([RNG.standard_normal((500, 9))])
    deviations = Chart(
        lambda x: log_p(x[:, 0]) + stats.norm.logpdf(x[:, 1:]).sum(1),
        [start],
        to_first=lambda x: x,
        from_first=lambda x: x.copy(),
    )
    centred = Chart(
        lambda x: funnel(x) + 0.0, [start], to_first=as_deviations, from_first=of_deviations
    )
    found = sample_charts([deviations, centred], seed=1)
    mean, sd = moments(found)
    assert found.complaints == ()
    assert np.abs(mean).max() < 0.15
    np.testing.assert_allclose(sd, [1.5, *[1.0] * 8], rtol=0.1)
    assert found.log_evidence == pytest.approx(0.0, abs=0.1)


def test_a_density_without_an_integral_is_complained_of():
    found = sample_charts(only(lambda x: -2.0 * np.log(np.abs(x)).sum(1)), seed=1)
    assert found.complaints


def test_the_same_seed_gives_the_same_points():
    one, same, other = (sample_charts(only(two_modes), seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.x, same.x)
    np.testing.assert_array_equal(one.weight, same.weight)
    assert one.x.shape != other.x.shape or not np.array_equal(one.x, other.x)


def test_the_total_and_the_share_of_noises_keep_the_density():
    """The log volume is that of JAX's Jacobian; the noises are second and third."""
    free = {"a": np.zeros(2), "v": np.zeros(()), "w": np.zeros(())}
    with own_settings():
        coordinates = Coordinates(free, ("w", "v"), ())
        x = jnp.array([0.3, -0.2, 0.7, -1.1])

        def flat(x):
            z = coordinates.unconstrained(x)
            return jnp.concatenate([z["a"], z["v"][None], z["w"][None]])

        _, log_volume = jnp.linalg.slogdet(jax.jacobian(flat)(x))
        np.testing.assert_allclose(coordinates.log_jacobian(x), log_volume, rtol=1e-10)
        np.testing.assert_allclose(coordinates.of(coordinates.unconstrained(x)), x, rtol=1e-10)

        z = coordinates.unconstrained(x)
        total = np.hypot(np.exp(z["v"]), np.exp(z["w"]))
        assert total == pytest.approx(np.exp(-1.1))  # in the place of delta_w


NOISE = dist.LogNormal(-3.0, 0.5)


def own(awareness, contact_rate=None, n_ticks=None):
    weight = numpyro.sample("weight", dist.Normal(1.0, 0.3))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 4.0))
    delta_w = numpyro.sample("delta_w", NOISE)
    delta_v = numpyro.sample("delta_v", NOISE)
    drift = (1.0 - beta0) * weight * awareness[..., 0]
    with numpyro.plate("mission", len(drift)):
        rates = ContactRate(drift, beta0, delta_w, delta_v, n_ticks=n_ticks)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def first_mission(n_ticks):
    """A mission in which the lead was always seen."""
    rates = np.ones((8, 3))
    ticks = None if n_ticks is None else np.full((8, 3), n_ticks)
    return tb.Mission.from_arrays(None, np.full((8, 3, 1), 0.9), rates, n_ticks=ticks)


@pytest.fixture(scope="module")
def of_ones():
    """The posterior of a mission whose rates are all 1; it passes the checks of `fit`."""
    return tb.fit([first_mission(100.0)], own, sampler="importance", latent=False, progress=False)[
        "posterior"
    ]


def test_rates_that_are_all_1_are_accepted(of_ones):
    """They say that trust is high and noise small, which the prior does not."""
    weight, delta_v = of_ones["weight"], of_ones["delta_v"]
    assert float(weight.mean()) > 1.05  # 0.9 weight is near 1
    assert float(weight.std()) < 0.25
    assert float(delta_v.mean()) < float(NOISE.mean)


@pytest.mark.slow  # its function is compiled for NUTS
def test_nuts_has_the_same_answer_for_rates_that_are_all_1(of_ones):
    b = tb.fit(
        [first_mission(100.0)], own, sampler="nuts", draws=300, check=False, latent=False,
        progress=False,
    )["posterior"]  # fmt: skip
    a = of_ones
    for name in ("weight", "beta0", "delta_w", "delta_v"):
        sd = float(b[name].std())
        assert abs(float(a[name].mean() - b[name].mean())) < 0.25 * sd
        assert float(a[name].std()) == pytest.approx(sd, rel=0.25)


def test_equal_rates_without_ticks_are_named_as_the_cause():
    def without_ticks(awareness, contact_rate=None):
        level = numpyro.sample("level", dist.Normal(0.1, 0.2))
        noise = numpyro.sample("noise", dist.HalfNormal(0.1))
        rates = ContactRate(level + 0.3 * awareness[..., 0], 0.5, noise, noise)
        numpyro.sample("contact_rate", rates, obs=contact_rate)

    with pytest.raises(tb.errors.PosteriorError, match="n_ticks"):
        tb.fit([first_mission(None)], without_ticks, sampler="importance", progress=False)
