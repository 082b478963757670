"""Figures of a result."""

import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr

import trustbo as tb
from trustbo.models import PlaceEffect, PooledTrust, fit
from trustbo.plots.maps import draw_hillshade


def test_one_panel_per_iteration_and_one_for_the_end(result):
    axes = result.plot_maps()
    assert [ax.get_title() for ax in axes] == [
        "mission 1 (prior)",
        "mission 2",
        "after 2 missions",
    ]
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
    learned = np.stack([result.history["trust_map"].values[1], result.trust_map.values])
    learned[:, 2, 0] = np.nan
    assert limits.pop() == (np.nanmin(learned), np.nanmax(learned))


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
    assert [ax.get_title() for ax in axes] == ["surface (DSM)", *names]
    np.testing.assert_allclose(axes[2].images[0].get_array(), result.workspace.pixels["visibility"])
    seen = result.workspace.awareness.sel(feature="line_of_sight").mean("robot")
    np.testing.assert_allclose(axes[3].images[0].get_array(), seen)
    bare = tb.Workspace.from_awareness(np.full((1, 3, 3, 2), 0.5))
    with pytest.raises(tb.TrustboError, match=r"Workspace\.from_terrain"):
        tb.plots.terrain_maps(bare)


def test_every_map_has_shadows_and_the_first_a_scale(result):
    first, *others = result.plot_maps()
    assert [text.get_text() for text in first.texts] == ["20 m"]
    for ax in (first, *others):
        shadow = ax.images[1].get_array()
        assert shadow.shape[2] == 4
        assert 0.0 < shadow[..., 3].max() <= 0.55


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
    assert ax.get_facecolor() == (0.75, 0.75, 0.75, 1.0)


def test_level_ground_keeps_its_colour_whatever_lies_beside_it():
    height = np.zeros((40, 40))
    height[:, 20:] = np.arange(20) * 0.2  # a bank that faces the west, towards the sun
    height[20:, :20] -= np.arange(20)[:, None] * 0.3  # and one that faces the south
    y, x = np.arange(40.0)[::-1] + 0.5, np.arange(40.0) + 0.5
    dem = xr.DataArray(height, {"y": y, "x": x}, ("y", "x"))
    terrain = tb.terrain.assemble_terrain(dem.rio.write_crs("EPSG:32633"), dem)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # such ground makes for odd indices
        workspace = tb.Workspace.from_terrain(terrain, (2, 2))
    _, ax = plt.subplots()
    draw_hillshade(ax, workspace, exaggerate=1.0)
    shadow = ax.images[0].get_array()[..., 3]
    np.testing.assert_allclose(shadow[2:18, 2:18], 0.0, atol=1e-12)  # level
    np.testing.assert_allclose(shadow[2:18, 23:38], 0.0, atol=1e-12)  # lit
    # Lambert's law on the bank to the south: n = (0, -0.3, 1), sun (-1, 1, sqrt 2) / 2, over level.
    light = (1.0 - 0.3 / np.sqrt(2.0)) / np.sqrt(1.0 + 0.3**2)
    np.testing.assert_allclose(shadow[23:38, 2:18], 0.55 * (1.0 - light), rtol=1e-9)


def test_maps_of_places_have_the_mean_the_sd_and_an_arrow_for_each_bound_made(result):
    maps = tb.models.place_maps(result.posterior)
    axes = tb.plots.place_map(result.posterior, result.workspace)
    assert [ax.get_title() for ax in axes] == ["better (+) or worse (\N{MINUS SIGN})", "how sure"]
    for ax, kind in zip(axes, ("mean", "sd"), strict=True):
        np.testing.assert_allclose(ax.images[0].get_array(), maps[f"place_{kind}"])
        assert ax.images[1].get_array().shape[2] == 4  # the hillshade
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
    own = fit(missions, model, workspace=result.workspace, n_draws=50, whole=False)
    axes = tb.plots.place_map(own, result.workspace)
    assert [ax.get_title() for ax in axes[::2]] == [
        f"{name}: better (+) or worse (\N{MINUS SIGN})" for name in result.workspace.team.names
    ]
    assert (axes[0].images[0].get_array() == 0.0).all()  # cells have no effect
    small = tb.Workspace.from_awareness(np.full((3, 1, 1, 2), 0.5))
    with pytest.raises(tb.ShapeError, match="3 rows and 4 columns, the workspace has 1 and 1"):
        tb.plots.place_map(own, small)
