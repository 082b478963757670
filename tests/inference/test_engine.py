"""The engine against the joint normal of all rates, and a plain NumPyro program."""

import jax
import numpy as np
import pytest
from dense_coefficients import DenseRates
from dense_families import with_one_limit
from every_model import FEATURES, GRID, models_of, observed
from numpyro import handlers

from trustbo.inference import engine
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.density import at
from trustbo.inference.nuts import in_jax
from trustbo.models.backend import own_settings
from trustbo.models.visited import visited

GAUSSIAN = models_of("gaussian")
CENSORED = models_of("censored")
EVERYTHING = "places and robots"
LEAST = 1e-4  # the least sd of an effect that the models take


def posterior_of(model, *, change=None, **options):
    """Density of a model, three thetas, and the dense reference of a given theta."""
    model = model.for_features(FEATURES)
    with_places = any(effect.group == "places" for effect in model.effects)
    observations, bounds = observed(with_places=with_places, **options)
    if change is not None:
        observations = change(observations)

    posterior = ClassTarget(model, observations)
    z = 0.5 * np.random.default_rng(1).standard_normal((3, posterior.n_scores))
    return posterior, posterior.theta(z), lambda at: DenseRates(model, observations, at, bounds)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("name", GAUSSIAN)
def test_the_evidence_is_the_density_of_the_dense_joint_normal(name, gaps):
    posterior, theta, dense = posterior_of(GAUSSIAN[name], gaps=gaps)
    expected = dense(theta).log_density()
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)


@pytest.mark.parametrize("name", CENSORED)
def test_the_evidence_of_censored_rates_inside_the_limits_is_that_of_gaussian_ones(name):
    posterior, theta, dense = posterior_of(CENSORED[name], gaps=True)
    expected = dense(theta).log_density()
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)


@pytest.mark.parametrize("limit", [0.0, 1.0])
@pytest.mark.parametrize("name", CENSORED)
def test_the_evidence_with_one_rate_at_a_limit_has_the_normal_tail_beyond_it(name, limit):
    """Expectation propagation is exact if it has one term to approximate."""

    def change(observations):
        observations.contact_rate[2, 1, 1] = limit
        return observations

    posterior, theta, dense = posterior_of(CENSORED[name], gaps=True, change=change)
    joint = dense(theta)
    cov = joint.cov + joint.noise
    expected = [with_one_limit(*moments, joint.y) for moments in zip(joint.mean, cov, strict=True)]
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)


MAPS = np.array([1, 0, 2, 0])
"""Maps of four missions; 0 is that of the workspace."""


def posterior_on_maps(name):
    """As `posterior_of`, with missions on three maps; in the reference, these are far apart."""
    model = GAUSSIAN[name].for_features(FEATURES)
    observations, bounds = observed(gaps=True)
    posterior = ClassTarget(model, observations._replace(visited=visited(bounds, GRID, MAPS)))
    z = 0.5 * np.random.default_rng(1).standard_normal((3, posterior.n_scores))

    apart = bounds.copy()
    apart[..., 1] += 10_000 * MAPS[:, None]
    return posterior, posterior.theta(z), lambda at: DenseRates(model, observations, at, apart)


@pytest.mark.parametrize("name", [name for name in GAUSSIAN if "places" in name])
def test_places_on_other_maps_have_independent_effects(name):
    posterior, theta, dense = posterior_on_maps(name)
    expected = dense(theta).log_density()
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)


def test_effects_of_cells_given_missions_on_other_maps_are_those_of_the_joint_normal():
    posterior, theta, dense = posterior_on_maps("pooled, places")
    places = posterior.observations.visited
    assert places.cell_map.tolist() == sorted(places.cell_map)
    drawn = posterior.draw_coefficients(at(theta, np.zeros(4000, int)), np.random.default_rng(0))
    mean, cov = (moment[0] for moment in dense(theta).coefficients())
    sd = np.sqrt(np.diag(cov))
    some = slice(len(FEATURES) + 1 + len(places.cells))  # bounds are in another order
    off = np.abs(drawn.mean(0)[some] - mean[some])
    assert (off < 5.0 * sd[some] / np.sqrt(4000)).all()
    np.testing.assert_allclose(drawn.std(0)[some], sd[some], rtol=5.0 / np.sqrt(8000))


def posterior_with_posts(name):
    """As `posterior_of`, where some bounds are watched from the second or third set of posts."""
    model = GAUSSIAN[name].for_features(FEATURES)
    observations, bounds = observed(gaps=True)
    posts = np.random.default_rng(2).integers(0, 3, bounds.shape[:2])
    bounds = bounds + 8 * np.where(bounds[..., :1] >= 0, posts[..., None], 0) * (1, 0, 0)

    posterior = ClassTarget(model, observations._replace(visited=visited(bounds, GRID)))
    z = 0.5 * np.random.default_rng(1).standard_normal((3, posterior.n_scores))
    return posterior, posterior.theta(z), lambda at: DenseRates(model, observations, at, bounds)


@pytest.mark.parametrize("name", [name for name in GAUSSIAN if "places" in name])
def test_effects_of_a_bound_are_correlated_between_sets_of_posts(name):
    posterior, theta, dense = posterior_with_posts(name)
    ways = posterior.observations.visited.bounds
    assert len(np.unique(ways % (8, 100, 100), axis=0)) < len(ways)
    np.testing.assert_allclose(posterior.log_evidence(theta), dense(theta).log_density(), rtol=1e-9)


def require_equal_slopes(posterior):
    """Compare slopes at random scores with differences of the density."""
    z = 0.5 * np.random.default_rng(3).standard_normal((2, posterior.n_scores))
    steps = 1e-4 * np.eye(posterior.n_scores)
    differences = [
        posterior.log_density(one + steps) - posterior.log_density(one - steps) for one in z
    ]
    in_nuts = in_jax(lambda z, _: z, posterior.log_density)
    with own_settings():
        log_p, slopes = jax.vmap(jax.value_and_grad(lambda z: in_nuts(z, None)))(z)
    np.testing.assert_allclose(log_p, posterior.log_density(z), rtol=1e-12)
    np.testing.assert_allclose(slopes, np.array(differences) / 2e-4, rtol=1e-3, atol=1e-3)


def test_first_missions_keep_their_maps():
    posterior, *_ = posterior_on_maps("pooled, places")
    few = posterior.observations.visited.first(2)
    assert sorted(set(few.bound_map.tolist())) == [0, 1]
    assert few.at.shape[0] == 2


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 3), (3, 4, 1)])
def test_one_bound_and_one_robot_are_cases_like_others(shape):
    name = f"pooled, shared noise, {EVERYTHING}"
    posterior, theta, dense = posterior_of(GAUSSIAN[name], shape=shape)
    expected = dense(theta).log_density()
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "value"),
    [("beta0", 0.0), ("beta0", 1 - 1e-6), ("delta_w", 1e-3), ("delta_v", 3.0), ("tau_e", 0.0)],
)
def test_the_evidence_holds_at_extreme_hyperparameters(name, value):
    posterior, theta, dense = posterior_of(GAUSSIAN[f"pooled, {EVERYTHING}"], gaps=True)
    theta = {**theta, name: np.full(3, value)}
    theta["inverse_gain"] = 1.0 - theta["beta0"]
    floor = {"tau_e": np.maximum(theta["tau_e"], LEAST)}
    expected = dense(theta | floor).log_density()
    np.testing.assert_allclose(posterior.log_evidence(theta), expected, rtol=1e-7)


def test_a_matrix_that_is_not_positive_definite_costs_its_point_alone():
    A = np.stack([np.eye(2), -np.eye(2), 4.0 * np.eye(2)])
    factors = engine.cholesky(A)
    assert np.isnan(factors[1]).any()
    np.testing.assert_allclose(factors[[0, 2]], np.stack([np.eye(2), 2.0 * np.eye(2)]))


OF_DRAWS = f"pooled, shared noise, {EVERYTHING}", f"coupled, {EVERYTHING}"


@pytest.mark.parametrize("name", OF_DRAWS)
def test_coefficients_drawn_often_at_visited_points_have_the_moments_of_the_joint_normal(name):
    posterior, theta, dense = posterior_of(GAUSSIAN[name])
    means, covs = dense(theta).coefficients()
    z = np.repeat(0.5 * np.random.default_rng(1).standard_normal((3, posterior.n_scores)), 500, 0)
    rng = np.random.default_rng(0)
    log_p, coefficients = posterior.visit(z, rng)
    np.testing.assert_allclose(log_p[::500], posterior.log_density(z[::500]), rtol=1e-12)
    for k in range(3):
        first = np.arange(500 * k, 500 * (k + 1))
        drawn = coefficients.draw(np.repeat(first, 20), rng)
        sd = np.sqrt(np.diag(covs[k]))
        n_independent = 4 * 500
        assert (np.abs(drawn.mean(0) - means[k]) < 5.0 * sd / np.sqrt(n_independent)).all()
        np.testing.assert_allclose(drawn.std(0), sd, rtol=5.0 / np.sqrt(2 * n_independent))


@pytest.mark.parametrize("name", OF_DRAWS)
def test_drawn_coefficients_have_the_moments_of_the_joint_normal(name):
    posterior, theta, dense = posterior_of(GAUSSIAN[name])
    drawn = posterior.draw_coefficients(at(theta, np.zeros(4000, int)), np.random.default_rng(0))
    mean, cov = (moment[0] for moment in dense(theta).coefficients())
    sd = np.sqrt(np.diag(cov))
    assert (np.abs(drawn.mean(0) - mean) < 5.0 * sd / np.sqrt(4000)).all()
    np.testing.assert_allclose(drawn.std(0), sd, rtol=5.0 / np.sqrt(8000))


PROGRAMS = {
    f"pooled, {EVERYTHING}": GAUSSIAN,
    f"pooled, deviation, shared noise, {EVERYTHING}": GAUSSIAN,
    "hierarchical, robots": GAUSSIAN,
    f"coupled, {EVERYTHING}": GAUSSIAN,
    f"pooled, deviation, {EVERYTHING}": CENSORED,
    "hierarchical, shared noise, robots": CENSORED,
}
"""Models whose programs have every option of every model between them, by their families."""


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_plain_program_has_the_density_of_the_dense_joint_normal(name):
    """Given coefficients, which the program samples without their prior mean."""
    posterior, _, dense = posterior_of(PROGRAMS[name][name], gaps=True, shape=(3, 4, 2))
    model, observations, rng = posterior.model, posterior.observations, np.random.default_rng(2)
    values = posterior.scores.draw(20, rng)
    joint = dense(model.theta(values, observations.resolution))
    root = np.linalg.cholesky(joint.prior_cov)
    deviation = (root @ rng.standard_normal((*root.shape[:2], 1)))[..., 0]

    with own_settings():
        density, sizes = log_density_of_rates(model, observations)
        first = 0
        for site, size in sizes.items():
            values[site] = deviation[:, first : first + size]
            first += size
        assert first == deviation.shape[1]
        given = [{site: jax.numpy.asarray(v[i]) for site, v in values.items()} for i in range(20)]
        found = [float(density(one)) for one in given]

    expected = joint.log_density_given(joint.prior_mean + deviation)
    if model.likelihood.gaussian:  # the program has the probability of tick counts
        expected -= np.log(observations.n_ticks[~np.isnan(observations.contact_rate)]).sum()
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def log_density_of_rates(model, observations):
    """By the program; also the sizes of the sites of its coefficients by name.

    Noise that it samples is integrated out, as its log-density is quadratic.
    """

    def sites(given):
        program = handlers.substitute(handlers.seed(model.program, 0), given)
        return handlers.trace(program).get_trace(observations)

    def density(given):
        found = sites(given)
        if "trust_noise" not in found:
            rates = found["contact_rate"]
            return rates["fn"].log_prob(rates["value"]).sum()
        prior = found["trust_noise"]["fn"]

        def log_joint(e):
            noise = e.reshape(prior.event_shape)
            rates = sites({**given, "trust_noise": noise})["contact_rate"]
            return prior.log_prob(noise) + rates["fn"].log_factor

        zero = jax.numpy.zeros(prior.event_shape).ravel()
        slope, precision = jax.grad(log_joint)(zero), -jax.hessian(log_joint)(zero)
        gain = slope @ jax.numpy.linalg.solve(precision, slope)
        size = zero.size * np.log(2 * np.pi) - jax.numpy.linalg.slogdet(precision)[1]
        return log_joint(zero) + 0.5 * (gain + size)

    groups = "weights", "places", "robots"
    of_coefficients = {
        site: values["value"].size
        for site, values in sites({}).items()
        if site.rpartition("_")[0] in groups
    }
    return jax.jit(density), of_coefficients


@pytest.mark.parametrize(
    "name", [f"pooled, {EVERYTHING}", f"pooled, shared noise, {EVERYTHING}", "coupled"]
)
def test_slopes_are_those_of_the_density(name):
    posterior, *_ = posterior_of(GAUSSIAN[name], gaps=True)
    require_equal_slopes(posterior)
