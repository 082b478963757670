"""Bad input of a user is refused with an error that names it, before any work starts."""

import math

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import trustbo as tb
from trustbo import errors
from trustbo.inference import TrustFilter, fit, params_of
from trustbo.inference.diagnostics import diagnostics
from trustbo.models import PooledTrust, Priors
from trustbo.planning import Planner
from trustbo.planning.policies import optimistic
from trustbo.simulation import KinematicSimulator, ModelSimulator, ReplaySimulator, Truth

ENDS = (5, 0), (0, 5)
PATH = [(5, 0), (4, 1), (3, 2)]
PARAMS = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
RNG = np.random.default_rng(0)
Z, Y = np.full((2, 3, 2), 0.5), np.full((2, 3), 0.5)


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 6, 6, 2)))


def hills(**options):
    terrain = tb.terrain.synthetic_terrain((60.0, 60.0), resolution=3.0)
    return tb.Workspace.from_terrain(terrain, (2, 2), **options)


def made(z=Z, y=Y, path=PATH, **options):
    return tb.Mission.from_arrays(path, z, y, **options)


MISTAKES = {
    "ratings of 1 to 7": (lambda w: made(y=7.0 * Y), "contact_rate"),
    "a rate too few": (lambda w: made(y=Y[:-1]), "contact_rate"),
    "no features": (lambda w: made(z=Z[..., :0]), "awareness"),
    "awareness as text": (lambda w: made(z="high"), "awareness"),
    "two robots of one name": (lambda w: made(robots=("a", "b", "a")), "robots"),
    "an empty path": (lambda w: made(path=[]), "path"),
    "an unknown status": (lambda w: made(status="tired"), "status"),
    "a mission, no list": (lambda w: fit(made()), "missions"),
    "no missions": (lambda w: fit([]), "missions"),
    "a number for missions": (lambda w: fit(3), "missions"),
    "arrays for a mission": (lambda w: fit([Z]), "mission"),
    "a negative seed of a fit": (lambda w: fit([made()], seed=-1), "seed"),
    "no draws": (lambda w: fit([made()], draws=0), "draws"),
    "a workspace as text": (lambda w: fit([made()], workspace="x"), "workspace"),
    "diagnostics of missions": (lambda w: diagnostics([made()]), "diagnostics"),
    "parameters of any tree": (lambda w: params_of(xr.DataTree()), "params_of"),
    "a filter over a model": (lambda w: TrustFilter(PooledTrust()), "PooledTrust"),
    "a plan of missions": (lambda w: Planner(w, *ENDS).plan([made()]), "posterior"),
    "start off the grid": (lambda w: Planner(w, (6, 0), (0, 5)), "start"),
    "start is goal": (lambda w: Planner(w, (5, 0), (5, 0)), "start"),
    "an unknown objective": (lambda w: Planner(w, *ENDS, "trust"), "objective"),
    "a number for a prior": (lambda w: Priors(beta0=0.5), "beta0"),
    "awareness without robots": (lambda w: tb.Workspace.from_awareness(Z), "awareness"),
    "a number for a team": (lambda w: tb.Workspace.from_awareness(Z[None], team=3), "team"),
    "robots=3": (lambda w: tb.Team(robots=3), "robots"),
    "degrees for radians": (lambda w: tb.Robot(max_slope=45), "max_slope"),
    "no such raster": (lambda w: tb.terrain.read_terrain("no.tif", "no.tif"), r"no\.tif"),
    "no path to suggest": (lambda w: tb.Campaign(w, *ENDS).suggest([(0, 0)]), "path"),
    "None for a path to suggest": (lambda w: tb.Campaign(w, *ENDS).suggest(None), "path"),
    "None for a path": (lambda w: w.along(None), "path"),
    "a path without cells": (lambda w: w.along([]), "path"),
    "numbers for cells": (lambda w: Planner(w, *ENDS).evaluate([1, 2], PARAMS), r"path\[0\]"),
    "a share as text": (lambda w: tb.RegretBound(eps="0.05"), "eps"),
    "a correlation of 1": (lambda w: tb.models.RobotEffect(rho=1.0), "rho"),
    "sight as text": (lambda w: tb.workspace.Sight(crown_base="0.3"), "crown_base"),
    "extinction below 0": (lambda w: tb.workspace.Sight(extinction=-0.1), "extinction"),
    "one number for a mean and an sd": (lambda w: tb.hazard.Hazard(margin=0.5), "margin"),
    "no effects": (lambda w: PooledTrust(effects=None), "effects.*PlaceEffect"),
    "an unknown family": (lambda w: Priors.from_features(("a",), family="x"), "family"),
    "a model as text": (lambda w: tb.inference.sample_prior("x", 2, 5, 0), "model"),
    "a quantile as text": (
        lambda w: optimistic(RNG, PARAMS, Planner(w, *ENDS), quantile="9"),
        "quantile",
    ),
    "a map of risk of another shape": (lambda w: Planner(w, *ENDS).avoiding(Z, Z), "bounds"),
    "x0 of another team": (lambda w: tb.planning.expected_trust(PARAMS, Z, [0.5, 0.5]), "x0"),
    "None for parameters": (lambda w: tb.planning.expected_trust(None, Z), "params"),
    "no missions to replay": (lambda w: ReplaySimulator([]), "missions"),
    "a number for a mission": (lambda w: w.fill(3), "mission"),
    "a number for a simulated workspace": (lambda w: KinematicSimulator(3), "workspace"),
    "no features of a terrain": (lambda w: hills(features={}), "features"),
    "signs as text": (lambda w: tb.terrain.CompositeIndex("slope"), "signs"),
    "one side of a terrain": (lambda w: tb.terrain.synthetic_terrain(30.0), "size"),
    "a number for a campaign": (lambda w: tb.Follower(3), "campaign"),
    "options as text": (lambda w: tb.Campaign(w, *ENDS, fit="draws"), "fit"),
    "an export of None": (lambda w: tb.export.write_csv("m.csv", None), "result"),
    "a report of None": (lambda w: tb.report.write_report("r.html", None), "result"),
    "a map of None": (lambda w: tb.plots.grid_map(None), "workspace"),
    "no cases": (lambda w: tb.study.run_grid({}, {}, "study"), "case"),
    "a column as a number": (lambda w: tb.logs.read_reports({}, person=3, inputs=["x"]), "person"),
}
HUGE = {
    "n_robots": lambda w, n: tb.Team(n),
    "draws": lambda w, n: fit([made()], draws=n),
    "n_draws": lambda w, n: tb.inference.sample_prior(PooledTrust(), 2, n, 0),
    "n_iterations": lambda w, n: list(tb.Campaign(w, *ENDS).run(ModelSimulator(w, PARAMS), n)),
    "max_bounds": lambda w, n: Planner(w, *ENDS, max_bounds=n),
    "max_bounds of the fewest and more": lambda w, n: Planner(w, *ENDS, max_bounds=f"shortest+{n}"),
    "n_replicates": lambda w, n: Truth.from_simulator(KinematicSimulator(hills()), n_replicates=n),
    "n_missions": lambda w, n: tb.study.run_grid({}, {}, "study", n_missions=n),
    "seed": lambda w, n: Planner(w, *ENDS).plan_draws(PARAMS, seed=n),
}


@pytest.mark.parametrize("name", HUGE)
def test_huge_numbers_are_refused(name, workspace):
    with pytest.raises(tb.TrustboError, match=name.split()[0]):
        HUGE[name](workspace, 10**24)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_bad_input_is_refused_by_name(mistake, workspace, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make, named = MISTAKES[mistake]
    with pytest.raises(tb.TrustboError, match=named) as error:
        make(workspace)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_other_names_are_refused_as_python_does():
    with pytest.raises(TypeError, match="wholly"):
        fit([made()], wholly=False)


ONE = (1, 1.0, True, np.int8(1), np.float32(1.0), np.array(1.0), jnp.asarray(1.0))
NO_NUMBER = (None, "1", b"1", [], [1.0], {}, 1 + 0j, np.ones(1), pd.NA, object(), math.nan)
NUMBERS = {
    "finite": errors.require_finite,
    "positive": errors.require_positive,
    "share": errors.require_share,
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_of_any_library_are_numbers(name):
    for value in ONE:
        assert NUMBERS[name]("x", value) == 1.0
        assert type(NUMBERS[name]("x", value)) is float


@pytest.mark.parametrize("name", NUMBERS)
def test_what_is_not_one_finite_number_is_refused(name):
    for value in (*NO_NUMBER, math.inf, -math.inf, 10**400):
        with pytest.raises(tb.TrustboError, match="x must be"):
            NUMBERS[name]("x", value)


def test_share_includes_its_ends_unless_told_otherwise():
    assert errors.require_share("x", 0) == 0.0
    for value in (0.0, 1.0):
        with pytest.raises(tb.TrustboError, match="x"):
            errors.require_share("x", value, ends=False)


def test_whole_numbers_have_limits():
    assert errors.require_whole("n", np.int16(3), 0) == 3
    assert errors.require_whole("seed", 2**63 - 1, 0) == 2**63 - 1
    assert errors.require_count("n", errors.MANY) == errors.MANY
    for value in (*NO_NUMBER, True, 1.0, -1, 10**24):
        with pytest.raises(tb.TrustboError, match="n must be"):
            errors.require_whole("n", value, 0)
    for value in (0, errors.MANY + 1):
        with pytest.raises(tb.TrustboError, match="n must be"):
            errors.require_count("n", value)


def test_any_iterable_is_a_list_except_text_and_dicts():
    for value in ([1, 2], (1, 2), {1, 2}, range(1, 3), np.array([1, 2]), iter([1, 2])):
        assert errors.require_list("n", value, int | np.integer) == [1, 2]
    for value in (None, 3, "12", b"12", {1: 2}, np.array(1.0), np.ma.masked, [1, "2"]):
        with pytest.raises(tb.TrustboError, match="n"):
            errors.require_list("n", value, int)


def test_cells_are_a_list_of_pairs_of_whole_numbers():
    assert errors.require_cells("path", np.array([[1, 2], [0, 1]])) == ((1, 2), (0, 1))
    for value in (None, 3, "1,2", [1, 2], [(1, 2, 3)], [(0.5, 1)], {(1, 2): 3}, np.array(1.0)):
        with pytest.raises(tb.TrustboError, match="path"):
            errors.require_cells("path", value)
