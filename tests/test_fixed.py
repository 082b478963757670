"""Nothing that plans are computed from can be changed in place, also in pickles and copies."""

import copy
import dataclasses
import pickle

import joblib
import numpy as np
import pytest
import xarray as xr
from worlds import unequal_robots

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.fixed import fix
from trustbo.identity import fingerprint


@pytest.fixture(scope="module")
def workspace():
    return unequal_robots(blocked=[(0, 0)]).with_places({"camp": (2, 0)})


@pytest.fixture(scope="module")
def plan(workspace):
    return tb.Campaign(workspace, (2, 0), (0, 3)).ask()


@pytest.fixture(scope="module")
def mission():
    return tb.Mission.from_arrays(
        [(2, 0), (1, 0), (1, 1)], np.full((2, 3, 2), 0.5), np.full((2, 3), 0.5)
    )


def set_in(array):
    array[...] = 0


REFUSED_BY_NAME = {
    "a cell": lambda w: w.passable.__setitem__((1, 1), False),
    "a cell by label": lambda w: w.passable.loc.__setitem__({"row": 1, "col": 1}, False),
    "awareness of a feature": lambda w: set_in(w.awareness.sel(feature="visibility")),
    "all awareness": lambda w: set_in(w.awareness),
    "a bound": lambda w: set_in(w.passable_bounds[0, 1]),
    "part of the team": lambda w: set_in(w.of_robots(["r1"]).awareness),
    "a variable of the terrain": lambda w: w.terrain.__setitem__("dsm", w.terrain["dem"]),
    "a variable of the pixels": lambda w: w.pixels.update({"passable": 1}),
    "a variable that is removed": lambda w: w.pixels.__delitem__("passable"),
    "a place": lambda w: w.places.__setitem__("camp", (0.0, 0.0)),
    "places in bulk": lambda w: w.places.update(camp=(0.0, 0.0)),
    "a composite": lambda w: w.composites.clear(),
}


@pytest.mark.parametrize("change", REFUSED_BY_NAME.values(), ids=REFUSED_BY_NAME)
def test_a_workspace_refuses_changes_and_says_what_to_do(change, workspace):
    with pytest.raises(TrustboError, match=r"with_|from_|closing"):
        change(workspace)
    assert workspace.passable[1, 1]
    assert workspace.places.keys() == {"camp"}


ARRAYS = {
    "passable": lambda w, p, m: w.passable.values,
    "heights": lambda w, p, m: w.terrain["dem"].values,
    "pixels": lambda w, p, m: w.pixels["passable"].values,
    "trust of a plan": lambda w, p, m: p.trust,
    "bands of a plan": lambda w, p, m: p.bands,
    "positions of a plan": lambda w, p, m: p.positions,
    "stops of a plan": lambda w, p, m: p.stops,
    "posts of a plan": lambda w, p, m: p.posts,
    "risk of a plan": lambda w, p, m: p.p_fail,
    "awareness of a mission": lambda w, p, m: m.awareness,
    "rates of a bound": lambda w, p, m: m.bounds[0].contact_rate,
}


@pytest.mark.parametrize("again", [lambda one: one, copy.deepcopy, copy.copy,
                                   lambda one: pickle.loads(pickle.dumps(one))])  # fmt: skip
@pytest.mark.parametrize("of", ARRAYS.values(), ids=ARRAYS)
def test_arrays_are_read_only_also_in_copies_and_pickles(of, again, workspace, plan, mission):
    array = of(again(workspace), again(plan), again(mission))
    with pytest.raises(ValueError, match="read-only"):
        array[...] = 0


def test_what_a_campaign_keeps_of_its_missions_is_read_only(workspace):
    campaign = tb.Campaign(workspace, (2, 0), (0, 3))
    truth = tb.models.TrustParams(0.6, np.array([0.3, 0.2, 0.1]), 0.05, 0.05, 0.05)
    list(campaign.run(tb.simulation.ModelSimulator(workspace, truth), 1))
    kept = (campaign.hazard["margin"], campaign.history["path"])
    for array in kept:
        with pytest.raises(ValueError, match=r"read-only|is a view"):
            array[...] = 0.0
    maps = campaign.maps(n_draws=5)
    maps["trust_mean"][...] = 0.0  # made anew for each call
    assert campaign.maps(n_draws=5)["trust_mean"].max() > 0.0


def test_what_is_computed_from_a_workspace_can_be_changed(workspace):
    doubled = workspace.awareness * 2.0
    doubled[0] = 0.0
    mine = workspace.passable.copy()
    mine[1, 1] = False
    maps = workspace.terrain.copy()
    maps["dsm"] = maps["dem"] + 1.0
    assert type(maps) is xr.Dataset
    assert workspace.passable[1, 1]


def test_changes_of_given_arrays_and_terrains_do_not_reach_the_workspace():
    awareness = np.full((2, 3, 3, 2), 0.5)
    passable = np.ones((3, 3), dtype=bool)
    small = tb.Workspace.from_awareness(awareness, passable)
    awareness[...] = 0.0
    passable[...] = False
    assert small.passable.all()
    assert np.nanmax(small.awareness) == 0.5

    terrain = tb.terrain.synthetic_terrain((60.0, 60.0), resolution=3.0)
    hills = tb.Workspace.from_terrain(terrain, (2, 2), n_posts=1)
    before = hills.terrain["dem"].values.copy()
    terrain["dem"].values[...] = 0.0
    np.testing.assert_array_equal(hills.terrain["dem"], before)


def test_a_view_of_an_array_that_can_be_changed_is_copied():
    mine = np.zeros(3)
    view = mine[:]
    view.flags.writeable = False
    fixed = fix(view)
    mine[0] = 1.0
    assert fixed[0] == 0.0
    assert fix(fixed) is fixed


def test_the_pickle_of_a_mission_is_the_same_before_and_after_use(mission):
    fresh = pickle.loads(pickle.dumps(mission))
    before = joblib.hash(fresh)
    assert fresh.bounds[0].status == "ok"
    assert fresh.stations == fresh.path
    assert repr(fresh)
    assert joblib.hash(fresh) == before


def use(workspace, plan, planner):
    """Compute what workspaces, plans and planners keep."""
    params = tb.models.TrustParams(0.6, np.full(len(workspace.features), 0.1), 0.0, 0.1, 0.1)
    planner.plan(params)
    workspace.difficulty.whole()
    workspace.of_robots(workspace.team.names[:1])
    workspace.passable.attrs  # noqa: B018  (xarray makes it when it is asked for)
    for one in (workspace, plan):
        assert repr(one)
        assert one._repr_html_()
    assert plan.routes is not None
    assert plan.posts is not None


def test_hashes_of_workspaces_plans_and_planners_are_those_before_use(workspace, plan):
    things = workspace, plan, tb.Planner(workspace, (2, 0), (0, 3))
    fresh = pickle.loads(pickle.dumps(things))
    before = [(joblib.hash(one), fingerprint(one)) for one in fresh]
    use(*fresh)
    assert [(joblib.hash(one), fingerprint(one)) for one in fresh] == before
    again = pickle.loads(pickle.dumps(fresh))
    assert [(joblib.hash(one), fingerprint(one)) for one in again] == before
    assert [fingerprint(one) for one in things] == [hashed for _, hashed in before]


def test_the_fingerprint_of_a_posterior_is_that_before_use(mission):
    posterior = tb.fit([mission] * 2, check=False, progress=False)
    before = fingerprint(posterior)
    assert repr(posterior)
    assert posterior["posterior"]["b"].mean().item()
    assert fingerprint(posterior.copy(deep=True)) == before == fingerprint(posterior)
    posterior["posterior"]["b"][0, 0] += 1.0
    assert fingerprint(posterior) != before


def test_trust_maps_and_truths_can_be_changed_without_effect(workspace):
    campaign = tb.Campaign(workspace, (2, 0), (0, 3))
    before = campaign.trust_map.values.copy()
    campaign.trust_map[...] = 0.0
    np.testing.assert_array_equal(campaign.trust_map, before)


def test_other_values_of_a_field_make_another_object(mission):
    rates = mission.contact_rate.copy()
    rates[0, 0] = 0.0
    other = dataclasses.replace(mission, contact_rate=rates)
    assert other.contact_rate[0, 0] == 0.0
    assert mission.contact_rate[0, 0] == 0.5
