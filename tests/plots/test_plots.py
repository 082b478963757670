"""Figures: they draw on new axes and on those of the user, and show the numbers given."""

import re
from copy import copy
from itertools import pairwise

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from cycler import cycler
from matplotlib import patheffects

import trustbo as tb
from trustbo import plots
from trustbo.plots.explorer import _layers
from trustbo.plots.maps import draw_contours, draw_path, extent_of, limits_of, path_in
from trustbo.report import bounds_of, facts_of, write_report

EFFECTS = pd.DataFrame(
    [
        {"mission": m, "robot": r, "effect": 0.3 * (r == "r2"), "sd": 0.05, "stands_out": r == "r2"}
        for m in (1, 2) for r in ("r1", "r2")
    ]
)  # fmt: skip


@pytest.fixture(scope="module")
def result():
    terrain = tb.terrain.synthetic_terrain((80.0, 60.0), 2.0, seed=0, relief=4.0)
    workspace = tb.Workspace.from_terrain(terrain, (4, 3))
    return tb.iterate(workspace, (3, 0), (0, 2), n_iterations=2, seed=1, progress=False)


FIGURES = {
    "trust_maps": (lambda r, ax: r.plot_maps(ax=ax), 3),
    "trust_maps of a robot": (lambda r, ax: r.plot_maps("r2", ax=ax), 2),
    "terrain_maps": (lambda r, ax: plots.terrain_maps(r.workspace, ax=ax), 4),
    "cell_map": (lambda r, ax: plots.cell_map(r.trust_map, r.workspace, path=r.path, ax=ax), 1),
    "plan_map": (lambda r, ax: plots.plan_map(r.plan(), bounds=[1], ax=ax), 2),
    "trust_curves": (lambda r, ax: plots.trust_curves(r.posterior, ax=ax), 3),
    "trust_curves of a plan": (lambda r, ax: plots.trust_curves(r.plan(), ax=ax), 3),
    "campaign_history": (lambda r, ax: r.plot_history(ax=ax), 1),
    "robot_effects": (lambda r, ax: plots.robot_effects(EFFECTS, ax=ax), 1),
    "grid_map": (lambda r, ax: plots.grid_map(r.workspace, ax=ax), 1),
}


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_draws_on_new_axes_and_on_those_of_the_user(name, result):
    draw, n = FIGURES[name]
    made = np.ravel(draw(result, None))
    made[0].figure.canvas.draw()
    assert len(made) == n
    _, axes = plt.subplots(2, 2, layout="constrained", figsize=(3.5, 4.0))
    drawn = np.ravel(draw(result, axes.ravel()[:n]))
    assert list(drawn) == list(axes.ravel()[:n])
    drawn[0].figure.canvas.draw()


def draw_wide_maps(ax):
    """Draw the trust maps of three missions with values for which few and many ticks differ."""
    workspace = tb.Workspace.from_awareness(np.full((1, 4, 6, 1), 0.5), cell_size=30.0)
    trust = xr.DataArray(np.linspace(0.55, 0.93, 24).reshape(4, 6), dims=("row", "col"))
    path = [(0, k) for k in range(6)]
    of_missions = {
        "trust_map": trust.expand_dims(iteration=[1, 2, 3]),
        "path": (("iteration", "step", "cell"), np.array([path] * 3)),
    }
    plots.trust_maps(xr.Dataset(of_missions), trust, path, workspace, missions=[1, 2, 3], ax=ax)


NARROW = {
    "trust_maps": (2, 2, 3.2, lambda r, ax: r.plot_maps(missions=[1, 2], ax=ax)),
    "trust_maps of a wide area": (2, 2, 3.2, lambda r, ax: draw_wide_maps(ax)),
    "trust_curves": (1, 3, 1.8, lambda r, ax: plots.trust_curves(r.posterior, ax=ax)),
    "cell_map": (1, 1, 1.6, lambda r, ax: plots.cell_map(r.maps(n_draws=10)["cost"], r.workspace,
                                                         ax=ax)),
    "robot_effects": (1, 1, 1.8, lambda r, ax: plots.robot_effects(EFFECTS, ax=ax)),
    "grid_map": (1, 1, 1.8, lambda r, ax: plots.grid_map(r.workspace, ax=ax)),
}  # fmt: skip
"""Figures of 3.5 inches: rows and columns of panels, height in inches, and function."""


@pytest.mark.parametrize("name", NARROW)
def test_labels_of_narrow_figures_are_not_cut_off(name, result):
    """In the first drawing, nothing reaches the edge."""
    rows, cols, height, draw = NARROW[name]
    with mpl.rc_context({"font.size": 8.0}):
        figure, axes = plt.subplots(rows, cols, figsize=(3.5, height), layout="compressed")
        draw(result, axes)
        figure.canvas.draw()
    drawn = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    for edge in (drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]):
        assert (edge == 255).all()


def test_settings_of_matplotlib_stay_as_they_were(result):
    before = dict(plt.rcParams)
    result.plot_maps()
    assert dict(plt.rcParams) == before


def test_a_backend_that_the_first_figure_loads_stays_interactive(tmp_path, monkeypatch):
    lines = "import matplotlib", "from matplotlib.backends.backend_agg import *"
    (tmp_path / "own.py").write_text("\n".join([*lines, "matplotlib.interactive(True)"]))
    monkeypatch.syspath_prepend(tmp_path)
    with mpl.rc_context({"backend": "module://own"}):
        monkeypatch.setattr(plt, "_backend_mod", None)  # as before the first figure
        plots.robot_effects(EFFECTS)
        assert mpl.is_interactive()
    plt.switch_backend("agg")


def test_too_few_axes_are_refused(result):
    with pytest.raises(tb.TrustboError, match="ax"):
        result.plot_maps(ax=plt.gca())


@pytest.mark.parametrize("missions", [[5], [1, 5], [0], 1])
def test_maps_of_missions_that_were_not_run_are_refused(result, missions):
    with pytest.raises(tb.TrustboError, match="mission"):
        result.plot_maps(missions=missions)
    assert not plt.get_fignums()


def test_effects_of_a_model_without_robot_effects_are_refused():
    with pytest.raises(tb.TrustboError, match="RobotEffect"):
        plots.robot_effects(pd.DataFrame())
    with pytest.raises(tb.TrustboError, match="table"):
        plots.robot_effects(None)


def test_a_map_shows_the_values_of_passable_cells_in_metres(result):
    ax = plots.cell_map(result.trust_map, result.workspace, limits=(0.0, 1.0))
    known = result.workspace.passable.values.copy()
    known[3, 0] = False  # the trust at the start is assumed
    shown = np.ma.filled(ax.images[0].get_array(), np.nan)
    np.testing.assert_array_equal(shown, np.where(known, result.trust_map.values, np.nan))
    assert tuple(ax.images[0].get_extent()) == extent_of(result.workspace.grid) == (0, 60, 0, 80)


def other_order(values):
    """The same map, with rows from south to north, columns from east to west, and x first."""
    south = values.sortby(values.dims[0], ascending=values.dims[0] == "y")
    return south.sortby(values.dims[1], ascending=False).transpose(*values.dims[::-1])


def test_maps_are_aligned_by_their_coordinates(result):
    """Also the start, whose trust is assumed."""
    workspace = result.workspace
    placed = result.maps(n_draws=10)["trust_mean"]
    by_cell = result.trust_map.assign_coords(row=range(4), col=range(3))
    for values in (placed, by_cell):
        expected = plots.cell_map(values, workspace).images[0].get_array()
        assert np.ma.getmaskarray(expected)[3, 0]
        shown = plots.cell_map(other_order(values), workspace).images[0].get_array()
        np.testing.assert_array_equal(np.ma.filled(shown, -1.0), np.ma.filled(expected, -1.0))


def test_maps_of_other_cells_are_refused(result):
    placed = result.maps(n_draws=10)["trust_mean"]
    step = result.workspace.grid.cell_height
    for values, match in (
        (placed.assign_coords(y=placed["y"] + 0.5 * step), "y coordinates"),
        (placed.assign_coords(x=["a", "b", "c"]), "x coordinates"),
        (placed.isel(y=slice(3)), "shape"),
        (placed.rename(y="north"), "dims"),
        (result.robot_maps()["trust_mean"], r"\.sel\(robot='r1'\)"),
    ):
        with pytest.raises(tb.TrustboError, match=match):
            plots.cell_map(values, result.workspace)


def test_layers_of_the_explorer_are_aligned_by_their_coordinates(result):
    maps = result.maps(n_draws=10)
    expected = _layers(result.plan(), maps, result.history)
    layers = _layers(result.plan(), maps.sortby("y"), result.history)
    np.testing.assert_array_equal(layers["trust mean"], expected["trust mean"])


def test_a_path_goes_through_the_centres_of_its_cells(result):
    _, ax = plt.subplots()
    draw_path(ax, [(3, 0), (2, 1)], result.workspace.grid)
    np.testing.assert_allclose(ax.lines[0].get_xydata(), [(10.0, 10.0), (30.0, 30.0)])


def test_bounds_that_other_posts_watch_are_coloured_and_named(result):
    _, ax = plt.subplots()
    draw_path(ax, [(3, 0), (2, 1, "route"), (1, 1), (0, 2)], result.workspace.grid)
    (coloured,) = ax.collections
    np.testing.assert_allclose(coloured.get_segments(), [[(30.0, 30.0), (30.0, 50.0)]])
    assert "route posts" in ax.get_legend_handles_labels()[1]


def test_a_path_in_a_history_has_its_sets_of_posts():
    steps = np.array([(3, 0), (2, 1), (0, 2), (-1, -1)])
    mission = xr.Dataset({"path": (("step", "axis"), steps), "posts": ("bound", [0, 2, -1])})
    assert path_in(mission) == [(3, 0, "standard"), (2, 1, "route"), (0, 2)]
    assert path_in(mission.drop_vars("posts")) == [(3, 0), (2, 1), (0, 2)]


@pytest.mark.parametrize(("relief", "interval"), [(0.0, None), (12.0, 1), (24.0, 2), (60.0, 5)])
def test_contour_lines_of_a_plane_are_level_and_at_round_heights(relief, interval):
    terrain = tb.terrain.synthetic_terrain((80.0, 60.0), 2.0, seed=0, relief=4.0)
    y = terrain["y"].values
    terrain["dem"] = terrain["dem"] * 0.0 + relief * (y - y.min())[:, None] / np.ptp(y)
    terrain["dsm"] = terrain["dem"]

    _, ax = plt.subplots()
    draw_contours(ax, tb.Workspace.from_terrain(terrain, (4, 3)), "black", 1.0)
    if interval is None:
        assert not ax.collections
        return

    (lines,) = ax.collections
    heights = [path.vertices[:, 1] for path in lines.get_paths() if len(path.vertices)]
    assert len(heights) > 3
    assert all(np.ptp(height) < 1e-6 for height in heights)
    np.testing.assert_allclose(np.diff(lines.levels), interval)
    np.testing.assert_allclose(lines.levels % interval, 0.0)


@pytest.mark.parametrize(("high", "limit"), [(0.9, 0.9), (1.05, 1.0), (4.0, 4.0)])
def test_scales_of_trust_end_at_1_unless_trust_is_a_logit(high, limit):
    assert limits_of(np.array([0.5, high] * 50), is_trust=True) == (0.5, limit)


@pytest.mark.parametrize("name", ["trust_mean", "trust_sd", "cost", "path_probability"])
def test_good_values_are_bright_and_assumed_ones_are_masked(result, name):
    values = result.maps(n_draws=10)[name]
    image = plots.cell_map(values, result.workspace).images[0]
    assert np.ma.is_masked(image.get_array()[3, 0]) == (name != "path_probability")

    red, green, _ = image.get_cmap()([0.0, 1.0])[:, :3].T
    high_is_bright = (red + green)[1] > (red + green)[0]
    assert high_is_bright == (name in ("trust_mean", "path_probability"))


def test_a_scale_of_trust_says_that_values_exceed_it(result):
    low = result.trust_map.copy(data=np.linspace(0.5, 0.9, 12).reshape(4, 3))
    high = low + 0.2
    for values, label in ((low, "0.9"), (high.assign_attrs(low.attrs), "≥ 1")):
        ax = plots.cell_map(values.rename("trust"), result.workspace)
        (bar,) = (other for other in ax.figure.axes if other is not ax)
        ax.figure.canvas.draw()
        assert [text.get_text() for text in bar.get_yticklabels()][-1] == label
        assert "contact" not in bar.get_ylabel() or label == "≥ 1"


def test_cells_that_no_mission_entered_are_hatched(result):
    entered = [{bound.cell for bound in mission.bounds} for mission in result.missions]
    driven = [set(), entered[0], entered[0] | entered[1]]
    axes = result.plot_maps(missions=[1, 2])
    for ax, known in zip(axes, driven, strict=True):
        (hatched,) = (c for c in ax.collections if c.get_hatch())
        new = ~np.ma.getmaskarray(hatched.get_array())
        expected = result.workspace.passable.values.copy()
        for cell in known:
            expected[cell] = False
        np.testing.assert_array_equal(new.reshape(expected.shape), expected)


def test_contact_lost_is_measured_and_predicted_in_bounds_on_one_axis(result):
    (ax,) = result.plot_history()
    drawn = {line.get_label(): line.get_ydata() for line in ax.lines}
    np.testing.assert_allclose(drawn["predicted by the plan"], -result.history["objective"])
    assert "bounds" in ax.get_ylabel()

    other = result.history.assign_attrs(objective="mean")
    assert len(plots.curves.campaign_history(other)) == 2


def test_the_explorer_is_one_page_without_addresses(result, tmp_path):
    page = result.explore()
    page.save(tmp_path / "map.html")
    html = (tmp_path / "map.html").read_text(encoding="utf-8")
    assert '<script src="http' not in html
    assert '<link rel="stylesheet" href="http' not in html
    assert "trust mean" in html
    assert "@set, bound @bound" in html  # the set of the posts at the pointer
    assert "<title>Path from 3,0 to 0,2 after 2 missions</title>" in html
    assert len(repr(page)) < 100
    assert page._repr_html_().startswith("<iframe")


@pytest.mark.filterwarnings("ignore:mission 2 is excluded")
def test_the_explorer_says_that_contact_was_not_measured():
    awareness = np.random.default_rng(0).uniform(size=(2, 3, 3, 2))
    workspace = tb.Workspace.from_awareness(awareness)
    campaign = tb.Campaign(workspace, (2, 0), (0, 2), fit={"draws": 100}, progress=False)
    path = [(2, 0), (1, 1), (0, 2)]
    for rate in (0.8, np.nan):
        rates = np.full((2, 2), rate)
        campaign.tell(tb.Mission.from_arrays(path, np.full((2, 2, 2), np.nan), rates))
    html = campaign.explore().html
    assert "contact rate 0.800" in html
    assert "contact rate not measured" in html


@pytest.fixture(scope="module")
def page(result, tmp_path_factory):
    """The file of the report of `result`."""
    file = tmp_path_factory.mktemp("report") / "report.html"
    write_report(file, result)
    return file


def test_the_report_is_one_page_with_the_path_and_every_figure(result, page):
    html = page.read_text(encoding="utf-8")
    assert "→".join(f" {row},{col} " for row, col in result.path).strip() in html
    assert html.count('src="data:image/png;base64,') == 6
    assert "http" not in html

    first, *_ = html.partition("<section")
    assert f"{result.plan().p_arrive:.1%}" in first
    assert first.count("<img") == 2

    cells = [f"{row},{col}" for row, col in result.path]
    for cell, (x, y) in zip(cells, result.plan().stops, strict=True):
        posts = r"(?:<td>\w*</td>\s*)?"  # the column of the sets
        place = rf"<td>{x:.1f}</td>\s*<td>{y:.1f}</td>"
        assert re.search(rf"<td>{cell}</td>\s*{posts}{place}", html)
    assert result.workspace.grid.crs_name in html

    # The rule that hides all but the last 12 missions in print is that of their section.
    [hides] = re.findall(r"\.(\w+) tbody tr:nth-last-child\(n \+ 13\)", html)
    assert re.search(rf'<section class="{hides}">\s*<h2>Contact in each mission', html)
    [screen] = re.findall(r"\.(\w+) { display: none }", html)
    for heading in ("Diagnostics", "Settings"):
        assert re.search(rf'<section class="{screen}">\s*<h2>{heading}', html)


def table_under(heading, page):
    """The first table after a heading of a page, as texts."""
    _, _, after = page.read_text(encoding="utf-8").partition(f"<h2>{heading}</h2>")
    table, _, _ = after.partition("</table>")
    columns, *rows = [re.findall(r"<t[hd][^>]*>([^<]*)<", row) for row in table.split("<tr")[1:]]
    return pd.DataFrame(rows, columns=columns)


def with_plan(result, path):
    """Copy of a result that recommends another path."""
    other = copy(result)
    planned = result.planner.evaluate(path, result.forecast)
    other.plan = lambda *ends, **robots: planned
    return other


def bounds_begun(paths):
    """Stations left and cells entered in all bounds of plans or missions."""
    pairs = (pair for path in paths for pair in pairwise(path.stations))
    return [(left, entered[:2]) for left, entered in pairs]


def test_the_report_has_one_definition_of_driven_bounds(result, page, tmp_path):
    """Text, table and figure are of the same bounds; a cell entered from elsewhere is no bound."""
    longer = [(3, 0), (3, 1), (3, 2), (2, 2), (1, 2), (0, 2)]
    driven = bounds_begun(result.missions)
    for other in (result, with_plan(result, longer)):
        table = bounds_of(other)
        expected = [driven.count(bound) for bound in bounds_begun([other.plan()])]
        assert table["begun"].tolist() == [0, *expected]
        assert np.isfinite(table["measured"]).tolist() == [False, *(n > 0 for n in expected)]

        facts = facts_of(other)
        text = facts["Uncertain"].partition(";")[0].partition(": ")[2]
        new = [k for k, n in enumerate(expected, start=1) if not n]
        assert [int(k) for k in re.findall(r"(\d+) into", text)] == new

        weakest = table["contact"].idxmin()
        assert re.match(r"bound (\d+)", facts["Weakest bound"])[1] == f"{weakest}"
        file = page if other is result else tmp_path / "report.html"
        if other is not result:
            write_report(file, other)
        shown = table_under("Bounds of the path", file)
        assert shown["driven"].tolist() == ["start", *map(str, expected)]


def test_the_report_shows_the_objective_with_one_sign(result, page):
    missions = table_under("Contact in each mission", page)
    assert (missions["predicted lost"].astype(float) > 0.0).all()
    shown, low, high = re.findall(r"-?[\d.]+", facts_of(result)["Predicted contact lost"])[:3]
    assert float(shown) == pytest.approx(-result.plan().value, rel=0.005)
    assert float(low) < float(high)


def test_the_report_shows_failed_bounds_and_the_measured_contact_of_the_weakest(tmp_path):
    awareness = np.random.default_rng(0).uniform(size=(2, 3, 3, 2))
    workspace = tb.Workspace.from_awareness(awareness)
    campaign = tb.Campaign(workspace, (2, 0), (0, 2), fit={"draws": 100}, progress=False)
    unknown = np.full((2, 2, 2), np.nan)
    rates = np.array([[0.9, 0.7], [0.25, 0.35]])
    path = [(2, 0), (1, 1), (0, 2)]
    campaign.tell(tb.Mission.from_arrays(path, unknown, rates, status=["ok", "stuck"]))
    write_report(tmp_path / "report.html", campaign)
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<th>failed bounds</th>" in html
    assert "<td>2 into 0,2 (stuck)</td>" in html

    known = bounds_of(with_plan(campaign, path))
    assert known["begun"].tolist() == [0, 1, 1]
    np.testing.assert_allclose(known["measured"], [np.nan, 0.8, 0.3])

    around = bounds_of(with_plan(campaign, [(2, 0), (2, 1), (1, 2), (0, 2)]))
    assert around["begun"].tolist() == [0, 0, 0, 0]  # (0, 2) was entered from (1, 1) only
    assert around["measured"].isna().all()


def test_the_report_has_the_limits_of_all_robots_and_marks_replanned_missions(tmp_path):
    slow = tb.Robot(max_slope=np.radians(20.0), lidar_range=40.0)
    team = tb.Team(robots=(slow, tb.Robot()), names=("spot", "husky"))
    awareness = np.random.default_rng(0).uniform(size=(2, 3, 3, 2))
    workspace = tb.Workspace.from_awareness(awareness, team=team)
    campaign = tb.Campaign(workspace, (2, 0), (0, 2), fit={"draws": 100}, progress=False)

    def drive(*, replan):
        follower = tb.Follower(campaign)
        t = 0.0
        while len(follower.rest) > 1:
            follower.begin(t)
            follower.tick(t + 1.0, [True, False])
            fails = replan and not follower.bounds
            follower.end(t := t + 2.0, "stuck" if fails else "ok")
            if fails:
                follower.replan()
        campaign.tell(follower.to_mission())
        write_report(tmp_path / "report.html", campaign)
        return (tmp_path / "report.html").read_text(encoding="utf-8")

    html = drive(replan=False)
    assert "<td>lead, spot, husky</td>" in html
    assert "<td>lead 45, spot 20, husky 45</td>" in html
    assert "<td>lead 100, spot 40, husky 100</td>" in html
    assert "replanned" not in html

    html = drive(replan=True)
    assert html.count("<td>replanned</td>") == 1
    assert "In replanned missions" in html


@pytest.mark.parametrize(("bounds", "n"), [([], 1), ([2], 2)])
def test_the_map_of_the_path_shows_all_posts(result, bounds, n):
    axes = plots.plan_map(result.plan(), bounds=bounds)
    assert len(axes) == n
    corner = np.array(result.workspace.grid.corner)
    drawn = [line.get_xydata() for line in axes[0].lines]
    for i in range(result.workspace.team.n_robots):
        posts = result.plan().posts[:, i] - corner
        assert any(a.shape == posts.shape and np.allclose(a, posts) for a in drawn)


def test_the_report_has_contact_and_not_the_logit_of_it(result):
    model = tb.models.PooledTrust(family="beta_binomial")
    ends = (3, 0), (0, 2)
    found = tb.iterate(result.workspace, *ends, n_iterations=1, model=model, progress=False)
    contact = 1.0 / (1.0 + np.exp(-found.plan().trust.mean(1)))
    assert found.plan().trust.max() > 1.0
    shown = float(re.match(r"([\d.]+)%", facts_of(found)["Expected contact"])[1])
    assert shown == pytest.approx(100.0 * contact.mean(), abs=1.0)


OTHER_SETTINGS = {
    "image.origin": "lower",
    "image.interpolation": "bicubic",
    "image.interpolation_stage": "rgba",
    "image.aspect": "auto",
    "image.cmap": "gray_r",
    "image.resample": False,
    "axes.prop_cycle": cycler(linestyle=["none", ":"], marker=["x", "s"], alpha=[0.1, 0.2]),
    "axes.xmargin": -0.3,
    "axes.ymargin": -0.3,
    "axes.axisbelow": False,
    "axes.spines.left": False,
    "axes.spines.bottom": False,
    "axes.formatter.useoffset": True,
    "axes.formatter.limits": [-1, 1],
    "lines.linestyle": "none",
    "lines.marker": "o",
    "lines.markersize": 40.0,
    "lines.linewidth": 0.0,
    "lines.markeredgewidth": 20.0,
    "scatter.marker": "x",
    "scatter.edgecolors": "red",
    "patch.linewidth": 30.0,
    "patch.facecolor": "red",
    "patch.force_edgecolor": True,
    "hatch.color": "red",
    "hatch.linewidth": 20.0,
    "errorbar.capsize": 30.0,
    "boxplot.notch": True,
    "contour.corner_mask": False,
    "contour.linewidth": 20.0,
    "contour.algorithm": "threaded",
    "pcolor.shading": "gouraud",
    "pcolormesh.snap": False,
    "text.usetex": True,
    "text.parse_math": False,
    "figure.autolayout": True,
    "figure.constrained_layout.use": False,
    "figure.subplot.left": 0.6,
    "legend.numpoints": 5,
    "legend.markerscale": 0.0,
    "legend.loc": "center",
    "path.simplify_threshold": 1.0,
    "path.sketch": (30.0, 100.0, 2.0),
    "path.effects": [patheffects.Normal(), patheffects.withStroke(linewidth=20, foreground="w")],
    "xaxis.labellocation": "left",
    "xtick.bottom": False,
    "xtick.labelbottom": False,
    "xtick.direction": "in",
    "xtick.minor.visible": True,
    "ytick.labelleft": False,
    "ytick.labelright": True,
}
"""Settings of Matplotlib that change or hide what a figure says."""


def pixels_of(figure):
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())


@pytest.mark.parametrize("name", FIGURES)
def test_settings_of_the_user_do_not_change_what_a_figure_says(name, result):
    draw, _ = FIGURES[name]
    expected = pixels_of(np.ravel(draw(result, None))[0].figure)
    with mpl.rc_context(OTHER_SETTINGS):
        found = pixels_of(np.ravel(draw(result, None))[0].figure)
    np.testing.assert_array_equal(found, expected)


def test_lines_on_the_user_s_axes_are_lines(result):
    with mpl.rc_context(OTHER_SETTINGS):
        [panel] = np.ravel(result.plot_history(ax=plt.subplots()[1]))
    assert panel.lines[0].get_linestyle() == "-"
    assert panel.lines[0].get_marker() == "None"


@pytest.mark.parametrize("style", ["default", *plt.style.available])
def test_the_colour_of_a_cell_is_that_of_its_value_in_every_style(style):
    values = np.linspace(0.0, 1.0, 12).reshape(4, 3)
    workspace = tb.Workspace.from_awareness(np.full((1, 4, 3, 1), 0.5), cell_size=10.0)
    trust = xr.DataArray(values, dims=("row", "col"))
    with plt.style.context(style):
        panel = plots.cell_map(trust, workspace, limits=(0.0, 1.0), cmap="viridis")
        drawn = pixels_of(panel.figure)

    for cell in np.ndindex(4, 3):
        place = np.array(workspace.grid.center(cell)) - workspace.grid.corner + 2.0  # off the bar
        x, y = panel.transData.transform(place)
        colour = drawn[len(drawn) - 1 - round(y), round(x)]
        np.testing.assert_allclose(
            colour, mpl.colormaps["viridis"](values[cell], bytes=True), atol=1
        )


def test_the_map_of_a_robot_shows_its_trust_and_its_sd_where_nobody_went(result):
    mean, sd = result.plot_maps("r2")
    of_robot = result.robot_maps().sel(robot="r2")
    free = result.workspace.passable.values
    for ax, name in ((mean, "trust_mean"), (sd, "trust_sd")):
        shown = np.ma.filled(ax.images[0].get_array().astype(float), np.nan)
        np.testing.assert_array_equal(shown, np.where(free, of_robot[name].values, np.nan))
        [hatched] = [one for one in ax.collections if one.get_hatch()]
        new = free.copy()
        for mission in result.missions:
            for bound in mission.bounds:
                new[bound.cell] = False
        assert np.sum(~np.ma.getmaskarray(hatched.get_array())) == new.sum()
    assert mean.get_title().startswith("r2")
    with pytest.raises(tb.TrustboError, match="robot"):
        result.plot_maps("r9")


def test_what_is_closed_is_crossed_in_maps(result):
    ground = result.workspace.closing([(1, 1), ((2, 1), (2, 2))], "mud")
    ax = plots.cell_map(result.trust_map, ground)
    crosses = [line.get_xydata()[0] for line in ax.lines if line.get_marker() == "x"]
    grid = ground.grid
    middle = np.mean([grid.center((2, 1)), grid.center((2, 2))], 0)
    expected = np.array([grid.center((1, 1)), middle]) - grid.corner
    np.testing.assert_allclose(crosses, expected)
