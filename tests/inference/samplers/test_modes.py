"""Posteriors with two modes: each has its share, or the posterior is refused."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logsumexp

from trustbo.errors import PosteriorError
from trustbo.inference import diagnostics, fit
from trustbo.inference.samplers import run
from trustbo.inference.samplers.complaints import complaints_of_modes
from trustbo.inference.samplers.modes import Modes, find_modes
from trustbo.inference.samplers.nuts import NutsDraws
from trustbo.inference.samplers.reparam import reparametrise
from trustbo.models import PooledTrust
from trustbo.models.backend import own_settings
from trustbo.models.ticks import weigh_ticks
from trustbo.stacking import stack_missions

SPEC = importlib.util.spec_from_file_location(
    "modes", Path(__file__).parents[3] / "benchmarks" / "modes.py"
)
assert SPEC is not None
assert SPEC.loader is not None
modes = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(modes)

ONE_OF_MODES = (163, 556, 643)
"""Data sets, constant but once, of which all draws were on one mode with k-hat < 0.5."""


@pytest.mark.parametrize("seed", ONE_OF_MODES)
def test_the_exact_sampler_gives_each_mode_its_share(seed):
    missions = modes.odd_missions("constant", np.random.default_rng(seed))
    truth = modes.marginal(missions, "real")
    valley = truth.valley()
    share = truth.below(valley)
    assert 0.05 < share < 0.95
    posterior = fit(missions, PooledTrust(modes.REAL), "exact")
    assert posterior.attrs["sampler"] == "exact"
    found = float((posterior["posterior"]["beta0"] < valley).mean())
    assert abs(found - share) < 0.03


LEFT_OUT = (136, 235)
"""Data sets, constant but once, of which all draws of NUTS were on one mode, R-hat below 1.01."""


@pytest.mark.slow  # its program compiles for this alone
def test_nuts_starts_at_both_modes_and_knows_their_mass():
    missions = modes.odd_missions("constant", np.random.default_rng(LEFT_OUT[1]))
    truth = modes.marginal(missions, "real")
    batch = stack_missions(missions)
    weight = np.ones(len(batch.contact_rate))
    model = PooledTrust(modes.REAL).at_resolution(weigh_ticks(batch, weight))

    @jax.jit
    def search(data):
        target = reparametrise(model, data, complete=True, collapse=True)
        found = find_modes(
            target.profile,
            lambda theta: -target.potential({"theta": theta}),
            target.starts,
            target.longest,
        )
        return jax.vmap(target.constrain)(found.mode)["beta0"], found.share

    with own_settings():
        beta0, share = map(np.asarray, search(run.nuts_data(model, batch, weight)))
    assert (share > 0.0).sum() == 2
    # Laplace's error, as measured, is .003: the noises, which are skewed, are alike at both.
    assert abs(share[beta0 < truth.valley()].sum() - truth.below(truth.valley())) < 0.01


@pytest.mark.slow  # its program compiles for this alone
def test_chains_of_nuts_that_do_not_meet_have_a_bad_rhat():
    missions = modes.odd_missions("constant", np.random.default_rng(163))
    posterior = fit(missions, PooledTrust(modes.REAL), "nuts", check=False)
    assert diagnostics(posterior)["r_hat"] > 1.1
    middle = posterior["posterior"]["beta0"].median("draw")
    assert float(middle.min()) < -0.1
    assert float(middle.max()) > 0.1


@pytest.mark.slow  # eight runs of NUTS
@pytest.mark.parametrize("seed", LEFT_OUT)
def test_nuts_gives_each_mode_its_share_or_is_refused(seed):
    missions = modes.odd_missions("constant", np.random.default_rng(seed))
    truth = modes.marginal(missions, "real")
    valley = truth.valley()
    try:
        posterior = fit(missions, PooledTrust(modes.REAL), "nuts")
    except PosteriorError:
        return
    found = float((posterior["posterior"]["beta0"] < valley).mean())
    assert abs(found - truth.below(valley)) < 0.03


CENTERS, SHARES = np.array([[0.2, 1.0], [-0.3, -1.0]]), np.array([0.9, 0.1])
SCALE = np.array([[0.05, 0.0], [0.3, 0.8]])


def test_modes_of_a_normal_mixture_are_found_with_their_mass():
    """Also from starts whose first Newton step would leave for the other mode."""

    def log_density(x):
        white = jnp.linalg.solve(jnp.asarray(SCALE), (x[None] - CENTERS).T)
        return logsumexp(jnp.log(SHARES) - 0.5 * (white**2).sum(0))

    @jax.jit
    def find(starts, longest):
        found = find_modes(lambda x: -log_density(x), log_density, starts, longest)
        return found, found.spread(3)[0]

    starts = np.array([[0.5, 0.0], [-0.55, 0.0], [0.1, 9.0], [-0.2, -9.0]])
    with own_settings():
        found, starts_of_chains = find(starts, np.array([0.05, np.inf]))
    distinct = np.flatnonzero(found.share)
    assert len(distinct) == 2
    # The other mode is 10 sd away: it moves a mode by less than exp(-50).
    np.testing.assert_allclose(found.mode[distinct], CENTERS, atol=1e-8)
    np.testing.assert_allclose(found.share[distinct], SHARES, rtol=1e-8)
    np.testing.assert_allclose(found.scale[distinct], [SCALE, SCALE], atol=1e-6)
    np.testing.assert_allclose(starts_of_chains, CENTERS[[0, 1, 0]], atol=1e-8)


def complaints(share_of_draws, *, sticky):
    """Complaints about draws of the mixture, a share of which lies around the second mode."""
    rng = np.random.default_rng(0)
    n = (4, 1000)
    second = rng.uniform(size=n) < share_of_draws
    if sticky:  # chains that change modes every hundred draws
        second = np.repeat(rng.uniform(size=(4, 10)) < share_of_draws, 100, axis=1)
    x = CENTERS[second.astype(int)] + rng.normal(size=(*n, 2)) @ SCALE.T
    found = Modes(CENTERS, np.array([SCALE, SCALE]), SHARES)
    params = {"beta0": x[..., 0], "beta": x[..., 1:]}
    at_modes = {"beta0": CENTERS[:, 0], "beta": CENTERS[:, 1:]}
    return complaints_of_modes(NutsDraws(params, {}, None, None, x, found, at_modes))


def test_a_mode_that_all_chains_left_is_a_complaint():
    (said,) = complaints(0.0, sticky=False)
    assert said == "0.0% of the draws are around the mode where beta0 is -0.3, of some 10% mass"
    assert complaints(0.008, sticky=False)[0].startswith("0.")
    assert complaints(0.05, sticky=False) == []  # masses of fits are rough
    assert complaints(0.1, sticky=False) == []


def test_a_share_that_is_not_settled_is_a_complaint():
    about_first, about_second = complaints(0.5, sticky=True)
    assert "the share of the mode where beta0 is -0.3 is 0." in about_second
    assert "(limit 0.015)" in about_first
