"""Refusals, CPU time and effective draws of `sampler="nuts"` on the example hillside.

    python benchmarks/nuts.py [3] [8] [15] [--seeds 10]

The missions are those of a greedy campaign with the default model, as in `trustbo demo`. For each
number of missions, the default model is fitted by NUTS with all seeds in one process. The table
shows the number of fits that the diagnostics of `fit` refuse, and the worst R-hat, the smallest ESS
and the number of divergences over all fits. It also shows the CPU time of the first fit, which
includes compilation, the median CPU time of later fits, and the CPU time per effective draw. The
last column is the largest difference between the posterior means over all fits and those of
importance sampling with eight times as many points as usual, in units of its Monte Carlo standard
error.
"""

import sys
import time

import numpy as np
from arviz_stats import sampling_diagnostics
from common import Table, arguments, parsed
from inference import hillside

import trustbo as tb
from trustbo.inference import importance
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.diagnostics import MAX_RHAT, MIN_ESS
from trustbo.inference.modes import at_modes

SIZES = "3", "8", "15"
OVER = "chain", "draw"
_N_POINTS = 2048  # importance points per round, eight times as many as in `fit`
_ENOUGH = 4000.0  # effective number of importance points


def main():
    """Print one row for each number of missions."""
    parser = arguments(__doc__, names=SIZES, seeds=10)
    given = parsed(parser)
    data = hillside(max(map(int, given.names)))
    table = Table(
        "missions", "refused", "R-hat", "ESS", "divergences", "steps per draw", "first, s",
        "later, s", "ms per effective draw", "difference, standard errors", name="nuts",
    )  # fmt: skip
    for name in given.names:
        table.row(name, *measured(data[: int(name)], given.seeds))


def measured(data, n_seeds):
    """Fit with each seed, and return the cells of a row."""
    attrs, cpu, steps, fits = [], [], [], []
    for seed in range(n_seeds):
        started = time.process_time()
        fitted = tb.fit(
            data, sampler="nuts", seed=seed, latent=False, check=False, progress=False
        )  # fmt: skip
        cpu.append(time.process_time() - started)
        attrs.append(fitted.attrs)
        steps.append(float(fitted["sample_stats"]["n_steps"].mean()))
        fits.append(scalars(fitted["posterior"].to_dataset()))
        print(f"  seed {seed}: {cpu[-1]:.1f} s, {attrs[-1]['ess_bulk']:.0f} ESS, "
              f"{attrs[-1]['divergences']} divergences", file=sys.stderr, flush=True)  # fmt: skip

    r_hat, ess, divergences = (
        np.array([one[name] for one in attrs]) for name in ("r_hat", "ess_bulk", "divergences")
    )
    refused = (r_hat > MAX_RHAT) | (ess < MIN_ESS) | (divergences > 0)
    later = np.median(cpu[1:]) if n_seeds > 1 else np.nan
    return (
        f"{refused.sum()} of {n_seeds}", f"{r_hat.max():.4f}", f"{ess.min():.0f}",
        int(divergences.sum()), f"{np.mean(steps):.1f}", f"{cpu[0]:.1f}", f"{later:.1f}",
        f"{1000.0 * np.median(cpu / ess):.1f}", f"{difference(data, fits):.1f}",
    )  # fmt: skip


def scalars(draws):
    """Select the hyperparameters, which are scalars."""
    return draws[[name for name in draws.data_vars if draws[name].ndim == 2]]


def difference(data, fits):
    """Compare the means of all fits with importance sampling; see the docstring of the script."""
    model = tb.models.default_model().for_features(data[0].features)
    posterior = ClassTarget(model, model.observations(data))
    rng = np.random.default_rng(0)
    origin = at_modes(posterior.log_density, posterior.start()[None])
    points = importance.sample(
        posterior.log_density, origin, rng, size=_N_POINTS, enough=_ENOUGH,
        defensive=posterior.defensive,
    ).points  # fmt: skip
    values = posterior.theta(points.x)

    largest = 0.0
    for name in fits[0].data_vars:
        if name not in values or values[name].ndim > 1:
            continue
        theirs = values[name]
        mean = points.weight @ theirs
        error = np.sqrt(points.weight**2 @ (theirs - mean) ** 2)

        ours = [float(draws[name].mean()) for draws in fits]
        sizes = [float(sampling_diagnostics.ess(draws[[name]])[name]) for draws in fits]
        errors = [
            float(draws[name].std()) / np.sqrt(size)
            for draws, size in zip(fits, sizes, strict=True)
        ]
        of_nuts = np.sqrt(np.sum(np.square(errors))) / len(errors)
        largest = max(largest, abs(np.mean(ours) - mean) / np.hypot(error, of_nuts))
    return largest


if __name__ == "__main__":
    main()
