"""Functions whose posterior would contain the padding, or whose rates are not the data."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray as xr
from jax import lax
from numpyro import handlers
from numpyro.contrib.control_flow import cond, scan

import trustbo as tb
from trustbo.files import is_storable
from trustbo.inference.functions.checks import require_fittable
from trustbo.inference.functions.data import data_of
from trustbo.inference.functions.known import as_model
from trustbo.logs.netcdf import read_tree, write_tree
from trustbo.models import ContactRate
from trustbo.models.observations import Observations


def missions_of(n_missions, n_bounds=4, n_robots=3):
    """Missions without tick counts, with bounds of 60 s."""
    rng = np.random.default_rng(0)
    made = []
    for j in range(n_missions):
        n = max(2, n_bounds - j)
        z = rng.uniform(size=(n, n_robots, 1))
        duration = np.full((n, n_robots), 60.0)
        path = [(0, k) for k in range(n + 1)]
        made.append(tb.Mission.from_arrays(path, z, 0.3 + 0.4 * z[..., 0], duration))
    return made


@pytest.fixture(scope="module")
def missions():
    return missions_of(3)


def rates(drift, contact_rate, delta_v=0.1, delta_w=0.05, **options):
    with numpyro.plate("mission", len(drift)):
        law = ContactRate(drift, 0.4, delta_w, delta_v, **options)
        numpyro.sample("contact_rate", law, obs=contact_rate)


def check(missions, model):
    """Check a function as `tb.fit` does, without sampling."""
    data = data_of(missions, Observations.from_missions(missions))
    made = as_model(model)
    n_bounds = [len(mission.bounds) for mission in missions]
    require_fittable(made, data, made.sites(data), n_bounds)


def with_times(awareness, contact_rate=None, duration=None):
    mean = numpyro.sample("mean", dist.Normal(50.0, 50.0))
    with numpyro.plate("mission", len(awareness)):
        numpyro.sample("time", dist.Normal(mean, 10.0), obs=duration[:, 0, 0])
    rates(0.3 * awareness[..., 0], contact_rate)


def with_factor(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    drift = b + 0.3 * awareness[..., 0]
    numpyro.factor("small", -(drift**2).sum())
    rates(drift, contact_rate)


def standardised(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    z = awareness[..., 0]
    rates(b * (z - z.mean()) / z.std(), contact_rate)


def above_the_least(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    z = awareness[..., 0]
    rates(b * (z - z.min()), contact_rate)  # any padding makes it 0


def by_progress(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    progress = jnp.linspace(0.0, 1.0, awareness.shape[1])[:, None]
    rates(b * progress + 0.0 * awareness[..., 0], contact_rate)


def with_mean_day(awareness, contact_rate=None):
    with numpyro.plate("mission", len(awareness)):
        z = numpyro.sample("z", dist.Normal())
    numpyro.deterministic("mean_day", z.mean())
    rates(0.1 * z[:, None, None] + 0.0 * awareness[..., 0], contact_rate)


def with_common_prior(awareness, contact_rate=None):
    with numpyro.plate("mission", len(awareness)):
        z = numpyro.sample("z", dist.Normal(awareness.mean(), 0.1))
    rates(z[:, None, None] + 0.0 * awareness[..., 0], contact_rate)


def without_plate(awareness, contact_rate=None):
    z = numpyro.sample("z", dist.Normal().expand([len(awareness)]).to_event(1))
    rates(z[:, None, None] + 0.0 * awareness[..., 0], contact_rate)


def with_rough_noise(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal())
    rates(b + awareness[..., 0], contact_rate, delta_v=0.1 + awareness.mean())


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (with_times, "density of the site 'time'"),
        (with_factor, "density of the site 'small'"),
        (standardised, "the drift"),
        (above_the_least, "the drift"),
        (by_progress, "the drift"),
        (with_mean_day, "the site 'mean_day'"),
        (with_common_prior, "density of the site 'z'"),
        (without_plate, "the variable 'z'"),
        (with_rough_noise, "a noise"),
    ],
)
@pytest.mark.parametrize("n", [1, 3])
def test_the_padding_must_not_enter_the_posterior(n, function, message):
    with pytest.raises(tb.TrustboError, match=message):
        tb.fit(missions_of(n), function, draws=20, warmup=20, check=False, progress=False)


def test_the_padding_must_not_enter_the_posterior_of_missions_that_need_none():
    """Four missions of eight bounds have the padded shape, so five would have another posterior."""
    with pytest.raises(tb.TrustboError, match="the drift"):
        check([missions_of(1, n_bounds=8)[0]] * 4, standardised)


def test_a_campaign_refuses_a_second_likelihood_of_the_padding_before_the_first_mission():
    awareness = np.random.default_rng(0).uniform(size=(3, 3, 3, 1))
    workspace = tb.Workspace.from_awareness(awareness)
    with pytest.raises(tb.TrustboError, match="density of the site 'time'"):
        tb.Campaign(workspace, (2, 0), (0, 2), model=with_times)
    tb.Campaign(workspace, (2, 0), (0, 2), model=with_masked_times)


def with_masked_times(awareness, contact_rate=None, duration=None):
    """The mean duration of the measured bounds, as a second likelihood."""
    is_measured = jnp.isfinite(contact_rate)
    total = jnp.where(is_measured, duration, 0.0).sum((1, 2))
    mean = numpyro.sample("mean", dist.Normal(50.0, 50.0))
    with (
        numpyro.plate("mission", len(awareness)),
        handlers.mask(mask=is_measured.any((1, 2))),
    ):
        found = total / jnp.maximum(is_measured.sum((1, 2)), 1)
        numpyro.sample("time", dist.Normal(mean, 10.0), obs=found)
    rates(0.3 * awareness[..., 0], contact_rate)


def with_masked_factor(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    drift = b + 0.3 * awareness[..., 0]
    numpyro.factor("small", -jnp.where(jnp.isfinite(contact_rate), drift**2, 0.0).sum())
    rates(drift, contact_rate)


def with_outliers(awareness, contact_rate=None):
    """A heavy-tailed variable of each bound."""
    scale = numpyro.sample("scale", dist.HalfNormal(0.1))
    with numpyro.plate("mission", len(awareness)):
        jumps = dist.StudentT(4.0, 0.0, scale).expand(awareness.shape[1:3]).to_event(2)
        jump = numpyro.sample("jump", jumps)
    rates(jump + 0.3 * awareness[..., 0], contact_rate)


def with_a_walk(awareness, contact_rate=None, duration=None):
    """A random walk over missions, and a drift of the bounds so far and their durations."""
    with numpyro.plate("mission", len(awareness)):
        step = numpyro.sample("step", dist.Normal(0.0, 0.1))
    level = numpyro.deterministic("level", jnp.cumsum(step))
    drift = level[:, None, None] + jnp.cumsum(awareness[..., 0], axis=1) * duration / 60.0
    numpyro.deterministic("drift", drift)
    rates(drift, contact_rate)


@pytest.mark.parametrize(
    "function", [with_masked_times, with_masked_factor, with_outliers, with_a_walk]
)
def test_a_function_that_leaves_out_the_padding_is_accepted(missions, function):
    check(missions, function)


def with_constant_ticks(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    rates(b + awareness[..., 0], contact_rate, n_ticks=200.0)


def with_halved_rates(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    rates(b + awareness[..., 0], None if contact_rate is None else 0.5 * contact_rate)


def with_filled_rates(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    rates(b + awareness[..., 0], jnp.nan_to_num(contact_rate, nan=0.5))


def with_noise_of_missions(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    with numpyro.plate("mission", len(awareness)):
        noise = numpyro.sample("noise", dist.HalfNormal(0.1))
    rates(b + awareness[..., 0], contact_rate, delta_v=noise)


def with_noise_of_bounds(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    rates(b + awareness[..., 0], contact_rate, delta_v=0.1 * b**2 * jnp.ones(awareness.shape[1]))


def with_skew_noise(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    skew = 0.01 * jnp.eye(3) + jnp.zeros((3, 3)).at[0, 1].set(0.005)
    rates(b + awareness[..., 0], contact_rate, delta_v=skew)


def with_factor_of_the_covariance(awareness, contact_rate=None):
    L = jnp.eye(3).at[1, 0].set(numpyro.sample("r", dist.Normal(0.5, 0.1)))
    rates(0.3 * awareness[..., 0], contact_rate, delta_w=0.1 * L)


@pytest.mark.parametrize(
    ("n_robots", "function", "message"),
    [
        (3, with_constant_ticks, "n_ticks"),
        (3, with_halved_rates, "obs=contact_rate"),
        (3, with_filled_rates, "obs=contact_rate"),
        (4, with_noise_of_missions, "a noise"),  # missions are padded to four
        (8, with_noise_of_bounds, "a noise"),  # bounds are padded to eight
        (3, with_skew_noise, "matrix delta_v"),
        (3, with_factor_of_the_covariance, "matrix delta_w"),
    ],
)
def test_rates_and_noises_must_be_those_of_the_data(n_robots, function, message):
    missions = missions_of(3, n_robots=n_robots)
    with pytest.raises(tb.TrustboError, match=message):
        tb.fit(missions, function, draws=20, warmup=20, check=False, progress=False)


def test_noises_must_be_those_of_robots_if_data_are_not_padded():
    """Three missions, given as one object, and three robots."""

    def model(observations):
        with_noise_of_missions(observations.awareness, observations.contact_rate)

    with pytest.raises(tb.TrustboError, match="a noise"):
        tb.fit(missions_of(3), model, draws=20, warmup=20, check=False, progress=False)


@pytest.mark.parametrize("n_ticks", [100.0, 200.0])
def test_a_constant_number_of_ticks_must_be_that_of_the_missions(n_ticks):
    counted = []
    for one in missions_of(3):
        shares = np.round(200.0 * one.contact_rate) / 200.0
        ticks = np.full(shares.shape, 200.0)
        counted.append(tb.Mission.from_arrays(one.path, one.awareness, shares, n_ticks=ticks))

    def model(awareness, contact_rate=None):
        b = numpyro.sample("b", dist.Normal(0.5, 0.3))
        rates(b + awareness[..., 0], contact_rate, n_ticks=n_ticks)

    if n_ticks == 200.0:
        check(counted, model)
        return
    with pytest.raises(tb.TrustboError, match="n_ticks"):
        check(counted, model)


def with_correlated_noise(awareness, contact_rate=None, n_ticks=None):
    L = numpyro.sample("L", dist.LKJCholesky(3, 1.0))
    rates(0.3 * awareness[..., 0], contact_rate, delta_v=0.01 * L @ L.T, n_ticks=n_ticks)


def test_a_covariance_and_unknown_tick_counts_are_accepted(missions):
    check(missions, with_correlated_noise)


SCANS = jnp.linspace(0.5, 1.5, 20)


def some_scans(index):
    """Observe the scans with these indices, whose mean is a variable."""
    level = numpyro.sample("level", dist.Normal(0.0, 10.0))
    return lambda: numpyro.sample("range", dist.Normal(level, 1.0), obs=SCANS[index])


def in_a_plate():
    with numpyro.plate("scan", 20, subsample_size=5) as index:
        some_scans(index)()


def in_a_scope():
    with handlers.scope(prefix="lidar"):
        in_a_plate()


def in_nested_plates():
    level = numpyro.sample("level", dist.Normal(0.0, 10.0))
    with numpyro.plate("scan", 4, subsample_size=2, dim=-2) as index, numpyro.plate("beam", 5):
        numpyro.sample("range", dist.Normal(level, 1.0), obs=SCANS.reshape(4, 5)[index])


def with_chosen_indices():
    with handlers.substitute(data={"scan": jnp.arange(5)}):
        in_a_plate()


def in_a_loop():
    scan(lambda carry, _: (carry, in_a_plate()), 0.0, None, length=2)


def in_a_branch():
    def branch(_):
        with numpyro.plate("scan", 20, subsample_size=5):
            numpyro.sample("range", dist.Normal())
        return 0.0

    cond(True, branch, branch, None)


def with_own_key():
    index = jax.random.choice(numpyro.prng_key(), 20, (5,))
    some_scans(index)()


def beside(part):
    """A function with a linear drift that also runs `part`."""

    def model(awareness, contact_rate=None):
        b = numpyro.sample("b", dist.Normal(0.5, 0.3))
        part()
        rates(b * awareness[..., 0], contact_rate)

    return model


@pytest.fixture(scope="module")
def workspace():
    awareness = np.random.default_rng(0).uniform(size=(3, 3, 3, 1))
    return tb.Workspace.from_awareness(awareness)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (in_a_plate, "the plate 'scan' .*subsample_size"),
        (in_a_scope, "the plate 'lidar/scan'"),
        (in_nested_plates, "the plate 'scan'"),
        (with_chosen_indices, "the plate 'scan'"),
        (in_a_loop, "the plate 'scan'"),
        (in_a_branch, "the plate 'scan'"),
        (with_own_key, "numpyro.prng_key"),
    ],
)
def test_a_random_subset_of_data_is_refused_before_the_first_mission(workspace, part, message):
    with pytest.raises(tb.TrustboError, match=message):
        tb.Campaign(workspace, (2, 0), (0, 2), model=beside(part))


def with_whole_plate():
    with numpyro.plate("scan", 20, subsample_size=20) as index:
        some_scans(index)()


def test_a_plate_that_takes_all_of_its_data_is_accepted(missions):
    check(missions, beside(with_whole_plate))


def of_drift(change):
    """A function whose drift is b, changed."""

    def model(awareness, contact_rate=None):
        b = numpyro.sample("b", dist.Normal(0.5, 0.3))
        rates(change(b) + 0.3 * awareness[..., 0], contact_rate)

    return model


def by_while_loop(b):
    return lax.while_loop(lambda s: s[1] < 3, lambda s: (0.5 * s[0], s[1] + 1), (b, 0))[0]


def by_dynamic_loop(b):
    return lax.fori_loop(0, 2 + (b > 0.0), lambda _, x: 0.5 * x, b)


def by_callback(b):
    return jax.pure_callback(np.tanh, b, b, vmap_method="expand_dims")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (by_while_loop, "Reverse-mode differentiation does not work"),
        (by_dynamic_loop, "Reverse-mode differentiation does not work"),
        (by_callback, "callbacks do not support JVP"),
    ],
)
def test_a_function_without_gradient_is_refused_before_the_first_mission(workspace, change, reason):
    with pytest.raises(tb.TrustboError, match=f"has no gradient.*{reason}"):
        tb.Campaign(workspace, (2, 0), (0, 2), model=of_drift(change), sampler="nuts")


@pytest.mark.parametrize("change", [by_while_loop, by_callback])
def test_importance_sampling_needs_no_gradient(missions, change):
    """The drift is b / 8, or tanh(b)."""

    def exact(b):
        return b / 8.0 if change is by_while_loop else jnp.tanh(b)

    fits = [
        tb.fit(missions, of_drift(one), latent=False, progress=False) for one in (change, exact)
    ]
    assert [one.attrs["sampler"] for one in fits] == ["importance", "importance"]
    found, expected = (one["posterior"]["b"] for one in fits)
    assert abs(float(found.mean() - expected.mean())) < 0.1 * float(expected.std())


def with_gradient(change):
    """The change, with the gradient of half of its argument."""
    changed = jax.custom_jvp(change)
    changed.defjvp(lambda b, slope: (changed(*b), 0.5 * slope[0]))
    return changed


@pytest.mark.parametrize("change", [by_while_loop, by_callback])
def test_a_function_that_defines_its_gradient_is_accepted(workspace, change):
    model = of_drift(with_gradient(change))
    tb.Campaign(workspace, (2, 0), (0, 2), model=model, sampler="nuts")


def test_a_gradient_that_is_not_finite_is_refused(missions):
    """The square root of 0 has an infinite slope, which is multiplied by 0."""
    model = of_drift(lambda b: jnp.sqrt(0.0 * b**2))
    short = {"draws": 5, "warmup": 5, "chains": 1, "check": False, "progress": False}
    with pytest.raises(tb.TrustboError, match="gradient that is not finite"):
        tb.fit(missions, model, sampler="nuts", **short)


def failing(_):
    raise ValueError("no such survey")


def by_failing_callback(b):
    return with_gradient(lambda b: jax.pure_callback(failing, b, b, vmap_method="expand_dims"))(b)


def test_the_reason_of_an_error_in_a_callback_is_quoted(missions):
    with pytest.raises(tb.TrustboError, match=r"no such survey$"):
        check(missions, of_drift(by_failing_callback))


def with_other_shape_in_a_loop(b):
    return lax.scan(lambda x, _: (jnp.stack([x, x]), None), b, None, length=2)[0]


def test_the_reason_of_an_error_is_quoted_if_its_first_line_announces_it(missions):
    with pytest.raises(tb.TrustboError, match=r"they differ: .*float64\[2\]"):
        check(missions, of_drift(with_other_shape_in_a_loop))


@pytest.mark.parametrize(
    "distribution",
    [dist.Delta(0.1), dist.Delta(0.1).expand([2]).to_event(1), dist.Delta(0.1).mask(True)],
)
def test_a_variable_with_a_single_value_is_refused(missions, distribution):
    with pytest.raises(tb.TrustboError, match=r"the site 'c' .* Delta"):
        check(missions, beside(lambda: numpyro.sample("c", distribution)))


def test_a_misspelt_input_with_a_default_is_warned_of():
    def model(awareness, contact_rate=None, nticks=None, size=3):
        pass

    with pytest.warns(UserWarning, match="'nticks' .* if the input 'n_ticks'") as caught:
        as_model(model)
    assert len(caught) == 1


@pytest.mark.parametrize("noise", ["delta_w", "delta_v"])
def test_a_noise_that_may_be_negative_is_refused(missions, noise):
    def model_with(prior):
        def model(awareness, contact_rate=None):
            b = numpyro.sample("b", dist.Normal(0.5, 0.3))
            noises = {"delta_w": 0.05, "delta_v": 0.1, noise: numpyro.sample("noise", prior)}
            law = ContactRate(b * awareness[..., 0], 0.4, **noises)
            numpyro.sample("contact_rate", law, obs=contact_rate)

        return model

    for prior in (dist.Normal(0.0, 0.1), dist.Normal(0.0, 0.1).expand([3]).to_event(1)):
        with pytest.raises(tb.TrustboError, match=f"{noise} of .* 'noise', .* HalfNormal"):
            check(missions, model_with(prior))
    check(missions, model_with(dist.HalfNormal(0.1)))


def test_a_site_with_obs_mask_is_refused(missions):
    known = jnp.arange(20) < 15

    def part():
        with numpyro.plate("scan", 20):
            numpyro.sample("range", dist.Normal(1.0, 1.0), obs=SCANS, obs_mask=known)

    with pytest.raises(tb.TrustboError, match=r"the site 'range' .* obs_mask"):
        check(missions, beside(part))


def test_contact_rates_with_obs_mask_are_refused(missions):
    def model(awareness, contact_rate=None):
        b = numpyro.sample("b", dist.Normal(0.5, 0.3))
        law = ContactRate(b * awareness[..., 0], 0.4, 0.05, 0.1)
        known = jnp.isfinite(contact_rate).all((1, 2))
        numpyro.sample("contact_rate", law, obs=contact_rate, obs_mask=known)

    with pytest.raises(tb.TrustboError, match=r"the site 'contact_rate' .* obs_mask"):
        check(missions, model)


@pytest.mark.parametrize(
    "name",
    ["%w", ".w", "w ", " w", "/w", "w\n", "w\tx", "(w)", "", "w\0", "w\x7f", "\u212b", "w" * 121],
)
@pytest.mark.parametrize("role", ["site", "deterministic", "plate", "dim"])
def test_names_that_files_cannot_store_are_refused(name, role, missions, tmp_path):
    def own(awareness, contact_rate=None):
        site = name if role == "site" else "weight"
        event_dims = [name] if role == "dim" else ["level"]
        weight = numpyro.sample(
            site, dist.Normal(0.3, 0.3).expand([2]).to_event(1), infer={"event_dims": event_dims}
        )
        if role == "deterministic":
            numpyro.deterministic(name, weight[0])
        if role == "plate":
            with numpyro.plate(name, 2):
                numpyro.sample("other", dist.Normal())
        rates(weight[0] * awareness[..., 0], contact_rate)

    workspace = tb.Workspace.from_awareness(np.full((3, 3, 3, 1), 0.5))
    with pytest.raises(tb.TrustboError, match="store"):
        check(missions, own)
    with pytest.raises(tb.TrustboError, match="store"):
        tb.Campaign(workspace, (2, 0), (0, 2), model=own, directory=tmp_path / "campaign")
    assert not (tmp_path / "campaign").exists()


@pytest.mark.parametrize(
    "name", ["w", "_w", "1 w", "größe", "weight of sight", "w.x", "w%", "net/w", "a/b/c", "w" * 120]
)
def test_names_that_files_can_store_are_accepted_and_stored(name, missions, tmp_path):
    def own(awareness, contact_rate=None):
        weight = numpyro.sample(name, dist.Normal(0.3, 0.3))
        rates(weight * awareness[..., 0], contact_rate)

    check(missions, own)
    stored = name.replace("/", ".")
    assert is_storable(stored)
    tree = xr.DataTree(xr.Dataset({stored: ("x", [1.0, 2.0]), "y": (stored, [1.0])}))
    write_tree(tmp_path / "a.nc", tree)
    assert read_tree(tmp_path / "a.nc").identical(tree)
