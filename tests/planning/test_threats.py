"""Where a threat is: the evidence of its place, sightings, and plans that avoid it."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import trustbo as tb
from trustbo.data import THREAT, Sighting
from trustbo.planning.threats import _log_evidence, threat_map
from trustbo.workspace.moves import MOVES
from trustbo.workspace.threats import REACHES, exposures

SHAPE, CELL = (7, 7), 30.0
PLACE, REACH, LOST = (3, 4), 40.0, 0.6
"""Cell and reach of the threat of these tests, and the contact that is lost at its place."""


@pytest.fixture(scope="module")
def workspace():
    z = np.random.default_rng(0).uniform(0.8, 1.0, (3, 8, *SHAPE, 2))
    names = "traversability", "line_of_sight"
    return tb.Workspace.from_awareness(z, cell_size=CELL, features=names).with_threat()


def position(workspace, cell=PLACE):
    x, y = workspace.grid.center(cell)
    return float(x), float(y)


@pytest.fixture(scope="module")
def missions(workspace):
    """Six missions on three paths; the threat is there from the fourth one on."""
    rng = np.random.default_rng(1)
    place = np.array(position(workspace))
    found = []
    for k, row in enumerate((3, 2, 4, 3, 2, 4)):
        path = [(row, col) for col in range(SHAPE[1])]
        z = workspace.along(path)
        cells = np.array([position(workspace, cell) for cell in path])
        middle = (cells[1:] + cells[:-1]) / 2.0
        d2 = ((middle - place) ** 2).sum(1)
        lost = LOST * np.exp(-0.5 * d2 / REACH**2) * (k >= 3)
        rates = z[..., 1] - lost[:, None] + 0.01 * rng.standard_normal(z.shape[:2])
        names = {"features": workspace.features, "robots": workspace.team.names}
        found.append(tb.Mission.from_arrays(path, z, np.clip(rates, 0.0, 1.0), **names))
    return found


@pytest.fixture(scope="module")
def posterior(missions, workspace):
    return tb.fit(missions, workspace=workspace, seed=0)


def test_the_evidence_is_that_of_the_joint_normal_with_one_more_column():
    rng = np.random.default_rng(0)
    n, number = 6, np.array([0, 0, 1, 1, 2, 2])
    A = rng.standard_normal((n, n))
    cov, rest = A @ A.T + np.eye(n), rng.standard_normal(n)
    exposed = rng.uniform(0.0, 1.0, (2, 3, n))
    ratios = _log_evidence(rest, cov, number, exposed, 4)

    without = multivariate_normal(np.zeros(n), cov).logpdf(rest)
    for first, k, q in np.ndindex(ratios.shape):
        x = np.where(number >= first, exposed[k, q], 0.0)
        joint = multivariate_normal(-0.5 * x, cov + 0.09 * np.outer(x, x))
        assert ratios[first, k, q] == pytest.approx(joint.logpdf(rest) - without, abs=1e-9)
    np.testing.assert_allclose(ratios[3], 0.0, atol=1e-12)  # no bound of the last mission is known


def test_the_exposure_falls_with_the_distance_of_the_way(workspace):
    exposed = exposures(workspace.grid)
    assert exposed.shape == (len(REACHES), SHAPE[0] * SHAPE[1], 8, *SHAPE)
    move = MOVES.index((0, 1))
    share = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
    for cell, (row, col) in {(3, 4): (3, 4), (0, 0): (3, 1), (6, 6): (2, 5)}.items():
        x = (col - 1 + share - cell[1]) * CELL
        y = np.full(5, (row - cell[0]) * CELL)
        expected = np.exp(-0.5 * (x**2 + y**2) / REACHES[1] ** 2).mean()
        found = exposed[1, np.ravel_multi_index(cell, SHAPE), move, row, col]
        assert found == pytest.approx(expected, rel=1e-5)


def test_a_threat_is_found_where_and_when_contact_was_lost(workspace, missions, posterior):
    threat = threat_map(missions, posterior, workspace)
    assert float(threat["probability"].sum()) > 0.6
    sooner = threat_map(missions, posterior, workspace, prior=0.5)
    assert float(sooner["probability"].sum()) > 0.9
    of_cells = threat["probability"].sum("reach")
    best = of_cells.argmax(("row", "col"))
    found = int(best["row"]), int(best["col"])
    assert max(abs(np.subtract(found, PLACE))) <= 1
    assert int(threat["began"].argmax("mission")) == 3
    assert float(threat["began"].sum()) == pytest.approx(1.0)


def test_there_is_no_threat_without_lost_contact(workspace, missions):
    few = missions[:3]
    posterior = tb.fit(few, workspace=workspace, seed=0)
    assert float(threat_map(few, posterior, workspace)["probability"].sum()) < 0.1


def test_a_sighting_says_where_and_a_false_one_does_not_persuade(workspace, missions, posterior):
    def off(*places):
        seen = tuple(Sighting(*place, 5.0) for place in places)
        last = dataclasses.replace(missions[-1], sightings=seen)
        threat = threat_map([*missions[:-1], last], posterior, workspace)
        share = threat["probability"].sum("reach")
        share = share / share.sum()
        mean = [float((share * share[axis]).sum()) for axis in ("x", "y")]
        return float(np.hypot(*np.subtract(mean, position(workspace))))

    assert off(position(workspace)) < min(10.0, off())
    assert off(position(workspace, (6, 0))) < 60.0  # contact was measured, and was whole, there
    assert off(position(workspace), position(workspace), position(workspace, (0, 0))) < 10.0


def test_plans_avoid_a_threat_before_they_have_learned_its_effect(workspace, missions, posterior):
    seen = Sighting(*position(workspace))
    last = dataclasses.replace(missions[-1], sightings=(seen,))
    threat = threat_map([*missions[:-1], last], posterior, workspace)
    known = workspace.with_threat(threat)
    assert known.features == workspace.features == ("traversability", "line_of_sight", THREAT)
    assert float(workspace.awareness.sel(feature=THREAT).max()) == 0.0
    exposure = known.awareness.sel(feature=THREAT).values[0, 4]
    assert np.nanmax(exposure[PLACE[0]]) > 0.5 > 2.0 * np.nanmax(exposure[0])
    assert known.with_threat().awareness.identical(workspace.awareness)

    ends = (3, 0), (3, 6)
    exposed = {}
    for name, space in {"unknown": workspace, "known": known}.items():
        plan = tb.Campaign(space, *ends).ask()
        exposed[name] = known.along(plan.path)[..., -1].mean(1).sum()
    assert exposed["known"] < 0.8 * exposed["unknown"]


def test_a_campaign_goes_on_after_a_threat_appeared(workspace, missions, posterior):
    campaign = tb.Campaign(workspace, (3, 0), (3, 6))
    campaign.tell(missions[3])
    known = workspace.with_threat(threat_map(missions, posterior, workspace))
    again = tb.Campaign(known, (3, 0), (3, 6), earlier=campaign)
    assert [mission.map for mission in again.state.earlier.missions] == [""]  # the same places


def test_sightings_are_stored_with_their_missions(missions, tmp_path):
    seen = (Sighting(1.0, 2.0, 3.0, "r2", 4.0), Sighting(5.0, 6.0))
    log = [missions[0], dataclasses.replace(missions[1], sightings=seen)]
    tb.logs.write_missions(tmp_path / "log.nc", log)
    first, second = tb.logs.read_missions(tmp_path / "log.nc")
    assert first.sightings == ()
    np.testing.assert_equal(second.sightings, seen)


@pytest.mark.parametrize(
    ("sightings", "problem"),
    [
        ([(1.0, 2.0, 0.0)], r"sightings\[0\].sd must be positive"),
        ([(np.nan, 2.0)], r"sightings\[0\].x must be finite|sightings\[0\].x"),
        ([3.0], r"sightings\[0\]"),
    ],
)
def test_places_that_are_none_are_refused(missions, sightings, problem):
    with pytest.raises(tb.TrustboError, match=problem):
        dataclasses.replace(missions[0], sightings=sightings)


def test_maps_and_posteriors_that_do_not_fit_are_refused(workspace, missions, posterior):
    other = tb.Workspace.from_awareness(np.ones((3, 4, 4, 1)), cell_size=CELL)
    threat = threat_map(missions, posterior, workspace)
    with pytest.raises(tb.TrustboError, match=r"probability \(reach, row, col\) = \(3, 4, 4\)"):
        other.with_threat(threat)
    plain = tb.fit(missions, tb.models.PooledTrust(), seed=0)
    with pytest.raises(tb.TrustboError, match="needs a posterior with place effects"):
        threat_map(missions, plain, workspace)
