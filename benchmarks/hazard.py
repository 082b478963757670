"""Hazard posteriors against weighted draws from the prior.

    python benchmarks/hazard.py --sets 100 --draws 1000000

In each simulated data set, 15 missions cross 10 of 80 bounds; every third one that fails is lost
somewhere unknown. In half of the sets the true slope limit is 4 degrees below the stated one. For
the default prior of the margin and for a single wide normal, the script prints how many posterior
means are off by more than .2 prior sds at an accepted k-hat, and how many posteriors are refused.
"""

import argparse
import time

import numpy as np
from scipy import special

from trustbo.hazard import Hazard
from trustbo.hazard.exposures import Exposures
from trustbo.hazard.model import sample

MEASURES = ("untraversable", "tilt", "narrowness", "tightness")
PRIORS = {"mixture (default)": Hazard(), "N(1, 4^2)": Hazard(margin=(1.0, 4.0), doubt=(0.0, 4.0))}
LIMIT, N_BOUNDS, CHUNK = np.deg2rad(22.0), 80, 1 << 14


def simulate(seed):
    """Difficulty (bound, measure) and exposures of one data set."""
    rng = np.random.default_rng(seed)
    difficulty = rng.uniform(0.0, 1.0, (N_BOUNDS, len(MEASURES)))
    steepness = np.rad2deg(np.arctan(difficulty[:, 1] * np.tan(LIMIT)) - LIMIT)
    margin = 4.0 * (seed % 2)
    passed = special.expit(5.0 - 4.0 * difficulty[:, 0]) * special.expit(-(steepness + margin))

    n, failed, lost = np.zeros(N_BOUNDS), np.zeros(N_BOUNDS), []
    for mission in range(15):
        path = rng.choice(N_BOUNDS, 10, replace=False)
        fails = np.flatnonzero(rng.random(10) > passed[path])
        if len(fails) and mission % 3 == 0:
            lost.append(path)
            continue
        done = path[: fails[0] + 1] if len(fails) else path
        n[done] += 1.0
        failed[path[fails[:1]]] += 1.0
    bounds = np.column_stack(
        [np.zeros(N_BOUNDS, int), np.arange(N_BOUNDS), np.zeros(N_BOUNDS, int)]
    )
    return difficulty, Exposures(bounds, n, failed, tuple(lost), np.zeros(5))


def reference(prior, exposures, n_draws, seed):
    """Posterior means of the scores by weighted prior draws, and their effective number."""
    rng, n, failed = np.random.default_rng(seed), exposures.n, exposures.failed
    drawn, log_weight = [], []
    for _ in range(n_draws // CHUNK):
        z = rng.standard_normal((CHUNK, len(prior.center)))
        alpha, beta = prior.betas(z)
        a, b = alpha + failed, beta + n - failed
        log_p = (special.betaln(a, b) - special.betaln(alpha, beta))[:, n > 0.0].sum(1)
        if exposures.lost:
            survival = 1.0 - rng.beta(a, b)
            fails = [1.0 - survival[:, path].prod(1) for path in exposures.lost]
            log_p += np.log(np.maximum(np.prod(fails, axis=0), 1e-300))
        drawn.append(z)
        log_weight.append(log_p)
    weight = special.softmax(np.concatenate(log_weight))
    return weight @ np.concatenate(drawn), 1.0 / (weight**2).sum()


def main():
    """Print one row for each prior of the margin."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--draws", type=int, default=1_000_000)
    given = parser.parse_args()
    for name, hazard in PRIORS.items():
        rows = []
        for seed in range(given.sets):
            difficulty, exposures = simulate(seed)
            prior = hazard.of_bounds(difficulty, MEASURES, LIMIT)
            started = time.process_time()
            points = sample(prior, exposures, np.random.default_rng(seed)).points
            seconds = time.process_time() - started
            expected, kish = reference(prior, exposures, given.draws, seed)
            off = np.abs(points.weight @ points.z - expected).max()
            rows.append((off, points.k_hat, kish, seconds))
        off, k_hat, kish, seconds = np.array(rows).T
        refused = k_hat > 0.7
        print(
            f"{name}: off by > .2 prior sds {((off > 0.2) & ~refused).sum()} of {given.sets}, "
            f"largest {off[~refused].max():.2f}, median {np.median(off):.3f}; "
            f"refused {refused.sum()}, largest k-hat {k_hat.max():.2f}; "
            f"{np.median(seconds):.2f} s; effective prior draws at least {kish.min():.0f}"
        )


if __name__ == "__main__":
    main()
