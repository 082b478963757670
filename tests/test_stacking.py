"""Missions may be given in any iterable that has an order, in every public function."""

import inspect
from collections import deque
from functools import partial

import numpy as np
import pandas as pd
import pytest
from missions import simulate_missions
from worlds import random_cells

import trustbo as tb
from trustbo.hazard.trials import LostMission

MODULES = (
    tb, tb.criticism, tb.hazard, tb.inference, tb.logs, tb.models, tb.planning, tb.plots,
    tb.simulation, tb.study, tb.terrain, tb.workspace, tb.export,
)  # fmt: skip
NO_MISSIONS = {"trust_maps"}  # `missions` are numbers
HOOKS = {"add_data"}  # called by the package, with a list
few_draws = partial(
    tb.fit, model=tb.models.PooledTrust(), sampler="importance", draws=50, latent=False,
    check=False, progress=False,
)  # fmt: skip


def public_functions():
    """Public functions, classes and methods with an argument `missions`, by name."""
    found = {}
    for public in [getattr(module, name) for module in MODULES for name in module.__all__]:
        name = getattr(public, "__name__", "")
        if not callable(public) or not str(getattr(public, "__module__", "")).startswith("trustbo"):
            continue
        if inspect.isclass(public) and issubclass(public, Exception):
            continue
        members = vars(public).items() if inspect.isclass(public) else ()
        methods = {f"{name}.{k}": m for k, m in members if inspect.isfunction(m) and k[0] != "_"}
        found |= {name: public, **methods}

    return {
        name
        for name, function in found.items()
        if "missions" in inspect.signature(function).parameters
        and name.split(".")[-1] not in NO_MISSIONS | HOOKS
    }


@pytest.fixture(scope="module")
def missions():
    return simulate_missions(4, lengths=(3, 2))


@pytest.fixture(scope="module")
def posterior(missions):
    return few_draws(missions)


@pytest.fixture(scope="module")
def placed(driven):
    """A posterior with effects of places, and the workspace of the missions in `driven`."""
    simulator, missions = driven
    workspace = simulator.workspace
    model = tb.models.default_model()
    return few_draws(missions[:4], model=model, workspace=workspace), workspace


@pytest.fixture(scope="module")
def people():
    z = np.random.default_rng(0).uniform(size=(4, 3, 1, 2))
    y = np.random.default_rng(1).uniform(0.2, 0.8, size=(4, 3, 1))
    return [tb.Mission.from_arrays(None, *pair) for pair in zip(z, y, strict=True)]


@pytest.fixture(scope="module")
def of_people(people):
    return few_draws(people, model=tb.models.HumanTrust())


@pytest.fixture(scope="module")
def driven():
    """A simulator and missions with poses."""
    workspace = tb.Workspace.from_terrain(
        tb.terrain.synthetic_terrain((90.0, 90.0), seed=5), (3, 3)
    )
    simulator = tb.simulation.KinematicSimulator(workspace)
    path = [(2, 0), (1, 1), (0, 2), (0, 1), (1, 0)]
    return simulator, 5 * [simulator.run(path, seed=j, mission=0) for j in range(4)]


def written(missions, folder):
    tb.logs.write_missions(folder / "missions.nc", missions)
    return tb.logs.read_missions(folder / "missions.nc")


def watched(posterior, workspace, missions):
    path = [(2, 0), (1, 1), (0, 2)]
    planner = tb.Planner(workspace, path[0], path[-1])
    return planner.watchers(path, posterior, missions=missions)


CALLS = {
    "fit": lambda m, r: few_draws(m)["posterior"].to_dataset(),
    "fit_hazard": lambda m, r: tb.hazard.fit_hazard(m, random_cells(n=10))["intercept"],
    "score": lambda m, r: tb.inference.score(r("posterior"), m),
    "check": lambda m, r: tb.check(r("posterior"), missions=m).table,
    "add_latent": lambda m, r: tb.inference.add_latent(r("posterior"), m, progress=False)[
        "latent"
    ].to_dataset(),
    "to_frame": lambda m, r: tb.logs.to_frame(m),
    "write_missions": lambda m, r: tb.logs.to_frame(written(m, r("tmp_path"))),
    "ReplaySimulator": lambda m, r: tb.logs.to_frame(tb.simulation.ReplaySimulator(m).missions),
    "HumanTrust.observations": lambda m, r: tb.models.HumanTrust().observations(m).contact_rate,
    "RealtimeAwareness": lambda m, r: tb.simulation.RealtimeAwareness(r("driven")[0], m).describe(),
    "threat_map": lambda m, r: tb.planning.threat_map(m, *r("placed"))["probability"],
    "predict_reports": lambda m, r: tb.inference.predict_reports(r("of_people"), m, n_draws=20),
    "contact_dependence": lambda m, r: tb.planning.contact_dependence(m),
    "Planner.watchers": lambda m, r: watched(*r("placed"), m),
}
"""Calls with missions that return what they depend on."""
OTHERS = {"RealtimeAwareness": "driven", "threat_map": "driven",
          "contact_dependence": "driven", "Planner.watchers": "driven",
          "HumanTrust.observations": "people",
          "predict_reports": "people"}  # fmt: skip
"""Fixtures of calls that need other missions."""


def as_objects(missions):
    found = np.empty(len(missions), dtype=object)
    found[:] = missions
    return found


SLOW = {"RealtimeAwareness"}
FORMS = {
    "tuple": tuple,
    "Series": lambda missions: pd.Series(missions, index=range(len(missions), 0, -1)),
    "array of objects": as_objects,
    "generator": lambda missions: (mission for mission in missions),
    "values of a dict": lambda missions: dict(enumerate(missions)).values(),
    "deque": deque,
}


def same(one, other):
    if isinstance(one, pd.DataFrame):
        return one.equals(other)
    return one.identical(other) if hasattr(one, "identical") else np.array_equal(one, other)


def test_every_public_function_with_missions_is_tested():
    assert public_functions() == CALLS.keys()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", CALLS)
def test_missions_may_be_in_any_iterable_that_has_an_order(name, request):
    given = request.getfixturevalue(OTHERS.get(name, "missions"))
    missions = given[1] if isinstance(given, tuple) else given
    expected = CALLS[name](missions, request.getfixturevalue)
    for form, make in FORMS.items() if name not in SLOW else [("generator", iter)]:
        found = CALLS[name](make(missions), request.getfixturevalue)
        assert same(found, expected), form

    for wrong in (missions[0], set(range(3)), dict(enumerate(missions)), 3, "missions", ["ab"]):
        with pytest.raises(tb.TrustboError, match="missions"):
            CALLS[name](wrong, request.getfixturevalue)


def test_earlier_and_lost_missions_may_be_in_any_iterable(missions):
    expected = few_draws(missions[:2], earlier=missions[2:])["posterior"]
    for make in (tuple, iter, as_objects):
        found = few_draws(make(missions[:2]), earlier=make(missions[2:]))["posterior"]
        assert found.to_dataset().identical(expected.to_dataset())

    lost = [LostMission(missions[0].path)]
    workspace = random_cells(n=10)
    expected = tb.hazard.fit_hazard(missions, workspace, lost=lost)["intercept"]
    found = tb.hazard.fit_hazard(missions, workspace, lost=iter(lost))["intercept"]
    np.testing.assert_array_equal(found, expected)
