"""Whether trust carries over between bounds: evidence against quadrature, and simulated rates."""

import jax
import numpy as np
import pytest
from scipy import stats

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.memory import Memory
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.models import HierarchicalTrust, PooledTrust, Priors, RobotEffect, TrustParams
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.weights import Weights
from trustbo.report.summary import facts_of
from trustbo.stacking import stack_missions

FEATURES = ("line_of_sight", "slope")


def missions_with(beta0, n=4, seed=0):
    """Missions of a straight path whose trust has that memory, and the same level."""
    rng, missions = np.random.default_rng(seed), []
    rest = 1.0 - beta0
    truth = TrustParams(beta0, rest * np.array([0.6, 0.1]), rest * 0.1, 0.08 * rest, 0.03)
    for _ in range(n):
        z = rng.uniform(size=(12, 3, 2))
        key = jax.random.key(int(rng.integers(1000)))
        y = np.clip(PooledTrust().simulate(key, truth, z[None]).contact_rate[0], 0.0, 1.0)
        path = [(k, 0) for k in range(13)]
        missions.append(Mission.from_arrays(path, z, y, features=FEATURES))
    return missions


def test_the_evidence_without_memory_is_that_of_quadrature():
    """Over both noises, half-normal a priori; the sampler's error of 400 draws is some .03 nat."""
    (mission,) = missions_with(0.3, 1)
    priors = Priors.of(FEATURES)
    slots = Slots.of(stack_missions([mission]), 1, FEATURES)
    target = posterior_of(priors, PooledTrust().family, [], slots, carries=False)
    found = sample_scores(target, 400, 0).draws.log_evidence
    scale = 0.2  # of the priors of both noises
    p = (np.arange(80) + 0.5) / 80
    w, v = (x.ravel() for x in np.meshgrid(*[scale * stats.halfnorm.ppf(p)] * 2))
    theta = {"beta0": 0.0 * w, "rest": 0.0 * w + 1.0, "delta_w": w, "delta_v": v}
    evidence = Gaussian(slots, [Weights(priors).group(slots)], (0.5, 0.5))
    expected = np.logaddexp.reduce(evidence.log_density(theta)) - np.log(len(w))
    assert found == pytest.approx(expected, abs=0.15)


@pytest.mark.parametrize(
    "model",
    [
        PooledTrust(),
        PooledTrust(effects=RobotEffect()),
        PooledTrust(observation="censored"),
    ],
    ids=["pooled", "robots", "censored"],
)
def test_memory_is_found_where_it_is_and_not_where_it_is_not(model):
    carried, not_carried = (
        tb.inference.memory(tb.fit(missions_with(beta0), model, whole=False))
        for beta0 in (0.5, 0.0)
    )
    assert carried.log_bf > 3.0
    assert abs(carried.beta0 - 0.5) < 0.25
    assert str(carried).startswith("trust carries over from one bound to the next: beta0 0.")
    assert not_carried.log_bf < 0.0
    assert not_carried.p_none > 0.5


def test_the_finding_is_open_between_odds_of_19():
    assert Memory(0.0, 0.3, 0.1).p_none == 0.5
    assert str(Memory(1.0, 0.3, 0.1)).startswith("open whether trust carries over")
    assert str(Memory(1.0, 0.3, 0.1)).endswith("log Bayes factor 1.0 for beta0 > 0")
    assert str(Memory(-4.0, 0.3, 0.1)).startswith("trust does not carry over")
    assert Memory(2000.0, 0.9, 0.1).p_none == 0.0


def test_what_has_no_such_evidence_is_refused():
    missions = missions_with(0.3, 2)
    with pytest.raises(TrustboError, match=r"memory is weighed under PooledTrust.*Hierarchical"):
        tb.inference.memory(tb.fit(missions, HierarchicalTrust(), whole=False, check=False))
    posterior = tb.fit(missions, PooledTrust(response="change"), whole=False, check=False)
    with pytest.raises(TrustboError, match='response="change"'):
        tb.inference.memory(posterior)
    with pytest.raises(TrustboError, match="takes a posterior from fit"):
        tb.inference.memory(missions)


def test_a_campaign_states_the_finding_in_its_report_and_once_asked_for_in_its_card():
    z = np.random.default_rng(2).uniform(size=(3, 5, 5, 2))
    workspace = tb.Workspace.from_awareness(z, features=FEATURES)
    truth = TrustParams(0.5, np.array([0.3, 0.05]), 0.05, 0.03, 0.03)
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    options = {"simulator": simulator, "progress": False, "n_iterations": 2, "seed": 3}
    result = tb.iterate(workspace, (4, 0), (0, 4), **options)
    assert "memory" not in dict(result._card().rows)
    facts = {fact.name: fact.text for fact in facts_of(result)}
    finding = str(result.memory)
    assert facts["Memory"] == f"{finding[0].upper()}{finding[1:]}."
    assert dict(result._card().rows)["memory"] == finding
    alone = tb.inference.memory(result.posteriors[-1], result.missions, workspace)
    assert alone.log_bf == result.memory.log_bf
    with pytest.raises(TrustboError, match="parameters alone"):
        tb.inference.memory(result.posteriors[-1])
