"""Every model with every family and effect is fitted, and latent trust is added later."""

from itertools import product

import numpy as np
import pytest

import trustbo as tb
from trustbo.inference import add_latent
from trustbo.inference.tree import parameters_alone
from trustbo.models import CoupledTrust, HierarchicalTrust, PlaceEffect, PooledTrust, RobotEffect

FAMILIES = "gaussian", "censored", "beta_binomial"
EFFECTS = (), (PlaceEffect(), RobotEffect())
N_TICKS = 20
N_DRAWS = 20
MODELS = {
    f"{model.__name__}, {family}, {len(effects)} effects": model(family=family, effects=effects)
    for model, family, effects in product(
        (PooledTrust, HierarchicalTrust, CoupledTrust), FAMILIES, EFFECTS
    )
}
for model, family in product(("HierarchicalTrust", "CoupledTrust"), FAMILIES):
    del MODELS[f"{model}, {family}, 0 effects"]  # the pooled ones show what a fit has without
MODELS |= {
    f"PooledTrust, {family}, shared noise": PooledTrust(family=family, shared_noise=True)
    for family in ("gaussian", "censored")
}
MODELS["PooledTrust, gaussian, deviation"] = PooledTrust(memory="deviation")


@pytest.fixture(scope="module")
def missions():
    """Missions of different lengths, with a rate that was not measured."""
    rng = np.random.default_rng(0)
    found = []
    for n_bounds in (5, 3, 4):
        path = [(0, 0)]
        for k in range(n_bounds):
            row, col = path[-1]
            path.append((row, col + 1) if k % 2 else (row + 1, col))

        awareness = rng.uniform(size=(n_bounds, 2, 2))
        rates = rng.integers(0, N_TICKS + 1, (n_bounds, 2)) / N_TICKS
        rates[1, 0] = np.nan
        found.append(
            tb.Mission.from_arrays(
                path,
                awareness,
                rates,
                n_ticks=np.full(rates.shape, N_TICKS),
                features=("line_of_sight", "slope"),
            )
        )
    return found


@pytest.mark.parametrize("name", MODELS)
def test_a_fit_has_trust_predictions_and_likelihoods_of_all_rates(name, missions):
    fitted = tb.fit(missions, MODELS[name], draws=N_DRAWS, chains=1, check=False, progress=False)

    seen = ~np.isnan(fitted["observed_data"]["contact_rate"].to_numpy())
    predicted = fitted["posterior_predictive"]["contact_rate"].to_numpy()
    trust = fitted["latent"]["trust"].to_numpy()
    of_missions = fitted["log_likelihood"]["contact_rate"].to_numpy()

    assert predicted.shape == (1, N_DRAWS, 3, 5, 2)
    assert np.isfinite(predicted[..., seen]).all()
    assert np.isfinite(trust[..., seen]).all()
    assert of_missions.shape == (1, N_DRAWS, 3)
    assert np.isfinite(of_missions).all()

    later = add_latent(parameters_alone(fitted), missions, progress=False)
    for group in ("latent", "posterior_predictive", "log_likelihood", "log_prior"):
        assert later[group].to_dataset().equals(fitted[group].to_dataset()), group
