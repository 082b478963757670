"""What a newcomer gets wrong: each gives one line that says what was wrong, and what to do."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.export import write_geojson
from trustbo.inference import (
    TrustFilter,
    by_rate,
    diagnostics,
    fit,
    loo,
    params_of,
    place_maps,
    prior_predictive,
    sample_prior,
)
from trustbo.models import PlaceEffect, PooledTrust, Priors, TrustParams
from trustbo.planning import Planner, roll_trust
from trustbo.simulation import KinematicSimulator, ModelSimulator
from trustbo.workspace.grid import Grid

ENDS = (5, 0), (0, 5)
PLACES = PooledTrust(place=PlaceEffect())
GRID = Grid((5, 5), 380_000.0, 5_225_000.0, 100.0, 100.0, "EPSG:32616")
TRUTH = TrustParams(0.5, np.array([0.2, 0.1]), 0.2, 0.05, 0.05)


def made(*shape):
    return tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=shape))


class Own:
    """A simulator of these methods."""

    def __init__(self, **methods):
        self.__dict__.update(methods)


class Case:
    """A mission that is as it should be, and its parts."""

    def __init__(self):
        self.workspace = made(3, 6, 6, 2)
        self.simulator = ModelSimulator(self.workspace, TRUTH)
        self.path = tb.Campaign(self.workspace, *ENDS).ask().path
        self.mission = self.simulator.run(self.path, seed=0)
        self.z, self.y = self.mission.awareness, self.mission.contact_rate

    @cached_property
    def result(self):
        return self.iterate(model=PooledTrust())

    def tell(self, path=None, z=None, y=None):
        z, y = (self.z if z is None else z), (self.y if y is None else y)
        campaign = tb.Campaign(self.workspace, *ENDS)
        campaign.tell(tb.Mission.from_arrays(path or self.path, z, y))

    def iterate(self, *ends, simulator=None, **options):
        simulator = self.simulator if simulator is None else simulator
        options = {"n_iterations": 1, "progress": False} | options
        return tb.iterate(self.workspace, *(ends or ENDS), simulator=simulator, **options)


@pytest.fixture(scope="module")
def case():
    return Case()


@pytest.fixture(scope="module")
def posterior(case):
    return fit([case.mission], PooledTrust())


MISTAKES = {
    # missions
    "row and col swapped": (lambda c: c.tell([(b, a) for a, b in c.path]), "were row and col swap"),
    "ratings of 1 to 7": (
        lambda c: c.tell(y=np.full_like(c.y, 7.0)), r"= 7 is .*rating .* .rating - 1. / .n - 1..\.$"
    ),
    "rates in percent": (lambda c: c.tell(y=100 * c.y), r"percent. divide by 100.\.$"),
    "other robots": (lambda c: c.tell(z=c.z[:, :2], y=c.y[:, :2]), "has robots .* not .'r1'"),
    "another grid": (
        lambda c: c.tell([(r + 20, k) for r, k in c.path]), "outside the grid of 6 rows"
    ),
    "a rate too few": (lambda c: c.tell(y=c.y[:-1]), "and contact_rate .bound, robot.; got"),
    "stuck before bound 1 ended": (
        lambda c: c.tell(z=c.z[:0], y=c.y[:0]), "got 0. .* campaign.fail..stuck., where=cell"
    ),
    "a mission, no list": (lambda c: fit(c.mission), "Write .mission."),
    "no missions": (lambda c: fit([]), "give at least one"),
    "a result, no missions": (lambda c: fit(c.result), "got a Result. Give its .missions"),
    "a number, no missions": (lambda c: fit(3), "must be a list of missions; got a int"),
    "missions as text": (lambda c: fit(["a"]), "mission 0 is no Mission; got 'a'"),
    "arrays, no missions": (
        lambda c: fit([c.z]), r"mission 0 is no Mission; got array.\[\[\[.{10,60}\.$"
    ),
    "missions for a posterior": (
        lambda c: Planner(c.workspace, *ENDS).plan([c.mission]), "posterior: got list .Mis"
    ),
    "draws of missions": (
        lambda c: Planner(c.workspace, *ENDS).path_posterior([c.mission]), "got list .*; give one"
    ),
    "diagnostics of missions": (
        lambda c: diagnostics([c.mission]), "diagnostics takes a posterior from fit; got a list"
    ),
    "rates of missions": (
        lambda c: by_rate([c.mission]), "by_rate takes a posterior from fit; got a list"
    ),
    "places of missions": (
        lambda c: place_maps([c.mission]), "posterior: got list .Mission.*; give one of trust"
    ),
    "a filter over a model": (lambda c: TrustFilter(PooledTrust()), "got PooledTrust rates gauss"),
    # places
    "start off the grid": (lambda c: c.iterate((6, 0), (0, 5)), "rows are 0..5 from the top"),
    "start of floats": (lambda c: c.iterate((5.0, 0.5), (0, 5)), "two whole numbers .row, col."),
    "start without names": (
        lambda c: c.iterate("25.5,25.5", (0, 5)), "got '25.5,25.5'.* x=25.5,y=25.5 is in cell"
    ),
    "start is goal": (lambda c: c.iterate((5, 0), (5, 0)), "same cell .5, 0.; choose two"),
    # workspaces
    "awareness without robots": (
        lambda c: tb.Workspace.from_awareness(np.ones((6, 6, 2))), "must be .robot, row, col, feat"
    ),
    "awareness of 0 to 10": (
        lambda c: tb.Workspace.from_awareness(np.full((3, 6, 6, 2), 9.0)), "9 is outside .0, 1."
    ),
    "passable of another shape": (
        lambda c: tb.Workspace.from_awareness(np.ones((3, 6, 6, 2)) / 2, passable=np.ones((5, 5))),
        "passable must be .row, col. = .6, 6.",
    ),
    "no such file": (lambda c: tb.terrain.read_terrain("no.tif", "no.tif"), "no.tif"),
    "a shape of one number": (
        lambda c: tb.Workspace.from_terrain(tb.terrain.example(), shape=10), "two whole numbers"
    ),
    "a path for a terrain": (
        lambda c: tb.Workspace.from_terrain("dem.tif"), "as read_terrain gives it; got str"
    ),
    "a number for a team": (
        lambda c: tb.Workspace.from_awareness(np.ones((3, 6, 6, 2)) / 2, team=3), "Team.n_robots=3"
    ),
    "robots=3": (lambda c: tb.Team(robots=3), "give n_robots="),
    "degrees for radians": (lambda c: tb.Robot(max_slope=45), "degrees. use numpy.deg2rad"),
    # campaigns
    "n_iteration": (lambda c: c.iterate(n_iteration=3), "did you mean n_iterations"),
    "max_bound": (lambda c: c.iterate(max_bound=12), "did you mean max_bounds"),
    "2.5 missions": (lambda c: c.iterate(n_iterations=2.5), "a whole number from 1 on; got 2.5"),
    "no missions at all": (lambda c: c.iterate(n_iterations=0), "from 1 on; got 0"),
    "a kind of progress": (
        lambda c: c.iterate(progress="pgae"),
        "unknown progress 'pgae'; choose one of bar",
    ),
    "too many bounds": (
        lambda c: c.iterate(max_bounds=10**9),
        r"max_bounds = 1000000000 admits paths .* states, more than 2e\+07; give less",
    ),
    "a folder that is a number": (
        lambda c: tb.load_result(3),
        "give the path of a file or folder; got a int",
    ),
    "a campaign in a number": (
        lambda c: tb.Campaign.load(3),
        "give the path of a file or folder; got a int",
    ),
    "too few bounds": (lambda c: c.iterate(max_bounds=2), "below the fewest possible"),
    "a negative seed": (lambda c: c.iterate(seed=-1), "a whole number from 0 on; got -1"),
    "a key for a seed": (lambda c: c.iterate(seed=np.array([1, 2])), "a whole number from 0 on"),
    "a model's class": (lambda c: c.iterate(model=PooledTrust), "e.g. PooledTrust.."),
    "a model's name": (lambda c: c.iterate(model="pooled"), "e.g. PooledTrust..; got 'pooled'"),
    "a simulator's class": (
        lambda c: c.iterate(simulator=KinematicSimulator), "make one of the class"
    ),
    "no terrain to drive on": (
        lambda c: tb.iterate(c.workspace, *ENDS, progress=False), "make the workspace with Work"
    ),
    "a rule's name": (lambda c: c.iterate(stop="converged"), "stop"),
    "an unknown policy, of numpy": (
        lambda c: c.iterate(policy=np.str_("greedyy")), "choose one of greedy, optimistic"
    ),
    "a folder of nothing": (lambda c: tb.load_result("nothing"), "give a folder written by save"),
    # models and planners
    "NUTS in capitals": (lambda c: fit([c.mission], sampler="NUTS"), "one of auto, exact, nuts"),
    "a number for a prior": (lambda c: Priors(beta0=0.5), "e.g. numpyro.distributions.Beta.con"),
    "a pair for a prior": (lambda c: Priors(b=(0, 1)), "numpyro.distributions.Normal.loc=0"),
    "an unknown objective": (
        lambda c: Planner(c.workspace, *ENDS, objective="trust"), "choose one of lost_contact"
    ),
    "places of a map along a path": (
        lambda c: roll_trust(TRUTH._replace(place=np.zeros((1, 6, 6))), c.z),
        "With the awareness of a path's bounds, give params.along.path.",
    ),
    "no draws": (lambda c: fit([c.mission], draws=0), "draws must be a .* 1 on; got 0"),
    "no chains": (lambda c: fit([c.mission], n_chains=0), "n_chains must be a .* 1 on; got 0"),
    "a warm-up below 0": (lambda c: fit([c.mission], warmup=-1), "warmup must .*0 on; got -1"),
    "a fit's negative seed": (lambda c: fit([c.mission], seed=-1), "seed must be .* 0 on; got -1"),
    "a fit's broken seed": (lambda c: fit([c.mission], seed=1.5), "seed must be .* 0 on; got 1.5"),
    "no features": (
        lambda c: fit([tb.Mission.from_arrays(c.path, c.z[..., :0], c.y)]),
        r"one feature at least; got awareness of shape .3, 0.. .* that is 0 everywhere",
    ),
    "a workspace without features": (
        lambda c: made(3, 6, 6, 0), r"length 0; got shape .3, 6, 6, 0.. .* that is 0 everywhere"
    ),
    "awareness as text": (
        lambda c: tb.Workspace.from_awareness("high"), "array of numbers; got 'high'"
    ),
    "parameters of a result": (
        lambda c: params_of(c.result), "takes a posterior from fit; got a Result. Give its .post"
    ),
    "a filter over any tree": (
        lambda c: TrustFilter(xr.DataTree()), "TrustFilter takes .* this DataTree has no 'posteri"
    ),
    "LOO of any tree": (
        lambda c: loo(xr.DataTree()), "loo takes a posterior from fit; this DataTree has no 'post"
    ),
    "LOO of a result": (lambda c: loo(c.result), "a posterior from fit; .* Give its .posterior"),
    "a number for a truth": (lambda c: c.iterate(truth=3), "must be Truth.of.simulator.; got 3"),
    # odd values
    "weights as text": (lambda c: fit([c.mission], weights="a"), "weights must be an array of num"),
    "a fit's workspace as text": (
        lambda c: fit([c.mission], PLACES, workspace="x"), "workspace: got str 'x'; give the one"
    ),
    "an earlier number": (lambda c: fit([c.mission], earlier=3), "takes a posterior .* got a int"),
    "a length scale in metres": (
        lambda c: PlaceEffect(length_scale=1e6), r"1e\+06 exceeds 1000: it is of cells, not metres"
    ),
    "effects of places beyond trust": (lambda c: PlaceEffect(tau_s=1e300), "exceeds 100: .* trust"),
    "a prior of no features": (
        lambda c: sample_prior(PooledTrust(), 0, 10, 0), "n_features must be .* 1 on; got 0"
    ),
    "prior draws below 0": (
        lambda c: sample_prior(PooledTrust(), 2, -1, 0), "n_draws must be .* 1 on; got -1"
    ),
    "a prior's negative seed": (
        lambda c: sample_prior(PooledTrust(), 2, 10, -1), "seed must be .* 0 on; got -1"
    ),
    "a prior of a name": (lambda c: sample_prior("x", 2, 10, 0), "e.g. PooledTrust..; got 'x'"),
    "prior predictions of text": (
        lambda c: prior_predictive(PooledTrust(), "x"), "awareness must be an array of numbers"
    ),
    "a tuple for parameters": (
        lambda c: Planner(c.workspace, *ENDS).plan((0.5, 0.1)), "posterior: got tuple .0.5, 0.1.; g"
    ),
    "a planner on text": (lambda c: Planner("x", *ENDS), "workspace: got str 'x'; give a trust"),
    "a campaign on a terrain": (
        lambda c: tb.Campaign(tb.terrain.example(), *ENDS), "workspace: got Dataset .* give a trust"
    ),
    "no path to suggest": (
        lambda c: tb.Campaign(c.workspace, *ENDS).suggest(None), "path must be cells .* got None"
    ),
    "features by number": (
        lambda c: tb.Workspace.from_awareness(np.ones((3, 6, 6, 2)) / 2, features=(1, 2)),
        r"features must be a list of names; got \(1, 2\)",
    ),
    "features as one word": (
        lambda c: tb.Mission.from_arrays(c.path, c.z, c.y, features="ab"), "list of names; got 'ab'"
    ),
    "two robots of one name": (
        lambda c: tb.Mission.from_arrays(c.path, c.z, c.y, robots=("a", "b", "a")), "distinct names"
    ),
    "features without definitions": (
        lambda c: tb.Workspace.from_terrain(tb.terrain.example(), features=("slope",)),
        "features: got tuple",
    ),
    "a terrain of 4 TB": (
        lambda c: tb.terrain.synthetic_terrain((1e6, 1e6)), "1000000 x 1000000 pixels, more than"
    ),
    "a mission of an empty path": (
        lambda c: tb.Mission.from_arrays([], c.z, c.y), "path is empty; give its cells, or None for"
    ),
    "a single rate": (lambda c: tb.Mission.from_arrays(c.path, c.z, 0.5), "contact_rate .bound, r"),
    "a simulator without a path": (
        lambda c: c.simulator.run(None, seed=0), "path must be cells .row, col., start first"
    ),
    "a simulator's seed": (lambda c: c.simulator.run(c.path, seed="a"), "seed must .* got 'a'"),
    "a simulator on text": (lambda c: ModelSimulator("x", TRUTH), "workspace: got str 'x'"),
    "a simulator of a number": (lambda c: ModelSimulator(c.workspace, 3), "params: got int 3"),
    "a path exported to nowhere": (
        lambda c: write_geojson(None, c.result), "path of a file or folder; got a NoneType"
    ),
    "a number exported": (lambda c: write_geojson("p.csv", 3), "plan: got int 3; give a Plan"),
    "latitude first": (
        lambda c: GRID.cell_at_lonlat(46.5, 200.0),
        r"'lon=46.5,lat=200' .*no place of the CRS.*outside the grid",
    ),
    "a longitude of NaN": (
        lambda c: GRID.cell_at_lonlat(np.nan, 1.0), "lon must be a finite number; got nan"
    ),
    "an infinite position": (lambda c: GRID.cell_at(np.inf, 1.0), "x must be a finite .* got inf"),
    "a position as text": (lambda c: GRID.cell_at("a", "b"), "x must be a finite number; got 'a'"),
    "a cell of one number": (lambda c: GRID.center(3), "cell must be two whole numbers"),
    "a grid off the Earth": (
        lambda c: replace(GRID, left=1e9, top=1e9).lonlat((0, 0)), "is no place on Earth in EPSG"
    ),
    "weights of other features": (
        lambda c: Planner(made(3, 6, 6, 3), *ENDS).plan(TRUTH), "2 weights, but awareness has 3"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_gives_one_line_that_says_what_to_do(name, case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    attempt, message = MISTAKES[name]
    with pytest.raises(tb.TrustboError, match=message) as caught:
        attempt(case)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []  # nothing was begun


def test_a_filter_of_parameters_needs_the_number_of_robots(posterior):
    with pytest.raises(tb.TrustboError, match="say how many robots: n_robots="):
        TrustFilter(params_of(posterior))


def test_numpy_s_text_and_numbers_are_as_good_as_python_s(case):
    campaign = tb.Campaign(
        case.workspace, np.array([5, 0]), (np.int64(0), 5), policy=np.str_("greedy"),
        seed=np.int32(1), objective=np.str_("mean"),
    )  # fmt: skip
    assert campaign.ask().path[0] == (5, 0)
