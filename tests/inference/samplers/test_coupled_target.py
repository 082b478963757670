"""The exact sampler of coupled robots: its integral, its scores, its draws, its evidence."""

import jax
import numpy as np
import numpyro.distributions as dist
import pytest

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import fit, sample_prior
from trustbo.inference.samplers.choice import resolve_sampler
from trustbo.inference.samplers.coupled_target import CoupledTarget
from trustbo.inference.samplers.importance import sample_scores
from trustbo.models import CoupledParams, CoupledTrust, Priors
from trustbo.stacking import stack_missions


def small(lengths=(3,), n_robots=2, n_features=1, gaps=()):
    """Missions of these lengths; a gap is (mission, bound, robot)."""
    rng, missions = np.random.default_rng(0), []
    for j, n in enumerate(lengths):
        rates = rng.uniform(0.3, 0.9, (n, n_robots))
        for at in gaps:
            if at[0] == j:
                rates[at[1:]] = np.nan
        awareness = rng.uniform(size=(n, n_robots, n_features))
        missions.append(Mission.from_arrays([(0, k) for k in range(n + 1)], awareness, rates))
    return missions


def target_of(missions, model, weight=None):
    batch = stack_missions(missions)
    padded = np.ones(len(batch.contact_rate))
    padded[: len(missions)] = 1.0 if weight is None else weight
    return CoupledTarget(model, batch, padded)


def rates_of(p, awareness):
    """Mean (bound x robot,) and covariance of a mission's rates, from powers of B0."""
    n_bounds, n = awareness.shape[:2]
    power = [np.linalg.matrix_power(p.B0, k) for k in range(n_bounds + 1)]
    mean, of_x0, of_w = [], [], np.zeros((n_bounds, n, n_bounds, n))
    drift = np.einsum("mij,kjm->ki", p.B, awareness) + p.b

    def trust(k):
        return power[k] @ np.full(n, p.x0_mean) + sum(
            (power[k - j] @ drift[j - 1] for j in range(1, k + 1)), np.zeros(n)
        )

    for k in range(1, n_bounds + 1):
        mean.append(trust(k))
        of_x0.append(power[k])
        for j in range(1, k + 1):
            of_w[k - 1, :, j - 1] = power[k - j]
    X0, W = np.concatenate(of_x0), of_w.reshape(n_bounds * n, -1)
    cov = p.x0_sd**2 * X0 @ X0.T + W @ np.kron(np.eye(n_bounds), p.Delta_w) @ W.T
    return np.concatenate(mean), cov + np.kron(np.eye(n_bounds), p.Delta_v)


def dense_log_density(model, missions, weight, sites):
    """Log p(rates | all but the coefficients), each mission's density to its weight."""
    m, priors = missions[0].awareness.shape[2], model.priors
    n, beta0 = missions[0].awareness.shape[1], np.diag(sites["B0"])

    def params(c):
        own = c.reshape(n, -1)
        B = np.moveaxis(own[:, :-1].reshape(n, n, m), 2, 0)
        given = {name: sites[name] for name in ("B0", "Delta_w", "Delta_v")}
        return CoupledParams(B=B, b=own[:, -1], **given, x0_mean=0.5, x0_sd=0.5)

    per_robot, rest = n * m + 1, 1.0 - beta0
    rest = rest if priors.stationary else np.ones(n)
    loc, scale = np.zeros((n, per_robot)), np.full((n, per_robot), priors.coupling.scale)
    for i in range(n):
        own = slice(i * m, (i + 1) * m)
        loc[i, own], scale[i, own] = rest[i] * priors.beta.loc, rest[i] * priors.beta.scale
        loc[i, -1], scale[i, -1] = rest[i] * priors.b.loc, rest[i] * priors.b.scale
    X, off, blocks, constant = [], [], [], 0.0
    for mission, w in zip(missions, weight, strict=True):
        seen = ~np.isnan(mission.contact_rate.ravel())
        base, cov = rates_of(params(np.zeros(loc.size)), mission.awareness)
        unit = [rates_of(params(e), mission.awareness)[0] - base for e in np.eye(loc.size)]
        cov = cov[np.ix_(seen, seen)]
        X.append(np.array(unit).T[seen])
        off.append((mission.contact_rate.ravel() - base)[seen])
        blocks.append(cov / w)  # N(y; mean, cov)^w is N(y; mean, cov / w) times a constant
        log_det = np.linalg.slogdet(2.0 * np.pi * cov)[1]
        constant += 0.5 * (1.0 - w) * log_det - 0.5 * seen.sum() * np.log(w)
    X, off = np.concatenate(X), np.concatenate(off)
    V, at = np.zeros((len(off), len(off))), 0
    for block in blocks:
        V[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    V += (X * scale.ravel() ** 2) @ X.T
    e = off - X @ loc.ravel()
    return constant - 0.5 * (np.linalg.slogdet(2.0 * np.pi * V)[1] + e @ np.linalg.solve(V, e))


@pytest.mark.parametrize("stationary", [True, False])
def test_the_density_is_the_dense_joint_normal_s(stationary):
    """Missions of three lengths, two with the same gap and one with another; one weighs less."""
    gaps = (0, 1, 2), (1, 1, 2), (3, 4, 0)
    missions = small((5, 4, 3, 5), n_robots=3, n_features=2, gaps=gaps)
    weight = np.array([1.0, 1.0, 0.3, 1.0])
    priors = Priors(
        beta=dist.Normal(np.array([0.2, -0.1]), np.array([0.7, 0.5])),
        b=dist.Normal(0.1, 0.4),
        stationary=stationary,
    )
    model = CoupledTrust(priors)
    target, rng = target_of(missions, model, weight), np.random.default_rng(1)
    z = 0.7 * rng.standard_normal((4, target.n_scores))
    found = target.log_density(z) - target.log_prior(z)
    params, _ = target.draw(z, found, np.arange(4), rng)
    expected = [
        dense_log_density(model, missions, weight, {name: v[t] for name, v in params.items()})
        for t in range(4)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_scores_of_correlations_are_normal_under_the_lkj_prior():
    """Density of the prior times the Jacobian, by differences: error 1e-8."""
    target, z = target_of(small(n_robots=3), CoupledTrust()), np.array([[0.4, -1.1, 0.8]])

    def correlations(scores):
        L = target._correlations(scores)
        return (L @ np.swapaxes(L, 1, 2))[0]

    rows, cols = np.tril_indices(3, -1)
    slopes = [
        (correlations(z + step) - correlations(z - step))[rows, cols] / 2e-5
        for step in 1e-5 * np.eye(3)
    ]
    with jax.enable_x64(True):
        law = dist.LKJ(3, target.priors.concentration)
        prior = jax.jit(law.log_prob)(correlations(z))
    found = float(prior) + np.linalg.slogdet(np.array(slopes))[1]
    assert found == pytest.approx(-0.5 * (z**2).sum() - 1.5 * np.log(2.0 * np.pi), abs=1e-6)


def test_draws_and_evidence_are_those_of_weighted_prior_draws():
    """Importance sampling from the prior by the model's own likelihood: another way to both."""
    priors = Priors(beta=dist.Normal(0.1, 0.3), b=dist.Normal(0.2, 0.2))
    model, missions = CoupledTrust(priors), small((2,))
    found = sample_scores(target_of(missions, model), 4000, 0).draws
    prior = sample_prior(model, 1, 40_000, seed=1, n_robots=2)
    log_weight = model.log_likelihood(prior, missions)[:, 0]
    weight = np.exp(log_weight - log_weight.max())
    n = weight.sum() ** 2 / (weight**2).sum()
    assert n > 500
    expected = np.log(weight.mean()) + log_weight.max()
    assert found.log_evidence == pytest.approx(expected, abs=5.0 / np.sqrt(n))
    together = found.params
    for name in ("B0", "B", "b", "Delta_w", "Delta_v"):
        values = np.asarray(getattr(prior, name)).reshape(len(weight), -1)
        mean = weight @ values / weight.sum()
        sd = np.sqrt(weight @ (values - mean) ** 2 / weight.sum())
        error = 4.5 * sd * np.sqrt(1.0 / n + 1.0 / min(found.kish, 4000))
        off = np.abs(np.asarray(together[name]).reshape(4000, -1).mean(0) - mean)
        assert (off <= error + 1e-12).all(), name


def test_an_influence_of_one_robot_on_another_is_found():
    """Robot 0 follows robot 1; the other way there is nothing."""
    rng, n = np.random.default_rng(0), 12
    truth = CoupledParams(
        B0=np.array([[0.3, 0.5], [0.0, 0.5]]),
        B=np.array([[[0.2, 0.0], [0.0, 0.5]]]),
        b=np.zeros(2),
        Delta_w=0.05**2 * np.eye(2),
        Delta_v=0.03**2 * np.eye(2),
        x0_mean=0.5,
        x0_sd=0.1,
    )
    model = CoupledTrust(Priors(coupling=dist.Normal(0.0, 0.4)))
    awareness = rng.uniform(size=(n, 8, 2, 1))
    rates = model.simulate(jax.random.key(0), truth, awareness).contact_rate
    path = [(0, k) for k in range(9)]
    missions = [
        Mission.from_arrays(path, z, np.clip(y, 0.0, 1.0))
        for z, y in zip(awareness, rates, strict=True)
    ]
    posterior = fit(missions, model, whole=False)
    assert posterior.attrs["sampler"] == "exact"
    assert posterior.attrs["k_hat"] <= 0.7
    low, high = posterior["posterior"]["B0"].quantile([0.005, 0.995], ("chain", "draw")).values
    assert ((low <= truth.B0) & (truth.B0 <= high)).all()
    assert low[0, 1] > 0.1
    others = fit(small(n_robots=3), CoupledTrust(), earlier=posterior, whole=False)
    assert others.attrs["k_hat"] <= 0.7  # a proposal of another team is not taken


def test_where_coefficients_do_not_integrate_out_nuts_is_taken_and_says_why():
    heavy = CoupledTrust(Priors(coupling=dist.StudentT(3.0, 0.0, 0.1)))
    chosen, reason = resolve_sampler(heavy, "auto")
    assert chosen == "nuts"
    assert reason.startswith("it needs the prior of coupling to be a Normal distribution; got")
    with pytest.raises(TrustboError, match='sampler "exact": it needs the prior of coupling'):
        resolve_sampler(heavy, "exact")
    censored = CoupledTrust(observation="censored")
    expected = "its robots influence each other, and its observations are not Gaussian"
    for sampler in ("auto", "exact"):
        with pytest.raises(TrustboError, match=expected):
            resolve_sampler(censored, sampler)


def test_noises_that_underflow_have_no_density_and_raise_nothing():
    model = CoupledTrust()
    target = target_of(small(), model)
    z = np.zeros((2, target.n_scores))
    of_sizes = 4  # behind beta0 and the coupling
    z[:, of_sizes : of_sizes + 2] = [[-800.0], [-380.0]]
    z[:, 0] = -40.0  # a beta0 of 0 leaves nothing of the start's variance
    assert (target.log_density(z) == -np.inf).all()
