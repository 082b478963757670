"""Does NUTS recover known parameters? Coverage of 95 % intervals over simulated campaigns.

Run: python benchmarks/recovery.py [-n 20] [--quick]

Truths are drawn at random, each campaign is 8 missions of 11 bounds with 3 robots. Trust before
the first bound is N(0.5, 0.1^2), so that contact rates stay in [0, 1] without being cut there,
which the Gaussian model does not know of; a draw with a rate outside is drawn again.
"""

import jax
import numpy as np
from common import Table, arguments, parsed

from trustbo import Mission
from trustbo.inference import diagnostics, fit, params_of
from trustbo.models import PooledTrust, Priors, TrustParams

N_MISSIONS, N_BOUNDS, N_ROBOTS = 8, 11, 3


def draw_truth(rng):
    beta0, beta = rng.uniform(0.3, 0.8), rng.normal(0.0, 0.15, 2)
    b = 0.5 * (1.0 - beta0) - 0.5 * beta.sum()  # level 1/2 at average awareness
    return TrustParams(beta0, beta, b, *rng.uniform(0.02, 0.06, 2), 0.5, 0.1)


def simulate_campaign(rng, model):
    while True:
        truth = draw_truth(rng)
        z = rng.uniform(size=(N_MISSIONS, N_BOUNDS, N_ROBOTS, 2))
        key = jax.random.key(int(rng.integers(2**31)))
        rates = model.simulate(key, truth, z).contact_rate
        if (rates >= 0.0).all() and (rates <= 1.0).all():
            path = [(0, k) for k in range(N_BOUNDS + 1)]
            return truth, [Mission.from_arrays(path, *pair) for pair in zip(z, rates, strict=True)]


def main():
    given = parsed(arguments(__doc__, n=20, quick="2 campaigns"))
    n_campaigns = 2 if given.quick else given.n
    rng = np.random.default_rng(0)
    model = PooledTrust(Priors(x0_sd=0.1))
    inside = {name: [] for name in ("beta0", "beta[0]", "beta[1]", "b", "delta_w", "delta_v")}
    worst = {"r_hat": 0.0, "ess_bulk": np.inf}
    for campaign in range(n_campaigns):
        truth, missions = simulate_campaign(rng, model)
        posterior = fit(missions, model, "nuts", seed=campaign)
        results = diagnostics(posterior)
        worst["r_hat"] = max(worst["r_hat"], results["r_hat"])
        worst["ess_bulk"] = min(worst["ess_bulk"], results["ess_bulk"])
        draws = params_of(posterior)
        pairs = {
            "beta0": (draws.beta0, truth.beta0),
            "beta[0]": (draws.beta[:, 0], truth.beta[0]),
            "beta[1]": (draws.beta[:, 1], truth.beta[1]),
            "b": (draws.b, truth.b),
            "delta_w": (draws.delta_w, truth.delta_w),
            "delta_v": (draws.delta_v, truth.delta_v),
        }
        for name, (values, true) in pairs.items():
            low, high = np.percentile(values, [2.5, 97.5])
            inside[name].append(low <= true <= high)
    print(f"{n_campaigns} simulated campaigns; truth inside the 95 % interval:")
    table = Table("parameter", "inside", "share", first=8)
    for name, hits in inside.items():
        table.row(name, f"{sum(hits)} of {n_campaigns}", f"{np.mean(hits):.0%}")
    table.row("all", "", f"{np.mean(list(inside.values())):.1%}")
    print(f"worst R-hat {worst['r_hat']:.4f}, smallest bulk ESS {worst['ess_bulk']:.0f} of 4000")


if __name__ == "__main__":
    main()
