"""Missions drawn in NumPy: their moments, and numpyro's draws of the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from missions import random_covariance
from references import dense_joint

from trustbo.models import CoupledParams, RobotParams, TrustParams
from trustbo.models.backend import own_settings
from trustbo.models.families import FAMILIES
from trustbo.models.state_space.contact_rate import ModelRates
from trustbo.models.state_space.generate import draw_missions

GAUSSIAN, N = FAMILIES["gaussian"], 40


def coupled_draws(rng, n=2, m=2):
    """Two draws of the parameters of n coupled robots."""
    return CoupledParams(
        0.5 * np.eye(n) + rng.normal(0.0, 0.2, (2, n, n)),
        rng.normal(0.0, 0.3, (2, m, n, n)),
        rng.normal(0.0, 0.2, (2, n)),
        np.stack([random_covariance(rng, n, 0.1) for _ in range(2)]),
        np.stack([random_covariance(rng, n, 0.1) for _ in range(2)]),
        np.array([0.4, 0.6]),
        np.array([0.3, 0.2]),
    )


def test_coupled_missions_have_the_moments_of_the_dense_joint_normal():
    rng, n = np.random.default_rng(0), 40_000
    params, z = coupled_draws(rng), rng.uniform(size=(3, 2, 2))
    many = np.broadcast_to(z, (n, *z.shape))
    sample = draw_missions(GAUSSIAN, params, many, np.asarray(np.nan), rng)
    for d in range(2):
        p = params.draw(d)
        drift = p.b + np.einsum("kim,mai->ka", z, p.B)
        joint = dense_joint(p.B0, drift, p.Delta_w, p.Delta_v, p.x0_mean, p.x0_sd)
        mean = np.concatenate([joint.mean_x, joint.mean_y])
        cov = np.block([[joint.cov_x, joint.cov_xy], [joint.cov_xy.T, joint.cov_y]])
        drawn = np.concatenate([a[d].reshape(n, -1) for a in sample], axis=1)
        sd = np.sqrt(np.diag(cov))
        # 5 standard errors: some 200 comparisons.
        assert (np.abs(drawn.mean(0) - mean) < 5 * sd / np.sqrt(n)).all()
        se = np.sqrt((np.outer(sd, sd) ** 2 + cov**2) / n)
        assert (np.abs(np.cov(drawn.T) - cov) < 5 * se).all()


@pytest.mark.parametrize("shared", [True, False])
def test_trust_without_noise_is_the_recursion(shared):
    """Each draw, mission, bound and robot on its own, where bounds have intercepts."""
    rng, shape = np.random.default_rng(1), (2, 3, 4, 2)  # draw, mission, bound, robot
    own = (2,) if shared else (2, 2)
    b = rng.normal(size=(*shape[:3], 1 if shared else 2))
    kind, zero = TrustParams if shared else RobotParams, np.zeros(own)
    p = kind(rng.uniform(size=own), rng.normal(size=(*own, 3)), b, zero, zero,
             np.array([0.3, 0.6]), np.zeros(2))  # fmt: skip
    z = rng.uniform(size=(3, 4, 2, 3))
    sample = draw_missions(GAUSSIAN, p, 1.0, z, np.asarray(np.nan), rng)
    for d, j, i in np.ndindex(2, 3, 2):
        at = (d,) if shared else (d, i)
        x = p.x0_mean[d]
        for k in range(4):
            before = x
            x = p.beta0[at] * x + z[j, k, i] @ p.beta[at] + b[d, j, k, 0 if shared else i]
            assert sample.trust[d, j, k, i] == pytest.approx(x, abs=1e-12)
            assert sample.contact_rate[d, j, k, i] == pytest.approx(x - before, abs=1e-12)


def test_a_covariance_that_rounding_made_singular_is_drawn_from():
    rng = np.random.default_rng(2)
    factor = rng.normal(size=(2, 3, 1))
    one = factor @ np.swapaxes(factor, 1, 2)  # of rank 1
    p = CoupledParams(np.zeros((2, 3, 3)), np.zeros((2, 1, 3, 3)), np.zeros((2, 3)), one, one,
                      np.zeros(2), np.zeros(2))  # fmt: skip
    z = np.zeros((4000, 1, 3, 1))
    trust = draw_missions(GAUSSIAN, p, 0.0, z, np.asarray(np.nan), rng).trust
    for d in range(2):
        # A variance of 4000 to 2 %; what is not of rank 1 has 1e-15 of the variance.
        np.testing.assert_allclose(np.cov(trust[d, :, 0].T), one[d], rtol=0.12)
        off = trust[d, :, 0] - np.outer(trust[d, :, 0, 0] / factor[d, 0], factor[d, :, 0])
        np.testing.assert_allclose(off, 0.0, atol=1e-6)


SLOW = pytest.mark.slow  # JAX's samplers of counts and of odd rates compile for long


@pytest.mark.parametrize(
    ("family", "coupled"),
    [
        *(("gaussian", False), pytest.param("gaussian", True, marks=SLOW)),
        *(pytest.param(f, False, marks=SLOW) for f in ("censored", "beta_binomial")),
    ],
)
def test_numpyro_draws_the_same_missions(family, coupled):
    """`ModelRates`, by which numpyro draws from a model, against NumPy: two codes of one law."""
    rng, n = np.random.default_rng(3), 4000
    p = TrustParams(0.6, np.array([0.5, 0.3]), -0.05, 0.1, 0.2, 0.5, 0.5)
    if coupled:
        p = coupled_draws(rng).draw(0)
    z, ticks = rng.uniform(size=(1, 4, 2, 2)), np.full((1, 4, 2), float(N))
    with own_settings():
        law = ModelRates(p.map(lambda v, _: jnp.asarray(v, float)), jnp.asarray(z),
                          n_ticks=jnp.asarray(ticks), observation=family)  # fmt: skip
        theirs = np.asarray(law.sample(jax.random.key(0), (n,)))
    many = p.map(lambda v, _: np.repeat(np.asarray(v, dtype=float)[None], n, 0))
    ours = draw_missions(FAMILIES[family], many, 0.0, z, ticks, rng).contact_rate
    assert ours.shape == theirs.shape == (n, 1, 4, 2)
    ours, theirs = ours.reshape(n, -1), theirs.reshape(n, -1)
    for power in (1, 2):
        # Moments of each rate and of each pair; 5 standard errors.
        one, other = (y if power == 1 else (y[:, :, None] * y[:, None]).reshape(n, -1)
                      for y in (ours, theirs))  # fmt: skip
        error = np.sqrt((one.var(0) + other.var(0)) / n)
        assert (np.abs(one.mean(0) - other.mean(0)) < 5 * error).all()
    if family in ("censored", "beta_binomial"):
        assert 0.0 <= ours.min() <= ours.max() <= 1.0
    if family == "beta_binomial":
        np.testing.assert_allclose(ours * N, np.round(ours * N), atol=1e-9)
