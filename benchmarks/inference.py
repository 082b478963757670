"""CPU time, effective draws and memory of fits, compared with NUTS of other libraries.

    python benchmarks/inference.py [fits] [nuts] [paper] [memory] [busy] [filter]

`fits`: CPU time of fits of the default model to 3, 15, 60 and 200 missions, and of fits with shared
noise, with censored rates, with counts of ticks and of `CoupledTrust`. --only selects fits by name.
A `later` fit starts from the posterior of the fit to one mission fewer, as in a campaign. The first
fit of the process, to 3 missions, has its own row. Missions are on different random paths, or on 10
paths, as in a campaign that repeats its paths.
`nuts`: CPU time of `sampler="nuts"` for the default model and eight missions, with compilation, and
the difference of the means from those of importance sampling.
`accuracy`: errors of the posterior means of fits with 10 x --seeds seeds, in posterior standard
deviations. The means are compared with those of a run with over 20 000 points, for 3, 8 and 15
missions of `trustbo demo`.
`paper`: effective draws and CPU seconds for the paper's model and 600 rates. The peers are
`MCMC(NUTS(model.program))`, the same program with latent trust sampled, the likelihood of dynamax,
and PyMC with nutpie. All samplers use the same seeds, run one after another, and have run once
before. The effective size is the smaller of the sizes for beta0 and delta_w. There are two data
sets. The rates of `missions` have no memory, so they determine delta_w^2 + delta_v^2 but say little
about delta_w and delta_v separately. The other rates are simulated from the model with beta0 = 0.6.
All peers together take some 30 minutes of CPU time; set NPROC=1 to run JAX in one thread.
`memory`: bytes of a posterior of 60 missions on random paths, with all groups and with the
parameters alone, and of the parameters after 60 missions on 10 paths, as a campaign keeps them
after each mission. Also bytes that a campaign of `trustbo demo` keeps per mission, missions 11 to
40, in memory and with a folder.
`busy`: wall time of a fit to 60 missions with all groups, alone and beside two processes that
always compute. If three processes share two cores fairly, the ratio is 1.5.
`filter`: time to update the filter with one bound of three robots, with 1000 draws.

The peers are installed by `pip install trustbo[bench]`; a peer that is missing is left out.
"""

import gc
import subprocess
import sys
import tempfile
import time
import tracemalloc
from importlib import import_module

import numpy as np
from arviz_stats import sampling_diagnostics
from common import Table, arguments, parsed

import trustbo as tb
from trustbo.inference import TrustFilter, importance, sample_prior
from trustbo.inference.class_target import ClassTarget
from trustbo.inference.diagnostics import diagnostics
from trustbo.inference.modes import at_modes
from trustbo.inference.tree import parameters_alone
from trustbo.models import CoupledTrust, PlaceEffect, PooledTrust, Priors, RobotEffect
from trustbo.models.backend import own_settings

EFFECTS = (PlaceEffect(), RobotEffect())

DEFAULT = PooledTrust(effects=EFFECTS)
SHARED = PooledTrust(effects=EFFECTS, shared_noise=True)
CENSORED = PooledTrust(effects=EFFECTS, family="censored")
COUNTS = PooledTrust(effects=EFFECTS, family="beta_binomial")
COUPLED = CoupledTrust(effects=(RobotEffect(),))

FITS = {
    "default model, 3 missions": (3, DEFAULT, None),
    "default model, 15 missions": (15, DEFAULT, None),
    "default model, 60 missions": (60, DEFAULT, None),
    "default model, 200 missions": (200, DEFAULT, None),
    "default model, 15 missions on 10 paths": (15, DEFAULT, 10),
    "default model, 60 missions on 10 paths": (60, DEFAULT, 10),
    "default model, 200 missions on 10 paths": (200, DEFAULT, 10),
    "shared noise, 15 missions": (15, SHARED, None),
    "censored rates, 15 missions": (15, CENSORED, None),
    "counts of ticks, 15 missions": (15, COUNTS, None),
    "censored rates, 60 missions": (60, CENSORED, None),
    "counts of ticks, 60 missions": (60, COUNTS, None),
    "CoupledTrust with robot effects, 15 missions": (15, COUPLED, None),
}
"""Number of missions, model, and number of paths (None if all differ), by name."""

N_TICKS = 40
"""Number of ticks of each rate, if ticks are counted."""

NAMES = ("beta0", "delta_w")
"""Parameters whose draws and means are compared in `paper`."""


def missions(n, n_bounds=10, size=10, limit=False, seed=0, n_paths=None, n_ticks=None):
    """Simulate missions of three robots on random walks, which repeat after `n_paths` missions."""
    rng, found = np.random.default_rng(seed), []
    for j in range(n):
        path = [tuple(rng.integers(size, size=2).tolist())]
        if n_paths is not None and j >= n_paths:
            path = list(found[j % n_paths].path)
        while len(path) <= n_bounds:
            step = np.array(path[-1]) + rng.integers(-1, 2, size=2)
            if (step >= 0).all() and (step < size).all() and tuple(step.tolist()) != path[-1]:
                path.append(tuple(step.tolist()))
        z = rng.uniform(size=(n_bounds, 3, 2))
        y = 0.2 + 0.5 * z[..., 0] + 0.1 * z[..., 1] + 0.08 * rng.standard_normal((n_bounds, 3))
        y = np.clip(1.6 * y - 0.3 if limit else y, 0.0, 1.0)
        if n_ticks is not None:
            y = np.round(n_ticks * y) / n_ticks
        features = ["line_of_sight", "slope"]
        found.append(tb.Mission.from_arrays(path, z, y, features=features, n_ticks=n_ticks))
    return found


def missions_with_memory(n, seed=1):
    """Simulate the paper's model along the paths of `missions`, with beta0 = 0.6."""
    rng = np.random.default_rng(seed)
    found = []
    for mission in missions(n):
        trust = np.full(3, 0.5)
        rates = []
        for z in mission.awareness:
            trust = 0.6 * trust + 0.1 + z @ [0.25, 0.05] + 0.06 * rng.standard_normal(3)
            rates.append(trust + 0.06 * rng.standard_normal(3))
        y = np.clip(rates, 0.0, 1.0)
        features = ["line_of_sight", "slope"]
        found.append(tb.Mission.from_arrays(mission.path, mission.awareness, y, features=features))
    return found


def timed_fits(given):
    """Print the CPU time of fits without predictions, first and later in a campaign."""
    columns = "fit", "CPU s, median", "least", "most", "kish", "ms per effective point", "k-hat"
    table = Table(*columns, first=40, name="fits")
    one_case(table, "default model, 3 missions", 1, label="first fit of the process")
    for name in given.only or FITS:
        one_case(table, name, given.seeds)
        if FITS[name][1] is DEFAULT:
            one_case(table, name, given.seeds, later=True)


def one_case(table, name, n_seeds, later=False, label=""):
    """Add the row of a fit; if `later`, it starts from the posterior of one mission fewer."""
    n, model, n_paths = FITS[name]
    n_ticks = N_TICKS if model is COUNTS else None
    data = missions(n, limit=model is CENSORED, n_paths=n_paths, n_ticks=n_ticks)
    options = {"latent": False, "check": False}
    if later:
        options["start"] = tb.fit(data[:-1], model, **options)

    seconds, kish, k_hat = [], [], []
    for seed in range(n_seeds):
        started = time.process_time()
        fitted = tb.fit(data, model, seed=seed, **options)
        seconds.append(time.process_time() - started)
        kish.append(fitted.attrs["kish"])
        k_hat.append(fitted.attrs["k_hat"])

    per_point = 1e3 * np.median(np.divide(seconds, kish))
    table.row(
        label or name + ", later" * later, f"{np.median(seconds):.2f}", f"{min(seconds):.2f}",
        f"{max(seconds):.2f}", f"{np.median(kish):.0f}", f"{per_point:.1f}", f"{max(k_hat):.2f}",
    )  # fmt: skip


def nuts(given):
    """Print CPU time and error of NUTS for the default model and eight missions."""
    data, model = missions(8), PooledTrust(effects=EFFECTS)
    exact = tb.fit(data, model, draws=4000, latent=False)["posterior"].to_dataset()
    started = time.process_time()
    chains = tb.fit(data, model, sampler="nuts", latent=False, check=False, progress=False)
    seconds, over = time.process_time() - started, ("chain", "draw")
    off = abs(chains["posterior"].to_dataset().mean(over) - exact.mean(over)) / exact.std(over)
    worst = max(float(values.max()) for values in off.data_vars.values())
    print(f"NUTS, 4 x (300 + 1000): {seconds:.0f} s, {diagnostics(chains)}, off by {worst:.3f} sd")


def accuracy(given):
    """Print errors of the means of parameters in fits of few missions with little noise."""
    table = Table(
        "missions of the demo", "rms error", "largest rms error", "of", "largest bias", "of",
        "CPU s, median", "kish", "k-hat", "largest", name="fits_accuracy",
    )  # fmt: skip
    data = hillside(15)
    for n in 3, 8, 15:
        mean, sd = long_run(data[:n])
        found, seconds, attrs = [], [], []
        for seed in range(10 * given.seeds):
            started = time.process_time()
            fitted = tb.fit(data[:n], seed=seed, latent=False, check=False, progress=False)
            seconds.append(time.process_time() - started)
            attrs.append((fitted.attrs["kish"], fitted.attrs["k_hat"]))
            draws = fitted["posterior"]
            found.append([float(draws[name].mean()) for name in mean])

        off = (np.array(found) - list(mean.values())) / list(sd.values())
        rms, bias, names = np.sqrt((off**2).mean(0)), np.abs(off.mean(0)), list(mean)
        kish, k_hat = np.array(attrs).T
        table.row(
            n, f"{np.sqrt((off**2).mean()):.3f}", f"{rms.max():.3f}", names[rms.argmax()],
            f"{bias.max():.3f}", names[bias.argmax()], f"{np.median(seconds):.2f}",
            f"{np.median(kish):.0f}", f"{np.median(k_hat):.2f}", f"{k_hat.max():.2f}",
        )  # fmt: skip


def hillside(n):
    """Drive the first n missions of the campaign of `trustbo demo`."""
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10))
    result = tb.iterate(workspace, (9, 0), (0, 9), n_iterations=n, seed=0, progress=False)
    return list(result.missions)


def long_run(data):
    """Return means and standard deviations of the hyperparameters by name, from many points."""
    model = tb.models.default_model().for_features(data[0].features)
    posterior = ClassTarget(model, model.observations(data))
    origin = at_modes(posterior.log_density, posterior.start()[None])
    points = importance.sample(
        posterior.log_density, origin, np.random.default_rng(0), size=4096, enough=10_000.0,
        defensive=posterior.defensive,
    ).points  # fmt: skip
    values = posterior.theta(points.x)
    names = [name for name in posterior.scores.priors if name in values]
    mean = {name: points.weight @ values[name] for name in names}
    sd = {name: np.sqrt(points.weight @ (values[name] - mean[name]) ** 2) for name in names}
    print(f"long run: {len(points.x)} points, kish {points.kish:.0f}, k-hat {points.k_hat:.2f}")
    return mean, sd


def paper(given):
    """Print effective draws, CPU seconds and means of the paper's model, also of the peers."""
    print("rates without memory")
    compared(missions(20), given.seeds)
    print("rates with memory")
    compared(missions_with_memory(20), given.seeds)


@own_settings()
def compared(data, n_seeds):
    """Print a row for each sampler and seed, then a table of medians and worst seeds."""
    runs = {}
    for name, sample in compiled_samplers(data):
        runs[name] = []
        print(f"{name}, seed: effective size, CPU seconds, divergences, means of", *NAMES)
        for seed in range(n_seeds):
            started = time.process_time()
            draws, n_divergent = sample(seed)
            seconds = time.process_time() - started
            size = effective_size(draws)
            means = [float(draws[n].mean()) for n in NAMES]
            runs[name].append((size, seconds, n_divergent, *means))
            print(f"{name}, {seed}: {size:.0f}, {seconds:.2f}, {n_divergent}, {means}", flush=True)

    columns = (
        "sampler", "effective size", "worst", "CPU s", "worst", "effective draws per s", "worst",
        "divergences, worst", *(f"{what} of {n}" for n in NAMES for what in ("mean", "range")),
    )  # fmt: skip
    table = Table(*columns, first=40, name="fits_peers")
    for name, found in runs.items():
        size, seconds, n_divergent, *means = np.array(found).T
        rate = size / seconds
        of_means = []
        for mean in means:
            of_means += [f"{np.median(mean):.3f}", f"{mean.min():.3f} to {mean.max():.3f}"]
        table.row(
            name, f"{np.median(size):.0f}", f"{size.min():.0f}",
            f"{np.median(seconds):.2f}", f"{seconds.max():.2f}",
            f"{np.median(rate):.0f}", f"{rate.min():.0f}",
            f"{n_divergent.max():.0f}", *of_means,
        )  # fmt: skip


def effective_size(draws):
    """Smaller effective size of the two parameters; for weighted points, at most `kish`."""
    sizes = [float(sampling_diagnostics.ess(draws[n])) for n in NAMES]
    return min(*sizes, draws.get("kish", np.inf))


def compiled_samplers(data):
    """Yield names and samplers of the paper's model: the peers that are installed, then ours.

    Each sampler is compiled when it is asked for, and has run once. Some peers change settings of
    JAX, after which a sampler of NumPyro that was compiled before fails.
    """
    # With explicit priors, as the default priors for line of sight are not those of the peers.
    model = PooledTrust(priors=Priors()).for_features(["line_of_sight", "slope"])
    z, y = (np.stack([getattr(m, name) for m in data]) for name in ("awareness", "contact_rate"))

    peers = {
        "numpyro_nuts": (model, data),
        "numpyro_latent": (z, y),
        "dynamax_lgssm": (z, y),
        "pymc_nutpie": (z, y),
    }
    for name, inputs in peers.items():
        try:
            peer = import_module(f"peers.{name}")
        except ImportError as error:
            print(f"{name}: skipped, {error}")
            continue

        started = time.process_time()
        found = peer.samplers(*inputs)
        seconds = time.process_time() - started
        print(f"{name}: compiled and run once in {seconds:.0f} s", flush=True)
        yield from found.items()

    def ours(seed):
        fitted = tb.fit(data, model, seed=seed, latent=False)
        draws = {name: fitted["posterior"][name].to_numpy() for name in NAMES}
        return {**draws, "kish": fitted.attrs["kish"]}, 0

    ours(10_000)
    yield "trustbo, importance sampling", ours


def memory(given):
    """Print the bytes of a posterior of 60 missions, whole and without what grows with missions."""
    fitted = tb.fit(missions(60), DEFAULT, check=False)
    table = Table("posterior of 60 missions", "MB", first=40, name="fits_memory")
    for name, group in fitted.children.items():
        table.row(f"group {name}", f"{group.nbytes / 1e6:.2f}")
    table.row("all groups", f"{fitted.nbytes / 1e6:.2f}")
    table.row("parameters alone", f"{parameters_alone(fitted).nbytes / 1e6:.2f}")

    options = {"draws": 250, "latent": False, "check": False}
    repeated = tb.fit(missions(60, n_paths=10), DEFAULT, **options)
    table.row("parameters, 10 paths", f"{parameters_alone(repeated).nbytes / 1e6:.2f}")

    with tempfile.TemporaryDirectory() as folder:
        for directory in None, folder:
            where = "with a folder" if directory else "in memory"
            table.row(f"campaign, per mission, {where}", f"{kept_per_mission(directory):.2f}")


def kept_per_mission(directory):
    """MB that a campaign adds to the memory of Python per mission, from mission 11 to 40."""
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10))
    campaign = tb.Campaign(workspace, (9, 0), (0, 9), directory=directory, progress=False)
    sizes = []
    tracemalloc.start()
    with campaign:
        for n in 10, 40:
            for _ in campaign.run(n_iterations=n):
                pass
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    return (sizes[1] - sizes[0]) / 30e6


def busy(given):
    """Print the wall time of a fit alone and beside two processes that always compute."""
    data = missions(60)
    tb.fit(missions(3), DEFAULT, check=False)
    spin = [sys.executable, "-c", "while True: pass"]
    alone, beside = [], []
    for seed in range(given.seeds):
        alone.append(wall_and_cpu(data, seed))
        others = [subprocess.Popen(spin) for _ in range(2)]
        try:
            beside.append(wall_and_cpu(data, seed))
        finally:
            for other in others:
                other.kill()
                other.wait()

    table = Table("60 missions, all groups", "wall s, median", "CPU s, median", first=40)
    for name, seconds in {"alone": alone, "beside two busy processes": beside}.items():
        table.row(name, *(f"{value:.1f}" for value in np.median(seconds, axis=0)))
    ratios = np.divide(beside, alone)[:, 0]
    print(f"ratio of wall times: median {np.median(ratios):.1f}, worst {ratios.max():.1f}")


def wall_and_cpu(data, seed):
    """Seconds of wall and processor of a fit with all groups."""
    started = time.perf_counter(), time.process_time()
    tb.fit(data, DEFAULT, seed=seed, check=False, progress=False)
    return time.perf_counter() - started[0], time.process_time() - started[1]


def one_bound(given):
    """Print the shortest time that the filter needs for one bound."""
    live = TrustFilter(sample_prior(PooledTrust(), 2, 1000, 0), 3)
    z, y, seconds = np.full((3, 2), 0.5), [0.5, 0.6, 0.7], []
    for _ in range(300):
        started = time.perf_counter()
        live.update(z, y)
        seconds.append(time.perf_counter() - started)
    print(f"TrustFilter, one bound: {1000.0 * min(seconds):.2f} ms")


PARTS = {
    "fits": timed_fits,
    "nuts": nuts,
    "accuracy": accuracy,
    "paper": paper,
    "memory": memory,
    "busy": busy,
    "filter": one_bound,
}


def main():
    parser = arguments(__doc__, names=PARTS, seeds=5)
    parser.add_argument("--only", action="append", choices=FITS, help="fit to time, by name")
    given = parsed(parser)
    for part in given.names:
        PARTS[part](given)


if __name__ == "__main__":
    main()
