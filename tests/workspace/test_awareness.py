"""From pixels to cells."""

import json

import numpy as np
import pytest
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.terrain import FEATURES, feature, synthetic_terrain
from trustbo.terrain.features import canopy_cover
from trustbo.workspace import Sight, Workspace
from trustbo.workspace.netcdf import workspace_from_tree, workspace_to_tree


@pytest.fixture(scope="module")
def terrain():
    terrain = synthetic_terrain((130.0, 90.0), seed=2, relief=6.0)
    terrain["dem"][40:44, 20:30] = np.nan
    terrain["dsm"][40:44, 20:30] = np.nan
    return terrain


def test_features_are_composites_or_used_unchanged(terrain):
    features = {"traversability": ("slope", "tri"), "cover": "canopy_cover"}
    workspace = Workspace.from_terrain(terrain, (4, 3), features=features)
    assert workspace.features == ("traversability", "cover", "line_of_sight")
    assert set(workspace.composites) == {"traversability"}
    cover = workspace.grid.cell_means(terrain["dem"].copy(data=canopy_cover(terrain)))
    of_r1 = workspace.awareness.sel(robot="r1", feature="cover").mean("move")
    np.testing.assert_allclose(of_r1, cover, atol=1e-6)


def test_the_remedy_for_a_large_feature_says_that_the_index_is_reversed(terrain):
    with pytest.raises(TrustboError, match=r"\['tri'\]}, which is larger where tri is smaller"):
        Workspace.from_terrain(terrain, (4, 3), features={"z": "tri"})


def test_canopy_of_the_features_is_that_of_the_assumed_sight(terrain):
    def pixels(**sight):
        made = Workspace.from_terrain(terrain, (4, 3), bounds=False, features=features,
                                      sight=Sight(**sight))  # fmt: skip
        return made.pixels

    features = {"open": "openness", "dense": "vegetation_density"}
    clear, usual, solid = (pixels(extinction=x) for x in (0.0, 0.1, np.inf))
    assert float(clear["open"].mean()) > float(usual["open"].mean()) > float(solid["open"].mean())
    xr.testing.assert_equal(clear["dense"], solid["dense"])
    assert float(pixels(crown_base=1.0)["dense"].max()) == 0.0


@pytest.mark.parametrize(
    "features", [{"z": ("slope", "steep")}, {"z": 3}, {"z": "tri"}, {"z": "steep"}, ("slope",)]
)
def test_features_that_are_none_are_refused(terrain, features):
    with pytest.raises(TrustboError, match="feature"):
        Workspace.from_terrain(terrain, (4, 3), features=features)


@pytest.mark.parametrize(
    "name", [3, "", "a/b", "cover ", "%", "line_of_sight", "passable", "x", "spatial_ref"]
)
def test_names_that_a_feature_cannot_have_are_refused(terrain, name):
    with pytest.raises(TrustboError, match="feature"):
        Workspace.from_terrain(terrain, (4, 3), features={name: ["slope", "tri"]})


def test_a_feature_needs_at_least_one_feature_of_pixels(terrain):
    with pytest.raises(TrustboError, match="feature"):
        Workspace.from_terrain(terrain, (4, 3), features={"ease": []})


def test_names_of_features_and_attributes_of_a_terrain_survive_a_file(terrain, tmp_path):
    attrs = {
        "title": "Höhe",
        "year": 2013,
        "box": [1.5, 2.5],
        "tags": ["a", "b"],
        "is_final": True,
        "source": {"by": None},
    }
    names = ("ease", "2nd", "Grün-%, no. 1")
    features = {name: ["slope", "tri"] for name in names}
    workspace = Workspace.from_terrain(
        terrain.assign_attrs(attrs), (4, 3), features=features, bounds=False
    )
    workspace_to_tree(workspace).to_netcdf(tmp_path / "workspace.nc")
    with xr.open_datatree(tmp_path / "workspace.nc") as tree:
        again = workspace_from_tree(tree.load())

    assert again.features == names
    assert again.composites.keys() == workspace.composites.keys()
    found = again.terrain.attrs
    assert (found["title"], found["year"], found["tags"]) == ("Höhe", 2013, ["a", "b"])
    assert list(found["box"]) == [1.5, 2.5]
    assert json.loads(found["is_final"]) is True
    assert json.loads(found["source"]) == {"by": None}
    assert workspace.terrain.attrs == attrs  # the user's terrain is unchanged


def test_pixel_maps_are_those_of_the_terrain(terrain):
    workspace = Workspace.from_terrain(terrain, (4, 3))
    assert isinstance(workspace.pixels, xr.Dataset)
    assert set(workspace.pixels) == {"traversability", "visibility", "passable"}
    xr.testing.assert_equal(workspace.pixels["y"], terrain["y"])
    missing = workspace.pixels["visibility"].isnull()
    assert missing.values[terrain["dem"].isnull().values].all()
    assert missing.sum() < 60  # squares of 4 x 4 pixels share an openness


def test_a_feature_that_returns_a_sorted_map_is_not_mirrored():
    terrain = synthetic_terrain((60.0, 60.0), seed=0)
    north = (terrain["y"] > float(terrain["y"].mean())) * xr.ones_like(terrain["dem"])
    feature("north", sign=1)(lambda given: north.sortby("y"))
    try:
        workspace = Workspace.from_terrain(terrain, (2, 2), bounds=False, features={"n": "north"})
    finally:
        del FEATURES["north"]
    np.testing.assert_allclose(workspace.awareness[0].max("move")[..., 0], [[1, 1], [0, 0]])
