"""Models that are NumPyro functions: time, agreement with model classes, and calibration.

    python benchmarks/functions.py [campaign] [own_campaign] [as_default] [program] [samplers] [sbc]
        [--seeds N] [--sets N] [--functions NAME ...] [--slow]

- campaign: run a campaign of eight missions with a saturating drift. Then run NumPyro's own MCMC
  (NUTS, 4 vectorised chains of 500 + 1000 draws, otherwise with default settings) on the same data:
  after each mission, with a new compilation each time, as a script would, and once on all eight
  missions. Print the CPU time with compilation and the diagnostics of both.
- own_campaign: run a campaign of ten missions in the terrain example with functions of
  own_functions.py, the first of which is like that of the README.
- as_default: run campaigns of ten missions with the default model and with a function that is the
  default model, in ten worlds, and print the differences of lost contact.
- program: compare `PooledTrust().program`, passed as a function, with `sampler="nuts"` of the
  class.
- samplers: fit functions of own_functions.py to ten missions in the terrain example by importance
  sampling, by trustbo's NUTS, by NumPyro's own MCMC (NUTS, 4 vectorised chains of 1000 + 1000
  draws, otherwise with default settings) and by nutpie (4 chains of 1000 + 1000 draws), with five
  seeds each. Print the CPU time without compilation. Then compare the means and standard
  deviations of importance sampling with those of a long run of NUTS. If R-hat of the long run is
  large, it is no reference. `--slow` adds two functions that take minutes.
- sbc: check the fits of four functions by simulation-based calibration.
"""

import sys
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
import pandas as pd
from common import Table, arguments, parsed
from groups import holm, interval, over_worlds
from jax.flatten_util import ravel_pytree
from numpyro.infer import MCMC, NUTS, Predictive
from numpyro.infer.util import initialize_model
from own_functions import FUNCTIONS
from own_functions import as_default as default_as_function
from scipy import stats
from world_set import worlds

import trustbo as tb
from trustbo.inference.diagnostics import complaints_of
from trustbo.inference.functions.data import arrays_of, data_of
from trustbo.inference.functions.draws import draws_of_drift, function_drift
from trustbo.inference.functions.function import keys_of
from trustbo.inference.functions.known import as_model
from trustbo.inference.functions.missions import FunctionData
from trustbo.inference.functions.source import OfFunction
from trustbo.models import ContactRate, PooledTrust, TrustParams
from trustbo.models.observations import Observations
from trustbo.study import lost_in

FEATURES = ("traversability", "line_of_sight")
START, GOAL = (7, 0), (0, 7)
MISSIONS = 8
LEVEL = 0.01  # significance level of sbc, for all parameters together
RANKED = 99  # draws among which a true parameter is ranked
PRINTED = 10  # sets between two lines of progress
SHORT = (
    "four", "saturating", "weights_by_robot", "hierarchical", "heavy_tailed", "coupled", "ridge",
    "two_modes", "shared_noise",
)  # fmt: skip
SLOW = "hsgp", "neural"
OF_CAMPAIGNS = "four", "saturating", "weights_by_robot"
CALIBRATED = "four", "saturating", "two_modes", "shared_noise"
FEW = 4  # draws of a run of NumPyro's MCMC that takes about as long as compilation
WORLDS = (
    "synthetic-0", "synthetic-1", "wellington", "synthetic-0-aged", "synthetic-0-slopes",
    "synthetic-1-dense", "synthetic-1-one-poor", "synthetic-0-rain", "synthetic-2-jammer",
    "synthetic-1-radio",
)  # fmt: skip
SEEDS = 1, 2, 3, 4, 5  # seed 0 compiles
LONG = {"draws": 5000, "warmup": 1000}  # per chain of the reference


def saturating(awareness, contact_rate=None):
    level = numpyro.sample("level", dist.Normal(0.0, 0.3))
    most = numpyro.sample("most", dist.HalfNormal(0.5))
    rise = numpyro.sample("rise", dist.LogNormal(1.0, 1.0))
    beta0 = numpyro.sample("beta0", dist.Beta(2.0, 2.0))
    delta_w = numpyro.sample("delta_w", dist.HalfNormal(0.2))
    delta_v = numpyro.sample("delta_v", dist.HalfNormal(0.2))
    drift = level + most * (1.0 - jnp.exp(-rise * awareness[..., 1]))
    with numpyro.plate("mission", len(drift)):
        rates = ContactRate(drift, beta0, delta_w, delta_v)
        numpyro.sample("contact_rate", rates, obs=contact_rate)


def world(seed):
    awareness = np.random.default_rng(seed).uniform(size=(3, 8, 8, 2))
    workspace = tb.Workspace.from_awareness(awareness, features=FEATURES)
    z = workspace.awareness.fillna(0.0).values
    drift = 0.1 + 0.4 * (1.0 - np.exp(-6.0 * z[..., 1]))
    truth = TrustParams(0.4, np.zeros(2), 0.0, 0.03, 0.04, place_bound=drift)
    return workspace, tb.simulation.ModelSimulator(workspace, truth)


def padded(missions):
    n = max(len(mission.bounds) for mission in missions)
    z = np.zeros((len(missions), n, 3, 2))
    y = np.full(z.shape[:3], np.nan)
    for j, mission in enumerate(missions):
        z[j, : len(mission.bounds)] = mission.awareness
        y[j, : len(mission.bounds)] = mission.contact_rate
    return z, y


def own_mcmc(function, data, seed, warmup=500, n=1000):
    """NumPyro's own MCMC; returns CPU seconds with compilation, diagnostics and failed checks."""
    started = time.process_time()
    with jax.enable_x64(True):
        mcmc = MCMC(NUTS(function), num_warmup=warmup, num_samples=n, num_chains=4,
                    chain_method="vectorized", progress_bar=False)  # fmt: skip
        mcmc.run(jax.random.key(seed), **data)
        draws = {n: np.asarray(v) for n, v in mcmc.get_samples(group_by_chain=True).items()}
        diverging = np.asarray(mcmc.get_extra_fields()["diverging"])
    seconds = time.process_time() - started
    return seconds, *complaints_of(draws, diverging)


def campaign(seeds):
    table = Table("seed", "", "CPU s", "of which fits", "samplers", "fewest effective draws",
                  "learned or good", "compilations")  # fmt: skip
    for seed in range(seeds):
        workspace, simulator = world(seed)
        as_model(saturating).compiled.clear()
        jax.clear_caches()
        started = time.process_time()
        run = tb.iterate(workspace, START, GOAL, model=saturating, simulator=simulator, seed=seed,
                         policy="thompson", n_iterations=MISSIONS, progress=False)  # fmt: skip
        total = time.process_time() - started
        fits = [tree.attrs for tree in run.posteriors if tree is not None]
        learned = (run.table()["state"] == "learned").sum()
        table.row(seed, "trustbo, whole campaign", f"{total:.0f}",
                  f"{sum(fit['seconds'] for fit in fits):.0f} (wall)", counted(fits),
                  f"{min(map(effective, fits)):.0f}", f"{learned} of {MISSIONS}",
                  n_compiled(as_model(saturating)))  # fmt: skip

        own = []
        for n in range(1, MISSIONS + 1):
            jax.clear_caches()
            z, y = padded(run.missions[:n])
            own.append(own_mcmc(saturating, {"awareness": z, "contact_rate": y}, seed))
        seconds = [one[0] for one in own]
        found = [one[1] for one in own]
        good = sum(not one[2] for one in own)
        table.row(seed, "NumPyro, after each mission", f"{sum(seconds):.0f}", "all",
                  f"{MISSIONS} nuts", f"{min(f['ess_bulk'] for f in found):.0f}",
                  f"{good} of {MISSIONS}", MISSIONS)  # fmt: skip
        table.row(seed, "NumPyro, once on all", f"{seconds[-1]:.0f}", "all", "1 nuts",
                  f"{found[-1]['ess_bulk']:.0f}", f"{int(not own[-1][2])} of 1", 1)  # fmt: skip
        print(f"  ratio: {total / sum(seconds):.2f} of NumPyro after each mission, "
              f"{total / seconds[-1]:.1f} of NumPyro once", flush=True)  # fmt: skip


def effective(attrs):
    """Effective number of draws: that of the points, or the smallest bulk ESS."""
    return attrs["kish"] if attrs["sampler"] == "importance" else attrs["ess_bulk"]


def counted(fits):
    """Count the samplers of fits."""
    samplers = [fit["sampler"] for fit in fits]
    return ", ".join(f"{samplers.count(name)} {name}" for name in dict.fromkeys(samplers))


def n_compiled(model):
    """Count the programs that were compiled for a function, one for each shape of the data."""
    return sum(compiled._cache_size() for compiled in model.compiled.values())


def own_campaign(names):
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10))
    table = Table("function", "CPU s", "learned", "samplers", "warnings",
                  name="functions_campaign")  # fmt: skip
    for name in names:
        started = time.process_time()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run = tb.iterate(workspace, (0, 0), (0, 5), model=FUNCTIONS[name], n_iterations=10,
                             seed=1, progress=False)  # fmt: skip
        seconds = time.process_time() - started
        fits = [tree.attrs for tree in run.posteriors if tree is not None]
        learned = (run.table()["state"] == "learned").sum()
        table.row(name, f"{seconds:.0f}", f"{learned} of 10", counted(fits), len(caught))
        for message in {str(one.message) for one in caught}:
            print(f"  {message}", flush=True)


def as_default():
    """Compare campaigns with the default model, as a class and as a function, in ten worlds."""
    table = Table("world", "bounds lost, default", "as a function", "CPU s, default",
                  "as a function", name="functions_as_default")  # fmt: skip
    rows = []
    for name in WORLDS:
        world = worlds()[name]
        workspace = world.campaign_workspace()
        row = {"world": name}
        for label, model in {"default": None, "function": default_as_function}.items():
            started = time.process_time()
            campaign = tb.Campaign(workspace, *world.ends("sw-ne"), model=model, progress=False)
            for _ in campaign.run(world.simulator(workspace), 10):
                pass
            row[f"{label} s"] = time.process_time() - started
            row[label] = np.mean([lost_in(mission) for mission in campaign.missions])
        rows.append(row)
        table.row(name, f"{row['default']:.3f}", f"{row['function']:.3f}",
                  f"{row['default s']:.0f}", f"{row['function s']:.0f}")  # fmt: skip
    rows = pd.DataFrame(rows)
    less = (rows["function"] - rows["default"]).to_numpy()
    table.row("function minus default", "", interval(*over_worlds(less, rows["world"])[:3]), "", "")


def in_terrain():
    """Make ten missions in the terrain example: greedy ones, and two on random paths."""
    workspace = tb.Workspace.from_terrain(tb.terrain.example(), (10, 10))
    greedy = tb.iterate(workspace, (0, 0), (0, 5), n_iterations=8, seed=1, progress=False)
    random = tb.iterate(workspace, (0, 0), (9, 9), n_iterations=2, seed=2, policy="random",
                        progress=False)  # fmt: skip
    return [*greedy.missions, *random.missions]


def samplers(names):
    missions = in_terrain()
    table = Table("function", "sampler", "seeds", "refused or warned", "CPU s, median",
                  "effective draws, median", "least", "ms per effective draw, median", "worst",
                  name="functions_samplers")  # fmt: skip
    others = []
    for name in names:
        function = FUNCTIONS[name]

        def fitted(sampler, seed, function=function, **options):
            return tb.fit(missions, function, sampler=sampler, seed=seed, latent=False,
                          progress=False, **options)  # fmt: skip

        found = []

        def importance(seed, fitted=fitted, found=found):
            tree, seconds, complaints = timed_fit(fitted, "importance", seed)
            found.append(moments(tree))
            return seconds, effective(tree.attrs), complaints

        def nuts(seed, fitted=fitted):
            tree, seconds, complaints = timed_fit(fitted, "nuts", seed)
            return seconds, effective(tree.attrs), complaints

        data = unpadded(as_model(function), missions)

        def numpyro_nuts(seed, function=function, data=data):
            compilation, *_ = own_mcmc(function, data, 0, warmup=FEW, n=FEW)
            seconds, diagnosed, complaints = own_mcmc(function, data, seed, warmup=1000)
            return seconds - compilation, diagnosed["ess_bulk"], complaints

        def nutpie(seed, function=function, data=data):
            seconds, diagnosed, complaints = by_nutpie(function, data, seed)
            return seconds, diagnosed["ess_bulk"], complaints

        fitted("importance", 0, check=False)  # compiles
        long = fitted("nuts", 0, check=False, **LONG)  # so does this
        ways = {"importance": importance, "NUTS": nuts, "NumPyro": numpyro_nuts, "nutpie": nutpie}
        for sampler, sample in ways.items():
            seconds, effective_draws, complaints = zip(*map(sample, SEEDS), strict=True)
            seconds, effective_draws = np.array(seconds), np.array(effective_draws)
            each = 1000.0 * seconds / effective_draws
            table.row(name, sampler, len(SEEDS), sum(map(bool, complaints)),
                      f"{np.median(seconds):.1f}", f"{np.median(effective_draws):.0f}",
                      f"{effective_draws.min():.0f}", f"{np.median(each):.2f}",
                      f"{each.max():.2f}")  # fmt: skip
        others.append((name, *differences(found, long)))
        print(f"  {name}: {others[-1][1:]}", file=sys.stderr, flush=True)

    table = Table("function", "largest difference of means, sd", "of", "ratios of sds",
                  "R-hat of the long run", "its ESS", "its divergences",
                  name="functions_agreement")  # fmt: skip
    for cells in others:
        table.row(*cells)


def by_nutpie(function, data, seed):
    """Sample with nutpie, in the coordinates of NumPyro; return CPU s, diagnostics, complaints."""
    import nutpie  # which only `make bench` installs

    with jax.enable_x64(True):
        model = initialize_model(jax.random.key(seed), function, model_kwargs=data)
        center, unravel = ravel_pytree(model.param_info.z)
        slope = jax.jit(jax.value_and_grad(lambda x: -model.potential_fn(unravel(x))))
        slope(center)  # compiles

    def make_density():
        def density(x):
            with jax.enable_x64(True):
                value, gradient = slope(x)
            return float(value), np.asarray(gradient)

        return density

    n = len(center)
    starts = np.random.default_rng(seed)
    compiled = nutpie.compiled_pyfunc.from_pyfunc(
        n, make_density, lambda *_: lambda x: {"x": np.asarray(x)}, [np.dtype(float)], [(n,)],
        ["x"], make_initial_point_fn=lambda _: np.asarray(center) + starts.uniform(-1.0, 1.0, n),
    )  # fmt: skip
    started = time.process_time()
    trace = nutpie.sample(compiled, tune=1000, draws=1000, chains=4, cores=1, seed=seed,
                          progress_bar=False)  # fmt: skip
    seconds = time.process_time() - started
    draws = {"x": trace["posterior"]["x"].values}
    return seconds, *complaints_of(draws, trace["sample_stats"]["diverging"].values)


def timed_fit(fitted, sampler, seed):
    """Fit with the checks of users; return the posterior, CPU seconds, and complaints."""
    started = time.process_time()
    complaints = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            tree = fitted(sampler, seed)
        except tb.errors.PosteriorError as error:
            tree = error.posterior
            complaints.append(f"refused: {error.reason}")
    seconds = time.process_time() - started
    return tree, seconds, complaints + [f"warning: {one.message}" for one in caught]


def unpadded(model, missions):
    """Return the inputs that a function takes, as arrays without padding."""
    observations = Observations.from_missions(missions)
    n_missions, n_bounds = observations.contact_rate.shape[:2]
    arrays = arrays_of(data_of(missions, observations, moves=False))
    data = {name: array[:n_missions, :n_bounds] for name, array in arrays.items()}
    data |= {"features": missions[0].features, "observations": observations}
    return {name: data[name] for name in model.inputs}


def moments(tree):
    """Mean and sd of all variables, by name."""
    draws = tree["posterior"].to_dataset().stack(sample=("chain", "draw"))
    arrays = {name: draws[name].transpose(..., "sample").values for name in draws.data_vars}
    return {name: (array.mean(-1), array.std(-1)) for name, array in arrays.items()}


def differences(found, long):
    """Compare the moments of several fits with those of a long run of NUTS."""
    wanted = moments(long)
    apart = {
        name: max(float((np.abs(one[name][0] - mean) / sd).max()) for one in found)
        for name, (mean, sd) in wanted.items()
    }
    farthest = max(apart, key=apart.get)
    ratios = [one[name][1] / sd for one in found for name, (_, sd) in wanted.items()]
    ratios = np.concatenate([np.ravel(ratio) for ratio in ratios])
    return (f"{apart[farthest]:.3f}", farthest, f"{ratios.min():.3f} to {ratios.max():.3f}",
            f"{long.attrs['r_hat']:.3f}", f"{long.attrs['ess_bulk']:.0f}",
            int(long.attrs["divergences"]))  # fmt: skip


def program(seeds):
    table = Table("seed", "largest difference of means, sd", "log-likelihoods, largest relative",
                  "LOO of class", "LOO of function", "paths equal")  # fmt: skip
    for seed in range(seeds):
        workspace, simulator = world(seed)
        model = PooledTrust()
        run = tb.iterate(workspace, START, GOAL, model=model, simulator=simulator, seed=seed,
                         sampler="nuts", policy="thompson", n_iterations=MISSIONS,
                         progress=False)  # fmt: skip
        ours = tb.fit(run.missions, model, sampler="nuts", draws=2000, seed=seed, progress=False)
        theirs = tb.fit(run.missions, model.program, draws=2000, seed=seed, progress=False)
        resolution = model.observations(run.missions).resolution
        means = dict(theirs["posterior"].data_vars)
        means["delta_v"] = np.hypot(means["delta_v"], resolution)  # as the class reports it
        far = max(
            abs(float(ours["posterior"][n].mean() - means[n].mean()))
            / float(ours["posterior"][n].std())
            for n in ("beta0", "delta_w", "delta_v")
        )

        equal = 0
        error = 0.0
        for n, tree in enumerate(run.posteriors, start=1):
            missions = run.missions[:n]
            function, values = as_values(model, tree, missions)
            draws = draws_of_drift(function_drift(
                function, values, missions[0].robots, FEATURES, workspace.passable.shape
            ))  # fmt: skip
            planner = run.planner
            equal += planner.plan(draws).path == planner.plan(tree).path
            if n == MISSIONS:
                error = of_likelihoods(function, values, model, tree, missions)
        loo = [tb.inference.loo(one).elpd for one in (ours, theirs)]
        table.row(seed, f"{far:.3f}", f"{error:.1e}", f"{loo[0]:.2f}", f"{loo[1]:.2f}",
                  f"{equal} of {MISSIONS}")  # fmt: skip


def as_values(model, tree, missions):
    """Return the program of the class, and the class's draws as values of its variables."""
    of_features = model.for_features(missions[0].features)
    draws = tree["posterior"].to_dataset().stack(sample=("chain", "draw"))
    names = [name for name in ("beta0", "delta_w", "delta_v", "f_v") if name in draws]
    values = {name: draws[name].values for name in names}
    observations = of_features.observations(missions)
    values |= of_features.noise_without(values, observations.resolution)
    theta = of_features.theta(values, observations.resolution)
    mean, _ = of_features.weights.moments(theta, observations)
    c = np.vstack([draws["beta"].transpose("feature", "sample").values, draws["b"].values]).T
    return as_model(model.program), values | {"weights_0": c - mean}


def of_likelihoods(function, values, model, tree, missions):
    """Largest relative difference of log-likelihoods of the same draws."""
    whole = tb.inference.add_latent(tree, missions, model=model, progress=False)
    wanted = whole["log_likelihood"]["contact_rate"].values.reshape(-1, len(missions))
    known = FunctionData(function, missions)
    source = OfFunction(known, values, keys_of(len(wanted), 0), lambda some, theta: some)
    found = source.log_likelihood()
    return np.abs(found / wanted - 1.0).max()


def with_rates(awareness, rates, features):
    """Make a mission with any rates; simulated ones may leave [0, 1], which missions refuse."""
    inside = np.full(rates.shape, 0.5)
    mission = tb.Mission.from_arrays(None, awareness, inside, features=features)
    object.__setattr__(mission, "contact_rate", np.array(rates))
    return mission


def sbc(names, sets):
    table = Table("function", "sets", "refused", "parameters", "least p", "of", "rejected",
                  name="functions_sbc")  # fmt: skip
    for name in names:
        p, refused = sbc_of(FUNCTIONS[name], sets)
        least = min(p, key=p.get)
        rejected = int((np.array(holm(list(p.values()))) < LEVEL).sum())
        table.row(name, sets, refused, len(p), f"{p[least]:.4f}", least, rejected)


def sbc_of(function, sets):
    """Rank true parameters among posterior draws (Talts et al. 2018).

    Returns the p values of uniform ranks by parameter, and the number of refused fits.
    """
    driven = in_terrain()[::3]
    data = unpadded(as_model(function), driven) | {"contact_rate": None, "n_ticks": None}
    ranks = {}
    refused = 0
    for seed in range(sets):
        with jax.enable_x64(True):
            drawn = Predictive(function, num_samples=1)(jax.random.key(seed), **data)
        true = {name: np.asarray(value)[0] for name, value in drawn.items()}
        rates = true.pop("contact_rate")
        missions = [
            with_rates(one.awareness, y[: len(one.bounds)], one.features)
            for one, y in zip(driven, rates, strict=True)
        ]
        try:
            tree = tb.fit(missions, function, seed=seed, latent=False, progress=False)
        except tb.errors.PosteriorError as error:
            refused += 1
            tree = error.posterior
        for name, value in true.items():
            draws = tree["posterior"][name].values
            draws = draws.reshape(-1, *np.shape(value))
            some = draws[np.linspace(0, len(draws) - 1, RANKED).astype(int)]
            below = (some < value).sum(0)
            for where, rank in np.ndenumerate(below):
                label = f"{name}{list(where)}" if where else name
                ranks.setdefault(label, []).append(int(rank))

        if (seed + 1) % PRINTED == 0:
            means = ", ".join(f"{name} {np.mean(r) / RANKED:.2f}" for name, r in ranks.items())
            print(f"  {seed + 1} of {sets}: {refused} bad fits, mean ranks {means}",
                  file=sys.stderr, flush=True)  # fmt: skip

    p = {}
    for name, found in ranks.items():
        counts = np.bincount(np.array(found) * 10 // (RANKED + 1), minlength=10)
        p[name] = stats.chisquare(counts).pvalue
    return p, refused


PARTS = "campaign", "own_campaign", "as_default", "program", "samplers", "sbc"

if __name__ == "__main__":
    parser = arguments(__doc__, names=PARTS, seeds=3)
    parser.add_argument("--sets", type=int, default=200, help="data sets of sbc, default 200")
    parser.add_argument("--functions", nargs="+", choices=FUNCTIONS, metavar="NAME",
                        help="functions of own_campaign, samplers or sbc")  # fmt: skip
    parser.add_argument("--slow", action="store_true", help="add slow functions to samplers")
    given = parsed(parser)
    calls = {
        "campaign": lambda: campaign(given.seeds),
        "own_campaign": lambda: own_campaign(given.functions or OF_CAMPAIGNS),
        "as_default": as_default,
        "program": lambda: program(given.seeds),
        "samplers": lambda: samplers(given.functions or SHORT + (SLOW if given.slow else ())),
        "sbc": lambda: sbc(given.functions or CALIBRATED, given.sets),
    }
    for name in given.names:
        print(name, flush=True)
        calls[name]()
