"""Gridding lidar points: exact on what is known, within bounds on real surveys."""

import sys
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rioxarray
import xarray as xr

from trustbo.errors import TerrainError, TrustboError
from trustbo.terrain.dataset import pixel_size
from trustbo.terrain.lidar import read_lidar

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


def test_the_lowest_of_ground_points_in_one_place_counts(tmp_path):
    x, y, z = lattice()
    path = write_las(tmp_path / "twice.las", *stack((x, y, z + 1.0, 2), (x, y, z, 2)))
    terrain = read_lidar(path)
    inside = terrain["dem"].isel(x=slice(1, -1), y=slice(1, -1))
    np.testing.assert_allclose(inside, plane_of(inside), atol=1e-9)
    np.testing.assert_allclose((terrain["dsm"] - terrain["dem"]).max(), 1.0)


def test_noise_and_withheld_points_are_left_out(tmp_path):
    x, y, z = lattice()
    clean = read_lidar(write_las(tmp_path / "clean.las", x, y, z))
    strays = ([3.5, 8.5, 60.0], [3.5, 8.5, -40.0], [-500.0, 900.0, 2000.0], [7, 18, 18])
    withheld = ([5.5, 6.5], [5.5, 6.5], [300.0, -300.0], [1, 2])
    points = stack((x, y, z, 2), strays, withheld)
    hidden = np.r_[np.zeros(len(x) + 3), [1, 1]]
    path = write_las(tmp_path / "noisy.las", *points, withheld=hidden)
    xr.testing.assert_identical(read_lidar(path), clean)


def test_a_surface_gap_is_filled_only_as_far_as_max_gap(tmp_path):
    x, y, z = lattice()
    # Ground returns at the rim alone, and canopy all over but for a strip of pixels 8 to 12.
    rim = (x < 1) | (x > 19) | (y < 1) | (y > 19)
    canopy = (x < 8) | (x > 13)
    points = stack((x[rim], y[rim], z[rim], 2), (x[canopy], y[canopy], z[canopy] + 9.0, 5))
    path = write_las(tmp_path / "strip.las", *points)
    gaps = {}
    for reach in (0.5, 2.0, 3.0):
        row = read_lidar(path, max_gap=reach, ground_gap=50.0)["dsm"].sel(y=NORTH + 10.5)
        gaps[reach] = np.flatnonzero(row.isnull()).tolist()
    # From the pixels beside the strip (7 and 13), 2 m reaches 9 and 11, and 3 m its middle.
    assert gaps == {0.5: [8, 9, 10, 11, 12], 2.0: [10], 3.0: []}


def test_a_filled_pixel_takes_the_canopy_of_the_nearest_return(tmp_path):
    x, y, z = lattice()
    keep = ~((np.abs(x - 10.5) < 2) & (np.abs(y - 10.5) < 2))  # a hole of 3 x 3 pixels
    trees = (x[keep], y[keep], z[keep] + np.where(x[keep] < 10, 10.0, 20.0), 5)
    corners = (np.array([0.0, 0.0, 20.0, 20.0]), np.array([0.0, 20.0, 0.0, 20.0]))
    points = stack((*corners, height(*corners), 2), trees)
    terrain = read_lidar(write_las(tmp_path / "hole.las", *points), ground_gap=30.0)
    canopy = terrain["dsm"] - terrain["dem"]
    assert at(canopy, 9.5, 10.5) == pytest.approx(10.0)
    assert at(canopy, 11.5, 10.5) == pytest.approx(20.0)
    assert canopy.notnull().all()


def test_a_gap_on_a_bare_slope_is_filled_with_bare_slope(tmp_path):
    x, y, z = lattice()
    keep = ~((np.abs(x - 10.5) < 2) & (np.abs(y - 10.5) < 2))
    path = write_las(tmp_path / "slope.las", x[keep], y[keep], 10.0 * z[keep])
    terrain = read_lidar(path)
    assert terrain["dem"].notnull().all()
    np.testing.assert_allclose(terrain["dsm"], terrain["dem"], atol=1e-9)
    assert terrain.attrs["filled_share"] == pytest.approx(9 / 400)


def test_ground_is_not_invented_far_from_ground_points(tmp_path):
    x, y, z = lattice(30)
    bare = (x < 5) | (x > 25)  # a lake or closed canopy between 5 and 25
    points = stack((x[bare], y[bare], z[bare], 2), (x, y, z + 8.0, 9))
    path = write_las(tmp_path / "lake.las", *points)
    near = read_lidar(path, ground_gap=3.0)["dem"].sel(y=NORTH + 15.5).notnull().to_numpy()
    # Ground points are at 4.5 and 25.5.
    assert np.flatnonzero(~near).tolist() == list(range(8, 22))
    far = read_lidar(path)
    assert far["dem"].isel(x=slice(1, -1), y=slice(1, -1)).sel(y=NORTH + 15.5).isnull().sum() == 0
    np.testing.assert_allclose(far["dem"], plane_of(far["dem"]), atol=1e-9)


def test_tiles_equal_one_file(tmp_path):
    x, y, z, label = stack((*ground(), 2), (*ground(seed=1), 5))
    z = np.where(label == 5, z + 7.0, z)
    whole = read_lidar(write_las(tmp_path / "whole.las", x, y, z, label))
    west = x < 9.0
    tiles = [
        write_las(tmp_path / f"{name}.las", x[part], y[part], z[part], label[part])
        for name, part in (("west", west), ("east", ~west))
    ]
    xr.testing.assert_identical(read_lidar(tiles), whole)
    xr.testing.assert_identical(read_lidar([str(path) for path in tiles[::-1]]), whole)


def test_laz_equals_las(tmp_path):
    x, y, z, label = stack((*ground(), 2), (*ground(seed=1), 5))
    plain = read_lidar(write_las(tmp_path / "points.las", x, y, z, label))
    packed = write_las(tmp_path / "points.laz", x, y, z, label)
    assert packed.stat().st_size < (tmp_path / "points.las").stat().st_size
    xr.testing.assert_identical(read_lidar(packed), plain)


def test_a_shifted_origin_moves_the_terrain_and_nothing_else(tmp_path):
    x, y, z, label = stack((*ground(), 2), (*ground(seed=1), 5))
    here = read_lidar(write_las(tmp_path / "here.las", x, y, z, label))
    there = read_lidar(write_las(tmp_path / "there.las", x + 300.0, y - 700.0, z, label))
    for name in ("dem", "dsm"):
        np.testing.assert_allclose(there[name], here[name], atol=1e-9)
    np.testing.assert_allclose(there["x"] - here["x"].to_numpy(), 300.0)


@pytest.mark.parametrize("kind", ["array", "dataset"])
def test_like_puts_the_result_on_its_grid(tmp_path, kind):
    path = write_las(tmp_path / "plane.las", *ground())
    # Larger than the points' extent, pixels not square, south up.
    x, y = EAST - 3.0 + 0.8 * np.arange(30), NORTH - 2.0 + 1.25 * np.arange(20)
    like = xr.DataArray(np.zeros((20, 30)), {"y": y, "x": x}, ("y", "x")).rio.write_crs(UTM)
    terrain = read_lidar(path, like=like.to_dataset(name="height") if kind == "dataset" else like)
    np.testing.assert_array_equal(terrain["x"], x)
    np.testing.assert_array_equal(terrain["y"], y[::-1])
    east, north = terrain["x"] - EAST, terrain["y"] - NORTH
    inside = (north > 0.0) & (north < 20.0) & (east > 0.0) & (east < 20.0)
    assert (terrain["dem"].notnull() == inside).all()
    np.testing.assert_allclose(terrain["dem"], plane_of(terrain["dem"]), atol=1e-9)


def test_like_is_refused_where_it_cannot_serve(tmp_path):
    path = write_las(tmp_path / "plane.las", *ground())
    bare = xr.DataArray(np.zeros((3, 3)), {"y": [2.5, 1.5, 0.5], "x": [0.5, 1.5, 2.5]}, ("y", "x"))
    with pytest.raises(TerrainError, match=r"like has no CRS; set it, e\.g\. like\.rio\.write_crs"):
        read_lidar(path, like=bare)
    with pytest.raises(TerrainError, match=r"like is in EPSG:32634, but the points in EPSG:32633"):
        read_lidar(path, like=bare.rio.write_crs("EPSG:32634"))
    with pytest.raises(
        TerrainError, match=r"like covers no point of '.*plane\.las', x 500000\.0 to"
    ):
        read_lidar(path, like=bare.rio.write_crs(UTM))
    with pytest.raises(TerrainError, match=r"like's x is not a regular axis"):
        read_lidar(path, like=bare.assign_coords(x=[0.5, 1.5, 5.5]).rio.write_crs(UTM))
    with pytest.raises(TerrainError, match=r"like's y is not a regular axis of two pixels"):
        read_lidar(path, like=bare.isel(y=[0]).rio.write_crs(UTM))
    with pytest.raises(TerrainError, match=r"like has no x and y axes"):
        read_lidar(path, like=bare.rename(x="a", y="b").rio.write_crs(UTM))


def test_the_crs_is_the_header_s_or_else_the_one_given(tmp_path):
    named = write_las(tmp_path / "named.las", *ground())
    assert read_lidar(named, crs="EPSG:32634").rio.crs.to_epsg() == 32633
    bare = write_las(tmp_path / "bare.las", *ground(), crs=None)
    assert read_lidar(bare, crs=32634).rio.crs.to_epsg() == 32634
    with pytest.raises(
        TerrainError, match=r"bare\.las' has no CRS .* crs=None .*; pass e\.g\. crs="
    ):
        read_lidar(bare)
    with pytest.raises(TerrainError, match=r"crs='nonsense' is none PROJ knows"):
        read_lidar(bare, crs="nonsense")


def test_the_horizontal_part_of_a_compound_crs_is_taken(tmp_path):
    path = write_las(tmp_path / "compound.las", *ground(), crs="EPSG:32633+5773")
    with laspy.open(path) as reader:
        assert reader.header.parse_crs().is_compound
    crs = pyproj.CRS.from_wkt(read_lidar(path).rio.crs.to_wkt())
    assert not crs.is_compound
    assert crs.to_epsg() == 32633


def test_degrees_in_the_header_beside_metres_count_as_no_crs(tmp_path):
    path = write_las(tmp_path / "keys.las", *ground(), crs="EPSG:4326")
    with pytest.raises(TerrainError, match=r"keys\.las' has no CRS of its own"):
        read_lidar(path)
    assert read_lidar(path, crs=UTM).rio.crs.to_epsg() == 32633


@pytest.mark.parametrize(
    ("crs", "message"),
    [
        ("EPSG:4326", r"is in WGS 84, which is no projected CRS; reproject the points"),
        ("EPSG:2225", r"Easting in US survey foot, not metres; reproject the points to one UTM"),
        ("EPSG:32633+6360", r"height in US survey foot, not metres"),
        ("EPSG:3857", r"a metre of EPSG:3857 is over 1 % off at 4\.492 E 40\.92 N; reproject"),
    ],
)
def test_a_crs_that_does_not_measure_metres_is_refused(tmp_path, crs, message):
    path = write_las(tmp_path / "points.las", *ground(), crs=None)
    with pytest.raises(TerrainError, match=message):
        read_lidar(path, crs=crs)


def test_tiles_of_two_crs_are_refused(tmp_path):
    a = write_las(tmp_path / "a.las", *ground())
    b = write_las(tmp_path / "b.las", *ground(), crs="EPSG:32634")
    with pytest.raises(
        TerrainError, match=r"b\.las' is in EPSG:32634, but '.*a\.las' in EPSG:32633"
    ):
        read_lidar([a, b])


def test_files_that_are_absent_or_unreadable_are_named(tmp_path):
    with pytest.raises(
        TerrainError, match=r"there is no lidar file '.*absent\.laz'; check its path"
    ):
        read_lidar(tmp_path / "absent.laz")
    text = tmp_path / "notes.las"
    text.write_text("no points")
    with pytest.raises(TerrainError, match=r"notes\.las' cannot be read as LAS or LAZ \(Invalid"):
        read_lidar(text)
    with pytest.raises(TerrainError, match=r"given no file; give one LAS or LAZ file or more"):
        read_lidar([])


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_file_cut_short_is_refused(tmp_path, suffix):
    path = write_las(tmp_path / f"whole.{suffix}", *ground(n=3000))
    cut = tmp_path / f"cut.{suffix}"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(TerrainError, match=rf"cut\.{suffix}' cannot be read as LAS or LAZ"):
        read_lidar(cut)


def test_a_file_cut_between_two_points_is_refused(tmp_path):
    path = write_las(tmp_path / "whole.las", *ground(n=96))
    with laspy.open(path) as reader:
        start, size = reader.header.offset_to_point_data, reader.header.point_format.size
    cut = tmp_path / "cut.las"
    cut.write_bytes(path.read_bytes()[: start + 60 * size])
    with pytest.raises(TerrainError, match=r"cut\.las' cannot be read .*after 60 of 100 points"):
        read_lidar(cut)


def test_points_that_make_no_terrain_are_refused(tmp_path):
    x, y, z = ground()
    empty = write_las(tmp_path / "empty.las", [], [], [])
    with pytest.raises(TerrainError, match=r"empty\.las' has no points but noise and withheld"):
        read_lidar(empty)
    label = np.where(x < 5.0, 1, 5)
    with pytest.raises(
        TerrainError, match=r"no ground points \(class 2\), only .* class 1, 5; classify"
    ):
        read_lidar(write_las(tmp_path / "unclassified.las", x, y, z, label))
    two = np.where(np.arange(len(x)) < 2, 2, 1)
    with pytest.raises(
        TerrainError, match=r"the 2 ground points \(class 2\) of '.*two\.las' are too"
    ):
        read_lidar(write_las(tmp_path / "two.las", x, y, z, two))
    track = stack((x, y, z, 1), (np.arange(10.0), np.arange(10.0), 100.0, 2))
    with pytest.raises(TerrainError, match=r"the 10 ground points .* in line: it takes three"):
        read_lidar(write_las(tmp_path / "track.las", *track))


def test_ground_beyond_reach_of_every_pixel_centre_is_refused(tmp_path):
    corner = ([0.0, 0.2, 0.0], [0.0, 0.0, 0.2], [100.0, 100.0, 100.0], 2)
    points = stack(corner, ([9.9], [9.9], [101.0], 1))
    with pytest.raises(
        TerrainError, match=r"no pixel of '.*corner\.las' has ground within ground_g"
    ):
        read_lidar(write_las(tmp_path / "corner.las", *points))


def test_a_resolution_that_makes_no_grid_is_refused(tmp_path):
    path = write_las(tmp_path / "plane.las", *ground())
    with pytest.raises(TerrainError, match=r"resolution 50 m makes 1 x 1 pixels of '.*plane\.las'"):
        read_lidar(path, 50.0)
    with pytest.raises(TerrainError, match=r"makes 20000000 x 20000000 pixels .*stray points"):
        read_lidar(path, 1e-6)
    for name in ("resolution", "max_gap", "ground_gap"):
        for value in (0.0, -1.0, np.nan, "1"):
            with pytest.raises(TrustboError, match=rf"{name} must be positive and finite; got"):
                read_lidar(path, **{name: value})


def test_without_laspy_the_extra_is_named(tmp_path, monkeypatch):
    path = write_las(tmp_path / "plane.las", *ground())
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(TerrainError, match=r"lidar needs laspy: .* pip install 'laspy\[lazrs\]'$"):
        read_lidar(path)


def test_a_surface_well_below_the_ground_is_raised_and_reported(tmp_path):
    x, y, z = lattice()
    pit = (x % 4 == 2.5) & (y % 4 == 2.5)  # 25 of 400 pixels, 1 m deep, not classified as ground
    points = stack((x[~pit], y[~pit], z[~pit], 2), (x[pit], y[pit], z[pit] - 1.0, 1))
    path = write_las(tmp_path / "pits.las", *points)
    with pytest.warns(
        UserWarning, match=r"on 6\.2% of pixels the highest return lies over 0\.25 m"
    ):
        terrain = read_lidar(path)
    assert terrain.attrs["clipped_share"] == pytest.approx(25 / 400)
    np.testing.assert_allclose(terrain["dem"], plane_of(terrain["dem"]), atol=1e-9)
    np.testing.assert_allclose(terrain["dsm"], terrain["dem"], atol=1e-9)


def test_centimetres_below_the_ground_are_counted_without_a_warning(tmp_path):
    x, y, z = lattice()
    points = stack((*ground(n=40), 2), (x, y, z - 0.05, 1))
    terrain = read_lidar(write_las(tmp_path / "low.las", *points))
    # The 44 ground points are in 44 pixels at most.
    assert 356 / 400 <= terrain.attrs["clipped_share"] < 1.0
    assert (terrain["dsm"] >= terrain["dem"]).all()


def test_points_too_sparse_for_the_resolution_are_reported(tmp_path):
    path = write_las(tmp_path / "sparse.las", *ground(n=200))
    with pytest.warns(UserWarning, match=r"of pixels hold no return .*; take a coarser resolution"):
        terrain = read_lidar(path)
    assert 0.25 < terrain.attrs["filled_share"] < 0.75
    assert read_lidar(path, resolution=4.0).attrs["filled_share"] == 0.0


def stored(real_terrain, name):
    """The stored DEM and DSM of a survey, and their folder."""
    paths = real_terrain(name)
    rasters = []
    for path in paths:
        with rioxarray.open_rasterio(path, masked=True) as raster:
            rasters.append(raster.isel(band=0, drop=True).load())
    return *rasters, Path(paths[0]).parent


def rmse(a, b):
    return float(np.sqrt(((a - b) ** 2).mean()))


@pytest.mark.filterwarnings("ignore:40% of pixels hold no return:UserWarning")
def test_a_sparse_survey_comes_out_as_it_was_stored(real_terrain):
    dem, dsm, folder = stored(real_terrain, "topography")
    terrain = read_lidar(folder / "Topography.laz", like=dem)
    assert rmse(terrain["dem"], dem) < 1e-3
    # Three pixels in five hold a return. To fill the others, several are often equally near; which
    # one is taken is the search tree's choice, and another choice moves this RMSE by 1 m or more.
    assert rmse(terrain["dsm"], dsm) < 0.5
    off = np.abs(terrain["dsm"] - dsm).where(terrain["dsm"].notnull() & dsm.notnull())
    assert float((off < 1e-3).sum() / off.notnull().sum()) > 0.59
    # The rest of what is stored is a pond (class 9), over 10 m from any ground point.
    assert float(terrain["dem"].notnull().sum() / dem.notnull().sum()) > 0.95


def test_a_sparse_survey_warns_at_1_m_and_not_at_2_m(real_terrain):
    points = stored(real_terrain, "topography")[2] / "Topography.laz"
    with pytest.warns(UserWarning, match=r"40% of pixels hold no return"):
        read_lidar(points)
    terrain = read_lidar(points, resolution=2.0)
    assert pixel_size(terrain) == (2.0, 2.0)
    assert terrain.attrs["clipped_share"] < 0.1


def test_a_tile_of_a_dense_survey_comes_out_as_the_whole_was_stored(real_terrain):
    dem, dsm, folder = stored(real_terrain, "bcts")
    south = {"y": slice(-243, None)}
    terrain = read_lidar(folder / "bcts_1.laz", like=dem.isel(south))
    # The tile's northern edge differs: the stored rasters saw the points beyond it.
    assert rmse(terrain["dem"], dem.isel(south)) < 0.05
    assert rmse(terrain["dsm"], dsm.isel(south)) < 0.5
    assert float(terrain["dem"].notnull().sum() / dem.isel(south).notnull().sum()) > 0.99
