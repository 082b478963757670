"""What `tell` accepts, everything accepts: fits, scores, exports, reports, plots and files."""

import dataclasses
import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.crs import CRS

import trustbo as tb
from trustbo.campaign.state import LEARNED
from trustbo.simulation import ModelSimulator, ReplaySimulator

ENDS = (3, 0), (0, 3)
UNKNOWN = (2, 1)
"""Cell without awareness."""
AROUND = [(3, 0), (2, 0), (1, 1), (0, 2), (0, 3)]
ACROSS = [(3, 0), UNKNOWN, (1, 2), (0, 3)]
MODEL = tb.models.PooledTrust()
OPTIONS = {"model": MODEL, "fit": {"draws": 100}}
FIT = {"draws": 100, "progress": False, "check": False}


def make_workspace():
    """Small workspace with a CRS, for GIS, and with a cell that the map does not know."""
    awareness = np.random.default_rng(0).uniform(size=(2, 4, 4, 2))
    awareness[:, *UNKNOWN] = np.nan
    workspace = tb.Workspace.from_awareness(awareness)
    grid = dataclasses.replace(workspace.grid, crs=CRS.from_epsg(2193).to_wkt())
    return dataclasses.replace(workspace, grid=grid)


def tell(campaign, path, rng, *, n_run=None, status="ok", unmeasured=()):
    """Tell the campaign a mission whose rates are random, without those of some robots."""
    n_run = len(path) - 1 if n_run is None else n_run
    rates = rng.uniform(0.5, 0.9, (n_run, 2))
    rates[:, list(unmeasured)] = np.nan
    unknown = np.full((n_run, 2, 2), np.nan)
    campaign.tell(tb.Mission.from_arrays(path, unknown, rates, status=status))


def states_of(campaign):
    """Return the state of each mission, such as "learned"."""
    return [campaign.state.status_of(j)[0] for j in range(len(campaign.missions))]


def fail(campaign, rng):
    """Report that the planned path was not completed."""
    campaign.ask()
    campaign.fail("stuck")


def exclude_one(campaign, rng):
    """Exclude the first mission that the campaign learns from, if there is one."""
    states = states_of(campaign)
    if LEARNED in states:
        campaign.exclude(states.index(LEARNED) + 1, "a bad day")


EVENTS = {
    "arrived": lambda campaign, rng: tell(campaign, AROUND, rng),
    "ended early": lambda campaign, rng: tell(campaign, AROUND, rng, n_run=2, status="stuck"),
    "no rates": lambda campaign, rng: tell(campaign, AROUND, rng, unmeasured=(0, 1)),
    "one robot without rates": lambda campaign, rng: tell(campaign, AROUND, rng, unmeasured=(1,)),
    "unknown cell": lambda campaign, rng: tell(campaign, ACROSS, rng),
    "ended before the unknown cell": lambda campaign, rng: tell(
        campaign, [*AROUND[:2], *ACROSS[1:]], rng, n_run=1, status="aborted"
    ),
    "failed": fail,
    "failed there": lambda campaign, rng: campaign.fail("tipped", where=campaign.ask().path[1]),
    "rain": lambda campaign, rng: campaign.fail("rain"),
    "excluded": exclude_one,
}
"""What can happen to a campaign."""


def begin(events, seed, **options):
    """Make a campaign to which events have happened."""
    campaign = tb.Campaign(make_workspace(), *ENDS, **OPTIONS, **options)
    for k, event in enumerate(events):
        EVENTS[event](campaign, np.random.default_rng([seed, k]))
    return campaign


def learned(campaign):
    """Return the missions that the campaign learns from."""
    told = zip(campaign.missions, states_of(campaign), strict=True)
    return [mission for mission, state in told if state == LEARNED]


def loaded(campaign, folder):
    campaign.save(folder / "saved")
    with tb.Campaign.load(folder / "saved") as again:
        assert again.ask().path == campaign.ask().path
        assert again.table().equals(campaign.table())


def shown(campaign, folder):
    campaign.save(folder / "shown")
    assert tb.load_result(folder / "shown").table().equals(campaign.table())


def resumed(campaign, folder):
    """Continue a campaign, whose missions no simulator has run, with a simulator."""
    campaign.save(folder / "resumed")
    params = tb.models.TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    n_missions = len(campaign.missions) + 1
    simulator = ModelSimulator(campaign.workspace, params)
    again = tb.resume(
        folder / "resumed", simulator=simulator, n_iterations=n_missions, progress=False
    )
    assert len(again.missions) == n_missions


def replayed(campaign, folder):
    simulator = ReplaySimulator(campaign.missions, any_path=True)
    given = {"simulator": simulator, "n_iterations": 1, "progress": False}
    tb.iterate(campaign.workspace, *ENDS, **given, **OPTIONS)


def followed(campaign, folder):
    follower = tb.Follower(campaign)
    follower.ahead()
    follower.begin(0.0)
    follower.tick(1.0, [1, 0])
    follower.end(2.0)
    follower.to_mission()


def explored(campaign, folder):
    campaign.explore()._repr_html_()


def written_missions(campaign, folder):
    tb.logs.write_missions(folder / "missions.nc", campaign.missions)
    assert len(tb.logs.read_missions(folder / "missions.nc")) == len(campaign.missions)


def checked(campaign, folder):
    verdict = tb.check(campaign.posteriors, campaign.missions)
    assert len(verdict.table) == 5


def compared(campaign, folder):
    pair = {"a": campaign.posterior, "b": tb.fit(learned(campaign), MODEL, **FIT)}
    tb.compare(pair)


def scored(campaign, folder):
    scores = tb.inference.score(campaign.posteriors, campaign.missions)
    states = states_of(campaign)
    assert [states[j] for j in scores["mission"].values] == [LEARNED] * scores.sizes["mission"]


ALWAYS = {
    "repr": lambda campaign, folder: repr(campaign) + campaign._repr_html_(),
    "table": lambda campaign, folder: campaign.table(),
    "plan": lambda campaign, folder: campaign.plan(),
    "trust": lambda campaign, folder: campaign.trust("r2", campaign.path[0]),
    "robot_maps": lambda campaign, folder: campaign.robot_maps(),
    "plan of draws": lambda campaign, folder: campaign.planner.plan_draws(campaign.belief),
    "Follower": followed,
    "hazard": lambda campaign, folder: campaign.risk.mean,
    "maps": lambda campaign, folder: campaign.maps(n_draws=20),
    "write_geotiff": lambda campaign, folder: tb.export.write_geotiff(folder / "m.tif", campaign),
    "write_nav2": lambda campaign, folder: tb.export.write_nav2(folder / "nav2", campaign),
    "write_geojson": lambda campaign, folder: tb.export.write_geojson(folder / "p.json", campaign),
    "save and load": loaded,
    "resume": resumed,
}
"""Functions of a campaign that need no mission."""

OF_MISSIONS = {
    "history": lambda campaign, folder: campaign.history,
    "plot_history": lambda campaign, folder: campaign.plot_history(),
    "plot_maps": lambda campaign, folder: campaign.plot_maps(),
    "to_frame": lambda campaign, folder: tb.logs.to_frame(campaign.missions),
    "write_missions": written_missions,
    "replay": replayed,
    "load_result": shown,
    "explore": explored,
}
"""Functions that need a mission, learned from or not."""

OF_RATES = {
    "fit": lambda campaign, folder: tb.fit(
        campaign.missions, MODEL, workspace=campaign.workspace, **FIT
    ),
}
"""Functions that need a mission with a rate and a known awareness, excluded by the user or not."""

OF_POSTERIOR = {
    "posterior": lambda campaign, folder: campaign.posterior,
    "check": checked,
    "trust_curves": lambda campaign, folder: tb.plots.trust_curves(campaign.posterior),
    "write_report": lambda campaign, folder: tb.report.write_report(folder / "r.html", campaign),
    "write_csv": lambda campaign, folder: tb.export.write_csv(folder / "m.csv", campaign),
    "export_result": lambda campaign, folder: tb.export.export_result(
        campaign, folder / "all", list(tb.export.WRITERS)
    ),
}
"""Functions that need a posterior."""

OF_TWO = {"compare": compared}
"""Functions that need two missions that the campaign learns from."""

OF_PREDICTION = {"score": scored}
"""Functions that need a mission that is learned from and has an earlier posterior."""


def use(functions, campaign, folder, *, works):
    """Call functions: all of them work, or each refuses in one sentence."""
    for function in functions.values():
        if works:
            function(campaign, folder)
        else:
            with pytest.raises(tb.TrustboError) as error:
                function(campaign, folder)
            assert "\n" not in str(error.value)
        plt.close("all")


@st.composite
def histories(draw):
    """Events of a campaign, of which there may be none yet, and a seed of its rates."""
    return draw(st.lists(st.sampled_from(list(EVENTS)), max_size=5)), draw(st.integers(0, 2**16))


def accepts(history):
    """Check that every function accepts a campaign, or that the campaign lacks what it needs."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of missions that teach nothing
        campaign = begin(*history)
        states = states_of(campaign)
        predicted = [
            state == LEARNED and before is not None
            for before, state in zip(campaign.posteriors, states[1:], strict=False)
        ]
        folder = Path(folder)
        use(ALWAYS, campaign, folder, works=True)
        use(OF_MISSIONS, campaign, folder, works=len(states) > 0)
        usable = [
            np.isfinite(mission.awareness).all() and np.isfinite(mission.contact_rate).any()
            for mission in campaign.missions
        ]
        use(OF_RATES, campaign, folder, works=any(usable))
        use(OF_POSTERIOR, campaign, folder, works=LEARNED in states)
        use(OF_TWO, campaign, folder, works=states.count(LEARNED) > 1)
        use(OF_PREDICTION, campaign, folder, works=any(predicted))


@pytest.mark.parametrize(
    "events",
    [
        [],
        ["no rates", "arrived", "unknown cell", "excluded", "failed", "arrived", "arrived"],
        ["failed there", "ended early", "one robot without rates", "rain"],
        ["ended before the unknown cell", "excluded", "ended early", "excluded"],
    ],
    ids=lambda events: ", ".join(events) or "nothing",
)
def test_what_tell_accepts_everything_accepts(events):
    accepts((events, 1))


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(histories())
def test_what_tell_accepts_everything_accepts_in_many_campaigns(history):
    accepts(history)
