"""Names as users give them, and numbers that cannot be."""

import pytest

import trustbo as tb


def test_dollar_signs_in_names_are_no_formulas(result, tmp_path):
    axes = tb.plots.plan_trust(result.plan, ["a$^$", "$b", "c"])
    assert axes[0].get_title() == r"a\$^\$"
    axes[0].figure.savefig(tmp_path / "names.svg")  # would raise
    cost = result.workspace.awareness.isel(feature=0).assign_coords(robot=["a$^$", "$b", "c"])
    tb.plots.robot_maps(cost, result.workspace)[0].figure.savefig(tmp_path / "maps.svg")


def test_maps_of_robots_need_no_names(result):
    cost = result.workspace.awareness.isel(feature=0).drop_vars("robot")
    axes = tb.plots.robot_maps(cost, result.workspace)
    assert [ax.get_title() for ax in axes] == ["0", "1", "2"]
    with pytest.raises(tb.TrustboError, match="n_columns must be a whole number from 1 on; got 0"):
        tb.plots.robot_maps(cost, result.workspace, n_columns=0)


def test_a_mission_is_a_whole_number(result):
    with pytest.raises(tb.TrustboError, match=r"mission must be one of 2, .*; got 0\.5"):
        tb.plots.mission_trust(result.posterior, 0.5)
