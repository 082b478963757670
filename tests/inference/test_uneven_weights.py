"""What a fit says where the weights of the exact sampler are too uneven."""

import numpy as np
import pytest

import trustbo as tb
from trustbo.errors import PosteriorError
from trustbo.inference import fit
from trustbo.inference.samplers import run
from trustbo.models import PooledTrust

PATH = [(2, 0), (1, 1), (0, 2)]


def missions(share, *, ticks=True, n=10):
    """Missions of which a share of the rates is exactly 1."""
    rng = np.random.default_rng(0)
    rates = np.round(rng.uniform(0.3, 0.9, n * 4), 2)
    rates[: round(share * len(rates))] = 1.0
    z = rng.uniform(size=(n, 2, 2, 1))
    more = {"n_ticks": np.full((2, 2), 100)} if ticks else {}
    return [
        tb.Mission.from_arrays(PATH, z[j], of, **more)
        for j, of in enumerate(rates.reshape(n, 2, 2))
    ]


def force_uneven_weights(monkeypatch):
    """Of scores, which Gaussian rates of pooled robots have none of."""
    sample = run.sample_scores

    def uneven(*args):
        found = sample(*args)
        return found._replace(draws=found.draws._replace(khat=0.83))

    monkeypatch.setattr(run, "sample_scores", uneven)


def test_uneven_weights_of_a_family_that_was_asked_for_are_refused(monkeypatch):
    force_uneven_weights(monkeypatch)
    model = PooledTrust(observation="censored")
    with pytest.raises(PosteriorError, match=r"weights are too uneven .k-hat 0.83, limit 0.7"):
        fit(missions(0.5, n=3), model, n_draws=50, whole=False, check=False)
