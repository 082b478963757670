"""Bad input of a user is refused with an error that names it, before any work starts."""

import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.inference import TrustFilter, fit, params_of
from trustbo.inference.diagnostics import diagnostics
from trustbo.models import PooledTrust, Priors
from trustbo.planning import Planner

ENDS = (5, 0), (0, 5)
PATH = [(5, 0), (4, 1), (3, 2)]
Z, Y = np.full((2, 3, 2), 0.5), np.full((2, 3), 0.5)


@pytest.fixture(scope="module")
def workspace():
    return tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 6, 6, 2)))


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
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_bad_input_is_refused_by_name(mistake, workspace, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make, named = MISTAKES[mistake]
    with pytest.raises(tb.TrustboError, match=named) as error:
        make(workspace)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
