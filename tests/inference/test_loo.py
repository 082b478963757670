"""Leaving missions out of weighted posteriors: against refits without each mission."""

import arviz as az
import numpy as np
import pytest
from missions import simulate_missions

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference import compare, fit, loo, params_of
from trustbo.models import PooledTrust, Priors

pytestmark = pytest.mark.filterwarnings(
    "ignore:Estimated shape parameter of Pareto"
)  # few missions


def refitted(missions, weights):
    """Log predictive density of each mission under the posterior of the others."""
    found = []
    for j, left_out in enumerate(missions):
        rest = [i for i in range(len(missions)) if i != j]
        posterior = fit([missions[i] for i in rest], sampler="exact", weights=weights[rest], seed=1)
        each = PooledTrust().log_likelihood(params_of(posterior), [left_out])[:, 0]
        found.append(np.logaddexp.reduce(each) - np.log(len(each)))
    return np.array(found)


@pytest.mark.parametrize("forgetting", [0.6, 1.0])
def test_loo_is_what_refits_without_each_mission_give(forgetting):
    missions = simulate_missions(10, lengths=(8,))
    weights = forgetting ** np.arange(9.0, -1.0, -1.0)
    result = loo(fit(missions, sampler="exact", weights=weights))
    expected = refitted(missions, weights)
    good = result.pareto_k.values < 0.5
    assert good.sum() >= 7
    # Importance weights of 4000 draws and refits of 4000: some .05 nats a mission each.
    np.testing.assert_allclose(result.elpd_i.values[good], expected[good], atol=0.25)
    assert abs(result.elpd_i.values[good].sum() - expected[good].sum()) < 0.5


def test_without_weights_it_is_arviz_s():
    posterior = fit(simulate_missions(8), sampler="exact")
    ours, theirs = loo(posterior), az.loo(posterior, pointwise=True)
    assert ours.elpd == pytest.approx(theirs.elpd, rel=1e-12)
    np.testing.assert_allclose(ours.pareto_k, theirs.pareto_k)


def test_arviz_does_not_read_a_weighted_posterior_and_compares_our_results():
    missions, weights = simulate_missions(8), np.linspace(0.0, 1.0, 8)
    aged, other = (fit(missions, sampler="exact", weights=weights, seed=seed) for seed in (0, 1))
    with pytest.raises(Exception, match=r"log[_ ]likelihood"):
        az.loo(aged)
    # The mission of weight 0 is left out already: its density is a plain average.
    each = aged["mission_log_likelihood"]["contact_rate"].sel(mission=0).values.ravel()
    first = np.logaddexp.reduce(each) - np.log(len(each))
    assert float(loo(aged).elpd_i[0]) == pytest.approx(first, rel=1e-9)
    assert set(az.compare({"a": loo(aged), "b": loo(other)}).index) == {"a", "b"}


def test_a_mission_without_rates_is_left_out_of_the_sum():
    missions = simulate_missions(6)
    nothing = np.full_like(missions[2].contact_rate, np.nan)
    missions[2] = Mission.from_arrays(missions[2].path, missions[2].awareness, nothing)
    result = loo(fit(missions, sampler="exact"))
    assert result.n_data_points == 5
    assert result.elpd_i["mission"].values.tolist() == [0, 1, 3, 4, 5]
    alone = fit(missions[1:3], sampler="exact")
    with pytest.raises(TrustboError, match="one of several missions; 1 of 2 have rates"):
        loo(alone)


def test_compare_ranks_as_arviz_does_and_refuses_other_missions():
    missions = simulate_missions(8)
    fits = {
        "level": fit(missions, sampler="exact"),
        "wide": fit(missions, PooledTrust(Priors(x0_sd=3.0)), sampler="exact"),
    }
    table, theirs = compare(fits), az.compare(fits)
    assert list(table.index) == list(theirs.index)
    np.testing.assert_allclose(table["elpd_diff"], theirs["elpd_diff"], atol=1e-9)
    with pytest.raises(TrustboError, match="'fewer' and 'level' are posteriors of different"):
        compare({"level": fits["level"], "fewer": fit(missions[:5], sampler="exact")})
    with pytest.raises(TrustboError, match="two or more posteriors by name"):
        compare({"level": fits["level"]})
