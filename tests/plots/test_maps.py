"""Figures of a result."""

import dataclasses
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex
from scipy.spatial import cKDTree

import trustbo as tb
from trustbo.inference import fit
from trustbo.models import PlaceEffect, PooledTrust
from trustbo.plots.maps import contour_interval, contours
from trustbo.plots.style import LIGHT


def test_one_panel_per_iteration_and_one_for_the_end(result):
    axes = result.plot_maps()
    assert [ax.get_title() for ax in axes] == ["prior", "after 1 mission", "after 2 missions"]
    figure = axes[0].figure
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    assert len(bars) == 1
    assert bars[0].get_ylabel().startswith("expected trust")
    assert axes[0].get_xlabel() == "east (m)"
    assert axes[0].get_ylabel() == "north (m)"
    np.testing.assert_allclose(axes[0].get_xlim(), (0.0, 120.0))
    np.testing.assert_allclose(axes[0].get_ylim(), (0.0, 90.0))
    limits = {axes[i].images[0].get_clim() for i in range(3)}
    assert len(limits) == 1
    # The start's trust is assumed: it must not stretch the colours of what was learned.
    # Nor must the prior's map, a draw of which may be far off.
    maps = np.stack([result.history["trust_map"].values[1], result.trust_map.values])
    maps[:, 2, 0] = np.nan
    low, high = np.nanquantile(maps, [0.02, 0.98])
    assert limits.pop() == (low, min(high, 1.0))


def test_moments_of_a_long_campaign_are_the_prior_and_after_1_and_3_missions(result):
    n = 6
    history = result.history.isel(iteration=[0, 1, 0, 1, 0, 1]).assign_coords(
        iteration=np.arange(1, n + 1)
    )
    draw = tb.plots.trust_maps
    rest = result.trust_map, result.path, result.workspace
    titles = [ax.get_title() for ax in draw(history, *rest)]
    assert titles == ["prior", "after 1 mission", "after 3 missions", "after 6 missions"]
    assert len(draw(history, *rest, missions="all")) == n + 1
    assert draw(history, *rest, missions=[5])[0].get_title() == "after 4 missions"
    with pytest.raises(tb.TrustboError, match=r"missions must be some of 1\.\.6; got \[7\]"):
        draw(history, *rest, missions=[7])
    with pytest.raises(tb.TrustboError, match="missions must be 'moments', 'all' or numbers"):
        draw(history, *rest, missions="some")


def test_the_path_is_drawn_from_start_to_goal_where_its_cells_are(result):
    line, start, goal = result.plot_maps()[-1].lines
    grid = result.workspace.grid
    corner = (grid.left, grid.top - 90.0)
    expected = [np.subtract(grid.center(cell), corner) for cell in result.path]
    np.testing.assert_allclose(np.column_stack(line.get_data()), expected)
    np.testing.assert_allclose(np.ravel(start.get_data()), expected[0])
    np.testing.assert_allclose(np.ravel(goal.get_data()), expected[-1])
    assert (start.get_marker(), goal.get_marker()) == ("o", "*")


def test_a_map_s_top_row_is_north(result):
    image = result.plot_maps()[-1].images[0]
    np.testing.assert_allclose(image.get_array(), result.trust_map.values)
    assert image.origin == "upper"
    assert image.get_extent() == [0.0, 120.0, 0.0, 90.0] or image.get_extent() == (
        0.0,
        120.0,
        0.0,
        90.0,
    )


def test_terrain_maps_show_surface_traversability_and_visibility(result):
    axes = tb.plots.terrain_maps(result.workspace)
    names = ["traversability", "visibility", "line_of_sight"]
    assert [ax.get_title() for ax in axes] == [
        "surface (DSM)",
        *(name.replace("_", " ") for name in names),
    ]
    np.testing.assert_allclose(axes[2].images[0].get_array(), result.workspace.pixels["visibility"])
    seen = result.workspace.awareness.sel(feature="line_of_sight").mean("robot")
    np.testing.assert_allclose(axes[3].images[0].get_array(), seen)
    bare = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
    with pytest.raises(tb.TrustboError, match=r"Workspace\.from_terrain"):
        tb.plots.terrain_maps(bare)


def test_the_bar_of_a_row_of_axes_is_no_higher_than_their_maps(result):
    for layout in (None, "constrained"):
        figure, row = plt.subplots(1, 4, figsize=(12.0, 6.0), layout=layout)
        axes = tb.plots.terrain_maps(result.workspace, ax=row)
        figure.canvas.draw()
        assert axes[-1].get_position().height < 3.0 / 6.0
        bar = figure.axes[-1].get_position().height
        assert 0.7 < bar / axes[-1].get_position().height < 1.25


def test_a_height_just_below_0_is_0(result):
    terrain = result.workspace.terrain
    low = float(terrain["dsm"].min())
    flat = dataclasses.replace(result.workspace, terrain=terrain - low - 0.3)
    surface = tb.plots.terrain_maps(flat)[0]
    texts = [text.get_text() for inset in surface.child_axes for text in inset.texts]
    assert texts[0] == "0"


def test_every_map_has_contour_lines_and_the_first_a_scale(result):
    first, *others = result.plot_maps()
    assert [text.get_text() for text in first.texts] == ["20 m"]
    for ax in (first, *others):
        assert len(ax.images) == 1
        (lines,) = ax.collections
        assert len(lines.get_segments()) == len(contours(result.workspace)) > 0


def pixels_of(ax):
    """RGB of the pixels of Axes as drawn, (colour, 3), and the number of pixels of each."""
    image = np.asarray(ax.figure.canvas.buffer_rgba())[..., :3]
    x0, y0, x1, y1 = (int(v) for v in ax.get_window_extent().extents)
    part = image[image.shape[0] - y1 : image.shape[0] - y0, x0:x1].reshape(-1, 3)
    return np.unique(part, axis=0, return_counts=True)


def test_maps_have_the_colours_of_their_bar(result):
    """Of all pixels, path and scale included, 85 % are within 30 RGB units of the bar's."""
    mean = tb.inference.params_of(result.posterior).mean()
    cost = result.planner.cost_map(mean, per_robot=True)
    share = result.planner.path_posterior(result.posterior, n_draws=200)
    p_fail = result.planner.problem.risk.p_fail
    drawn = {
        "viridis": [
            *result.plot_maps(),
            *tb.plots.robot_maps(cost, result.workspace, result.path),
            tb.plots.path_posterior(share, result.workspace, result.path),
            tb.plots.hazard_map(p_fail, result.workspace, result.path),
            *tb.plots.terrain_maps(result.workspace)[1:],
            tb.plots.place_map(result.posterior, result.workspace)[1],
        ],
        "RdBu": [tb.plots.place_map(result.posterior, result.workspace)[0]],
    }
    for name, axes in drawn.items():
        bar = 255.0 * plt.get_cmap(name)(np.linspace(0.0, 1.0, 256))[:, :3]
        for figure in {ax.figure for ax in axes}:
            figure.canvas.draw()
        for ax in axes:
            colours, counts = pixels_of(ax)
            near = cKDTree(bar).query(colours)[0] <= 30.0
            assert counts[near].sum() >= 0.85 * counts.sum(), (name, ax.get_title())


def test_loadings_are_those_of_the_composites(result):
    composites = result.workspace.composites
    axes = tb.plots.loadings(composites)
    for ax, index in zip(axes, composites.values(), strict=True):
        widths = sorted(bar.get_width() for bar in ax.patches)
        np.testing.assert_allclose(widths, sorted(index.loadings_.values))
    with pytest.raises(tb.TrustboError, match="there are no composites"):
        tb.plots.loadings({})


def test_impassable_cells_are_grey():
    passable = np.ones((3, 3), bool)
    passable[1, 1] = False
    workspace = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5), passable)
    _, ax = plt.subplots()
    trust = workspace.awareness.isel(robot=0, feature=0)
    image = tb.plots.cell_map(ax, trust, workspace)
    assert np.ma.getmaskarray(image.get_array()).tolist() == (~passable).tolist()
    assert to_hex(ax.get_facecolor()) == LIGHT.closed


def test_contour_lines_are_where_the_ground_has_their_height():
    y, x = np.arange(60.0)[::-1] + 0.5, np.arange(90.0) + 0.5
    height = np.broadcast_to(0.5 * x, (60, 90))  # a plane: smoothing leaves it as it is
    dem = xr.DataArray(height, {"y": y, "x": x}, ("y", "x"))
    terrain = tb.terrain.read_terrain(*[dem.rio.write_crs("EPSG:32633")] * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # such ground makes for odd indices
        workspace = tb.Workspace.from_terrain(terrain, (2, 3))
    lines = contours(workspace)
    interval = contour_interval(0.5 * 89.0)
    assert interval == 5.0
    inner = [line for line in lines if 10.0 < line[:, 0].mean() < 80.0]  # edges are smoothed
    assert len(inner) == 6  # 10 m to 35 m
    for line in inner:
        rises = 0.5 * line[:, 0] / interval
        np.testing.assert_allclose(rises, np.round(rises), atol=2e-3)
        assert np.ptp(line[:, 1]) == pytest.approx(59.0)


@pytest.mark.parametrize(
    ("relief", "interval"), [(0.0, None), (1.0, 0.1), (24.0, 2.0), (25.0, 5.0), (1200.0, 100.0)]
)
def test_contour_lines_are_at_round_heights_and_at_most_a_dozen(relief, interval):
    assert contour_interval(relief) == pytest.approx(interval)


def test_maps_of_places_have_the_mean_the_sd_and_an_arrow_for_each_bound_made(result):
    maps = tb.inference.place_maps(result.posterior)
    axes = tb.plots.place_map(result.posterior, result.workspace)
    assert [ax.get_title() for ax in axes] == ["better (+) or worse (\N{MINUS SIGN})", "how sure"]
    for ax, kind in zip(axes, ("mean", "sd"), strict=True):
        np.testing.assert_allclose(ax.images[0].get_array(), maps[f"place_{kind}"])
    low, high = axes[0].images[0].get_clim()
    assert low == -high  # no effect has the colour in the middle
    (arrows,) = [c for c in axes[0].collections if hasattr(c, "U")]
    grid, made = result.workspace.grid, {}
    for mission in result.missions:
        for a, c in zip(mission.path[:-1], mission.path[1:], strict=True):
            made[a, c] = (np.add(grid.center(c), grid.center(a)) / 2 - grid.corner).tolist()
    assert len(arrows.XY) == len(made)
    step = np.array([grid.cell_width, grid.cell_height])
    for x, y in made.values():  # the tail is close to the edge, in the cell entered
        assert (np.abs(arrows.XY - [x, y]) <= 0.05 * step).all(1).any()
    assert len(axes[0].figure.axes) == 4  # a colour bar each


def test_robots_of_their_own_places_have_two_panels_each(result):
    missions = [result.workspace.fill(mission) for mission in result.missions]
    model = PooledTrust(place=PlaceEffect(cells=False, shared=False))
    own = fit(missions, model, workspace=result.workspace, draws=50, whole=False)
    axes = tb.plots.place_map(own, result.workspace)
    assert [ax.get_title() for ax in axes[::2]] == [
        f"{name}: better (+) or worse (\N{MINUS SIGN})" for name in result.workspace.team.names
    ]
    assert (axes[0].images[0].get_array() == 0.0).all()  # cells have no effect
    small = tb.Workspace.from_awareness(np.full((3, 1, 1, 2), 0.5))
    with pytest.raises(tb.ShapeError, match="3 rows and 4 columns, the workspace has 1 and 1"):
        tb.plots.place_map(own, small)
