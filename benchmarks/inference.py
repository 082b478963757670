"""Speed of our inference beside other tools on the same posteriors, and how it grows with data.

Run: python benchmarks/inference.py [pooled] [families] [large] [coupled] [scaling] [latency]
[--quick]

All sections by default; `--quick` cuts the numbers of draws by ten, to see that everything runs.
Cold is the first call in this process, compilation included (PyTensor's disk cache is empty); warm
the median of later ones with other seeds, which compile only what a tool compiles each time, as
numpyro's MCMC does to find its starts. "off" is the largest distance of a parameter's mean from the
reference's, in posterior standard deviations: about 0.1 is the Monte Carlo error of a few hundred
effective draws, so rows that show it have the same posterior. In `families` cold is the first call
of a process of its own, and moments and quantiles are averaged over seeds.
"""

import importlib.util
import os
import platform
import subprocess
import sys
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import arviz as az
import jax
import numpy as np
from common import Table, arguments, median_seconds, parsed, timed, verdict
from jax import lax
from threadpoolctl import threadpool_limits

from trustbo import Mission
from trustbo.inference import TrustFilter, fit, sample_prior
from trustbo.inference.evidence.statistics import gather
from trustbo.inference.samplers.choice import why_not_scores, with_warmup
from trustbo.inference.samplers.exact import _matched, _modes, _target, sample_exact
from trustbo.inference.samplers.nuts_scores import ScoresInJax
from trustbo.inference.samplers.nuts_sites import SitesInJax
from trustbo.inference.samplers.posterior import posterior_of
from trustbo.inference.samplers.run import draw_posterior
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.models import CoupledParams, CoupledTrust, HierarchicalTrust, PooledTrust, TrustParams
from trustbo.models.backend import own_settings
from trustbo.models.effects.effect import Slots
from trustbo.models.ticks import weigh_ticks
from trustbo.stacking import stack_missions

N_BOUNDS, N_ROBOTS, N_FEATURES = 10, 3, 2
N_WARM = 3
HEADER = ("", "cold s", "warm s", "min ESS", "ESS/s warm", "R-hat", "off")


class Data(NamedTuple):
    """Missions, and the same as arrays."""

    missions: list[Mission]
    awareness: np.ndarray  # (mission, bound, robot, feature)
    rates: np.ndarray  # (mission, bound, robot)


class Row(NamedTuple):
    """What a sampler did."""

    name: str
    cold: float
    warm: float
    ess: float
    worst: str
    off: float
    """Largest |mean - reference mean| / reference sd."""

    @property
    def speeds(self):
        """Effective draws per second: warm, cold, and of 1000 from a cold start."""
        warm = self.ess / self.warm
        started = max(self.cold - self.warm, 0.0)
        return warm, self.ess / self.cold, 1000.0 / (started + 1000.0 / warm)


class Exact(NamedTuple):
    """Draws that know their own effective number."""

    sites: dict[str, np.ndarray]
    kish: float
    k_hat: float


# --- data ---


def pooled_truth(n_robots):
    return TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


def coupled_truth(n_robots):
    eye, share = np.eye(n_robots), 1.0 / max(n_robots - 1, 1)
    around = share * (1.0 - eye)
    B = np.stack([0.25 * eye + 0.04 * around, 0.15 * eye + 0.02 * around])
    noise = 0.05**2 * (0.7 * eye + 0.3)
    return CoupledParams(0.5 * eye + 0.1 * around, B, np.full(n_robots, 0.05), noise, noise)


def simulate(model, truth, n_missions, n_robots=N_ROBOTS):
    """Missions of 10 bounds, their rates cut at 0 and 1; every tool gets the same."""
    z = np.random.default_rng(0).uniform(size=(n_missions, N_BOUNDS, n_robots, N_FEATURES))
    rates = model.simulate(jax.random.key(0), truth(n_robots), z).contact_rate.clip(0.0, 1.0)
    path = [(0, k) for k in range(N_BOUNDS + 1)]
    missions = [Mission.from_arrays(path, *pair) for pair in zip(z, rates, strict=True)]
    return Data(missions, z, rates)


def pooled_data(n_missions, n_robots=N_ROBOTS):
    return simulate(PooledTrust(), pooled_truth, n_missions, n_robots)


# --- samplers: a seed in, draws out ---


def trustbo_exact(missions):
    model = PooledTrust()

    def sampler(seed):
        batch = stack_missions(missions)
        floored = model.at_resolution(weigh_ticks(batch, np.ones(len(batch.contact_rate))))
        drawn = sample_exact(gather(floored, batch)[0], floored.priors, 4000, seed)
        sites = {name: drawn.params[name][None] for name in model.dims}
        return Exact(sites, min(drawn.kish, 4000.0), drawn.khat)

    return sampler


def trustbo_nuts(model, missions, settings):
    def sampler(seed):
        batch = stack_missions(missions)
        return draw_posterior(model, "nuts", settings, seed, batch, check=False)[0].params

    return sampler


def peer(module, *needs):
    """A module of `peers`, or None, said in one line, where its tools are missing or broken."""
    for need in needs:
        if importlib.util.find_spec(need) is None:
            print(f"{need}: not installed (make bench installs the peers)", flush=True)
            return None
    try:
        return importlib.import_module(f"peers.{module}")
    except (ImportError, AttributeError) as error:
        print(f"{' and '.join(needs)}: installed, but broken here: {error}", flush=True)
        return None


# --- measuring ---


def unknowns(sites):
    """Every unknown once, as one array (chain, draw, unknown)."""
    columns = []
    for name in sorted(sites):
        values = sites[name]
        if name.startswith("Delta"):
            values = values[(..., *np.tril_indices(values.shape[-1]))]
        columns.append(values.reshape(*sites["b"].shape[:2], -1))
    return np.concatenate(columns, axis=-1)


def measure(table, name, sampler, reference=None, *, n_warm=N_WARM, compile_seconds=0.0):
    """Time a sampler, print its row of the table, and return it."""
    cold, draws = timed(lambda: sampler(1))
    cold += compile_seconds
    runs = [timed(partial(sampler, 2 + i)) for i in range(n_warm)]
    warm = float(np.median([seconds for seconds, _ in runs])) if runs else cold
    draws = runs[-1][1] if runs else draws
    if isinstance(draws, Exact):
        x, ess, worst = unknowns(draws.sites), draws.kish, f"k-hat {draws.k_hat:.2f}"
    else:
        x = unknowns(draws)
        sites = az.from_dict({"posterior": {"x": x}})["posterior"].to_dataset()
        ess = float(az.ess(sites, method="bulk")["x"].min())
        worst = f"{float(az.rhat(sites)['x'].max()):.3f}"
    off = np.nan
    if reference is not None:
        off = np.abs((x.mean((0, 1)) - reference.mean((0, 1))) / reference.std((0, 1))).max()
    row = Row(name, cold, warm, ess, worst, float(off))
    cells = (f"{cold:.2f}", f"{warm:.3f}", f"{ess:.0f}", f"{ess / warm:.1f}", worst, f"{off:.3f}")
    table.row(name, *cells)
    return row


def aligned(*columns):
    return Table(*columns, first=54, others=11)


def print_ratios(ratios):
    """How many times the effective draws per second: (what, ours, theirs, target, warm or cold).

    Runs differ in length, and longer ones spread their compilation over more draws. "cold, 1000"
    makes up for that: 1000 effective draws at the warm speed, after what the cold call took longer.
    Cold targets are judged by the less favourable of the two.
    """
    print()
    head = "effective draws per second, ratio", "warm", "cold", "cold, 1000", "target", "reached"
    table = aligned(*head)
    for what, ours, theirs, target, when in ratios:
        speeds = [row.speeds for row in theirs]
        if not speeds:
            continue
        ratios = np.array(ours.speeds) / np.max(speeds, axis=0)
        judged = ratios[0] if when == "warm" else ratios[1:].min()
        cells = (f"{ratio:.1f} x" for ratio in ratios)
        table.row(what, *cells, f"{target} x", f"{verdict(judged >= target)} ({when})")
    print()


def settings_of(warmup, draws, chains, quick):
    share = 10 if quick else 1
    return {"warmup": warmup // share, "draws": draws // share, "chains": chains}


# --- sections ---


def pooled(quick):
    data = pooled_data(20)
    arrays = (data.awareness, data.rates)
    print(f"\n## pooled: {data.rates.size} observations, 6 unknowns\n")
    reference = unknowns(trustbo_exact(data.missions)(1000).sites)
    table = aligned(*HEADER)
    exact = measure(table, "trustbo exact, 4000 draws", trustbo_exact(data.missions), reference)
    settings = with_warmup(NutsSettings(draws=100 if quick else 1000), PooledTrust())
    sampler = trustbo_nuts(PooledTrust(), data.missions, settings)
    nuts = measure(table, "trustbo NUTS, 4 x (150 + 1000)", sampler, reference)
    mcmc = numpyro_pooled(table, arrays, reference, quick)
    if dynamax := peer("dynamax_blackjax", "dynamax", "blackjax"):
        sampler = dynamax.pooled(*arrays, **settings_of(500, 1000, 4, quick))
        measure(table, "dynamax + blackjax NUTS, 4 x (500 + 1000)", sampler, reference, n_warm=1)
    draws = 100 if quick else 1000
    rows = nutpie_rows(table, "pooled_marginal", data, reference, {"draws": draws, "chains": 4})
    if rows:
        nutpie_joint(table, arrays, reference, draws)
    gibbs = peer("gibbs")
    sampler = gibbs.pooled(*arrays, 500 if quick else 5000)
    measure(table, "Gibbs (NumPy), 4 x (500 + 5000)", sampler, reference, n_warm=1)
    low_rank = [row for kind, row in rows.items() if kind.startswith("low rank")]
    print_ratios([
        ("trustbo exact / best PyMC + nutpie", exact, rows.values(), 20, "warm"),
        ("trustbo exact / best numpyro MCMC", exact, mcmc, 40, "warm"),
        ("trustbo NUTS / best numpyro MCMC", nuts, mcmc, 20, "warm"),
        ("trustbo NUTS / best PyMC + nutpie low rank", nuts, low_rank, 2, "warm"),
    ])  # fmt: skip


def nutpie_joint(table, arrays, reference, draws):
    pymc = peer("pymc_nutpie", "pymc", "nutpie")
    seconds, compiled = timed(lambda: pymc.compile_model(pymc.pooled_joint(*arrays)))
    sampler = pymc.sampler_of(compiled, PooledTrust().dims, draws=draws, chains=4)
    name = f"PyMC + nutpie joint, non-centred, 4 x (default + {draws})"
    measure(table, name, sampler, reference, n_warm=1, compile_seconds=seconds)


def numpyro_pooled(table, arrays, reference, quick):
    """Rows of numpyro's MCMC on the marginal likelihood; the joint ones are only printed."""
    mcmc, rows = peer("numpyro_mcmc"), []
    for warmup in (1000, 300):
        options = settings_of(warmup, 1000, 4, quick)
        name = f"numpyro MCMC, dense, 4 x ({warmup} + 1000)"
        rows.append(
            measure(table, name, mcmc.marginal(PooledTrust(), *arrays, **options), reference)
        )
    for centred in (True, False):
        options = settings_of(500, 1000, 4, quick)
        name = f"numpyro joint, {'' if centred else 'non-'}centred, 4 x (500 + 1000)"
        sampler = mcmc.joint(*arrays, centred=centred, **options)
        measure(table, name, sampler, reference, n_warm=1)
    return rows


def nutpie_rows(table, build, data, reference, lengths, finish=None, n_warm=N_WARM):
    """Rows of PyMC + nutpie by kind; none where a tool is missing."""
    pymc, rows = peer("pymc_nutpie", "pymc", "nutpie"), {}
    if pymc is None:
        return rows
    model = getattr(pymc, build)(data.awareness, data.rates)
    finish = finish and getattr(pymc, finish)
    tune = lengths.get("tune", "default")
    length = f"{lengths['chains']} x ({tune} + {lengths['draws']})"
    for kind, with_jax in (("low rank", False), ("diagonal", False), ("low rank, JAX", True)):
        if kind != "diagonal":  # which shares its compiled code with the one before
            seconds, compiled = timed(partial(pymc.compile_model, model, with_jax=with_jax))
        low_rank = kind != "diagonal"
        sampler = pymc.sampler_of(compiled, **lengths, low_rank=low_rank, finish=finish)
        rows[kind] = measure(table, f"PyMC + nutpie {kind}, {length}", sampler, reference,
                             n_warm=n_warm, compile_seconds=seconds)  # fmt: skip
    return rows


COUNTED = {  # model, truth, most seconds cold and warm
    "pooled censored": (PooledTrust(observation="censored"), "rates", 0.6, 0.2),
    "pooled counts": (PooledTrust(observation="beta_binomial"), "logits", 0.8, 0.3),
    "hierarchical Gaussian": (HierarchicalTrust(), "rates", 0.2, 0.1),
    "hierarchical censored": (HierarchicalTrust(observation="censored"), "rates", None, None),
}
TICKS = 40


def counted(name):
    """The model at the resolution of its rates, and 20 missions of 8 bounds of 3 robots."""
    model, scale, *_ = COUNTED[name]
    truth = TrustParams(0.6, np.array([0.4, 0.3]), 0.05, 0.1, 0.08)
    if scale == "logits":
        truth = TrustParams(0.6, np.array([2.0, 1.0]), -0.3, 0.4, 0.25, 0.0, 1.5)
    z = np.random.default_rng(0).uniform(size=(20, 8, N_ROBOTS, N_FEATURES))
    of = PooledTrust(observation=model.observation)
    rates = of.simulate(jax.random.key(0), truth, z, n_ticks=TICKS).contact_rate.clip(0.0, 1.0)
    path, ticks = [(0, k) for k in range(9)], np.full((8, N_ROBOTS), TICKS)
    missions = [
        Mission.from_arrays(path, *pair, n_ticks=ticks)
        for pair in zip(z, np.round(TICKS * rates) / TICKS, strict=True)
    ]
    return model.at_resolution({float(TICKS): 1.0}), stack_missions(missions)


def draws_of(name, sampler, settings, seed):
    """Draws of every unknown, (draw, unknown)."""
    model, batch = counted(name)
    drawn = draw_posterior(model, sampler, settings, seed, batch, check=False)[0]
    if sampler == "exact" and drawn.sampler != "exact":
        sys.exit(f"{name}: {drawn.fallback}")
    return unknowns(drawn.params).reshape(settings.n_chains * settings.draws, -1)


def moments(draws):
    """Means, sds, and 5 and 95 % quantiles of draws (draw, unknown)."""
    return draws.mean(0), draws.std(0), *np.quantile(draws, [0.05, 0.95], axis=0)


def cold_seconds(name, sampler, settings):
    """Seconds of the first draws of a fresh process."""
    code = f"import inference; inference.print_cold({name!r}, {sampler!r}, {tuple(settings)})"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, text=True,
                           capture_output=True, cwd=Path(__file__).parent)  # fmt: skip
    return float(done.stdout.split()[-1])


def print_cold(name, sampler, settings):
    counted(name)
    print(timed(partial(draws_of, name, sampler, NutsSettings(*settings), 0))[0])


def families(quick):
    print("\n## families: 20 missions x 8 bounds x 3 robots; exact beside NUTS of 4 x (300 + 1000)")
    print(
        "Distances of Gaussian rates from long NUTS, acceptance .98, the largest of all unknowns.\n"
    )
    head = "", "cold s", "target", "warm s", "target", "mean, sd", "sd, %", "5-95 %, sd"
    table = aligned(*head)
    settings = NutsSettings(30, 50) if quick else NutsSettings()
    length = settings if quick else NutsSettings(300, 1500, 4, 0.98)
    for name, (model, *_, cold, warm) in COUNTED.items():
        gaussian = model.family.integrates_out
        if gaussian:
            mean, sd, low, high = moments(draws_of(name, "nuts", length, 1000))
        for sampler, n in (("exact", 5), ("nuts", 1))[: 1 + gaussian]:
            first = cold_seconds(name, sampler, settings)
            draws_of(name, sampler, settings, 0)
            runs = [timed(partial(draws_of, name, sampler, settings, i)) for i in range(n)]
            off = np.full(4, np.nan)
            if gaussian:
                ours = np.mean([moments(draws) for _, draws in runs], axis=0)
                off = np.abs((ours - [mean, sd, low, high]) / sd).max(1)
            again = float(np.median([seconds for seconds, _ in runs]))
            exact = sampler == "exact"
            cells = (f"{first:.2f}", f"{cold or ''}" * exact, f"{again:.3f}",
                     f"{warm or ''}" * exact, f"{off[0]:.3f}", f"{100 * off[1]:.1f}",
                     f"{off[2:].max():.3f}")  # fmt: skip
            table.row(f"{name}, {sampler}", *cells)


def large(quick):
    data = pooled_data(640)
    print(f"\n## large: {data.rates.size} observations, 6 unknowns\n")
    reference = unknowns(trustbo_exact(data.missions)(1000).sites)
    table = aligned(*HEADER)
    exact = measure(table, "trustbo exact, 4000 draws", trustbo_exact(data.missions), reference)
    lengths = {"draws": 30 if quick else 300, "tune": 300, "chains": 2}
    rows = nutpie_rows(table, "pooled_marginal", data, reference, lengths, n_warm=1)
    print_ratios([("trustbo exact / best PyMC + nutpie", exact, rows.values(), 50, "warm")])


def coupled(quick):
    model = CoupledTrust()
    data = simulate(model, coupled_truth, 20)
    arrays = (data.awareness, data.rates)
    print(f"\n## coupled: {data.rates.size} observations, 42 unknowns\n")
    settings = NutsSettings(draws=100 if quick else 1000)
    sampler, kept = trustbo_nuts(model, data.missions, settings), {}

    def remembered(seed):
        kept[seed] = sampler(seed)
        return kept[seed]

    table = aligned(*HEADER)
    nuts = measure(table, "trustbo NUTS, 4 x (300 + 1000)", remembered, n_warm=1 if quick else 2)
    reference = np.concatenate([unknowns(sites) for sites in kept.values()])
    mcmc = peer("numpyro_mcmc").marginal(model, *arrays, **settings_of(500, 500, 2, quick))
    rival = measure(table, "numpyro MCMC, dense, 2 x (500 + 500)", mcmc, reference, n_warm=1)
    lengths = {"draws": 30 if quick else 300, "tune": 300, "chains": 2}
    rows = nutpie_rows(
        table, "coupled_marginal", data, reference, lengths, "coupled_matrices", n_warm=1
    )
    print_ratios([
        ("trustbo NUTS / best PyMC + nutpie", nuts, rows.values(), 20, "cold"),
        ("trustbo NUTS / numpyro MCMC", nuts, [rival], 4, "cold"),
    ])  # fmt: skip


def scaling(quick):
    print("\n## scaling: one exact log density at 4096 points; gathering its statistics\n")
    table = aligned("observations", "density ms", "gather ms", "with stacking")
    costs = []
    for n_missions in (40, 160, 640, 2560):
        data = pooled_data(n_missions)
        costs.append(exact_cost(data))
        cells = (f"{1000 * seconds:.1f}" for seconds in costs[-1])
        table.row(data.rates.size, *cells)
    growth = costs[-1][0] / costs[0][0]
    print(f"\ngrowth of the density over 64 x the data: {growth:.2f} x (target <= 2 x)")
    print("\n## scaling: one potential and gradient of NUTS, padded as `fit` pads\n")
    table = aligned("", "observations", "padded", "us", "ns per rate")
    for n_missions in (20, 200, 1000, 3334):
        gradient_row(table, PooledTrust(), pooled_data(n_missions), quick)
    for n_robots in (1, 3, 10, 30):
        gradient_row(table, PooledTrust(), pooled_data(20, n_robots), quick)
    for n_robots in (1, 3, 6, 10):
        model = CoupledTrust()
        gradient_row(table, model, simulate(model, coupled_truth, 20, n_robots), quick)


def exact_cost(data):
    """Seconds of the log density at 4096 points, of gathering, and of that with stacking."""
    model, batch = PooledTrust(), stack_missions(data.missions)
    with threadpool_limits(limits=1):  # as the sampler does
        target = _target(gather(model, batch)[0], model.priors)
        z = _matched(target, _modes(target), 0).draw(4096, 0)
        density = median_seconds(lambda: target.log_density(z), 7)
    gathering = median_seconds(lambda: gather(model, batch), 5)
    return (
        density,
        gathering,
        median_seconds(lambda: gather(model, stack_missions(data.missions)), 5),
    )


def gradient_row(table, model, data, quick):
    batch = stack_missions(data.missions)
    weight = np.ones(len(batch.contact_rate))
    n = 20 if quick or batch.contact_rate.size > 20_000 else 200

    @jax.jit
    def run(density, theta):
        potential = jax.value_and_grad(lambda theta: density.potential({"theta": theta}))

        def step(_, carry):
            theta, total = carry
            value, gradient = potential(theta)
            return theta - 1e-9 * gradient, total + value

        return lax.fori_loop(0, n, step, (theta, 0.0))

    with own_settings():
        if why_not_scores(model):
            density = SitesInJax.of(model, batch, weight)
            theta = density._flat[0]
        else:
            target = posterior_of(model, Slots.of(batch, len(weight), (), weight))
            theta = np.append(0.0, np.append(-1.0, np.zeros(target.n_scores - 2)))
            density = ScoresInJax.of(target, theta)
        jax.block_until_ready(run(density, theta))
        seconds = median_seconds(lambda: jax.block_until_ready(run(density, theta)), 5) / n
    name = f"{type(model).__name__}, {len(data.missions)} missions, {data.rates.shape[2]} robots"
    cells = (data.rates.size, batch.contact_rate.size, f"{1e6 * seconds:.0f}")
    table.row(name, *cells, f"{1e9 * seconds / data.rates.size:.0f}")


FRESH = """
import time
import arviz, jax, numpy as np, numpyro, trustbo, trustbo.models
from trustbo import Mission
from trustbo.inference import fit
from trustbo.models import PooledTrust
rng = np.random.default_rng(0)
path = [(0, k) for k in range(11)]
missions = []
for _ in range(20):
    z, x, rates = rng.uniform(size=(10, 3, 2)), rng.normal(0.5, 0.5, 3), []
    for z_k in z:
        x = 0.6 * x + z_k @ [0.3, 0.2] + 0.05 + rng.normal(0.0, 0.05, 3)
        rates.append(x + rng.normal(0.0, 0.05, 3))
    missions.append(Mission.from_arrays(path, z, np.clip(rates, 0.0, 1.0)))
started = time.perf_counter()
fit(missions, PooledTrust(), "exact")
print(time.perf_counter() - started)
"""


def latency(quick):
    print("\n## latency\n")
    table = aligned("", "median ms", "target ms", "reached")
    n, model, missions = 5 if quick else 20, PooledTrust(), pooled_data(21).missions
    whole = median_seconds(lambda: fit(missions, model, "exact"), n)
    latency_row(table, "the whole fit(..., sampler='exact'), all groups", whole)
    for one in (model, CoupledTrust()):
        params = sample_prior(one, N_FEATURES, 1000, 0, n_robots=N_ROBOTS)
        latency_row(table, f"TrustFilter.update, {type(params).__name__}, 1000 draws",
                    filter_seconds(params, missions), 1)  # fmt: skip
    runs = [
        float(subprocess.run([sys.executable, "-W", "ignore", "-c", FRESH], check=True, text=True,
                             capture_output=True).stdout)
        for _ in range(1 if quick else 3)
    ]  # fmt: skip
    latency_row(
        table, "first fit(..., sampler='exact') of a fresh process", float(np.median(runs)), 500
    )


def filter_seconds(params, missions):
    following = TrustFilter(params, N_ROBOTS)
    seconds = []
    for mission in missions:
        following.reset()
        for z, y in zip(mission.awareness, mission.contact_rate, strict=True):
            seconds.append(timed(partial(following.update, z, y))[0])
    return float(np.median(seconds))


def latency_row(table, name, seconds, target=None):
    ms = 1000.0 * seconds
    reached = "" if target is None else verdict(ms <= target)
    table.row(name, f"{ms:.2f}", "" if target is None else target, reached)


def print_machine():
    def version_of(name):
        try:
            return version(name)
        except PackageNotFoundError:
            return "none"

    tools = ("numpyro", "jax", "pymc", "nutpie", "dynamax", "blackjax", "numpy")
    cores = len(os.sched_getaffinity(0))
    print(f"{platform.machine()}, {cores} core(s) for this process, {os.cpu_count()} in all; "
          f"Python {platform.python_version()}")  # fmt: skip
    print(", ".join(f"{name} {version_of(name)}" for name in tools))
    print(f"nutpie runs {min(2, cores)} chain(s) at once, every other tool one after the other.")


SECTIONS: dict[str, Any] = {
    "pooled": pooled,
    "families": families,
    "large": large,
    "coupled": coupled,
    "scaling": scaling,
    "latency": latency,
}


def main():
    given = parsed(arguments(__doc__, names=SECTIONS, quick="a tenth of the draws"))
    print_machine()
    for name in given.names:
        SECTIONS[name](given.quick)


if __name__ == "__main__":
    main()
