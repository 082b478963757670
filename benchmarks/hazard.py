"""Accuracy of hazard posteriors, compared with tempered sequential Monte Carlo.

    python benchmarks/hazard.py --sets 100 --particles 4096

In each simulated data set, 15 missions cross 10 of 80 bounds. In every third mission, the place of
a failure is unknown. In half of the data sets, the true slope limit is 4 degrees below the stated
limit. The script compares the default prior of the margin with a single wide normal distribution.
For each prior, it prints how many posterior means are off by more than .2 prior sds although k-hat
is accepted, and how many posteriors are rejected.
"""

import itertools
import time
from collections import Counter

import numpy as np
from common import Table, arguments, parsed
from scipy import special

from trustbo.hazard import Hazard
from trustbo.hazard.model import sample
from trustbo.hazard.trials import Trials

MEASURES = ("untraversable", "tilt", "narrowness", "tightness")
PRIORS = {"mixture (default)": Hazard(), "N(1, 4^2)": Hazard(margin=(1.0, 4.0), limit="measured")}
LIMIT, N_BOUNDS, MOVES = np.deg2rad(22.0), 80, 8


def simulate(seed):
    """Simulate the difficulty (bound, measure) and the trials of one data set."""
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
    return difficulty, Trials(bounds, n, failed, tuple(lost))


def log_likelihood(prior, trials, z):
    """Compute the exact log likelihood of scores, with inclusion-exclusion for lost missions."""
    alpha, beta = prior.betas(z)
    a, b = alpha + trials.failed, beta + trials.n - trials.failed
    met = trials.n > 0.0
    log_p = (special.betaln(a, b) - special.betaln(alpha, beta))[:, met].sum(1)
    all_fail = np.zeros(len(z))
    for chosen in itertools.product([0, 1], repeat=len(trials.lost)):
        paths = [path for path, taken in zip(trials.lost, chosen, strict=True) if taken]
        survived = np.ones(len(z))
        for e, count in Counter(np.concatenate([[], *paths]).astype(int)).items():
            for i in range(count):
                survived *= (b[:, e] + i) / (a[:, e] + b[:, e] + i)
        all_fail += (-1) ** sum(chosen) * survived
    return log_p + np.log(np.maximum(all_fail, 1e-300))


def reference(prior, trials, n, seed):
    """Compute the posterior mean of the scores by tempered sequential Monte Carlo."""
    rng, d = np.random.default_rng(seed), len(prior.center)
    z, power = rng.standard_normal((n, d)), 0.0
    log_l = log_likelihood(prior, trials, z)
    while power < 1.0:

        def too_far(step, log_l=log_l):
            weight = special.softmax(step * log_l)
            return 1.0 / (weight**2).sum() < 0.5 * n

        step = 1.0 - power
        if too_far(step):
            low, high = 0.0, step
            for _ in range(30):
                step = 0.5 * (low + high)
                low, high = (low, step) if too_far(step) else (step, high)
        power += step
        kept = rng.choice(n, n, p=special.softmax(step * log_l))
        z, log_l = z[kept], log_l[kept]
        factor = np.linalg.cholesky(np.cov(z.T) + 1e-6 * np.eye(d))
        for k in range(MOVES):
            width = (2.4 if k % 2 else 0.8) / np.sqrt(d)
            new = z + width * rng.standard_normal(z.shape) @ factor.T
            new_l = log_likelihood(prior, trials, new)
            ratio = power * (new_l - log_l) + 0.5 * (z**2 - new**2).sum(1)
            taken = np.log(rng.random(n)) < ratio
            z, log_l = np.where(taken[:, None], new, z), np.where(taken, new_l, log_l)
    return z.mean(0)


def main():
    """Print one row for each prior of the margin."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--particles", type=int, default=4096)
    given = parsed(parser)
    table = Table(
        "prior of the margin", "sets", "rejected", "largest k-hat", "off by > .2 prior sds",
        "largest", "median", "CPU s", name="hazard",
    )  # fmt: skip
    for name, hazard in PRIORS.items():
        rows = []
        for seed in range(given.sets):
            difficulty, trials = simulate(seed)
            prior = hazard.of_bounds(difficulty, MEASURES, LIMIT)
            started = time.process_time()
            points = sample(prior, trials, np.random.default_rng(seed))[0]
            seconds = time.process_time() - started
            expected = reference(prior, trials, given.particles, seed)
            off = np.abs(points.weight @ points.x - expected).max()
            rows.append((off, points.k_hat, seconds))
        off, k_hat, seconds = np.array(rows).T
        refused = k_hat > 0.7
        table.row(
            name, given.sets, refused.sum(), f"{k_hat.max():.2f}", ((off > 0.2) & ~refused).sum(),
            f"{off[~refused].max():.2f}", f"{np.median(off):.3f}", f"{np.median(seconds):.2f}",
        )  # fmt: skip


if __name__ == "__main__":
    main()
