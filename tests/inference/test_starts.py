"""Fits that start from a posterior which the new missions contradict, in every sampler."""

import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from scipy import special, stats

import trustbo as tb
from trustbo.inference import importance
from trustbo.inference.agreed import Chart, sample_charts
from trustbo.inference.class_sampling import misses
from trustbo.inference.mixture import Mixture
from trustbo.inference.weights import smoothed
from trustbo.models import ContactRate, PlaceEffect, PooledTrust

QUIET = {"latent": False, "progress": False}
LIMIT = 0.34
"""Largest difference of means from those without start, in standard deviations."""
FEATURES = ("traversability", "visibility", "line_of_sight")
FAMILIES = ("gaussian", "censored", "beta_binomial")


WHOLE = """
17
18     131  131 125 130    67  62  97  58  62  98  78  62  98
19      94   93  94  93    68  81 100  64  81  99  60  81 100
29     134  134 134 134    73  80 100  71  80 100  66  80 100
39     121  121 121 121    59  69 100  57  69 100  61  69 100
49     150  150 148 147    42  53 100  41  53 100  54  53  99
59     106   90 102 104    70  54  93  68  54  95  68  54  99
58      55   55  55  55    82  23  99  77  23 100  82  23  99
69     120  120 120 117    53  65 100  65  65 100  56  65 100
68      89   89  89  89    55  59 100  46  59 100  49  59 100
77     170  166 166 167    60  55  99  51  55  99  51  55 100
87     149  130 131 133    44  32  86  39  32  88  47  32  84
97      88   86  86  82    61  21  91  57  21  92  45  21  89
"""
LOST = """
04
14     118  116 115 118    56  14  96  52  14  95  47  14  97
24     131  113 121 125    57  18  84  51  18  93  55  18  93
34     143   64  67  60    57  37  94  54  37  94  61  37  92
43     132   28  29  34    64  75 100  63  75 100  72  75 100
54     188   39  41  40    78  65 100  73  65 100  77  65 100
65     110   27  21  17    66  59 100  67  59 100  62  59 100
74     156   94 149 147    61  78 100  63  78 100  66  78 100
84      94   94  94  94    70  77 100  71  77 100  66  77 100
95     186  184 181 186    63  60  99  52  60  99  59  60  99
86     100   94  97 100    47  22  94  46  22  95  60  22  95
"""
"""Two missions of three robots over one terrain. Each row has the row and column of a cell, the
ticks of the bound into it, the ticks in contact of each robot, and three features of each robot in
percent."""


def read(text):
    """Mission of a table of bounds; the first row is the start."""
    start, *bounds = (line.split() for line in text.strip().splitlines())
    path = [(int(cell[0]), int(cell[1])) for cell in (start[0], *(row[0] for row in bounds))]
    rows = np.array([row[1:] for row in bounds], dtype=float)

    n_ticks = np.repeat(rows[:, :1], 3, axis=1)
    awareness = rows[:, 4:].reshape(len(rows), 3, 3) / 100.0
    rates = rows[:, 1:4] / n_ticks
    return tb.Mission.from_arrays(path, awareness, rates, n_ticks=n_ticks, features=FEATURES)


def mission(rates, *, seed=0, noise=0.02):
    """Mission of two robots with rates (bound,) near those given, in shares of 100 ticks."""
    rng = np.random.default_rng(seed)
    shape = len(rates), 2
    y = np.clip(np.array(rates)[:, None] + noise * rng.standard_normal(shape), 0.0, 1.0)
    path = [(0, k) for k in range(len(rates) + 1)]
    n_ticks = np.full(shape, 100.0)
    z = rng.uniform(size=(*shape, 2))
    return tb.Mission.from_arrays(path, z, np.round(y, 2), n_ticks=n_ticks)


@pytest.fixture(scope="module")
def contradicting():
    """A mission in whole contact, and one that loses it on the way and finds it again."""
    whole = mission([1.0] * 12, noise=0.05)
    lost = mission([0.98, 0.9, 0.45, 0.22, 0.2, 0.2, 0.8, 1.0, 0.98, 0.96], seed=1, noise=0.03)
    return whole, lost


def linear(awareness, contact_rate=None, n_ticks=None):
    """Drift that is linear in the features, as a NumPyro function."""
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    weight = numpyro.sample("weight", dist.Normal(0.0, 0.5).expand([2]).to_event(1))
    level = numpyro.sample("level", dist.Normal(0.0, 0.3))
    noise = numpyro.sample("noise", dist.HalfNormal(0.3))
    with numpyro.plate("mission", len(awareness)):
        rates = ContactRate(awareness @ weight + level, beta0, noise, 0.05, n_ticks=n_ticks)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def assert_same_means(found, other, limit=LIMIT):
    """The means of all parameters differ by little, in standard deviations."""
    over = ("chain", "draw")
    one, two = found["posterior"].to_dataset(), other["posterior"].to_dataset()
    gap = abs(one.mean(over) - two.mean(over)) / two.std(over)
    assert float(gap.to_dataarray().max()) < limit


def with_proposal(posterior, change):
    """The posterior with another stored proposal."""
    changed = posterior.copy(deep=True)
    proposal = Mixture.from_text(posterior["sample_stats"].attrs["proposal"])
    changed["sample_stats"].attrs["proposal"] = change(proposal).text
    return changed


def with_draws(posterior, change):
    """The posterior with other draws."""
    changed = posterior.copy(deep=True)
    changed["posterior"].dataset = change(posterior["posterior"].to_dataset())
    return changed


@pytest.mark.parametrize("family", FAMILIES)
def test_a_start_that_the_new_mission_contradicts_gives_the_same_posterior(contradicting, family):
    model = PooledTrust(family=family)
    plain = tb.fit(contradicting, model, **QUIET)

    first = tb.fit(contradicting[:1], model, seed=3, **QUIET)
    for seed in range(4):
        found = tb.fit(contradicting, model, seed=seed, start=first, **QUIET)
        assert_same_means(found, plain)


@pytest.mark.parametrize(("first_seed", "seed"), [(1, 2), (2, 0), (2, 3), (3, 2)])
def test_a_start_without_an_effective_point_gives_the_same_posterior(first_seed, seed):
    missions = [read(WHOLE), read(LOST)]
    plain = tb.fit(missions, **QUIET)

    first = tb.fit(missions[:1], seed=first_seed, **QUIET)

    assert_same_means(tb.fit(missions, seed=seed, start=first, **QUIET), plain)


def test_a_start_with_effects_of_places_gives_the_same_posterior(contradicting):
    model = PooledTrust(effects=(PlaceEffect(),))
    plain = tb.fit(contradicting, model, **QUIET)

    first = tb.fit(contradicting[:1], model, seed=1, **QUIET)
    for seed in range(4):
        assert_same_means(tb.fit(contradicting, model, seed=seed, start=first, **QUIET), plain)


def test_a_start_on_whose_way_too_few_points_are_effective_is_left():
    model = PooledTrust(shared_noise=True, effects=(PlaceEffect(),))
    whole = [mission([1.0] * 8, seed=k) for k in (30, 31)]
    other = mission(np.random.default_rng(3).uniform(size=9), seed=8, noise=0.3)
    plain = tb.fit([*whole, other], model, **QUIET)

    first = tb.fit(whole, model, **QUIET)
    for seed in range(4):
        found = tb.fit([*whole, other], model, seed=seed, start=first, **QUIET)
        assert found.attrs["kish"] >= importance.ENOUGH
        assert_same_means(found, plain)


def test_a_start_near_a_lower_mode_is_left():
    model = PooledTrust(shared_noise=True)
    whole = [mission([1.0] * 8, seed=k, noise=0.01) for k in range(2)]
    none = [mission([0.05 * (k % 2)] * 8, seed=k, noise=0.02) for k in range(2, 5)]
    plain = tb.fit(whole + none, model, **QUIET)

    found = tb.fit(whole + none, model, start=tb.fit(whole, model, **QUIET), **QUIET)

    assert found.attrs["log_evidence"] == pytest.approx(plain.attrs["log_evidence"], abs=0.3)
    assert_same_means(found, plain)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    "change",
    [
        lambda near: near._replace(center=near.center + 10.0),
        lambda near: near._replace(center=near.center - 1e3),
        lambda near: near._replace(center=near.center + 1e6),
        lambda near: near._replace(center=near.center + 5.0).scaled(1e-2),
        lambda near: near._replace(center=np.nan * near.center),
        lambda near: near.scaled(1e-6),
        lambda near: near.scaled(1e6),
        lambda near: near.scaled(1e200),
    ],
    ids=["10 sds", "-1000 sds", "1e6 sds", "single", "nan", "1e-6", "1e6", "1e200"],
)
def test_a_proposal_far_away_or_of_another_scale_gives_the_same_posterior(
    contradicting, family, change
):
    model = PooledTrust(family=family)
    plain = tb.fit(contradicting, model, **QUIET)

    found = tb.fit(contradicting, model, start=with_proposal(plain, change), **QUIET)

    assert_same_means(found, plain)


@pytest.fixture(scope="module")
def of_function(contradicting):
    """Posteriors of a function given both missions, and given the first one."""
    first = tb.fit(contradicting[:1], linear, seed=1, **QUIET)
    return tb.fit(contradicting, linear, **QUIET), first


@pytest.mark.parametrize(
    "change",
    [
        lambda draws: draws,
        lambda draws: draws.assign(weight=draws["weight"] + 1e3),
        lambda draws: draws.assign(level=draws["level"] + 1e200),
        lambda draws: np.nan * draws,
        lambda draws: xr.zeros_like(draws) + draws.isel(draw=0),
        lambda draws: draws.assign(weight=1e5 * draws["weight"]),
        lambda draws: draws.assign(noise=1e-12 * draws["noise"]),
    ],
    ids=["contradicting", "1000", "1e200", "nan", "single", "wide", "narrow"],
)
def test_a_function_has_the_same_posterior_from_any_start(contradicting, of_function, change):
    plain, first = of_function

    found = tb.fit(contradicting, linear, start=with_draws(first, change), **QUIET)

    assert_same_means(found, plain)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 1e3, 1e200])
def test_nuts_of_a_function_has_the_same_posterior_from_any_start(
    contradicting, of_function, shift
):
    plain, first = of_function
    start = with_draws(first, lambda draws: draws.assign(level=draws["level"] + shift))

    found = tb.fit(contradicting, linear, sampler="nuts", start=start, **QUIET)

    assert_same_means(found, plain)


@pytest.mark.parametrize(("scale", "seed"), [(400.0, 0), (600.0, 32)])
def test_ratios_whose_tail_has_no_pareto_fit_have_their_own_weights(scale, seed):
    log_ratio = -scale * np.random.default_rng(seed).chisquare(5, 288)

    weight, k_hat, _ = smoothed(log_ratio)

    np.testing.assert_allclose(weight, special.softmax(log_ratio))
    assert k_hat == np.inf


def test_points_of_a_far_first_proposal_are_marked():
    def log_density(z):
        return stats.norm(scale=0.02).logpdf(z).sum(1)

    near = Mixture.single(np.zeros(3), 0.03 * np.eye(3))
    far = Mixture.single(np.full(3, 2.0), 0.03 * np.eye(3))
    for first, is_far in ((near, False), (far, True)):
        found = importance.sample(
            log_density, first, np.random.default_rng(1), is_known=True, defensive=lambda own: own
        )
        assert found.is_far == is_far


def test_points_at_one_mode_miss_a_higher_one():
    def log_density(z):
        low = stats.multivariate_normal([-3.0, 0.0], 0.01).logpdf(z)
        high = stats.multivariate_normal([3.0, 0.0], 0.01).logpdf(z) + 20.0
        return np.atleast_1d(np.logaddexp(low, high))

    near_low = Mixture.single(np.array([-3.0, 0.0]), 0.1 * np.eye(2))
    found = importance.sample(
        log_density, near_low, np.random.default_rng(1), is_known=True, defensive=lambda own: own
    )

    assert misses(found, log_density, np.array([3.0, 0.0]))
    assert not misses(found, log_density, np.array([-3.0, 0.0]))


def test_a_mixture_without_a_point_of_positive_density_is_complained_of():
    def log_density(x):
        return np.where((np.abs(x - 60.0) < 0.1).all(1), 0.0, -np.inf)

    start = np.random.default_rng(0).standard_normal((500, 2))
    chart = Chart(log_density, [start], lambda x: x, lambda x: x)

    found = sample_charts([chart], seed=1)

    assert found.complaints
    assert np.isfinite(found.weight).all()
