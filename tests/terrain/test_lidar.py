"""Gridding lidar points: exact on what is known, within bounds on real surveys."""

import sys

import numpy as np
import pyproj
import pytest
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.terrain import pixel_size, read_lidar

laspy = pytest.importorskip("laspy", reason="needs the extra lidar")

UTM = "EPSG:32633"
EAST, NORTH = 500_000.0, 5_000_000.0


def write_las(path, x, y, z, label=2, *, crs=UTM, withheld=0):
    """A file of points at (EAST + x, NORTH + y), coordinates to the millimetre."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [EAST, NORTH, 0.0]
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = EAST + np.asarray(x), NORTH + np.asarray(y), np.asarray(z, float)
    las.classification = np.broadcast_to(label, np.shape(x)).astype(np.uint8)
    las.withheld = np.broadcast_to(withheld, np.shape(x)).astype(np.uint8)
    las.write(path)
    return path


def height(x, y):
    return 100.0 + 0.1 * x - 0.2 * y


def ground(size=20.0, n=4000, seed=0):
    """Random ground points on the plane, corners included, so that the hull is the square."""
    inner = np.random.default_rng(seed).uniform(0.0, size, (n, 2))
    x, y = np.r_[inner, [[0.0, 0.0], [0.0, size], [size, 0.0], [size, size]]].round(1).T
    return x, y, height(x, y)


def lattice(size=20):
    """One ground point at the centre of each 1 m pixel, on the plane."""
    x, y = (a.ravel() + 0.5 for a in np.meshgrid(np.arange(size), np.arange(size)))
    return x, y, height(x, y)


def stack(*parts):
    """Points and their classes: each part is (x, y, z, class)."""
    return [np.concatenate(a) for a in zip(*(np.broadcast_arrays(*p) for p in parts), strict=True)]


def plane_of(dem):
    """What the DEM must be wherever it is known."""
    plane = height(dem["x"] - EAST, dem["y"] - NORTH)
    return plane.transpose("y", "x").where(dem.notnull())


def at(raster, x, y):
    return float(raster.sel(x=EAST + x, y=NORTH + y))


def test_a_tilted_plane_of_ground_points_comes_out_exactly(tmp_path):
    terrain = read_lidar(write_las(tmp_path / "plane.las", *ground()))
    assert terrain["dem"].shape == (20, 20)
    assert terrain.rio.bounds() == (EAST, NORTH, EAST + 20.0, NORTH + 20.0)
    assert terrain["y"][0] > terrain["y"][-1]
    assert terrain.rio.crs.to_epsg() == 32633
    # Heights are stored to the millimetre, and those of the plane are multiples of a centimetre.
    np.testing.assert_allclose(terrain["dem"], plane_of(terrain["dem"]), atol=1e-9)
    assert (terrain["dsm"] >= terrain["dem"]).all()


@pytest.mark.parametrize("resolution", [0.4, 0.5, 0.7, 3.0])
def test_pixel_edges_are_multiples_of_the_resolution(tmp_path, resolution):
    path = write_las(tmp_path / "plane.las", *ground())
    terrain = read_lidar(path, resolution)
    assert pixel_size(terrain) == pytest.approx((resolution, resolution))
    left, bottom, right, top = terrain.rio.bounds()
    edges = np.array([left, bottom, right, top]) / resolution
    np.testing.assert_allclose(edges, edges.round(), atol=1e-6)
    # All points are on the grid, and no row or column is without its share of the square.
    spare = np.array([EAST - left, NORTH - bottom, right - EAST - 20.0, top - NORTH - 20.0])
    assert (spare > -1e-6).all()
    assert (spare < resolution).all()
    np.testing.assert_allclose(terrain["dem"], plane_of(terrain["dem"]), atol=1e-9)


def test_the_surface_is_the_highest_return_of_a_pixel(tmp_path):
    tree = ([4.2, 4.7, 4.9], [7.1, 7.6, 7.9], [105.0, 112.0, 108.0], 5)
    terrain = read_lidar(write_las(tmp_path / "tree.las", *stack((*lattice(), 2), tree)))
    assert at(terrain["dsm"], 4.5, 7.5) == 112.0
    canopy = terrain["dsm"] - terrain["dem"]
    assert int((canopy > 1e-9).sum()) == 1
    np.testing.assert_allclose(at(terrain["dem"], 4.5, 7.5), height(4.5, 7.5))


def test_a_point_on_an_edge_belongs_to_the_pixel_east_or_south(tmp_path):
    # Pixels of 0.2 m, whose edges are no binary fractions; poles along the first row and column.
    edge, top = np.arange(1, 19) * 0.2, np.arange(130.0, 148.0)
    row, column = (edge, np.full(18, 0.1), top, 1), (np.full(18, 0.1), edge, top, 1)
    path = write_las(tmp_path / "edge.las", *stack((*ground(size=4.0), 2), row, column))
    surface = read_lidar(path, 0.2)["dsm"]
    row = surface.sel(y=NORTH + 0.1, x=EAST + edge + 0.1, method="nearest")
    np.testing.assert_array_equal(row, top)
    column = surface.sel(x=EAST + 0.1, y=NORTH + edge - 0.1, method="nearest")
    np.testing.assert_array_equal(column, top)


def test_noise_and_withheld_points_are_left_out(tmp_path):
    x, y, z = lattice()
    clean = read_lidar(write_las(tmp_path / "clean.las", x, y, z))
    strays = ([3.5, 8.5, 60.0], [3.5, 8.5, -40.0], [-500.0, 900.0, 2000.0], [7, 18, 18])
    withheld = ([5.5, 6.5], [5.5, 6.5], [300.0, -300.0], [1, 2])
    points = stack((x, y, z, 2), strays, withheld)
    hidden = np.r_[np.zeros(len(x) + 3), [1, 1]]
    path = write_las(tmp_path / "noisy.las", *points, withheld=hidden)
    xr.testing.assert_identical(read_lidar(path), clean)


def test_a_gap_takes_the_canopy_of_the_nearest_return_up_to_3_m_away(tmp_path):
    x, y, z = lattice()
    # Ground returns at the rim alone; trees of two heights beside strips of 3 and of 7 m.
    rim = (x < 1) | (x > 19) | (y < 1) | (y > 19)
    canopy = (x < 5) | ((x > 8) & (x < 10)) | (x > 17)
    trees = (x[canopy], y[canopy], z[canopy] + np.where(x[canopy] < 5, 5.0, 9.0), 5)
    path = write_las(tmp_path / "strip.las", *stack((x[rim], y[rim], z[rim], 2), trees))
    terrain = read_lidar(path)
    row = (terrain["dsm"] - terrain["dem"]).sel(y=NORTH + 10.5).values
    known = np.abs(np.array([0.5, 19.5]) - 10.5).min()  # ground is known to 10 m from the rim
    assert known < 10.0
    np.testing.assert_allclose(row[[4, 5, 7, 8, 9, 12]], [5.0, 5.0, 9.0, 9.0, 9.0, 9.0])
    assert np.isnan(row[13])


def test_ground_is_missing_beyond_10_m_from_ground_points(tmp_path):
    x, y, z = lattice(40)
    rim = (x < 1) | (x > 39) | (y < 1) | (y > 39)
    points = stack((x[rim], y[rim], z[rim], 2), (x, y, z + 4.0, 5))
    terrain = read_lidar(write_las(tmp_path / "rim.las", *points))
    known = terrain["dem"].notnull().sel(y=NORTH + 20.5).values
    np.testing.assert_array_equal(np.flatnonzero(~known), np.arange(11, 29))


def test_points_that_make_no_terrain_are_refused(tmp_path):
    x, y, z = lattice()
    label = np.full(len(x), 5)
    stray = z.copy()
    stray[3] = 9999.0
    cut = write_las(tmp_path / "cut.las", x, y, z)
    cut.write_bytes(cut.read_bytes()[:2000])
    (tmp_path / "text.las").write_text("no points")
    for wrong in (
        write_las(tmp_path / "class.las", x, y, z, label),
        write_las(tmp_path / "line.las", x, np.full_like(y, 3.0), z),
        write_las(tmp_path / "empty.las", [], [], []),
        write_las(tmp_path / "noise.las", x, y, z, 7),
        write_las(tmp_path / "stray.las", x, y, stray, np.where(z == stray, 2, 1)),
        write_las(tmp_path / "degrees.las", x, y, z, crs="EPSG:4326"),
        write_las(tmp_path / "nowhere.las", x, y, z, crs=None),
        cut, tmp_path / "text.las", tmp_path / "absent.las",
    ):  # fmt: skip
        with pytest.raises(TrustboError):
            read_lidar(wrong)
    nowhere = read_lidar(tmp_path / "nowhere.las", crs=UTM)
    assert nowhere.rio.crs.to_epsg() == 32633
    with pytest.raises(TrustboError, match="resolution"):
        read_lidar(tmp_path / "nowhere.las", 0.0)


@pytest.mark.filterwarnings("ignore:.*heights in units of")
def test_points_on_a_mountain_may_have_heights_in_feet(tmp_path):
    x, y, z = lattice()
    feet = 12_000.0 + z  # above the highest number of metres
    path = write_las(tmp_path / "feet.las", x, y, feet, crs="EPSG:32613+6360")
    dem = read_lidar(path)["dem"]
    np.testing.assert_allclose(dem, (12_000.0 + plane_of(dem)) * 1200.0 / 3937.0, atol=1e-3)


def test_lists_of_tiles_are_refused(tmp_path):
    with pytest.raises(TrustboError, match="tiles"):
        read_lidar([tmp_path / "1.laz", tmp_path / "2.laz"])


def test_laspy_is_named_where_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(TrustboError, match="laspy"):
        read_lidar(tmp_path / "points.las")


def test_a_real_survey_is_gridded(real_data):
    path = next(iter(sorted(real_data.rglob("*.la[sz]"))), None)
    if path is None:
        pytest.skip("no point cloud in the folder of real surveys")
    terrain = read_lidar(path, 1.0)
    canopy = (terrain["dsm"] - terrain["dem"]).values
    assert 0.0 <= np.nanmin(canopy)
    assert np.nanmax(canopy) < 120.0
