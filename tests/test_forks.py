"""Processes that are forked after JAX has started its threads."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import multiprocessing, warnings
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import trustbo as tb

warnings.simplefilter("ignore")
awareness = np.random.default_rng(0).uniform(size=(3, 3, 3, 1))
workspace = tb.Workspace.from_awareness(awareness)
truth = tb.models.TrustParams(0.4, np.array([0.3]), 0.1, 0.03, 0.04)
missions = [tb.simulation.ModelSimulator(workspace, truth).run([(2, 0), (1, 1), (0, 2)], seed=0)]
quick = {"draws": 5, "warmup": 5, "chains": 1, "check": False, "progress": False}


def own(awareness, contact_rate=None):
    b = numpyro.sample("b", dist.Normal(0.5, 0.3))
    rates = tb.models.ContactRate(b * awareness[..., 0], 0.4, 0.05, 0.1)
    numpyro.sample("contact_rate", rates, obs=contact_rate)


def told(answers, work):
    try:
        work()
        answers.put("done")
    except tb.TrustboError as error:
        answers.put("refused" if "spawn" in str(error) else str(error))


works = [
    lambda: tb.fit(missions, own, **quick),
    lambda: tb.Campaign(workspace, (2, 0), (0, 2), model=own),
    lambda: tb.fit(missions, tb.models.PooledTrust(), sampler="nuts", **quick),
    lambda: tb.fit(missions, draws=100, check=False, progress=False),
    lambda: tb.Planner(workspace, (2, 0), (0, 2)).plan(truth),
]
tb.fit(missions, draws=100, check=False, progress=False)
jnp.zeros(3).block_until_ready()
context = multiprocessing.get_context("fork")
for work in works:
    answers = context.Queue()
    child = context.Process(target=told, args=(answers, work))
    child.start()
    print(answers.get(timeout=300))
    child.join()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
def test_a_fork_is_refused_where_it_would_wait_for_threads_of_jax():
    """Fits without JAX and plans work as before."""
    command = [sys.executable, "-c", PROGRAM]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["refused", "refused", "refused", "done", "done"]
