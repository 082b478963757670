"""Twenty missions, one after the other: refitting, and passing on moments, against long NUTS.

Run: python benchmarks/updating.py [-n 20] [--quick]
"""

from dataclasses import replace

import jax
import numpy as np
from common import Table, arguments, parsed

from trustbo.data import Mission
from trustbo.inference import fit, params_of, sample_statistics
from trustbo.inference.updating import moment_matched, update_statistics
from trustbo.models import PooledTrust, TrustParams

TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
CHECKED = (1, 2, 5, 10, 15, 20)


def simulate(n_missions, seed):
    z = np.random.default_rng(seed).uniform(size=(n_missions, 10, 3, 2))
    rates = PooledTrust().simulate(jax.random.key(seed), TRUTH, z).contact_rate
    path = [(0, k) for k in range(11)]
    return [
        Mission.from_arrays(path, a, np.clip(b, 0.0, 1.0)) for a, b in zip(z, rates, strict=True)
    ]


def columns(params):
    p = params.flat()
    return np.column_stack([p.beta0, p.beta, p.b, p.delta_w, p.delta_v])


def main():
    given = parsed(arguments(__doc__, n=20, quick="2 missions"))
    n_missions = 2 if given.quick else given.n
    model, statistics, priors = PooledTrust(), None, PooledTrust().priors
    missions = simulate(n_missions, seed=0)
    print("mean error in posterior sd (worst parameter), and sd ratio (least, greatest)")
    table = Table("missions", "refit, exact sampler", "moments passed on")
    worst = {"refit": [0.0, 1.0, 1.0], "moments": [0.0, 1.0, 1.0]}
    for j, mission in enumerate(missions, start=1):
        statistics = update_statistics(model, statistics, [mission])
        refit = columns(sample_statistics(model, statistics, seed=j).params)
        passed_on = fit([mission], replace(model, priors=priors), "exact", seed=j)
        priors = moment_matched(params_of(passed_on), model.priors)
        if j not in CHECKED and j != n_missions:
            continue
        long = fit(missions[:j], model, "nuts", seed=j, n_draws=10_000)
        reference = columns(params_of(long))
        cells = []
        for name, draws in (("refit", refit), ("moments", columns(params_of(passed_on)))):
            error = np.abs(draws.mean(0) - reference.mean(0)) / reference.std(0)
            ratio = draws.std(0) / reference.std(0)
            cells.append(f"{error.max():.3f} ({ratio.min():.3f}, {ratio.max():.3f})")
            kept = worst[name]
            worst[name] = [
                max(kept[0], error.max()),
                min(kept[1], ratio.min()),
                max(kept[2], ratio.max()),
            ]
        table.row(j, *cells)
    for name, (error, least, greatest) in worst.items():
        print(f"{name}: worst mean error {error:.3f} sd, sd ratio {least:.3f} to {greatest:.3f}")
    print("target for refit: mean error <= 0.06 sd, sd ratio 0.95 to 1.05")


if __name__ == "__main__":
    main()
