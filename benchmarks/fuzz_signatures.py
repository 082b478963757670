"""Fuzz test of signatures: valid calls of the public functions, with one wrong argument at a time.

    python benchmarks/fuzz_signatures.py [name ...] [--all]

`CALLS` lists valid calls. In turn, each of their arguments is replaced by each of some 40 values:
None, numbers that are not finite, negative or huge, text, empty and ragged lists, arrays of another
shape or type, and objects of other classes. The outcome of such a call is one of

    TrustboError  the value is refused with a sentence
    TypeError     Python's own error, raised by the function that was called and not below it
    accepted      the call returns; the value may be valid for this argument
    foreign       another exception, from somewhere below
    hang          the call takes more than ten seconds of processor time

The first rows of the table are arguments that are numbers, names, arrays, lists or dicts, by kind
of value. A user may plausibly pass these values, except for objects of other classes. The last rows
are arguments that are flags, files, or objects such as a workspace: None is plausible there, but a
wrong class may get Python's own error. Below the table, each TypeError, foreign exception and hang
of a plausible value is listed, with the argument, the values and the line of the source. With
--all, the others are listed, too. The exit status is 1 if there is a foreign exception or a hang in
the list.

Everything is deterministic. Names select the calls whose name begins with one of them.
"""

import contextlib
import dataclasses
import io
import math
import os
import re
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import xarray as xr
from common import Table, arguments, parsed

import trustbo as tb

_SECONDS = 10.0  # after which a call hangs
_MEMORY = 12 * 2**30  # bytes of address space that the calls may add
_SHOWN = 150  # letters of the values and of the message of a foreign exception
OUTCOMES = ("TrustboError", "TypeError", "accepted", "foreign", "hang")
KINDS = (
    "None", "not finite", "negative or zero", "huge", "text", "empty", "ragged",
    "another shape", "another type of numbers", "another object", "None for an object",
    "another object for an object",
)  # fmt: skip
"""Rows of the table."""
IMPLAUSIBLE = "another object", "another object for an object"
"""Rows of values that may get Python's own error."""


class Call(NamedTuple):
    """Valid call of a public function."""

    name: str
    function: Callable[..., Any]
    arguments: dict[str, Any]


class Value(NamedTuple):
    """Wrong value of an argument; `make` is called anew for each call."""

    kind: str
    name: str
    make: Callable[[], Any]


# --- wrong values ---


def values_for(valid: Any) -> Iterator[Value]:
    """Yield the values that replace the valid value of an argument."""
    yield from SIMPLE
    if isinstance(valid, np.ndarray) and valid.dtype != bool:
        yield from arrays_like(valid.astype(float))


def same(kind: str, *values: Any) -> list[Value]:
    """Make values that no call changes."""
    return [Value(kind, f"{value!r:.25}", lambda value=value: value) for value in values]


SIMPLE = (
    *same("None", None),
    *same("not finite", math.nan, math.inf, -math.inf, np.array([np.nan])),
    *same("negative or zero", -1, 0, -0.5, np.int8(-3)),
    *same("huge", 10**24, 1e300),
    *same("text", "3", "", "x", "ü\0", b"3"),
    *same("empty", [], (), {}, np.array([])),
    *same("ragged", [[1, 2], [3]], [1, "a"], [None]),
    *same("another shape", [1], [1, 2], range(3), np.array(3.0), {"x": 1}),
    *same("another type of numbers", 1 + 2j, np.float16(1.5), True, pd.NA, np.ma.masked),
    *same("another object", {"a"}, float),
    Value("another object", "object()", object),
    Value("another object", "a function", lambda: lambda *words, **named: None),
    Value("another object", "a generator", lambda: (k for k in (1, 2))),
    Value("another object", "a time stamp", lambda: pd.Timestamp("2020")),
)


def arrays_like(valid: np.ndarray) -> list[Value]:
    """Make arrays that have the shape of a valid one but wrong values, or another shape."""
    one_none = valid.astype(object)
    one_none.flat[0] = None
    return [
        *same("not finite", np.full_like(valid, np.nan), np.full_like(valid, np.inf)),
        *same("negative or zero", -valid - 1.0),
        *same("huge", valid + 1e300),
        *same("text", valid.astype(str), np.full(valid.shape, "high").tolist()),
        *same("empty", valid[:0], valid[..., :0]),
        *same("another shape", valid.T, valid[None], valid.ravel(), np.repeat(valid, 2, axis=0)),
        *same("another type of numbers", one_none, valid + 1j, np.zeros(valid.shape, "M8[s]")),
    ]


# --- valid calls ---


def random(*seed: int) -> np.random.Generator:
    return np.random.default_rng([0, *seed])


ENDS = (3, 0), (0, 3)
PATH = [(3, 0), (2, 1), (1, 2), (0, 3)]
SHORT = [(2, 0), (1, 1), (0, 2)]
POOLED = tb.models.PooledTrust()
PARAMS = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)


@cache
def awareness() -> np.ndarray:
    return random(1).uniform(size=(3, 4, 4, 2))


@cache
def cells() -> tb.Workspace:
    return tb.Workspace.from_awareness(awareness())


@cache
def ground() -> xr.Dataset:
    return tb.terrain.synthetic_terrain((90.0, 90.0), resolution=3.0, seed=5)


@cache
def hills() -> tb.Workspace:
    return tb.Workspace.from_terrain(ground(), (3, 3))


@cache
def mission(seed: int = 0) -> tb.Mission:
    return tb.Mission.from_arrays(PATH, cells().along(PATH), random(2, seed).uniform(size=(3, 3)))


def campaign(n_missions: int = 0) -> tb.Campaign:
    begun = tb.Campaign(cells(), *ENDS, model=POOLED, fit={"draws": 100})
    for seed in range(n_missions):
        begun.tell(mission(seed))
    return begun


@cache
def result() -> tb.Campaign:
    return campaign(2)


@cache
def posterior() -> xr.DataTree:
    return tb.fit([mission(0), mission(1)], POOLED, draws=100, progress=False)


@cache
def posterior_of_people() -> xr.DataTree:
    return tb.fit(people(), tb.models.HumanTrust(), draws=100, progress=False)


@cache
def reports() -> pd.DataFrame:
    report = random(3).uniform(size=8)
    ease = random(4).uniform(size=8)
    who = ["a"] * 4 + ["b"] * 4
    return pd.DataFrame({"person": who, "step": [*range(4)] * 2, "report": report, "ease": ease})


@cache
def people() -> list[tb.Mission]:
    return tb.logs.read_reports(reports(), inputs=["ease"])


@cache
def draws() -> tb.models.TrustParams:
    return tb.inference.sample_prior(POOLED, 2, 50, 0)


@cache
def planner() -> tb.planning.Planner:
    return tb.planning.Planner(cells(), *ENDS)


@cache
def kinematic() -> tb.simulation.KinematicSimulator:
    return tb.simulation.KinematicSimulator(hills())


@cache
def truth() -> tb.simulation.Truth:
    return tb.simulation.Truth.from_simulator(kinematic(), n_replicates=1)


def small_case() -> dict[str, dict[str, Any]]:
    return {"a": {"model": POOLED, "fit": {"draws": 50}}}


@cache
def simulator() -> tb.simulation.ModelSimulator:
    return tb.simulation.ModelSimulator(cells(), PARAMS)


def of_team() -> list[Call]:
    numbers = {
        "speed": 2.0,
        "turn_rate": 1.0,
        "lookahead": 1.5,
        "lidar_range": 100.0,
        "vertical_fov": 0.3,
        "sensor_height": 1.0,
        "target_height": 1.0,
        "max_slope": 0.5,
        "detection": 1.0,
        "acquire": 1,
        "drop": 1,
    }
    team = {"n_robots": 3, "robots": (), "lead": tb.Robot(), "names": ("a", "b", "c")}
    return [Call("Robot", tb.Robot, numbers), Call("Team", tb.Team, team)]


def of_workspace() -> list[Call]:
    from_arrays = {
        "awareness": awareness(),
        "passable": np.ones((4, 4), bool),
        "cell_size": 50.0,
        "team": tb.Team(3),
        "features": ("a", "b"),
    }
    from_terrain = {
        "terrain": ground(),
        "shape": (3, 3),
        "team": tb.Team(2),
        "features": {"traversability": tb.terrain.TRAVERSABILITY},
        "bounds": False,
        "sight": tb.workspace.Sight(),
    }
    w = cells()
    return [
        Call("Workspace.from_awareness", tb.Workspace.from_awareness, from_arrays),
        Call("Workspace.from_terrain", tb.Workspace.from_terrain, from_terrain),
        Call("Workspace.along", w.along, {"path": PATH, "anywhere": False}),
        Call("Workspace.locate", w.locate, {"location": (3, 0)}),
        Call("Workspace.in_order", w.in_order, {"mission": mission()}),
        Call("Workspace.fill", w.fill, {"mission": mission()}),
        Call("Sight", tb.workspace.Sight, {"extinction": 0.1, "crown_base": 0.3}),
    ]


def of_terrain() -> list[Call]:
    maps = {"a": random(5).normal(size=(4, 4)), "b": random(6).normal(size=(4, 4))}
    index = tb.terrain.CompositeIndex({"a": 1, "b": -1})
    synthetic = {"size": (30.0, 30.0), "resolution": 3.0, "seed": 0, "relief": 30.0}
    heights = {"dem": ground()["dem"], "dsm": ground()["dsm"], "resolution": 3.0, "nodata": -9999.0}
    gradient = {"dem": random(7).normal(size=(5, 6)), "pixel": (1.0, 1.0)}
    return [
        Call("terrain.synthetic_terrain", tb.terrain.synthetic_terrain, synthetic),
        Call("terrain.read_terrain", tb.terrain.read_terrain, heights),
        Call("terrain.gradient", tb.terrain.gradient, gradient),
        Call("terrain.pixel_size", tb.terrain.pixel_size, {"terrain": ground()}),
        Call("terrain.CompositeIndex", tb.terrain.CompositeIndex, {"signs": {"a": 1}}),
        Call("terrain.CompositeIndex.fit", index.fit, {"features": maps}),
        Call("terrain.feature", tb.terrain.feature, {"name": "own", "sign": 1}),
    ]


def of_data() -> list[Call]:
    one = mission()
    arrays = {
        "path": PATH,
        "awareness": one.awareness.copy(),
        "contact_rate": np.full((3, 3), 0.5),
        "duration": np.full(3, 20.0),
        "status": "ok",
        "n_ticks": np.full((3, 3), 20.0),
        "features": ("a", "b"),
        "robots": ("r1", "r2", "r3"),
    }
    fields = {
        "path": one.path,
        "status": "ok",
        "features": one.features,
        "robots": one.robots,
        "scale": "unit",
    }
    return [
        Call("Mission.from_arrays", tb.Mission.from_arrays, arrays),
        Call("Mission", partial(dataclasses.replace, one), fields),
    ]


def of_models() -> list[Call]:
    usual = {"priors": tb.models.Priors(), "family": "gaussian", "effects": ()}
    more = usual | {"memory": "level", "shared_noise": False}
    human = {"scale": "unit", "tau_start": 0.3, "tau_level": 0.2, "tau_gain": 0.2}
    place = {"tau_s": 0.2, "tau_e": 0.2, "length_scale": 2.0, "length_scale_sd": 0.5}
    hazard = {
        "intercept": (-7.5, 1.5),
        "coefficient": (2.0, 2.0),
        "margin": (0.0, 0.5),
        "limit": (0.1, 4.0),
        "log_width": (0.0, 0.5),
        "log_strength": (-0.5, 1.0),
    }
    robot = {"tau_slow": 0.2, "tau_mission": 0.2, "rho": 0.9}
    numbers = {"concentration": 2.0, "x0_mean": 0.5, "x0_sd": 0.5, "stationary": False}
    of_names = {"features": ("a", "b"), "family": "gaussian"}
    return [
        Call("models.PooledTrust", tb.models.PooledTrust, more),
        Call("models.HierarchicalTrust", tb.models.HierarchicalTrust, more),
        Call("models.CoupledTrust", tb.models.CoupledTrust, usual),
        Call("models.HumanTrust", tb.models.HumanTrust, human),
        Call("models.PlaceEffect", tb.models.PlaceEffect, place),
        Call("models.RobotEffect", tb.models.RobotEffect, robot),
        Call("models.Priors", tb.models.Priors, numbers),
        Call("models.Priors.from_features", tb.models.Priors.from_features, of_names),
        Call("models.default_model", tb.models.default_model, {"places": True}),
        Call("hazard.Hazard", tb.hazard.Hazard, hazard),
    ]


def of_inference() -> list[Call]:
    fit = {
        "missions": [mission()],
        "model": POOLED,
        "sampler": "importance",
        "workspace": cells(),
        "draws": 50,
        "seed": 0,
        "progress": False,
    }
    nuts = {"draws": 20, "chains": 2, "warmup": 20}

    def by_nuts(**options: Any) -> xr.DataTree:
        usual = {"progress": False, "check": False, "sampler": "nuts"}
        return tb.fit([mission()], POOLED, **usual, **options)

    def updated(**arrays: Any) -> Any:
        return tb.inference.TrustFilter(posterior()).update(**arrays)

    def predicted(**arrays: Any) -> Any:
        return tb.inference.TrustFilter(posterior()).predict(**arrays)

    filtering = {
        "posterior": posterior(),
        "n_robots": 3,
        "family": "gaussian",
        "max_draws": 50,
    }
    update = {
        "awareness": mission().awareness[0],
        "contact_rate": np.full(3, 0.5),
        "n_ticks": np.full(3, 20.0),
    }
    prior = {"model": POOLED, "n_features": 2, "n_draws": 5, "seed": 0, "n_robots": 1}
    params = {"posterior": posterior(), "workspace": cells(), "next_mission": False}
    whole = {"posterior": posterior(), "missions": [mission(0), mission(1)], "model": POOLED}
    scored = {
        "posterior": posterior(),
        "missions": [mission(2)],
        "workspace": cells(),
        "seed": 0,
    }
    reported = {
        "posterior": posterior_of_people(),
        "missions": people(),
        "given": "earlier",
        "fitted": True,
        "n_draws": 50,
        "seed": 0,
    }
    checked = {"posterior": posterior(), "missions": [mission(0), mission(1)]}
    compared = {"posteriors": {"a": posterior(), "b": posterior()}}
    return [
        Call("fit", tb.fit, fit),
        Call("fit by NUTS", by_nuts, nuts),
        Call("compare", tb.compare, compared),
        Call("check", tb.check, checked),
        Call("inference.loo", tb.inference.loo, {"posterior": posterior(), "model": POOLED}),
        Call("inference.add_latent", tb.inference.add_latent, whole),
        Call("inference.params_of", tb.inference.params_of, params),
        Call("inference.sample_prior", tb.inference.sample_prior, prior),
        Call("inference.score", tb.inference.score, scored),
        Call("inference.predict_reports", tb.inference.predict_reports, reported),
        Call("inference.TrustFilter", tb.inference.TrustFilter, filtering),
        Call("inference.TrustFilter.update", updated, update),
        Call("inference.TrustFilter.predict", predicted, {"awareness": mission().awareness}),
    ]


def of_planning() -> list[Call]:
    made = {
        "workspace": cells(),
        "start": (3, 0),
        "goal": (0, 3),
        "objective": "lost_contact",
        "max_bounds": "shortest+4",
        "bound_cost": np.zeros((8, 4, 4)),
        "max_failure": 0.5,
        "failure_cost": 1.0,
        "family": "gaussian",
    }
    longest = {"max_bounds": 5}
    p_fail = np.full((8, 4, 4), 0.1)

    def of_at_most(max_bounds: Any) -> tb.planning.Plan:
        return tb.planning.Planner(cells(), *ENDS, max_bounds=max_bounds).plan(PARAMS)

    def at_risk(p_fail: Any, draws: Any) -> tb.planning.Plan:
        return planner().with_risk(p_fail, draws).plan(PARAMS)

    def at_cost(failure_cost: Any) -> tb.planning.Plan:
        return planner().with_risk(p_fail).with_failure_cost(failure_cost).plan(PARAMS)

    def avoiding(bounds: Any, risk: Any) -> tb.planning.Plan:
        return planner().avoiding(bounds, risk).plan(PARAMS)

    def by_policy(name: str) -> Call:
        policy = getattr(tb.planning.policies, name)
        given = {"rng": random(), "params": draws(), "planner": planner()}
        extra = {"optimistic": {"quantile": 0.9}, "ucb": {"kappa": 1.0}}
        return Call(f"planning.policies.{name}", policy, given | extra.get(name, {}))

    start = np.full(3, 0.5)
    some = {"posterior": draws(), "n_draws": 5, "seed": 0}
    along_path = {"params": PARAMS, "awareness": mission().awareness, "x0": start}
    avoided = {"bounds": np.zeros((8, 4, 4), bool), "risk": p_fail}
    place = {"robot": "r2", "cell": (2, 1), "move": "n"}
    p = planner()
    return [
        Call("planning.Planner", tb.planning.Planner, made),
        Call("planning.Planner of at most", of_at_most, longest),
        Call("planning.Planner.plan", p.plan, {"params": draws(), "x0": start}),
        Call("planning.Planner.plan_draws", p.plan_draws, some),
        Call("planning.Planner.evaluate", p.evaluate, {"path": PATH, "params": draws()}),
        Call("planning.Planner.maps", p.maps, some),
        Call("planning.Planner.trust_map", p.trust_map, {"params": PARAMS, "x0": start}),
        Call("planning.Planner.trust", p.trust, {"params": draws(), **place}),
        Call("planning.Planner.robot_maps", p.robot_maps, {"posterior": draws()}),
        Call("planning.Planner.graph", p.graph, {"params": PARAMS}),
        Call("planning.Planner.with_risk", at_risk, {"p_fail": p_fail, "draws": p_fail[None]}),
        Call("planning.Planner.with_failure_cost", at_cost, {"failure_cost": 1.0}),
        Call("planning.Planner.avoiding", avoiding, avoided),
        Call("planning.expected_trust", tb.planning.expected_trust, along_path),
        *map(by_policy, ("greedy", "thompson", "optimistic", "ucb", "random")),
    ]


def of_simulation() -> list[Call]:
    s, seen = tb.simulation, {"first": 0, "last": 3}
    kinematic_given = {
        "workspace": hills(),
        "terrain": ground(),
        "sight": tb.workspace.Sight(),
        "team": hills().team,
        "tick": 0.5,
        "bound_timeout": 60.0,
        "events": (),
    }
    model_given = {
        "workspace": cells(),
        "params": PARAMS,
        "model": POOLED,
        "awareness": cells().awareness.values,
        "p_fail": np.full((8, 4, 4), 0.1),
    }
    run = {"path": PATH, "seed": 0, "mission": 0}
    trees = {"height": 3.0, "center": (0.0, 0.0), "radius": 5.0, **seen}
    jam = {"center": (0.0, 0.0), "radius": 5.0, "strength": 1.0, **seen}
    fouling = {"worst": 0.5, "correlation": 0.95, "every": 16, "seed": 0, **seen}
    best = {"start": (2, 0), "goal": (0, 2), "max_bounds": "shortest+2", "failures": False}
    of_truth = {"simulator": kinematic(), "mission": 0, "n_replicates": 1, "seed": 0}
    replay = s.ReplaySimulator([mission()])
    t = truth()
    return [
        Call("simulation.KinematicSimulator", s.KinematicSimulator, kinematic_given),
        Call("simulation.KinematicSimulator.run", kinematic().run, {**run, "path": SHORT}),
        Call("simulation.ModelSimulator", s.ModelSimulator, model_given),
        Call("simulation.ModelSimulator.run", simulator().run, run),
        Call("simulation.RadioSimulator", s.RadioSimulator, {"workspace": hills(), "seed": 0}),
        Call("simulation.ReplaySimulator", s.ReplaySimulator, {"missions": [mission()]}),
        Call("simulation.ReplaySimulator.run", replay.run, run),
        Call("simulation.Truth.from_simulator", s.Truth.from_simulator, of_truth),
        Call("simulation.Truth.at", t.at, {"mission": 0}),
        Call("simulation.Truth.lost", t.lost, {"path": SHORT}),
        Call("simulation.Truth.best", t.best, best),
        Call("simulation.Truth.regret", t.regret, {"path": SHORT, "max_bounds": 4}),
        Call("simulation.Degradation", s.Degradation, {"robot": "r1", "detection": 0.5, **seen}),
        Call("simulation.Dust", s.Dust, {"detection": 0.5, **seen}),
        Call("simulation.Fouling", s.Fouling, fouling),
        Call("simulation.Jam", s.Jam, jam),
        Call("simulation.Season", s.Season, {"extinction": 0.5, **seen}),
        Call("simulation.Trees", s.Trees, trees),
    ]


def of_campaign() -> list[Call]:
    begun = {
        "workspace": cells(),
        "start": (3, 0),
        "goal": (0, 3),
        "model": POOLED,
        "policy": "greedy",
        "objective": "lost_contact",
        "sampler": "importance",
        "seed": 0,
        "overwrite": False,
        "initial": "prior_mean",
        "hazard": tb.hazard.Hazard(),
        "planner": {"max_failure": 0.5},
        "fit": {"draws": 50},
    }
    run = {"simulator": simulator(), "n_iterations": 1, "progress": False}
    iterated = {
        **{name: begun[name] for name in ("workspace", "start", "goal", "model", "fit", "seed")},
        **run,
    }

    def asked() -> tb.Campaign:
        one = campaign()
        one.ask()
        return one

    def following(t: Any, cell: Any, in_contact: Any, status: Any) -> tb.Mission:
        follower = tb.Follower(result())
        follower.begin(t, cell)
        follower.tick(t + 1.0, in_contact)
        follower.end(t + 2.0, status)
        return follower.to_mission()

    followed = {"t": 0.0, "cell": (2, 1), "in_contact": np.ones(3), "status": "ok"}
    failed = {"reason": "stuck", "where": (2, 1)}
    r = result()
    return [
        Call("Campaign", tb.Campaign, begun),
        Call("Campaign.suggest", lambda path: asked().suggest(path), {"path": PATH}),
        Call("Campaign.fail", lambda reason, where: asked().fail(reason, where=where), failed),
        Call("Campaign.tell", lambda mission: asked().tell(mission), {"mission": mission()}),
        Call("Campaign.exclude", campaign(1).exclude, {"n": 1, "reason": "rain"}),
        Call("Campaign.run", lambda **given: list(campaign().run(**given)), run),
        Call("Campaign.maps", r.maps, {"n_draws": 5}),
        Call("Campaign.trust", r.trust, {"robot": "r2", "cell": (2, 1), "move": "n"}),
        Call("Campaign.draw_prior", r.draw_prior, {"n_draws": 5}),
        Call("iterate", tb.iterate, iterated),
        Call("RegretBound", tb.RegretBound, {"eps": 0.05, "delta": 0.1}),
        Call("Follower", tb.Follower, {"campaign": r}),
        Call("Follower methods", following, followed),
        Call("load_result", tb.load_result, {"directory": Path(saved())}),
        Call("resume", tb.resume, {"directory": Path(simulated()), "simulator": simulator()}),
    ]


@cache
def saved() -> str:
    result().save("saved", overwrite=True)
    return "saved"


@cache
def simulated() -> str:
    options = {"model": POOLED, "fit": {"draws": 50}, "progress": False, "overwrite": True}
    given = {"simulator": simulator(), "n_iterations": 1, "directory": "simulated"}
    tb.iterate(cells(), *ENDS, **given, **options)
    return "simulated"


def of_logs() -> list[Call]:
    table = tb.logs.to_frame([mission()])
    ticks = np.arange(40.0)
    robots = np.repeat(["lead", "r1", "r2", "r3"], 40)
    poses = {"t": np.tile(ticks, 4), "robot": robots, "x": np.tile(ticks, 4), "y": 0.0}
    seen = {"t": ticks, "watcher": "r1", "seen": "lead"}
    tracks = {
        "poses": pd.DataFrame(poses),
        "detections": pd.DataFrame(seen),
        "lead": "lead",
        "window": 20.0,
        "tick": 1.0,
    }
    reported = {
        "table": reports(),
        "person": "person",
        "step": "step",
        "report": "report",
        "inputs": ["ease"],
        "scale": "unit",
    }
    written = {"path": Path("missions.nc"), "missions": [mission()]}
    tb.logs.write_missions(**written)
    return [
        Call("logs.to_frame", tb.logs.to_frame, {"missions": [mission()]}),
        Call("logs.read_table", tb.logs.read_table, {"table": table}),
        Call("logs.read_reports", tb.logs.read_reports, reported),
        Call("logs.read_tracks", tb.logs.read_tracks, tracks),
        Call("logs.write_missions", tb.logs.write_missions, written),
        Call("logs.read_missions", tb.logs.read_missions, {"path": Path("missions.nc")}),
    ]


def of_export() -> list[Call]:
    r = result()

    def in_crs(origin: Any, rotation: Any, xy: Any) -> Any:
        return tb.export.Frame(origin, rotation).of_crs(xy)

    framed = {"origin": (0.0, 0.0), "rotation": 0.0, "xy": np.array([[1.0, 2.0]])}
    nav2 = {
        "folder": Path("nav2"),
        "result": r,
        "frame": tb.export.Frame((0.0, 0.0)),
        "pixel": 10.0,
    }
    exported = {"result": r, "folder": Path("exported"), "formats": ["csv"]}
    return [
        Call("export.export_result", tb.export.export_result, exported),
        Call("export.write_csv", tb.export.write_csv, {"path": Path("missions.csv"), "result": r}),
        Call("export.write_nav2", tb.export.write_nav2, nav2),
        Call("export.Frame.of_crs", in_crs, framed),
        Call("report.write_report", tb.report.write_report, {"path": Path("r.html"), "result": r}),
    ]


def of_plots() -> list[Call]:
    r, p = result(), tb.plots
    shown = {"plan": r.plan(), "maps": r.maps(n_draws=5), "history": r.history}
    values = {
        "values": r.trust_map,
        "workspace": cells(),
        "path": PATH,
        "limits": (0.0, 1.0),
        "label": "trust",
    }
    maps = {
        "history": r.history,
        "trust_map": r.trust_map,
        "path": PATH,
        "workspace": cells(),
        "missions": (1, 2),
    }
    plan = tb.planning.Planner(hills(), (2, 0), (0, 2)).plan(three_features())
    return [
        Call("plots.cell_map", p.cell_map, values),
        Call("plots.grid_map", p.grid_map, {"workspace": hills()}),
        Call("plots.terrain_maps", p.terrain_maps, {"workspace": hills()}),
        Call("plots.trust_maps", p.trust_maps, maps),
        Call("plots.plan_map", p.plan_map, {"plan": plan, "bounds": [1]}),
        Call("plots.trust_curves", p.trust_curves, {"given": r.posterior, "mission": 0}),
        Call("plots.explore", p.explore, shown),
    ]


def three_features() -> tb.models.TrustParams:
    return PARAMS.replace(beta=np.array([0.3, 0.2, 0.1]))


def of_study() -> list[Call]:
    scenes = {"s": lambda: tb.study.Scene(cells(), simulator(), *ENDS)}
    run = {
        "cases": small_case(),
        "scenes": scenes,
        "folder": Path("study"),
        "seeds": (0,),
        "n_missions": 1,
    }
    return [Call("study.run_grid", partial(tb.study.run_grid, n_jobs=1), run)]


CALLS = (
    of_team, of_workspace, of_terrain, of_data, of_models, of_inference, of_planning,
    of_simulation, of_campaign, of_logs, of_export, of_plots, of_study,
)  # fmt: skip
"""Functions that list the valid calls, one for each part of the package."""


# --- outcome of a call ---


class TooLongError(BaseException):
    """The call takes too long; not an Exception, so that no `except` of trustbo catches it."""


def _stop(*_: object) -> None:
    raise TooLongError


def outcome(function: Callable[..., Any], given: dict[str, Any], seconds: float) -> tuple[str, str]:
    """Return the outcome of a call, and the error with its line if it is foreign."""
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            function(**given)
        return "accepted", ""
    except TooLongError:
        return "hang", f"more than {seconds:g} s of processor time"
    except tb.TrustboError as error:
        return "TrustboError", str(error)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in frames if "/trustbo/" in frame.filename]
        where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "not in trustbo"
        text = f"{type(error).__name__} in {where}: {' '.join(str(error).split())}"
        at_entry = (
            isinstance(error, TypeError) and len(ours) < 2 and frames[-1] in (*ours, frames[0])
        )
        return "TypeError" if at_entry else "foreign", text
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        plt.close("all")


def row_of(valid: Any, value: Value) -> str:
    """Return the row of the table that a wrong value belongs to."""
    if type(valid) in (int, float, str, np.ndarray, list, tuple, dict):  # not a bool or NamedTuple
        return value.kind
    return "None for an object" if value.kind == "None" else "another object for an object"


def fuzz(call: Call) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield the row, the argument, the value, the outcome and the error of each wrong call."""
    found, error = outcome(call.function, dict(call.arguments), 0.0)  # compiles, so no limit
    if found != "accepted":
        print(f"{call.name} is left out, as its valid call was not accepted: {error}")
        return
    for argument, valid in call.arguments.items():
        for value in values_for(valid):
            given = {**call.arguments, argument: value.make()}
            found, error = outcome(call.function, given, _SECONDS)
            yield row_of(valid, value), argument, value.name, found, error


# --- report ---


def main() -> int:
    words = arguments(__doc__ or "")
    words.add_argument("names", nargs="*", help="first letters of the calls to make")
    words.add_argument("--all", action="store_true", help="list also objects of other classes")
    given = parsed(words)

    mpl.use("agg")
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGPROF, _stop)
    used = int(re.findall(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())[0]) * 1024
    resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY, used + _MEMORY))

    counts = {row: Counter[str]() for row in KINDS}
    listed: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for call in (call for room in CALLS for call in room()):
            if given.names and not call.name.startswith(tuple(given.names)):
                continue
            for row, argument, value, found, error in fuzz(call):
                counts[row][found] += 1
                plain = row not in IMPLAUSIBLE or found == "hang" or given.all
                if found in ("TypeError", "foreign", "hang") and plain:
                    listed[call.name, argument, error].append(value)

    table = Table("value", "calls", *OUTCOMES, first=28, others=6)
    for row in KINDS:
        table.row(row, counts[row].total(), *(counts[row][found] for found in OUTCOMES))
    plausible = sum((counts[row] for row in KINDS if row not in IMPLAUSIBLE), Counter())
    table.row("plausible", plausible.total(), *(plausible[found] for found in OUTCOMES))
    whole = sum(counts.values(), Counter())
    table.row("all", whole.total(), *(whole[found] for found in OUTCOMES))

    print()
    for (name, argument, error), values in listed.items():
        print(f"{name}({argument}=) <- {', '.join(values):.{_SHOWN}}: {error:.{_SHOWN}}")
    return 1 if plausible["foreign"] or whole["hang"] else 0


if __name__ == "__main__":
    sys.exit(main())
