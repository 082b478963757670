"""GeoTIFF, read back by tifffile and by GDAL."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import rasterio
import tifffile
import xarray as xr

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.export import write_geotiff


def geokey(page, number):
    """A key of the GeoTIFF directory, whose entries are (key, place, count, value)."""
    directory = np.reshape(page.tags["GeoKeyDirectoryTag"].value, (-1, 4))
    return int(directory[directory[:, 0] == number, 3][0])


def test_each_map_is_a_band_where_it_belongs(result, maps, tmp_path):
    path = tmp_path / "maps.tif"
    write_geotiff(path, maps, result.workspace)
    assert [file.name for file in tmp_path.iterdir()] == ["maps.tif"]
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        values = page.asarray()
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values, maps.to_dataarray().values.astype(np.float32))
        assert np.isnan(values[:, 0, 0]).all()
        assert np.isfinite(values[:, 2, 3]).all()
        assert page.tags["ModelPixelScaleTag"].value == (30.0, 30.0, 0.0)
        # Pixel (0, 0) begins at the north-western corner.
        assert page.tags["ModelTiepointTag"].value == (0.0, 0.0, 0.0, 380000.0, 5225000.0, 0.0)
        assert page.tags["GDAL_NODATA"].value == "nan"
        assert geokey(page, 3072) == 32616  # ProjectedCRS: UTM zone 16N
        assert geokey(page, 1025) == 1  # RasterPixelIsArea
        items = ET.fromstring(page.tags["GDAL_METADATA"].value).findall("Item")
    names = [item.text for item in items if item.get("role") == "description"]
    assert names == list(maps.data_vars)
    texts = {int(i.get("sample")): i.text for i in items if i.get("name") == "long_name"}
    assert texts[0] == "mean expected trust"
    assert texts[3] == "traversability, 0 worst, 1 best"


def test_gdal_finds_the_terrain_s_place(result, maps, tmp_path):
    write_geotiff(tmp_path / "maps.tif", maps, result.workspace)
    with rasterio.open(tmp_path / "maps.tif") as source:
        assert source.crs.to_epsg() == 32616
        assert source.bounds == pytest.approx(result.workspace.terrain.rio.bounds())
        assert source.descriptions == tuple(maps.data_vars)
        assert np.isnan(source.nodata)
        row, col = result.path[-1]
        ((value, *_),) = source.sample([result.workspace.grid.center((row, col))])
        assert value == np.float32(maps["trust_mean"].values[row, col])


def test_one_map_is_one_band_however_its_dims_are_ordered(result, tmp_path):
    path = tmp_path / "new" / "trust.TIF"
    write_geotiff(path, result.trust_map.transpose("col", "row"), result.workspace)
    np.testing.assert_array_equal(tifffile.imread(path), result.trust_map.astype(np.float32))
    write_geotiff(path, result.workspace.passable.rename(None), result.workspace)
    with rasterio.open(path) as source:
        assert source.descriptions == ("map",)
        assert source.read(1).sum() == 11.0
    assert {file.name for file in path.parent.iterdir()} == {"trust.TIF"}


def test_what_is_no_map_of_the_cells_is_refused(result, maps, nowhere, tmp_path):
    workspace, path = result.workspace, tmp_path / "maps.tif"
    with pytest.raises(TrustboError, match="only a workspace made from a terrain has a CRS"):
        write_geotiff(path, maps, nowhere.workspace)
    with pytest.raises(ShapeError, match=r"map 'awareness' has dims \('robot', .*\(row, col\)"):
        write_geotiff(path, workspace.awareness, workspace)
    with pytest.raises(ShapeError, match=r"map 'trust_mean' has \(3, 3\) cells, .* \(3, 4\)"):
        write_geotiff(path, maps.isel(x=slice(3)), workspace)
    with pytest.raises(ShapeError, match="there are no maps"):
        write_geotiff(path, xr.Dataset(), workspace)
    with pytest.raises(TrustboError, match="map 'trust' must hold numbers; got <U"):
        write_geotiff(path, result.trust_map.astype(str), workspace)
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_is_refused_before_anything_is_written(result, maps, tmp_path):
    (tmp_path / "folder.tif").mkdir()
    (tmp_path / "text").write_text("")
    for name, message in (
        ("folder.tif", r"cannot write '.*folder\.tif': it is a folder; name a file in it"),
        ("text/maps.tif", r"'.*text' is a file"),
        ("maps.png", r"maps\.png' must end in \.tif or \.tiff"),
    ):
        with pytest.raises(TrustboError, match=message):
            write_geotiff(tmp_path / name, maps, result.workspace)
    assert {file.name for file in tmp_path.iterdir()} == {"folder.tif", "text"}


def test_a_workspace_of_a_lazy_terrain_keeps_its_place_when_saved(result, tmp_path):
    """Then the grid alone knows it; and the terrain alone in files of older versions."""
    lazy = dataclasses.replace(result.workspace, terrain=None, pixels=None)
    old = dataclasses.replace(
        result.workspace, grid=dataclasses.replace(result.workspace.grid, crs=None)
    )
    for workspace in (lazy, old):
        tb.export.write_geotiff(tmp_path / "trust.tif", result.trust_map, workspace)
        with rasterio.open(tmp_path / "trust.tif") as source:
            assert source.crs.to_epsg() == 32616
