"""Student-t rates: what odd values do to them, and to Gaussian ones."""

import arviz as az
import numpy as np
import pytest
from scipy import integrate, stats

import trustbo as tb
from trustbo.inference import fit
from trustbo.models import PooledTrust
from trustbo.models.families import FAMILIES

TRUTH = {"beta0": 0.5, "b": 0.1, "delta_w": 0.05, "delta_v": 0.03}


@pytest.mark.parametrize(
    ("mean", "var", "y", "sd"), [(0.6, 0.01, 0.7, 0.05), (0.6, 0.02, 0.0, 0.03)]
)
def test_a_rate_moves_trust_as_bayes_rule_says(mean, var, y, sd):
    """Moments by adaptive quadrature; the nodes leave less than .1 %."""
    known = [np.array([value]) for value in (mean, var, y, np.nan, sd)]
    center, left, log_density = FAMILIES["student_t"].observe(*known)

    def moment(power):
        def integrand(x):
            return x**power * stats.norm.pdf(x, mean, var**0.5) * stats.t.pdf(y, 4, x, sd)

        return integrate.quad(integrand, -1.0, 2.0, points=[mean, y], limit=400)[0]

    mass, first, second = (moment(k) for k in range(3))
    assert log_density[0] == pytest.approx(np.log(mass), abs=2e-3)
    assert center[0] == pytest.approx(first / mass, rel=1e-3)
    assert left[0] == pytest.approx(second / mass - (first / mass) ** 2, rel=5e-3)


def missions_with_odd_rates():
    """Ten missions; 5 % of the rates have nothing to do with trust."""
    rng, missions = np.random.default_rng(0), []
    for _ in range(10):
        z, x, y = rng.uniform(size=(8, 3, 2)), np.full(3, 0.5), np.zeros((8, 3))
        for k in range(8):
            x = 0.5 * x + z[k] @ [0.4, 0.2] + 0.1 + 0.05 * rng.normal(size=3)
            y[k] = x + 0.03 * rng.normal(size=3)
        odd = rng.uniform(size=y.shape) < 0.05
        y[odd] = rng.uniform(size=odd.sum())
        rates = np.clip(np.round(40 * y) / 40, 0.0, 1.0)
        path, ticks = [(0, k) for k in range(9)], np.full((8, 3), 40)
        missions.append(tb.Mission.from_arrays(path, z, rates, n_ticks=ticks))
    return missions


@pytest.mark.slow  # NUTS on parameters and trust
@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")  # by odd missions
def test_odd_rates_move_the_parameters_little():
    missions = missions_with_odd_rates()
    fits = {
        name: fit(missions, PooledTrust(observation=name)) for name in ("gaussian", "student_t")
    }
    assert fits["student_t"].attrs["sampler"] == "joint"
    draws = fits["student_t"]["posterior"]
    for name in ("beta0", "b", "delta_w"):
        assert abs(draws[name].mean() - TRUTH[name]) < 3.0 * draws[name].std()
    off = {o: abs(float(of["posterior"]["delta_v"].mean()) - 0.03) for o, of in fits.items()}
    assert off["student_t"] < 0.3 * off["gaussian"]
    assert az.compare(fits).loc["gaussian", "elpd_diff"] < -30.0


def test_the_exact_sampler_says_why_it_cannot():
    model = PooledTrust(observation="student_t")
    with pytest.raises(tb.TrustboError, match="expectation propagation does not know its observ"):
        fit(missions_with_odd_rates()[:2], model, "exact")
