"""Options that every figure takes, and colours that follow the paper."""

import inspect
import itertools

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.text import Text

import trustbo as tb
from trustbo import plots
from trustbo.plots.style import luminance, theme


@pytest.fixture(scope="module")
def figures(result):
    """Every figure of a result as a function of its options, and its number of panels."""
    workspace, posterior = result.workspace, result.posterior
    mean = tb.inference.params_of(posterior).mean()
    cost = result.planner.cost_map(mean, per_robot=True)
    share = result.planner.path_posterior(posterior, n_draws=100)
    p_fail = result.planner.problem.risk.p_fail
    found = tb.criticise(posterior, result.missions, compare=False)
    names = workspace.team.names
    rng = np.random.default_rng(0)
    study = xr.Dataset(
        {"regret": (("run", "mission"), 10.0 * rng.uniform(size=(8, 4)))},
        {
            "policy": ("run", ["thompson", "posterior_mean"] * 4),
            "terrain": ("run", ["hill"] * 4 + ["plain"] * 4),
            "mission": np.arange(1, 5),
        },
    )
    drawn = {
        "trust_maps": (lambda **o: result.plot_maps(**o), 3),
        "robot_maps": (lambda **o: plots.robot_maps(cost, workspace, result.path, **o), 3),
        "path_posterior": (lambda **o: plots.path_posterior(share, workspace, **o), 1),
        "hazard_map": (lambda **o: plots.hazard_map(p_fail, workspace, **o), 1),
        "terrain_maps": (lambda **o: plots.terrain_maps(workspace, **o), 4),
        "loadings": (lambda **o: plots.loadings(workspace.composites, **o), 2),
        "place_map": (lambda **o: plots.place_map(posterior, workspace, **o), 2),
        "plan_map": (lambda **o: plots.plan_map(result.plan, bounds=[1], **o), 2),
        "plan_trust": (lambda **o: plots.plan_trust(result.plan, names, **o), 3),
        "mission_trust": (lambda **o: plots.mission_trust(posterior, **o), 3),
        "parameter_history": (lambda **o: plots.parameter_history(result.posteriors, **o), 12),
        "campaign_history": (lambda **o: plots.campaign_history(result.history, **o), 2),
        "criticism": (lambda **o: plots.criticism(found, **o), 9),
        "regret_curves": (lambda **o: plots.regret_curves(study, panels="terrain", **o), 2),
    }
    return drawn


@pytest.fixture(scope="module")
def drawn(figures):
    """The first Axes of a figure with options, to be read only: one figure for all tests."""
    kept = {}

    def drawn(name, **options):
        key = name, *sorted((k, v) for k, v in options.items() if v is not None)
        if key not in kept:
            kept[key] = np.ravel(figures[name][0](**options))[0]
            kept[key].figure.canvas.draw()
        return kept[key]

    return drawn


NAMES = (
    "trust_maps", "robot_maps", "path_posterior", "hazard_map", "terrain_maps", "loadings",
    "place_map", "plan_map", "plan_trust", "mission_trust", "parameter_history",
    "campaign_history", "criticism", "regret_curves",
)  # fmt: skip
MAPS = NAMES[:5]


def test_all_figures_with_options_are_tried_here():
    with_options = [
        name
        for name in plots.__all__
        if inspect.isfunction(getattr(plots, name))
        and "style" in inspect.signature(getattr(plots, name)).parameters
    ]
    assert sorted(with_options) == sorted(NAMES)


def texts_of(artist):
    """All pieces of text that are drawn, of the ticks too."""
    if not artist.get_visible():
        return []
    if isinstance(artist, Text):
        return [artist] if artist.get_text().strip() else []
    parts = artist.get_children()
    if isinstance(artist, Axis):
        ticks = artist._update_ticks()  # only these are drawn
        parts = [artist.label, artist.offsetText, *(t.label1 for t in ticks)]
        parts += [t.label2 for t in ticks]
    return [text for part in parts for text in texts_of(part)]


def complaints_of(figure):
    """Sentences on what leaves a figure that is drawn, and on pieces of text over others."""
    renderer, whole = figure.canvas.get_renderer(), figure.bbox
    box = figure.get_tightbbox(renderer).transformed(figure.dpi_scale_trans)
    said = []
    if box.x0 < whole.x0 or box.y0 < whole.y0 or box.x1 > whole.x1 or box.y1 > whole.y1:
        said.append(f"{box.extents} leaves {whole.extents}")
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in texts_of(figure)]
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        if min(width, height) > 1.0:  # boxes are larger than letters
            said.append(f"{one!r} is over {other!r}")
    return said


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("width", [3.5, pytest.param(None, marks=pytest.mark.slow)])
def test_all_of_a_figure_is_inside_it_and_no_text_is_over_other_text(drawn, name, width):
    assert complaints_of(drawn(name, width=width).figure) == []


@pytest.mark.parametrize("name", NAMES)
def test_legends_and_bars_have_room_on_the_user_s_axes(figures, name):
    draw, n = figures[name]
    rows, columns = -(-n // 4), min(n, 4)
    size = 2.6 * columns, 2.4 * rows
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    draw(ax=axes.ravel()[:n])
    figure.canvas.draw()
    assert complaints_of(figure) == []


@pytest.mark.parametrize("name", ["trust_maps", "robot_maps", "path_posterior", "terrain_maps"])
@pytest.mark.parametrize("options", [{}, {"width": 3.5}, {"title": "all maps"}])
def test_maps_leave_no_blank_strip_above_or_below(drawn, name, options):
    figure = drawn(name, **options).figure
    content = figure.get_tightbbox()
    assert content.y0 < 0.1
    assert figure.get_figheight() - content.y1 < 0.1


@pytest.mark.parametrize(("shape", "rows"), [((1, 3), 1), ((3, 1), 3), ((2, 2), 2)])
def test_a_bar_of_the_user_s_axes_is_as_tall_as_their_rows(figures, shape, rows):
    figure, axes = plt.subplots(*shape, figsize=(7.0, 7.0))
    figures["trust_maps"][0](ax=axes.ravel()[:3])
    (bar,) = keys_of(figure)
    assert bar.get_box_aspect() == 14 * rows
    longest = max(map(len, bar.get_ylabel().splitlines()))
    height = sum({ax.get_position(original=True).height for ax in axes.ravel()[:3]}) * 7.0 * rows
    assert longest <= max(18, 11 * height)


def keys_of(figure):
    """Legends and colour bars."""
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    inside = [ax.get_legend() for ax in figure.axes if ax.get_legend() is not None]
    return [*figure.legends, *bars, *inside]


@pytest.mark.parametrize("name", NAMES)
def test_a_figure_is_drawn_on_the_axes_that_it_is_given(figures, name):
    draw, n = figures[name]
    figure, axes = plt.subplots(1, n + 1, figsize=(2.0 * n, 2.0))
    returned = np.ravel(draw(ax=list(axes[:n]), legend=False))
    assert [ax is given for ax, given in zip(returned, axes[:n], strict=True)] == [True] * n
    assert plt.get_fignums() == [figure.number]
    assert not axes[n].has_data()
    assert len(figure.axes) == n + 1  # no colour bar
    with pytest.raises(tb.TrustboError, match=rf"this figure has {n} panels, and ax 0; give {n}"):
        draw(ax=[])
    with pytest.raises(tb.TrustboError, match="ax must be matplotlib Axes; got a Figure"):
        draw(ax=figure)


@pytest.mark.parametrize("name", NAMES)
def test_a_legend_can_be_left_out_and_a_title_written(figures, drawn, name):
    draw, n = figures[name]
    assert keys_of(drawn(name).figure) or name == "loadings"  # whose bars all agree here
    axes = np.ravel(draw(legend=False, title="costs $1"))
    assert keys_of(axes[0].figure) == []
    suptitle = axes[0].figure.get_suptitle()
    assert (axes[0].get_title() if n == 1 else suptitle) == r"costs \$1"


@pytest.mark.parametrize("name", MAPS)
def test_colours_of_maps_are_the_user_s(figures, name):
    ax = np.ravel(figures[name][0](cmap="magma"))[-1]
    assert ax.images[0].get_cmap().name == "magma"
    with pytest.raises(tb.TrustboError, match="unknown cmap 'magmaa'; give a name"):
        figures[name][0](cmap="magmaa")


@pytest.mark.parametrize("name", NAMES)
def test_text_can_be_read_in_a_column_of_3_5_inches(drawn, name):
    figure = drawn(name, width=3.5).figure
    assert figure.get_figwidth() == 3.5
    texts = [t for t in figure.findobj(Text) if t.get_text() and t.get_visible()]
    signs = {"+", "\N{MINUS SIGN}"}  # of places, as large as their cells
    assert min(t.get_fontsize() for t in texts if t.get_text() not in signs) >= 8.0


@pytest.mark.parametrize("name", NAMES)
def test_ink_and_paper_are_those_of_the_user_s_settings(figures, name):
    with plt.style.context("dark_background"):
        assert (theme().ink, theme().paper) == ("#ffffff", "#000000")
        figure = np.ravel(figures[name][0]())[0].figure
    assert to_hex(figure.get_facecolor()) == "#000000"
    for ax in figure.axes:
        for text in (ax.title, ax.xaxis.label, ax.yaxis.label, *ax.get_xticklabels()):
            if text.get_text() and not text.get_path_effects():
                assert luminance(text.get_color()) > 0.5, text


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"titel": "a"}, r"unknown option 'titel'; did you mean title\?"),
        ({"font": "a"}, "unknown option 'font'; choose one of ax, n_columns"),
        ({"width": -1.0}, "width must be positive and finite; got -1.0"),
        ({"legend": "no"}, "legend must be True or False; got 'no'"),
        ({"title": 3}, "title must be text; got 3"),
    ],
)
def test_options_that_cannot_be_are_refused_in_a_line(result, option, message):
    with pytest.raises(tb.TrustboError, match=message):
        plots.mission_trust(result.posterior, **option)


def test_a_wrong_argument_is_said_in_a_line(result):
    wrong = {
        "mission_trust": (result.missions[0],),
        "plan_map": (result.workspace,),
        "plan_trust": (result, ["r1"]),
        "place_map": (result, result.workspace),
        "trust_maps": (result, result.trust_map, result.path, result.workspace),
        "robot_maps": (result.posterior, result.workspace),
        "path_posterior": (result.posterior, result.workspace),
        "parameter_history": (result.posterior,),
        "campaign_history": (result,),
        "terrain_maps": (result,),
        "loadings": (result.workspace,),
        "criticism": (result,),
        "regret_curves": (result,),
    }
    for name, arguments in wrong.items():
        said = rf"^plots\.{name}: got {type(arguments[0]).__name__} .*; give [^\n]*\.$"
        with pytest.raises(tb.TrustboError, match=said):
            getattr(plots, name)(*arguments)
