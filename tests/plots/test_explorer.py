"""The interactive page: its numbers are the result's, it is whole, and it works in a browser."""

import html
import io
import json
import re
import time
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from scipy.spatial import cKDTree

import trustbo as tb
from trustbo.plots.explorer import Layer, Scene, Step, draw_explorer, scene
from trustbo.plots.style import LIGHT
from trustbo.report.exploring import scene_of

WIDTHS = {"wide": (1300, 900, False), "phone": (390, 844, True)}


@pytest.fixture(scope="module")
def explorer(result):
    return result.explore()


@pytest.fixture(scope="module")
def record(explorer):
    """What the page's script reads."""
    text = re.search(r'<script type="application/json" id="scene">(.*?)</script>', explorer.html)[1]
    return json.loads(text)


@pytest.fixture(scope="module")
def layers(record):
    return {layer["name"]: layer for layer in record["layers"]}


def as_maps(layer, record):
    """Maps of a layer, shape (step, row, col)."""
    return np.array(layer["maps"], dtype=float).reshape(-1, *record["shape"])


def close(found, expected):
    """Equal to the six digits that the page has."""
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)


def test_the_layers_are_the_result_s_maps(layers, record, result):
    maps = result.maps()
    names = ["trust_mean", "trust_sd", "path_probability", "place_mean", "place_sd"]
    names += ["place_bounds_mean", *result.workspace.features]
    for name in names:
        (shown,) = as_maps(layers[name], record)
        close(shown, maps[name].transpose("y", "x").values)
    assert layers["trust_mean"]["sd"] == "trust_sd"


def test_awareness_is_by_robot_where_robots_differ(layers, record, result):
    awareness = result.workspace.awareness.where(result.workspace.passable)
    for feature in result.workspace.features:
        for robot in result.workspace.team.names:
            (shown,) = as_maps(layers[f"{feature} {robot}"], record)
            close(shown, awareness.sel(feature=feature, robot=robot).values)


def test_the_chance_to_fail_is_that_of_the_worst_way_in(layers, record, result):
    hazard, passable = result.posterior["hazard"], result.workspace.passable.values
    (mean,), (sd,) = (as_maps(layers[name], record) for name in ("p_fail", "p_fail_sd"))
    for row, col in np.argwhere(passable):
        moves = hazard["p_fail"].values[:, row, col]
        worst = int(np.nanargmax(moves))
        close(mean[row, col], moves[worst])
        close(sd[row, col], hazard["p_fail_sd"].values[worst, row, col])
    assert np.isnan(mean[~passable]).all()


def test_the_slider_has_a_step_for_each_mission_and_the_recommended_path(explorer, record, result):
    n = len(result.missions)
    assert f'<input id="step" type="range" min="1" max="{n + 1}" step="1"' in explorer.html
    *missions, last = record["steps"]
    latent, corner = result.posterior["latent"]["trust"], result.workspace.grid.corner
    for j, (step, mission) in enumerate(zip(missions, result.missions, strict=True)):
        assert step["path"] == [list(cell) for cell in mission.path]
        close(np.array(step["contact"], dtype=float), mission.contact_rate)
        recorded = np.stack([bound.poses[0, 1:, :2] for bound in mission.bounds]) - corner
        np.testing.assert_allclose(step["posts"], recorded, atol=0.006)  # centimetres
        team = latent.sel(mission=j).dropna("bound").mean("robot")
        five = team.quantile([0.05, 0.25, 0.5, 0.75, 0.95], dim=("chain", "draw"))
        close(step["trust"], five.transpose("quantile", "bound").values)
    assert [tuple(cell) for cell in last["path"]] == result.path
    assert np.isnan(np.array(last["contact"], dtype=float)).all()
    params = tb.inference.params_of(result.posterior, day=True).flat()
    some = [result.planner.evaluate(result.path, params.draw(i)).trust for i in range(1000)]
    five = np.quantile(np.mean(some, axis=2), [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
    close(last["trust"], five)


def test_the_recommended_path_has_what_one_would_see_of_its_bounds(record, result):
    *missions, last = record["steps"]
    assert all(step["overwatch"] is None for step in missions)
    workspace, corner = result.workspace, np.array(result.workspace.grid.corner)
    for (a, c), shown in zip(pairwise(result.path), last["overwatch"], strict=True):
        x, y = corner[0] + np.array(shown["x"]), corner[1] + np.array(shown["y"])
        stop = workspace.ground.posts.stop(a)
        assert np.abs(x - stop[0]).max() <= 30.0
        assert np.abs(y - stop[1]).max() <= 30.0
        seen = workspace.overwatch_map((a, c)).sel(x=x, y=y, method="nearest").values
        (percent,) = np.array(shown["percent"])  # of equal robots
        known = np.where(percent < 0, np.nan, percent / 100.0).reshape(seen.shape)
        np.testing.assert_allclose(known, seen, atol=0.0051)
    posts = np.array(last["posts"]) + corner
    np.testing.assert_allclose(posts, result.plan.posts, atol=0.01)


def test_the_map_of_each_step_is_the_one_that_its_path_was_planned_on(layers, record, result):
    *planned, last = as_maps(layers["trust_planned"], record)
    passable = result.workspace.passable
    close(planned, result.history["trust_map"].where(passable).values)
    close(last, result.trust_map.where(passable).values)


def test_the_page_is_small_and_needs_nothing_else(explorer):
    assert len(explorer.html.encode()) < 5e6
    head, _, rest = explorer.html.partition("<script>")
    page = head + rest.rpartition("<body>")[2]  # without the library
    assert not re.search(r'(?:src|href)\s*=\s*"(?!data:)', page)
    assert "url(" not in page
    assert "@import" not in page
    assert "http" not in page.replace("http-equiv", "")
    assert not re.search(r"<script[^>]*src=", explorer.html)


def test_a_notebook_shows_the_page_in_a_frame_and_a_terminal_a_line(explorer, tmp_path):
    frame = re.fullmatch(r"<iframe .*? srcdoc=\"(.*?)\" .*?</iframe>", explorer._repr_html_(), re.S)
    assert html.unescape(frame[1]) == explorer.html
    assert repr(explorer) == "Explorer(title='2 missions: trust, place by place')"
    explorer.save(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == explorer.html
    with pytest.raises(tb.TrustboError, match=r"'.*page.txt' must end in \.html"):
        explorer.save(tmp_path / "page.txt")


def test_layers_that_do_not_fit_are_left_out_and_named(result, monkeypatch):
    grid = result.workspace.passable.shape
    some = [Layer(name, name.upper(), "", np.zeros((n, *grid)), (0.0, 1.0)) for name, n in
            (("a", 1), ("b", 3), ("c", 1))]  # fmt: skip
    monkeypatch.setattr(scene, "MOST_BYTES", 2 * 11 * grid[0] * grid[1] + len("[]"))
    content = Scene("", result.workspace, some, ()).record()
    assert [layer["name"] for layer in content["layers"]] == ["a", "c"]
    assert content["left_out"] == ["B"]


@pytest.fixture(scope="module")
def hostile():
    """Without terrain, effects of places or a second bound; a name that would break a page."""
    team = tb.Team(names=("</script><b>r&1", 'r"2'), n_robots=2)
    awareness = np.random.default_rng(0).uniform(size=(2, 2, 2, 2))
    workspace = tb.Workspace.from_awareness(awareness, team=team)
    truth = tb.models.TrustParams(0.4, np.array([0.5, 0.2]), 0.1, 0.05, 0.05)
    return tb.iterate(
        workspace, (1, 0), (0, 1), n_iterations=1, model=tb.models.PooledTrust(place=None),
        sampler="exact", simulator=tb.simulation.ModelSimulator(workspace, truth), progress=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def files(explorer, hostile, tmp_path_factory):
    folder = tmp_path_factory.mktemp("explorer")
    explorer.save(folder / "explore.html")
    hostile.explore().save(folder / "hostile.html")
    frame = f'<!doctype html><meta charset="utf-8"><title>n</title>{explorer._repr_html_()}'
    (folder / "notebook.html").write_text(frame, encoding="utf-8")
    return {file.stem: file.as_uri() for file in folder.iterdir()}


def opened(chromium, address, *, width="wide", scheme="light", ready="document"):
    """Open a page at a width, and wait for its figures."""
    wide, tall, mobile = WIDTHS[width]
    metrics = {"width": wide, "height": tall, "deviceScaleFactor": 1, "mobile": mobile}
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = [{"name": "prefers-color-scheme", "value": scheme}]
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
    chromium.get_log("browser")
    chromium.get(address)
    until = time.monotonic() + 30.0
    script = f"return ({ready})?.documentElement.dataset.ready"
    while chromium.execute_script(script) != "yes":
        assert time.monotonic() < until, chromium.get_log("browser")
        time.sleep(0.05)
    return chromium


def complaints(chromium):
    return [entry for entry in chromium.get_log("browser") if entry["level"] != "INFO"]


def choose(chromium, name, value, event):
    chromium.execute_script(
        "const it = document.getElementById(arguments[0]); it.value = arguments[1];"
        "it.dispatchEvent(new Event(arguments[2]))", name, value, event,
    )  # fmt: skip


def point(chromium, x, y):
    """Move the pointer to a place of the map, m from its lower left corner, until it is shown."""
    before, until = numbers(chromium)[0], time.monotonic() + 10.0
    while numbers(chromium)[0] == before and time.monotonic() < until:
        at = chromium.execute_script(
            """
            const plot = Bokeh.documents.map((d) => d.get_model_by_name("map")).find((it) => it)
            const view = Bokeh.index.get_by_id(plot.id)
            view.el.scrollIntoView({block: "center"})
            const box = view.el.getBoundingClientRect()
            const [x, y] = arguments
            return [view.frame.x_scale.compute(x) + box.left,
                    view.frame.y_scale.compute(y) + box.top]
            """, x, y,
        )  # fmt: skip
        moved = {"type": "mouseMoved", "x": at[0], "y": at[1]}
        chromium.execute_cdp_cmd("Input.dispatchMouseEvent", moved)
        time.sleep(0.2)


def numbers(chromium):
    """The heading and the table of what is pointed at."""
    return chromium.execute_script(
        """
        const rows = [...document.querySelectorAll("#numbers tr")]
        return [document.getElementById("place").textContent,
                Object.fromEntries(rows.map((row) => [...row.cells].map((c) => c.textContent)))]
        """
    )


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("page", ["explore", "hostile"])
def test_a_browser_shows_it_without_complaint_or_network(page, width, chromium, files):
    seen = opened(chromium, files[page], width=width)
    for layer in range(seen.execute_script("return document.getElementById('layer').length")):
        choose(seen, "layer", layer, "change")
    for step in range(1, 4):
        choose(seen, "step", step, "input")
    time.sleep(0.3)
    assert complaints(seen) == []
    resources = "return performance.getEntriesByType('resource').map(e => e.name.slice(0, 80))"
    assert [name for name in seen.execute_script(resources) if not name.startswith("data:")] == []
    assert seen.execute_script("return document.scrollingElement.scrollWidth <= window.innerWidth")
    blank = "return [...document.querySelectorAll('b')].map(e => e.textContent)"
    assert seen.execute_script(blank) == []


def test_the_page_may_fetch_nothing(chromium, files):
    seen = opened(chromium, files["explore"])
    refused = seen.execute_async_script(
        """
        const done = arguments[arguments.length - 1];
        document.addEventListener('securitypolicyviolation', e => done(e.blockedURI));
        setTimeout(() => done('loaded'), 5000);
        new Image().src = 'http://127.0.0.1:9/pixel.png';
        """
    )
    assert refused == "http://127.0.0.1:9/pixel.png"


@pytest.mark.parametrize("width", WIDTHS)
def test_the_numbers_under_the_pointer_are_those_of_the_place(width, chromium, files, result):
    seen, grid = opened(chromium, files["explore"], width=width), result.workspace.grid
    choose(seen, "step", 1, "input")
    row, col = 0, 0  # no path comes here
    assert (row, col) not in result.missions[0].path
    point(seen, 0.3 * grid.cell_width, (grid.shape[0] - 0.3) * grid.cell_height)
    place, shown = numbers(seen)
    assert place == f"Cell {row},{col}"
    trust, sd = (float(text) for text in shown["expected trust"].split(" \N{PLUS-MINUS SIGN} "))
    maps = result.maps().isel(y=row, x=col)
    np.testing.assert_allclose(trust, maps["trust_mean"], atol=0.51 * 10 ** -digits(shown))
    np.testing.assert_allclose(sd, maps["trust_sd"], atol=0.51 * 10 ** -digits(shown))
    step = scene_of(result, result.maps()).steps[0]
    point(seen, *step.stops[:2].mean(0))
    place, shown = numbers(seen)
    a, c = (f"{r},{k}" for r, k in step.path[:2])
    assert place == f"Bound 1, {a} to {c}"
    for robot, rate in zip(result.workspace.team.names, step.contact[0], strict=True):
        np.testing.assert_allclose(float(shown[f"contact rate, {robot}"]), rate, atol=6e-4)
    assert "chance to fail" in shown


def digits(shown):
    """Number of decimals of the trust shown."""
    return len(shown["expected trust"].split()[0].partition(".")[2])


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_follows_the_colours_of_the_system(scheme, chromium, files):
    seen = opened(chromium, files["explore"], scheme=scheme)
    ground, ink, axis = seen.execute_script(
        """
        const style = getComputedStyle(document.body)
        const plot = Bokeh.documents.map((d) => d.get_model_by_name("map")).find((found) => found)
        return [style.backgroundColor, style.color, plot.below[0].major_label_text_color]
        """
    )
    ground, ink = (np.mean([int(c) for c in re.findall(r"\d+", rgb)[:3]]) for rgb in (ground, ink))
    assert (ground > 128) == (scheme == "light")
    assert abs(ground - ink) > 150
    assert (int(axis[1:3], 16) > 128) == (scheme == "dark")


def map_pixels(chromium):
    """RGB of the map as the browser shows it, (pixel, 3)."""
    corners = chromium.execute_script(
        """
        const plot = Bokeh.documents.map((d) => d.get_model_by_name("map")).find((found) => found)
        const view = Bokeh.index.get_by_id(plot.id)
        const box = view.el.getBoundingClientRect()
        const {x_scale: x, y_scale: y} = view.frame
        return [box.left + x.compute(plot.x_range.start), box.top + y.compute(plot.y_range.end),
                box.left + x.compute(plot.x_range.end), box.top + y.compute(plot.y_range.start)]
        """
    )
    with Image.open(io.BytesIO(chromium.get_screenshot_as_png())) as shot:
        return np.asarray(shot.convert("RGB").crop([round(at) for at in corners])).reshape(-1, 3)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("relief", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_map_has_the_colours_of_its_bar(scheme, relief, chromium, files, record):
    """Of all pixels, path and posts included, 85 % are within 30 RGB units of the bar's."""
    seen = opened(chromium, files["explore"], scheme=scheme)
    box = seen.find_element("id", "relief")
    if box.is_selected() != relief:
        box.click()
    time.sleep(0.3)
    bar = 255.0 * np.array([to_rgb(colour) for colour in record["palettes"]["viridis"]])
    pixels = map_pixels(seen)
    assert len(pixels) > 50_000
    assert np.mean(cKDTree(bar).query(pixels)[0] <= 30.0) >= 0.85


def test_impassable_cells_have_the_grey_of_figures_and_a_key(chromium, tmp_path):
    shape, passable = (2, 2), np.array([[True, True], [True, False]])
    workspace = tb.Workspace.from_awareness(np.full((1, *shape, 2), 0.5), passable)
    layer = Layer("trust_mean", "trust", "Trust", np.full(shape, 0.5), (0.0, 1.0))
    half = np.full((5, 1), 0.5)
    step = Step("m", "", "", [(0, 0), (0, 1)], np.full((2, 2), 0.5), None, half[:1], half)
    draw_explorer(Scene("t", workspace, [layer], [step])).save(tmp_path / "page.html")
    seen = opened(chromium, (tmp_path / "page.html").as_uri())
    assert "impassable" in seen.find_element("css selector", ".key").text
    time.sleep(0.3)
    closed = 255.0 * np.array(to_rgb(LIGHT.closed))
    near = (np.abs(map_pixels(seen) - closed) <= 1.0).all(1)
    assert 0.15 < near.mean() < 0.3  # one cell of four


def test_a_notebook_s_frame_is_as_high_as_the_page(chromium, files):
    frame = "document.querySelector('iframe').contentDocument"
    seen = opened(chromium, files["notebook"], ready=frame)
    time.sleep(0.3)
    inner = seen.execute_script(f"return {frame}.documentElement.offsetHeight")
    outer = seen.execute_script("return document.querySelector('iframe').offsetHeight")
    assert inner <= outer <= inner + 8
    assert complaints(seen) == []
