"""The figure of a criticism marks what lies outside its bands."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import trustbo as tb


@pytest.fixture(scope="module")
def found():
    """Missions in which the second robot has less contact from the fifth on."""
    rng, path, missions = np.random.default_rng(0), [(0, k) for k in range(7)], []
    for j in range(8):
        z = rng.uniform(size=(6, 2, 2))
        rates = 0.5 + 0.3 * z[..., 0] + 0.03 * rng.standard_normal((6, 2))
        rates[:, 1] -= 0.3 * (j >= 4)
        missions.append(tb.Mission.from_arrays(path, z, rates))
    return tb.criticise(tb.fit(missions, tb.models.PooledTrust(), whole=False), compare=False)


def test_in_a_column_of_a_journal_panels_are_lower_and_labels_keep_apart(found):
    axes = tb.plots.criticism(found, width=3.5)
    figure = axes[0].figure
    figure.canvas.draw()
    assert figure.get_figheight() < 14.0
    labels = [ax.yaxis.label.get_window_extent() for ax in axes if ax.get_ylabel()]
    assert not any(a.overlaps(b) for a, b in itertools.pairwise(labels))


def test_the_fault_is_in_bold_and_groups_outside_their_band_are_marked(found):
    groups = found.groups.copy()
    groups["stands_out"] = (groups["kind"] == "mission") & (groups["group"] == 3)
    axes = tb.plots.criticism(replace(found, groups=groups), n_columns=3)
    assert axes.shape == (9,)
    bold = [label for label in axes[0].get_yticklabels() if label.get_fontweight() == "bold"]
    assert [label.get_text() for label in bold] == [found.fault] == ["robot in a mission"]
    missions = next(ax for ax in axes if ax.get_xlabel() == "mission")
    (marked,) = (line for line in missions.lines if line.get_color() == "#c1272d")
    assert list(marked.get_xdata()) == [3]


def test_cells_that_stand_out_are_framed(found):
    groups = found.groups.copy()
    groups["stands_out"] = [group == (0, 5) for group in groups["group"]]
    (frame,) = tb.plots.criticism(replace(found, groups=groups))[-1].patches
    assert frame.get_xy() == (4.5, -0.5)
