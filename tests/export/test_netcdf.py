"""netCDF, read back by GDAL, as QGIS does."""

import netCDF4
import numpy as np
import pytest
import rasterio
from pyproj import CRS

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.export import write_netcdf


def test_gdal_reads_each_map_where_it_belongs(result, maps, tmp_path):
    write_netcdf(tmp_path / "maps.nc", maps, result.workspace)
    assert [file.name for file in tmp_path.iterdir()] == ["maps.nc"]
    for name, values in maps.items():
        with rasterio.open(f"netcdf:{tmp_path / 'maps.nc'}:{name}") as source:
            assert source.crs.to_epsg() == 32616
            assert source.bounds == pytest.approx(result.workspace.terrain.rio.bounds())
            assert np.isnan(source.nodata)
            np.testing.assert_array_equal(source.read(1), values.values)
            tags = source.tags(1)
        assert tags["units"] == "1"
        assert tags["long_name"] == values.attrs.get("long_name", name)


def test_attributes_are_those_of_the_cf_conventions(result, maps, tmp_path):
    write_netcdf(tmp_path / "maps.nc", maps, result.workspace)
    with netCDF4.Dataset(tmp_path / "maps.nc") as file:
        assert file.data_model == "NETCDF4"
        assert file.Conventions == "CF-1.8"
        assert set(file.variables) == {*maps.data_vars, "x", "y", "spatial_ref"}
        for name in maps:
            assert file[name].dimensions == ("y", "x")
            assert file[name].grid_mapping == "spatial_ref"
            assert file[name].filters()["zlib"]
        for axis in "xy":
            assert file[axis].standard_name == f"projection_{axis}_coordinate"
            assert (file[axis].units, file[axis].axis) == ("m", axis.upper())
            assert "_FillValue" not in file[axis].ncattrs()
        mapping = file["spatial_ref"]
        assert mapping.grid_mapping_name == "transverse_mercator"
        assert mapping.longitude_of_central_meridian == -87.0
        assert CRS.from_wkt(mapping.crs_wkt).to_epsg() == 32616


def test_cells_need_not_be_square(result, tmp_path):
    oblong = tb.Workspace.from_terrain(result.workspace.terrain, (3, 3))
    write_netcdf(tmp_path / "maps.nc", oblong.passable, oblong)
    with rasterio.open(tmp_path / "maps.nc") as source:
        assert source.res == (40.0, 30.0)
        assert source.bounds == pytest.approx(result.workspace.terrain.rio.bounds())


def test_without_a_terrain_positions_are_metres_of_the_grid(nowhere, maps, tmp_path):
    write_netcdf(tmp_path / "maps.nc", maps["cost"], nowhere.workspace)
    with rasterio.open(tmp_path / "maps.nc") as source:  # places it by x and y alone
        assert source.crs is None
        assert source.bounds == pytest.approx((380000.0, 5224910.0, 380120.0, 5225000.0))
        np.testing.assert_array_equal(source.read(1), maps["cost"].values)
    with netCDF4.Dataset(tmp_path / "maps.nc") as file:
        assert set(file.variables) == {"cost", "x", "y"}
        assert "standard_name" not in file["y"].ncattrs()
        assert file["y"].long_name == "distance north of the grid's lower left corner"


def test_a_map_s_own_attributes_are_kept(result, maps, tmp_path):
    cost = maps["cost"].assign_attrs(units="percent")
    write_netcdf(tmp_path / "cost.nc", cost, result.workspace)
    with netCDF4.Dataset(tmp_path / "cost.nc") as file:
        assert file["cost"].units == "percent"
    assert cost.encoding == maps["cost"].encoding  # the caller's is left alone
    assert set(cost.coords) == {"x", "y", "spatial_ref"}


def test_what_is_no_map_or_no_file_is_refused(result, maps, tmp_path):
    with pytest.raises(ShapeError, match=r"map 'cost' has \(2, 4\) cells"):
        write_netcdf(tmp_path / "maps.nc", maps["cost"][1:], result.workspace)
    with pytest.raises(TrustboError, match="it is a folder; name a file in it"):
        write_netcdf(tmp_path, maps, result.workspace)
    assert list(tmp_path.iterdir()) == []
