"""Contact rates given any drift, of programs of users."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from numpyro import handlers

from trustbo.errors import TrustboError
from trustbo.models import ContactRate

X0 = 0.4, 0.6


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


@pytest.mark.parametrize("shape", [(4, 3), (2, 4, 3, 1), ()])
def test_a_drift_of_another_shape_is_refused(shape):
    with pytest.raises(TrustboError, match="drift"):
        ContactRate(np.zeros(shape), 0.5, 0.1, 0.1)


def test_rates_and_parameters_must_have_the_shape_of_the_drift():
    rates = np.zeros((2, 4, 3))
    law = ContactRate(rates, np.full(3, 0.5), 0.1, 0.1)
    assert law.log_prob(rates).shape == (2,)
    with pytest.raises(TrustboError, match="mission, bound, robot"):
        law.log_prob(np.zeros((2, 3, 4)))
    with pytest.raises(TrustboError, match="beta0"):
        ContactRate(rates, np.full(4, 0.5), 0.1, 0.1)
