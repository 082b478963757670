"""Effects of places: what they cost, and what they cost where there are none.

Run: python benchmarks/places.py [times|nuts|absent|stopping ...] [--data DIR]

- times: refits and draws by effects and family, medians of three, one core; NUTS (the peer).
- nuts: means and sds of twelve seeds together, beside long NUTS (the peer); fifteen minutes.
- absent: truths without effects of places; regret with them in the model and without.
- stopping: campaigns that `RegretBound(eps=.05)` stopped, and how many of them were wrong.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from functools import partial

import arviz as az
import numpy as np
from common import Table, arguments, median_processor_seconds, parsed, timed
from scipy.stats import binomtest

import trustbo as tb
from trustbo.inference import params_of
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect, TrustParams
from trustbo.planning import Planner
from trustbo.simulation import ModelSimulator
from trustbo.study import worlds
from trustbo.study.world import COURSES
from trustbo.terrain import synthetic_terrain

PLACES = PooledTrust(effects=PlaceEffect())
BOTH = {"place": PlaceEffect(), "effects": [RobotEffect()]}
MODELS = {
    "places": PLACES,
    "places and robots": PooledTrust(**BOTH),
    "places and robots, censored": PooledTrust(**BOTH, observation="censored"),
}
TARGETS = {"objective": "mean", "max_bounds": "shortest+2"}


def walk(rng, shape, ends):
    """Cells of a walk between two cells that mostly heads for the second."""
    (row, col), goal = ends
    cells = [(row, col)]
    while (row, col) != goal:
        step = np.sign([goal[0] - row, goal[1] - col])
        if rng.random() < 0.1:
            step = rng.integers(-1, 2, 2)
        other = row + int(step[0]), col + int(step[1])
        if other != (row, col) and 0 <= other[0] < shape[0] and 0 <= other[1] < shape[1]:
            row, col = other
            cells.append(other)
    return cells


def driven(side, n_missions, random_ends, missing=0.0):
    """Missions over a random workspace whose truth has effects of places."""
    rng = np.random.default_rng(0)
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(3, side, side, 2)))
    place = rng.normal(0.0, 0.1, (1, side, side))
    bounds = rng.normal(0.0, 0.1, (1, 8, side, side))
    truth = TrustParams(0.3, np.array([0.2, 0.1]), 0.3, 0.05, 0.05, place=place, place_bound=bounds)
    simulator = ModelSimulator(workspace, truth)
    missions = []
    for seed in range(n_missions):
        ends = (side - 1, 0), (0, side - 1)
        if random_ends:
            while True:
                drawn = rng.integers(side, size=(2, 2))
                if abs(drawn[0] - drawn[1]).max() >= side // 2:
                    break
            ends = tuple(map(int, drawn[0])), tuple(map(int, drawn[1]))
        mission = simulator.run(walk(rng, (side, side), ends), seed=seed)
        rates = mission.contact_rate.copy()
        rates[rng.random(rates.shape) < missing] = np.nan
        missions.append(tb.Mission.from_arrays(mission.path, mission.awareness, rates))
    return workspace, missions


def campaign(world, workspace, course, n, seed, **options):
    """Result of a campaign on a world, and the regret of what is recommended after each mission."""
    truth, planner = world.truth(), {"max_bounds": TARGETS["max_bounds"]}
    campaign = tb.Campaign(
        workspace, *world.ends(course), objective=TARGETS["objective"], planner=planner, seed=seed,
        **options,
    )  # fmt: skip
    steps = campaign.run(world.simulator(workspace), n)
    results = [truth.regret(campaign.recommend(), **TARGETS) for _ in steps]
    return campaign.result(), np.array(results)


def times(given):
    print("processor seconds\n")
    table = Table(
        "missions", "effects", "visited bounds", "cold", "warm, one more", "1000 draws of all",
        "k-hat", "Kish size",
    )  # fmt: skip
    for name, side, n, random_ends, missing, models in (
        ("10 x 10, 15", 10, 15, False, 0.0, MODELS),
        ("10 x 10, 15, 15 % of rates missing", 10, 15, False, 0.15, ["places"]),
        ("10 x 10, 60", 10, 60, False, 0.0, ["places", "places and robots"]),
        ("10 x 10, 60, random ends", 10, 60, True, 0.0, ["places"]),
        ("30 x 30, 40, corner to corner", 30, 40, False, 0.0, ["places"]),
    )[: 1 if given.quick else None]:
        workspace, missions = driven(side, n, random_ends, missing)
        fitted = {"workspace": workspace, "sampler": "importance", "whole": False}
        for kind in models:
            fit = partial(tb.fit, model=MODELS[kind], **fitted)
            earlier = fit(missions[:-1])
            cold = median_processor_seconds(lambda m=missions, f=fit: f(m))
            warm = median_processor_seconds(lambda m=missions, f=fit, e=earlier: f(m, earlier=e))
            posterior = fit(missions, earlier=earlier)
            drawn = median_processor_seconds(lambda p=posterior: params_of(p))
            weights = posterior.attrs["k_hat"], posterior.attrs["kish"]
            table.row(
                name, kind, posterior["places"].sizes["bound"],
                *(f"{seconds:.2f}" for seconds in (cold, warm, drawn)),
                f"{weights[0]:.2f}", f"{weights[1]:.0f}",
            )  # fmt: skip
    if given.quick:
        return
    workspace, missions = driven(10, 8, False)
    options = {"workspace": workspace, "sampler": "nuts", "check": False}
    taken, _ = timed(lambda: tb.fit(missions, PLACES, **options))
    print(f"\nNUTS on the same marginal, 10 x 10, 8 missions: {taken:.0f} s")


def absent(given):
    """Campaigns on truths that have no effects of places."""
    n = 2 if given.quick else 24
    kinds = {"places": PLACES, "none": PooledTrust()}
    results = {name: {"lost": [], "learning": [], "tau": []} for name in kinds}
    for seed in range(n):
        ground = synthetic_terrain((500.0, 500.0), seed=seed % 6, relief=30.0)
        workspace = tb.Workspace.from_terrain(ground, (10, 10))
        rng = np.random.default_rng(seed)
        beta = np.array([0.15, 0.15, 0.35]) * rng.uniform(0.5, 1.5, 3)
        params = TrustParams(0.4, beta, 0.55 - beta.sum() * 0.6, 0.05, 0.08, x0_sd=0.1)
        simulator = ModelSimulator(workspace, params)
        ends = ((9, 0), (0, 9)) if seed % 2 else ((9, 4), (0, 5))
        planner = Planner(workspace, *ends)
        best = -planner.plan(params).value
        for name, model in kinds.items():
            result = tb.iterate(
                workspace, *ends, n_iterations=15, simulator=simulator, model=model, seed=seed,
                sampler="importance", progress=False,
            )  # fmt: skip
            results[name]["lost"].append(-planner.evaluate(result.plan.path, params).value)
            driven_on = [-planner.evaluate(m.path, params).value for m in result.missions]
            results[name]["learning"].append(np.mean(driven_on) - best)
            if name == "places":
                sites = result.posterior["posterior"]
                results[name]["tau"].append(
                    [float(sites[t].quantile(0.5)) for t in ("tau_s", "tau_e")]
                )
    lost = {name: np.array(each["lost"]) for name, each in results.items()}
    print(f"{n} campaigns of 15 missions; contact lost in bounds, expected on the path recommended")
    for name in kinds:
        learning = np.mean(results[name]["learning"])
        print(f"  {name:7s} lost {lost[name].mean():.3f}, lost while learning {learning:.3f}")
    print(f"  ratio of lost, places to none: {lost['places'].sum() / lost['none'].sum():.3f}")
    print(f"  median of tau_s, tau_e: {np.median(results['places']['tau'], axis=0).round(3)} "
          f"(prior {PlaceEffect().tau_s * 0.674:.3f})")  # fmt: skip


def of_synthetic_or_given(data):
    """Worlds of version 0.2 that have their files: synthetic ones, all where there is a folder."""
    kinds = "right", "wall", "bare", "aged", "canopy", "slopes"
    return [
        world for world in worlds(data).values()
        if world.kind in kinds and (data is not None or world.is_made)
    ]  # fmt: skip


def stopping(given):
    """Stops of `RegretBound` on the worlds."""
    stopped, wrong, missions, n = 0, 0, [], 0
    for world in of_synthetic_or_given(given.data):
        for course in COURSES:
            rule = tb.RegretBound(eps=0.05)
            result, regret = campaign(world, world.workspace(), course, 15, seed=0, stop=rule)
            n += 1
            if result.stop_reason != "n_iterations":
                stopped, wrong = stopped + 1, wrong + (regret[-1] > 5.0)
                missions.append(len(result.missions))
        print(f"{world.name}: {wrong} wrong of {stopped} stopped, of {n} campaigns", flush=True)
    low, high = binomtest(wrong, stopped).proportion_ci()
    print(f"\nwrong {wrong} of {stopped} stops ({wrong / stopped:.1%}, {low:.1%} to {high:.1%})")
    print(f"{n} campaigns; missions {np.median(missions):g} ({np.quantile(missions, 0.9):g})")


def nuts(given):
    workspace, missions = driven(6, 8, random_ends=False)
    seeds = [
        moments(tb.fit(missions, PLACES, sampler="importance", workspace=workspace, seed=seed))
        for seed in range(12)
    ]
    longer = {"warmup": 600, "draws": 6000, "check": False}
    posterior = tb.fit(missions, PLACES, "nuts", workspace=workspace, **longer)
    print("largest differences: of means in sd; of sds, with NUTS's own error there and at most\n")
    for name, (mean, square) in moments(posterior).items():
        sd = np.sqrt(square - mean**2)
        means, squares = (np.mean([one[name][i] for one in seeds], 0) for i in (0, 1))
        off = np.abs(np.sqrt(squares - means**2) / sd - 1.0)
        group = "posterior" if name in posterior["posterior"] else "places"
        own = np.ravel(az.mcse(posterior[group][name], method="sd")) / sd
        worst = int(np.argmax(off))
        print(
            f"{name}: {np.abs((means - mean) / sd).max():.3f}; "
            f"{off[worst]:.1%}, {own[worst]:.1%}, {own.max():.1%}"
        )


def moments(posterior):
    """Mean and mean square of every parameter and every effect of a place."""
    results, axes = {}, ("chain", "draw")
    for group in ("posterior", "places"):
        for name, draws in posterior[group].data_vars.items():
            if set(axes) <= set(draws.dims):
                results[name] = np.ravel(draws.mean(axes)), np.ravel((draws**2).mean(axes))
    return results


def main():
    parts = {f.__name__: f for f in (times, nuts, absent, stopping)}
    parser = arguments(__doc__, names=parts, data=True, quick="one row, two campaigns")
    parser.set_defaults(names=["times", "absent"])
    given = parsed(parser)
    for part in given.names:
        print(f"\n{part}\n")
        parts[part](given)


if __name__ == "__main__":
    main()
