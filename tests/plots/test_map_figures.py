"""Cost per robot, and where the best path may be."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import LogNorm
from matplotlib.text import Text

import trustbo as tb


def test_each_robot_has_its_map_in_the_same_colours(result):
    mean = tb.inference.params_of(result.posterior).mean()
    cost = result.planner.cost_map(mean, per_robot=True)
    axes = tb.plots.robot_maps(cost, result.workspace, result.path, label="cost 1 - sigma(trust)")
    assert [ax.get_title() for ax in axes] == ["r1", "r2", "r3"]
    known = np.where(result.workspace.passable, cost.transpose("robot", "row", "col"), np.nan)
    known[:, *result.path[0]] = np.nan  # trust at the start is assumed
    limits = tuple(np.nanquantile(known, [0.02, 0.98]))
    for ax in axes:
        own = cost.sel(robot=ax.get_title())
        np.testing.assert_array_equal(ax.images[0].get_array(), own)
        assert ax.images[0].get_clim() == limits
        assert ax.lines[0].get_xdata().size == len(result.path)
    (bar,) = [ax for ax in axes[0].figure.axes if ax.get_label() == "<colorbar>"]
    assert " ".join(bar.get_ylabel().split()).startswith("cost 1 - sigma(trust)")


def test_probabilities_of_cells_go_from_0_to_1(result):
    share = result.planner.path_posterior(result.posterior, n_draws=200)
    ax = tb.plots.path_posterior(share, result.workspace, result.path)
    np.testing.assert_array_equal(ax.images[0].get_array(), share)
    assert ax.images[0].get_clim() == (0.0, 1.0)


def test_columns_can_be_chosen_and_are_whole_numbers(result):
    axes = result.plot_maps(n_columns=1)
    assert np.ptp([ax.get_position().x0 for ax in axes]) < 1e-9
    assert [ax.get_xlabel() for ax in axes] == ["", "", "east (m)"]
    with pytest.raises(tb.TrustboError, match="n_columns must be a whole number from 1 on; got 0"):
        result.plot_maps(n_columns=0)


def test_fonts_are_the_user_s_and_sizes_the_figure_s(result):
    theirs = {"font.family": "serif", "font.size": 20, "figure.figsize": (9, 9)}
    sizes = []
    for settings in ({}, theirs):
        with plt.rc_context(settings):
            figure = result.plot_maps()[0].figure
            figure.canvas.draw()
        texts = [text for text in figure.findobj(Text) if text.get_text()]
        sizes.append(([text.get_fontsize() for text in texts], *figure.get_size_inches()))
    assert sizes[0][:2] == sizes[1][:2]  # texts, and the width
    assert sizes[0][2] == pytest.approx(sizes[1][2], abs=0.1)  # letters differ in height
    assert {8.0, 9.0} == set(sizes[0][0])
    assert {text.get_fontfamily()[0] for text in texts} == {"serif"}


def test_figures_are_vectors_but_for_the_maps(result, tmp_path):
    axes = result.plot_maps()
    axes[0].figure.savefig(tmp_path / "maps.svg")
    text = (tmp_path / "maps.svg").read_text()
    assert text.count("<path") > 20  # lines and letters
    assert text.count("<image") <= len(axes) + 1  # colours of each, the bar


def test_the_hazard_of_a_cell_is_that_from_its_worst_side(result):
    p_fail = result.planner.problem.risk.p_fail
    ax = tb.plots.hazard_map(p_fail, result.workspace, result.path)
    shown = np.ma.filled(ax.images[0].get_array(), np.nan)
    for row, col in np.ndindex(shown.shape):
        into = [p for p in p_fail[:, row, col] if not np.isnan(p)]
        np.testing.assert_equal(shown[row, col], max(into, default=np.nan))
    assert ax.images[0].get_clim() == (1e-3, 1.0)
    assert isinstance(ax.images[0].norm, LogNorm)  # small chances are seen
    assert ax.lines[0].get_xdata().size == len(result.path)
