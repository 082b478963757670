"""Simulation-based calibration of models, families and effects; prints the table of the docs.

    python benchmarks/sbc.py [row ...] --sets 200 --jobs 16

Data sets are simulated from the prior, and each true parameter is ranked among posterior draws
(Talts et al. 2018). If prior, likelihood and sampler are consistent, the ranks are uniform. Each
row of the table is a model. Its missions are random walks on a small grid, with missing rates. The
ranks of each parameter are tested for uniformity. A row shows the number of parameters for which
uniformity is rejected at the 1 % level, after Holm's correction for all tests. To check your own
model, add a row to `ROWS`.
"""

import numpy as np
import pandas as pd
from common import Table, arguments, parsed
from groups import holm
from joblib import Parallel, delayed
from scipy import stats
from tqdm import tqdm

import trustbo as tb
from trustbo.inference.class_sampling import by_importance
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.classes import OfClass
from trustbo.inference.density import JointDraws
from trustbo.inference.latent import replicate
from trustbo.inference.variables import to_variables
from trustbo.inference.weights import MAX_KHAT
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    HumanTrust,
    PlaceEffect,
    PooledTrust,
    RobotEffect,
)

LEVEL = 0.01  # significance level, for all tests together
N_RANKED = 399  # number of draws among which a true parameter is ranked
PART = 10  # number of data sets per task of a process
EFFECTS = (PlaceEffect(), RobotEffect())
ROWS = {
    "pooled": PooledTrust(),
    "pooled, deviations": PooledTrust(memory="deviation"),
    "pooled, shared noise": PooledTrust(shared_noise=True),
    "pooled, places and robots": PooledTrust(effects=EFFECTS),
    "pooled, all": PooledTrust(shared_noise=True, effects=EFFECTS),
    "hierarchical, robots": HierarchicalTrust(effects=(RobotEffect(),)),
    "coupled": CoupledTrust(),
    "coupled, robots": CoupledTrust(effects=(RobotEffect(),)),
    "censored, robots": PooledTrust(family="censored", effects=(RobotEffect(),)),
    "censored, places": PooledTrust(family="censored", effects=(PlaceEffect(),)),
    "counts": PooledTrust(family="beta_binomial"),
    "likert7": HumanTrust(scale="likert7"),
}


def walks(n_missions=4, n_bounds=6, n_robots=2, size=4):
    """Make missions on random walks; `rank` replaces their rates."""
    rng, missions = np.random.default_rng(0), []
    for _ in range(n_missions):
        path = [tuple(rng.integers(size, size=2).tolist())]
        while len(path) <= n_bounds:
            step = np.array(path[-1]) + rng.integers(-1, 2, size=2)
            if (step >= 0).all() and (step < size).all() and tuple(step.tolist()) != path[-1]:
                path.append(tuple(step.tolist()))
        z, y = rng.uniform(size=(n_bounds, n_robots, 2)), np.full((n_bounds, n_robots), 0.5)
        y[rng.integers(n_bounds), rng.integers(n_robots)] = np.nan
        ticks, features = np.full(y.shape, 40.0), ["line_of_sight", "slope"]
        missions.append(tb.Mission.from_arrays(path, z, y, n_ticks=ticks, features=features))
    return missions


def people(n_persons=10, n_steps=5):
    """Make reports of persons who see successes and failures; `rank` replaces the reports."""
    rng, persons = np.random.default_rng(0), []
    for _ in range(n_persons):
        z = rng.uniform(size=(n_steps, 1, 2))
        y, ticks = np.full((n_steps, 1), 0.5), np.full((n_steps, 1), 6.0)
        features = ["success", "failure"]
        persons.append(tb.Mission.from_arrays(None, z, y, n_ticks=ticks, features=features))
    return persons


def rank(model, missions, n, seed, n_ranked=N_RANKED):
    """Compute the ranks (data set, parameter) of n data sets, and the number of rejected fits.

    Measured rates are replaced by simulated rates; Gaussian rates are not clipped to [0, 1].
    """
    model = model.for_features(missions[0].features)
    observations = model.observations(missions)
    before, measured, ranks = (
        ClassTarget(model, observations),
        ~np.isnan(observations.contact_rate),
        [],
    )
    for j in range(n):
        rng = np.random.default_rng([seed, j])
        truth = draw_prior(before, rng)
        rates = np.where(measured, replicate(OfClass(before, truth), rng)[0], np.nan)
        posterior = ClassTarget(model, observations._replace(contact_rate=rates))
        drawn, _, summary = by_importance(posterior, n_ranked, int(rng.integers(2**31)))
        if summary["k_hat"] <= MAX_KHAT:
            found, true = (numbers(to_variables(posterior, d)) for d in (drawn, truth))
            ranks.append({name: int((found[name] < true[name][0]).sum()) for name in found})
    return pd.DataFrame(ranks), n - len(ranks)


def draw_prior(density, rng):
    """Draw the hyperparameters and coefficients once from the prior."""
    theta = density.model.theta(density.scores.draw(1, rng), density.observations.resolution)
    return JointDraws(theta, density.columns.prior(theta).draw(rng))


def numbers(groups):
    """Return the draws of all parameters, and of the first and last element of each effect."""
    found = {}
    for group, variables in groups.items():
        for name, values in variables.items():
            flat = values.reshape(len(values), -1)
            columns = range(flat.shape[1])
            if group != "posterior":
                columns = sorted({0, flat.shape[1] - 1})
            found |= {label(name, values, i): flat[:, i] for i in columns}
    return {n: v for n, v in found.items() if len(v) == 1 or np.ptp(v) > 0.0}


def label(name, values, i):
    """Return the name of element i of a variable."""
    if values.ndim == 1:
        return name
    return f"{name}[{','.join(map(str, np.unravel_index(i, values.shape[1:])))}]"


def uniformity(ranks, n_ranked):
    """Compute the p-value of a chi-squared test of uniformity, with nearly equal bins."""
    n_bins = min(20, max(2, len(ranks) // 5))  # the test needs five ranks per bin
    edges = np.linspace(0, n_ranked + 1, n_bins + 1).astype(int)
    counts, _ = np.histogram(ranks, edges - 0.5)
    expected = len(ranks) * np.diff(edges) / (n_ranked + 1)
    return float(stats.chisquare(counts, expected).pvalue)


def part_of(name, n, seed):
    """Compute the ranks of some data sets of a row; runs in a worker process."""
    model = ROWS[name]
    return rank(model, people() if isinstance(model, HumanTrust) else walks(), n, seed)


def main():
    """Compute the ranks in parallel, and print one row for each model."""
    parser = arguments(__doc__ or "", names=ROWS)
    parser.add_argument("--sets", type=int, default=200, help="data sets per row (default 200)")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default 1)")
    given = parsed(parser)
    names = list(given.names)

    parts = -(-given.sets // PART)
    sizes = [min(PART, given.sets - PART * i) for i in range(parts)]
    tasks = [(name, n, seed) for name in names for seed, n in enumerate(sizes)]
    done = Parallel(given.jobs, return_as="generator")(delayed(part_of)(*task) for task in tasks)
    done = list(tqdm(done, total=len(tasks), desc="parts"))
    tests = {}
    for i, name in enumerate(names):
        ranks, refused = zip(*done[i * parts : (i + 1) * parts], strict=True)
        tests[name] = pd.concat(ranks), sum(refused)

    p = [uniformity(r, N_RANKED) for ranks, _ in tests.values() for r in ranks.to_numpy().T]
    adjusted, first = holm(p), 0
    table = Table(
        "row",
        "sets",
        "refused",
        "parameters",
        "least p",
        "of",
        "rejected",
        "50 %",
        "90 %",
        name="sbc",
    )
    for name, (ranks, refused) in tests.items():
        of_row = slice(first, first := first + ranks.shape[1])
        if not ranks.size:
            table.row(name, given.sets, refused, 0, "", "", "", "", "")
            continue
        least = int(np.argmin(p[of_row]))
        off = abs((ranks.to_numpy() + 0.5) / (N_RANKED + 1) - 0.5)
        table.row(
            name, given.sets, refused, ranks.shape[1], f"{p[of_row][least]:.4f}",
            ranks.columns[least], int((adjusted[of_row] < LEVEL).sum()),
            f"{(off < 0.25).mean():.1%}", f"{(off < 0.45).mean():.1%}",
        )  # fmt: skip


if __name__ == "__main__":
    main()
