"""Models that are NumPyro functions: time, agreement with model classes, and calibration.

    python benchmarks/functions.py [campaign] [program] [sbc] [--seeds N] [--sets N]

- campaign: run a campaign of eight missions with a saturating drift. Then run NumPyro's own MCMC
  (NUTS, 4 vectorised chains of 500 + 1000 draws, otherwise with default settings) on the same data:
  after each mission, with a new compilation each time, as a script would, and once on all eight
  missions. Print the CPU time with compilation and the diagnostics of both.
- program: compare `PooledTrust().program`, passed as a function, with `sampler="nuts"` of the
  class.
- sbc: check the saturating model, fitted by `tb.fit`, by simulation-based calibration.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from common import Table, arguments, parsed
from groups import holm
from numpyro.infer import MCMC, NUTS, Predictive
from scipy import stats

import trustbo as tb
from trustbo.inference.diagnostics import complaints_of
from trustbo.inference.functions.draws import FunctionDraws
from trustbo.inference.functions.function import as_model
from trustbo.models import ContactRate, PooledTrust, TrustParams
from trustbo.planning.policies import random as random_policy

FEATURES = ("traversability", "line_of_sight")
START, GOAL = (7, 0), (0, 7)
MISSIONS = 8
LEVEL = 0.01  # significance level of sbc, for all parameters together
RANKED = 99  # draws among which a true parameter is ranked
PRINTED = 10  # sets between two lines of progress


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


def own_mcmc(missions, seed):
    """NumPyro's own MCMC; returns CPU seconds, draws (chain, draw) and the failed checks."""
    z, y = padded(missions)
    started = time.process_time()
    with jax.enable_x64(True):
        kernel = NUTS(saturating)
        mcmc = MCMC(kernel, num_warmup=500, num_samples=1000, num_chains=4,
                    chain_method="vectorized", progress_bar=False)  # fmt: skip
        mcmc.run(jax.random.key(seed), jnp.asarray(z), jnp.asarray(y))
        draws = {n: np.asarray(v) for n, v in mcmc.get_samples(group_by_chain=True).items()}
        diverging = np.asarray(mcmc.get_extra_fields()["diverging"])
    seconds = time.process_time() - started
    return seconds, *complaints_of(draws, diverging)


def campaign(seeds):
    table = Table("seed", "", "CPU s", "of which fits", "worst ESS", "worst R-hat", "divergences",
                  "learned or good", "compilations")  # fmt: skip
    for seed in range(seeds):
        workspace, simulator = world(seed)
        as_model(saturating).compiled.clear()
        as_model(saturating).sampler = None
        jax.clear_caches()
        started = time.process_time()
        run = tb.iterate(workspace, START, GOAL, model=saturating, simulator=simulator, seed=seed,
                         policy="thompson", n_iterations=MISSIONS, progress=False)  # fmt: skip
        total = time.process_time() - started
        fits = sum(tree.attrs["seconds"] for tree in run.posteriors if tree is not None)
        rows = run.table()
        table.row(seed, "trustbo, whole campaign", f"{total:.0f}", f"{fits:.0f} (wall)",
                  f"{rows['ess_bulk'].min():.0f}", f"{rows['r_hat'].max():.3f}",
                  f"{rows['divergences'].max():.0f}",
                  f"{(rows['state'] == 'learned').sum()} of {MISSIONS}",
                  as_model(saturating).sampler.n_compiled)  # fmt: skip

        own = []
        for n in range(1, MISSIONS + 1):
            jax.clear_caches()
            own.append(own_mcmc(run.missions[:n], seed))
        seconds = [one[0] for one in own]
        found = [one[1] for one in own]
        good = sum(not one[2] for one in own)
        table.row(seed, "NumPyro, after each mission", f"{sum(seconds):.0f}", "all",
                  f"{min(f['ess_bulk'] for f in found):.0f}",
                  f"{max(f['r_hat'] for f in found):.3f}",
                  f"{max(f['divergences'] for f in found)}", f"{good} of {MISSIONS}",
                  MISSIONS)  # fmt: skip
        table.row(seed, "NumPyro, once on all", f"{seconds[-1]:.0f}", "all",
                  f"{found[-1]['ess_bulk']:.0f}", f"{found[-1]['r_hat']:.3f}",
                  f"{found[-1]['divergences']}", f"{int(not own[-1][2])} of 1", 1)  # fmt: skip
        print(f"  ratio: {total / sum(seconds):.2f} of NumPyro after each mission, "
              f"{total / seconds[-1]:.1f} of NumPyro once", flush=True)  # fmt: skip


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
            draws = FunctionDraws(function, values, missions[0].robots, FEATURES,
                                  workspace.passable.shape)  # fmt: skip
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
    values = {n: draws[n].values for n in ("beta0", "delta_w", "delta_v")}
    observations = of_features.observations(missions)
    values["delta_v"] = of_features.noise_without(values["delta_v"], observations.resolution)
    theta = of_features.theta(values, observations.resolution)
    mean, _ = of_features.weights.moments(theta, observations)
    c = np.vstack([draws["beta"].transpose("feature", "sample").values, draws["b"].values]).T
    return as_model(model.program), values | {"weights_0": c - mean}


def of_likelihoods(function, values, model, tree, missions):
    """Largest relative difference of log-likelihoods of the same draws."""
    whole = tb.inference.add_latent(tree, missions, model=model, progress=False)
    wanted = whole["log_likelihood"]["contact_rate"].values.reshape(-1, len(missions))
    data = {"observations": model.observations(missions)}
    data |= {"awareness": data["observations"].awareness,
             "contact_rate": data["observations"].contact_rate,
             "features": missions[0].features}  # fmt: skip
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(0), len(wanted))
    found = function.over_draws("evaluate", 2, data)(values, keys).log_likelihood
    return np.abs(found / wanted - 1.0).max()


def with_rates(awareness, rates):
    """Make a mission with any rates; simulated ones may leave [0, 1], which missions refuse."""
    inside = np.full(rates.shape, 0.5)
    mission = tb.Mission.from_arrays(None, awareness, inside, features=FEATURES)
    for bound, of_bound in zip(mission.bounds, rates, strict=True):
        object.__setattr__(bound, "contact_rate", of_bound)
    return mission


def sbc(sets):
    """Rank true parameters among posterior draws (Talts et al. 2018)."""
    workspace, simulator = world(0)
    nothing = TrustParams(0.4, np.zeros(2), 0.0, 0.03, 0.04).flat()
    planner = tb.Planner(workspace, START, GOAL)
    rng = np.random.default_rng(1)
    paths = [random_policy(rng, nothing, planner).path for _ in range(4)]
    z, _ = padded([simulator.run(path, seed=1) for path in paths])

    ranks = {}
    refused = 0
    for seed in range(sets):
        with jax.enable_x64(True):
            true = Predictive(saturating, num_samples=1)(jax.random.key(seed), jnp.asarray(z))
        rates = np.asarray(true.pop("contact_rate"))[0]
        missions = [
            with_rates(z[j, : len(path) - 1], rates[j, : len(path) - 1])
            for j, path in enumerate(paths)
        ]
        try:
            tree = tb.fit(missions, saturating, seed=seed, latent=False, progress=False)
        except tb.errors.PosteriorError as error:
            refused += 1
            tree = error.posterior
        for name, value in true.items():
            draws = tree["posterior"][name].values.ravel()
            some = draws[np.linspace(0, draws.size - 1, RANKED).astype(int)]
            ranks.setdefault(name, []).append(int((some < float(value[0])).sum()))

        if (seed + 1) % PRINTED == 0:
            means = ", ".join(f"{name} {np.mean(r) / RANKED:.2f}" for name, r in ranks.items())
            print(f"  {seed + 1} of {sets}: {refused} bad fits, mean ranks {means}", flush=True)

    table = Table("parameter", "p of uniform ranks", "mean rank (expected .5)")
    p = {}
    for name, found in ranks.items():
        counts = np.bincount(np.array(found) * 10 // (RANKED + 1), minlength=10)
        p[name] = stats.chisquare(counts).pvalue
        table.row(name, f"{p[name]:.3f}", f"{np.mean(found) / RANKED:.3f}")
    rejected = int((np.array(holm(list(p.values()))) < LEVEL).sum())
    print(f"  {sets} sets, {rejected} of {len(p)} parameters rejected, {refused} fits with bad "
          "diagnostics", flush=True)  # fmt: skip


PARTS = {"campaign": campaign, "program": program}

if __name__ == "__main__":
    parser = arguments(__doc__, names=(*PARTS, "sbc"), seeds=3)
    parser.add_argument("--sets", type=int, default=100, help="data sets of sbc, default 100")
    given = parsed(parser)
    for name in given.names:
        print(name, flush=True)
        if name == "sbc":
            sbc(given.sets)
        else:
            PARTS[name](given.seeds)
