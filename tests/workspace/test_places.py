"""Places with names: in calls, tables, files and exports."""

import json

import numpy as np
import pytest
from worlds import hillside, random_cells

import trustbo as tb
from trustbo.identity import map_name
from trustbo.simulation import KinematicSimulator

CAMP, HILL = (2, 0), (0, 2)


@pytest.fixture(scope="module")
def workspace():
    ground = tb.Workspace.from_terrain(hillside(), (3, 3), n_posts=1)
    x, y = ground.grid.center(HILL)
    return ground.with_places({"camp": CAMP, "the hill": {"x": x + 3.0, "y": y - 4.0}})


@pytest.fixture(scope="module")
def campaign(workspace, tmp_path_factory):
    options = {"progress": False, "fit": {"draws": 100}}
    campaign = tb.Campaign(workspace, directory=tmp_path_factory.mktemp("places"), **options)
    plan = campaign.ask("camp", "the hill")
    campaign.tell(KinematicSimulator(workspace).run(plan.path, seed=0))
    yield campaign
    campaign.close()


def test_a_name_is_the_cell_of_the_place(workspace):
    assert (workspace.locate("camp"), workspace.locate("the hill")) == (CAMP, HILL)
    assert (workspace.name_of(HILL), workspace.name_of((1, 1))) == ("the hill", "1,1")
    again = workspace.with_places({"summit": "the hill", "camp": (2, 1)})
    assert again.places["summit"] == workspace.places["the hill"]
    assert again.locate("camp") == (2, 1)
    assert map_name(again) == map_name(workspace)
    part = workspace.of_robots(["r1"]).with_places({"ford": (1, 1)})
    assert part.team.names == ("r1",)
    assert part.places == part.whole.places != workspace.places


def test_the_distance_from_the_stop_is_told(workspace):
    x, y = workspace.grid.center(HILL)
    away = np.hypot(*(workspace.posts.stop(HILL) - np.array([x + 3.0, y - 4.0])))
    assert workspace.from_stop("the hill") == pytest.approx(away)
    assert f"cell 0,2, {away:.0f} m from its stop" in repr(workspace)
    assert random_cells().with_places({"camp": (0, 0)}).from_stop("camp") == 0.0


@pytest.mark.parametrize(
    ("places", "problem"),
    [
        ({"a,b": (0, 0)}, "name of a place"),
        ({"x=1": (0, 0)}, "name of a place"),
        ({" ": (0, 0)}, "name of a place"),
        ({3: (0, 0)}, "name of a place"),
        ({"camp": (9, 9)}, "place 'camp'.*outside the grid"),
        ({"camp": "nowhere"}, "unknown place 'camp' 'nowhere'; choose one of camp, the hill"),
        ([("camp", (0, 0))], "places"),
    ],
)
def test_places_that_are_none_are_refused(workspace, places, problem):
    with pytest.raises(tb.TrustboError, match=problem):
        workspace.with_places(places)


def test_unknown_names_are_refused_with_those_that_are_known(workspace, campaign):
    with pytest.raises(
        tb.TrustboError, match="unknown goal 'bridge'; choose one of camp, the hill"
    ):
        campaign.ask("camp", "bridge")
    with pytest.raises(tb.TrustboError, match="has no places"):
        tb.Campaign(random_cells(), "camp", "hill")


def test_tables_reports_and_exports_have_the_names(campaign, tmp_path):
    table = campaign.table()
    assert (table["start"].tolist(), table["goal"].tolist()) == (["camp"], ["the hill"])
    assert "camp to the hill" in repr(campaign)
    tb.report.write_report(tmp_path / "report.html", campaign)
    assert "the hill" in (tmp_path / "report.html").read_text(encoding="utf-8")

    tb.export.write_geojson(tmp_path / "path.geojson", campaign)
    features = json.loads((tmp_path / "path.geojson").read_text())["features"]
    of_places = [f["properties"] for f in features if f["properties"]["layer"] == "places"]
    assert [about["name"] for about in of_places] == ["camp", "the hill"]
    assert [about["cell"] for about in of_places] == [[*CAMP], [*HILL]]

    [ax, *_] = campaign.plot_maps()
    assert {"camp", "the hill"} <= {text.get_text() for text in ax.texts}


def test_a_stored_campaign_keeps_its_places(campaign, tmp_path):
    campaign.save(tmp_path)
    with tb.Campaign.load(tmp_path, progress=False) as again:
        assert again.workspace.places == campaign.workspace.places
        assert again.ask("the hill", "camp").goal == CAMP


def test_two_courses_on_one_ground_are_exported_in_one_frame(campaign, tmp_path):
    tb.export.write_nav2(tmp_path / "there", campaign.plan("camp", "the hill"))
    tb.export.write_nav2(tmp_path / "back", campaign.plan("the hill", "camp"))
    frames = [(tmp_path / name / "frame.yaml").read_bytes() for name in ("there", "back")]
    assert frames[0] == frames[1]
