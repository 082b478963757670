"""The importance sampler against closed forms."""

import numpy as np
import pytest
from scipy import special, stats

from trustbo.inference import importance
from trustbo.inference.mixture import DEGREES, Mixture, two_piece
from trustbo.inference.modes import at_modes, climb, climb_on
from trustbo.inference.weights import MAX_KHAT, smoothed, systematic


def prior(current):
    """Defensive proposal that is slightly wider than standard normal scores."""
    d = current.center.shape[1]
    return Mixture.single(np.zeros(d), 1.2 * np.eye(d))


def sampled(log_density, starts, rng, **options):
    """Points that begin at the modes reached from starts."""
    origin = at_modes(log_density, np.asarray(starts))
    return importance.sample(log_density, origin, rng, defensive=prior, **options).points


def gaussian_posterior(d, rng):
    """Log density of N(0, 1) scores seen as A z + noise, its mean, covariance and evidence."""
    A, y = rng.normal(size=(d + 2, d)), rng.normal(size=d + 2)
    covariance = np.linalg.inv(np.eye(d) + A.T @ A)
    evidence = stats.multivariate_normal(cov=A @ A.T + np.eye(d + 2)).logpdf(y)

    def log_density(z):
        return stats.norm.logpdf(z).sum(1) + stats.norm.logpdf(y - z @ A.T).sum(1)

    return log_density, covariance @ A.T @ y, covariance, evidence


@pytest.mark.parametrize("d", [1, 4, 8])
def test_a_gaussian_posterior_has_its_closed_form(d):
    log_density, mean, covariance, evidence = gaussian_posterior(d, np.random.default_rng(d))

    points = sampled(log_density, np.zeros((1, d)), np.random.default_rng(0))

    assert points.k_hat < MAX_KHAT
    assert points.kish > 200.0
    sd = np.sqrt(np.diag(covariance))
    of_points = points.weight @ points.x
    np.testing.assert_allclose(of_points / sd, mean / sd, atol=5.0 / np.sqrt(points.kish))
    off = points.x - of_points
    correlation = off.T * points.weight @ off / np.outer(sd, sd)
    np.testing.assert_allclose(
        correlation, covariance / np.outer(sd, sd), atol=8.0 / np.sqrt(points.kish)
    )
    assert points.log_evidence == pytest.approx(evidence, abs=0.1)


@pytest.mark.parametrize("starts", [[[0.0, 0.0]], [[0.0, 0.0], [-2.0, 0.0], [2.0, 0.0]]])
def test_two_modes_share_their_mass_or_the_weights_are_refused(starts):
    narrow = stats.multivariate_normal([2.0, 0.0], 0.02 * np.eye(2))
    wide = stats.multivariate_normal([-2.0, 1.0], 0.1 * np.eye(2))

    def log_density(z):
        terms = [np.log(0.7) + narrow.logpdf(z), np.log(0.3) + wide.logpdf(z)]
        return np.atleast_1d(special.logsumexp(terms, axis=0))

    n_accepted = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points = sampled(log_density, np.array(starts), rng, size=1024, enough=500.0)
        if points.k_hat < MAX_KHAT:
            n_accepted += 1
            assert points.log_evidence == pytest.approx(0.0, abs=0.1)
            assert points.weight[points.x[:, 0] > 0.0].sum() == pytest.approx(0.7, abs=0.05)
    assert n_accepted >= 5


def test_a_search_that_ends_on_a_ridge_goes_on():
    def log_density(z):
        return -5000.0 * (z[:, 1] - z[:, 0] ** 2) ** 2 - 2.0 * (z[:, 0] - 2.0) ** 2

    start = np.array([-3.0, 5.0])

    ends = np.array([climb(log_density, start), climb_on(log_density, start)])

    once, again = log_density(ends)
    assert once < -10.0  # otherwise, this ridge does not test `climb_on`
    assert again > -4.0


def test_a_density_may_vanish_in_places():
    def log_density(z):
        return np.where(z[:, 0] > 0.0, stats.norm.logpdf(z).sum(1), -np.inf)

    points = sampled(log_density, np.ones((1, 3)), np.random.default_rng(2))

    assert points.log_evidence == pytest.approx(np.log(0.5), abs=0.1)
    assert points.weight @ points.x[:, 0] == pytest.approx(np.sqrt(2.0 / np.pi), abs=0.1)


def test_the_same_generator_gives_the_same_points_and_draws():
    log_density, *_ = gaussian_posterior(3, np.random.default_rng(3))
    rngs = [np.random.default_rng(4) for _ in range(2)]

    points = [sampled(log_density, np.zeros((1, 3)), rng) for rng in rngs]
    draws = [one.x[one.resample(50, rng)] for one, rng in zip(points, rngs, strict=True)]

    np.testing.assert_array_equal(points[0].weight, points[1].weight)
    np.testing.assert_array_equal(draws[0], draws[1])


def test_a_student_integrates_to_its_density():
    rng = np.random.default_rng(5)
    student = Mixture.single(np.array([1.0, -1.0]), np.array([[2.0, 0.0], [0.5, 1.0]]))

    z, covariance = rng.normal(size=(6, 2)), student.total
    expected = stats.multivariate_t(student.mean, covariance, df=DEGREES)

    np.testing.assert_allclose(student.log_density(z), expected.logpdf(z), rtol=1e-12)
    within = (student.draw(4096, rng) @ [1.0, 0.0] < 1.0).mean()
    assert within == pytest.approx(0.5, abs=0.02)


def test_a_skewed_student_integrates_to_its_density():
    sides = np.array([[0.8, 1.5], [1.6, 1.0]])
    student = Mixture.single(np.array([1.0, -1.0]), np.array([[2.0, 0.0], [0.5, 1.0]]), sides)

    rng = np.random.default_rng(7)
    z = student.draw(16384, rng)
    other = stats.multivariate_t([1.0, 0.0], 2.0 * np.eye(2), df=30.0)
    ratio = np.exp(other.logpdf(z) - student.log_density(z))

    assert ratio.mean() == pytest.approx(1.0, abs=0.02)
    assert (ratio * z[:, 0]).mean() == pytest.approx(1.0, abs=0.1)


def test_a_skewed_student_has_no_jump_at_its_center():
    sides = np.array([[0.5], [2.0]])
    student = Mixture.single(np.zeros(1), np.eye(1), sides)

    below, above = student.log_density(np.array([[-1e-9], [1e-9]]))

    assert below == pytest.approx(above)
    assert (student.draw(4096, np.random.default_rng(8)) < 0.0).mean() == pytest.approx(
        0.2, abs=0.01
    )


def test_a_two_piece_normal_is_found_from_its_points():
    rng = np.random.default_rng(9)
    width = np.where(rng.random(40_000) < 0.25, -0.5, 1.5)
    x = 0.4 + width * np.abs(rng.standard_normal(40_000))

    center, sides = two_piece(x[:, None], np.full(len(x), 1.0 / len(x)), 0.0)

    assert center[0] == pytest.approx(0.4, abs=0.11)  # centers are tried in steps of 0.1
    np.testing.assert_allclose(sides[:, 0], [0.5, 1.5], atol=0.1)


def test_few_points_give_a_proposal_near_the_one_before():
    near = Mixture.single(np.zeros(2), np.array([[2.0, 0.0], [1.0, 1.0]]))
    z = 1e-3 * np.random.default_rng(10).standard_normal((3, 2))

    fitted = Mixture.of_points(z, np.full(3, 1.0 / 3.0), near)

    (scale,) = fitted.scale
    assert (np.diag(scale @ scale.T) > 0.5 * np.diag(near.total)).all()


def test_a_mixture_draws_its_components_by_their_shares():
    parts = [Mixture.single(np.full(2, at), 0.5 * np.eye(2)) for at in (-6.0, 0.0, 6.0)]
    mixture = Mixture.joined(parts, [0.5, 0.2, 0.3])

    x = mixture.draw(1024, np.random.default_rng(11))

    np.testing.assert_allclose(
        np.histogram(x[:, 0], 3, (-9.0, 9.0))[0] / 1024, [0.5, 0.2, 0.3], atol=0.01
    )
    other = stats.multivariate_t([0.0, 0.0], 16.0 * np.eye(2), df=8.0)
    z = other.rvs(60_000, random_state=1)
    ratio = np.exp(mixture.log_density(z) - other.logpdf(z))
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert Mixture.from_text(mixture.text).log_density(x) == pytest.approx(
        mixture.log_density(x), rel=1e-12
    )


def test_resampling_is_proportional_to_the_weights():
    weight = np.array([0.1, 0.0, 0.4, 0.5])

    count = np.bincount(systematic(weight, 1000, np.random.default_rng(6)), minlength=4)

    np.testing.assert_allclose(count, 1000 * weight, atol=1)


def test_equal_weights_have_no_tail():
    weight, k_hat, log_mean = smoothed(np.full(8, -3.0))

    np.testing.assert_array_equal(weight, 0.125)
    assert k_hat == -np.inf
    assert log_mean == pytest.approx(-3.0)
