"""Contact rates given any drift, against the joint normal of all rates."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from joint_normal import Dense
from missions import walking_missions
from numpyro import handlers
from scipy import sparse

from trustbo.models import ContactRate
from trustbo.models.effects.effect import Prior, Slots
from trustbo.stacking import stack_missions

X0 = 0.4, 0.6


class Fixed:
    """A column that is added to the drift as it is."""

    joined = ()

    def __init__(self, column):
        self.columns = sparse.csr_array(column.reshape(-1, 1))

    def prior(self, theta):
        return Prior(np.ones((1, 1)), np.zeros((1, 1)), ())


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_the_density_is_that_of_the_joint_normal_of_all_rates(missing):
    missions = walking_missions(1, 4, missing=missing)
    batch, rng = stack_missions(missions, pad=False), np.random.default_rng(0)
    drift = rng.normal(0.3, 0.2, batch.contact_rate.shape)
    with jax.enable_x64(True):
        law = ContactRate(jnp.asarray(drift), 0.6, 0.1, 0.05, *X0)
        found = law.log_prob(jnp.asarray(batch.contact_rate))
    slots = Slots.of(batch, len(missions), ())
    of_chains = drift[slots.mission, :, slots.robot][:, : slots.y.shape[1]]
    theta = {"beta0": [[0.6]], "delta_w": [0.1], "delta_v": [0.05]}
    dense = Dense(slots, [Fixed(of_chains)], {n: np.array(v) for n, v in theta.items()}, X0)
    assert found.shape == (4,)
    np.testing.assert_allclose(np.sum(found), dense.log_density(), rtol=1e-10)


def test_rates_that_are_drawn_have_the_moments_of_equations_3_and_4():
    """Of each robot's own parameters, in closed form, within 5 standard errors of 20 000 draws."""
    beta0, delta_w, delta_v = np.array([0.5, 0.9]), 0.1, np.array([0.05, 0.2])
    drift = np.array([[[0.2, 0.1], [0.3, -0.1]]])
    law = ContactRate(jnp.asarray(drift), beta0, delta_w, delta_v, *X0)
    n = 20_000
    rates = np.asarray(law.sample(jax.random.key(0), (n,)))
    assert rates.shape == (n, 1, 2, 2)
    mean, var = np.full(2, X0[0]), np.full(2, X0[1] ** 2)
    for k in range(2):
        mean, var = beta0 * mean + drift[0, k], beta0**2 * var + delta_w**2
        total = var + delta_v**2
        y = rates[:, 0, k]
        assert (np.abs(y.mean(0) - mean) < 5.0 * np.sqrt(total / n)).all()
        assert (np.abs(y.var(0) / total - 1.0) < 5.0 * np.sqrt(2.0 / n)).all()


def test_a_model_of_ones_own_is_a_numpyro_program():
    z = jnp.asarray(np.random.default_rng(0).uniform(size=(3, 4, 2, 1)))

    def program(rates=None):
        slope = numpyro.sample("slope", numpyro.distributions.Normal(0.5, 0.1))
        with numpyro.plate("mission", len(z)):
            law = ContactRate(slope * z[..., 0], 0.5, 0.1, 0.1)
            return numpyro.sample("contact_rate", law, obs=rates)

    rates = handlers.seed(program, jax.random.key(0))()
    trace = handlers.trace(handlers.seed(program, jax.random.key(0))).get_trace(rates)
    assert trace["contact_rate"]["fn"].log_prob(rates).shape == (3,)
