"""Tables of results: differences of paired campaigns, and numbers of a campaign, by hand."""

import numpy as np
import pytest
import xarray as xr

from trustbo.errors import TrustboError
from trustbo.study import worlds_table
from trustbo.study.table import as_text, differences, worse_than
from trustbo.study.world import COURSES


def results_by_hand():
    """Two worlds and courses, a seed on each, of three methods, three missions each."""
    keys = [(m, w, s) for m in ("ours", "good", "bad") for w in ("a", "b") for s in (0, 1)]
    shift = {"ours": 0.0, "good": -2.0, "bad": 3.0}
    by_world = {"a": 4.0, "b": 8.0}
    regret = np.array([[by_world[w] + s + shift[m]] * 3 for m, w, s in keys])
    one = np.ones(regret.shape)
    kinds = {"a": "right", "b": "wall"}
    return xr.Dataset(
        {
            "regret": (("run", "mission"), regret),
            "regret_before": ("run", np.full(len(keys), 10.0)),
            "lost": (("run", "mission"), 2.0 * one),
            "lost_before": ("run", np.full(len(keys), 5.0)),
            "lost_followed": (("run", "mission"), regret / 4.0 + [1.0, 2.0, 6.0]),
            "best": (("run", "mission"), one),
            "best_followed": (("run", "mission"), one * [1.0, 2.0, 6.0]),
            "oracle": ("run", np.full(len(keys), 0.5)),
            "status": (("run", "mission"), np.full(regret.shape, "ok")),
            "seconds_cpu": ("run", np.array([3.0 if m == "ours" else 1.5 for m, _, _ in keys])),
        },
        {
            "method": ("run", [m for m, _, _ in keys]),
            "world": ("run", [w for _, w, _ in keys]),
            "kind": ("run", [kinds[w] for _, w, _ in keys]),
            "course": ("run", [COURSES[s] for _, _, s in keys]),
            "seed": ("run", [s for _, _, s in keys]),
        },
    ).assign_coords(mission=[1, 2, 3])


def test_differences_are_of_the_same_world_course_and_seed():
    results = results_by_hand()
    shuffled = results.isel(run=np.random.default_rng(0).permutation(results.sizes["run"]))
    table = differences(shuffled, "ours")
    assert sorted(table.index) == ["bad", "good"]
    for column in ("value", "low", "high"):  # the same on every world, though worlds differ by 4
        assert table.loc["good", ("regret after 3", column)] == pytest.approx(2.0)
        assert table.loc["bad", ("regret after 3", column)] == pytest.approx(-3.0)
        assert table.loc["bad", ("lost while learning", column)] == pytest.approx(-0.75)
    assert table.loc["good", ("regret after 0", "value")] == 0.0
    assert table.loc["good", ("regret now", "value")] == pytest.approx(2.0 * 3 / 4)
    assert table.loc["good", ("seconds", "value")] == pytest.approx(0.5)
    assert table.loc["good", ("pairs", "value")] == 4
    by_kind = differences(results, "ours", "kind")
    assert set(by_kind.index) == {(k, m) for k in ("right", "wall") for m in ("good", "bad")}
    assert by_kind.loc[("wall", "bad"), ("pairs", "value")] == 2
    one = differences(results.isel(run=results["seed"] == 0), "ours", "kind")
    assert one.loc[("wall", "bad"), ("regret now", "value")] == pytest.approx(-9.0 / 4)
    assert np.isnan(one.loc[("wall", "bad"), ("regret now", "low")])  # one pair has no interval
    assert worse_than(one) == ["worse than: none"]


def test_what_ours_is_worse_in_is_listed_and_printed_like_what_it_is_better_in():
    table = differences(results_by_hand(), "ours", "kind")
    lines = worse_than(table)
    assert "worse in regret now than: right, good; wall, good" in lines
    assert not any("bad" in line for line in lines if "seconds" not in line)
    assert not any(line.startswith("worse in regret after 0") for line in lines)
    assert sum(line.startswith("worse in seconds") for line in lines) == 1
    text = as_text(table)
    assert text.startswith("| kind and ours less | pairs |")
    assert "**" not in text
    assert "| wall, good | 2 | 0.0 [0.0, 0.0] | 2.0 [2.0, 2.0] |" in text
    assert "| wall, bad | 2 | 0.0 [0.0, 0.0] | -3.0 [-3.0, -3.0] |" in text
    better = differences(results_by_hand(), "good").drop("ours")
    assert worse_than(better) == ["worse than: none"]


def test_a_comparison_with_no_other_method_on_the_same_worlds_is_refused():
    results = results_by_hand()
    with pytest.raises(TrustboError, match="unknown method 'his'; choose one of ours, good, bad"):
        differences(results, "his")
    ours = results["method"] == "ours"
    apart = results.isel(run=np.where(ours, results["world"] == "a", results["world"] == "b"))
    with pytest.raises(TrustboError, match="no other method was run on the worlds of 'ours'"):
        differences(apart, "ours")


def test_missions_to_1_percent_are_those_after_which_regret_stays_below():
    results = results_by_hand().isel(run=[0, 1, 2, 3])
    results["regret"][:] = [[0.5, 2.0, 1.0], [0.5, 0.2, 0.0], [9.0, 9.0, 9.0], [0.9, 0.9, 1.1]]
    results["regret_before"][1] = 0.3
    table = worlds_table(results, ["world", "seed"])
    assert table["missions to 1 %", "value"].tolist() == [3.0, 0.0, 4.0, 4.0]


def test_paths_driven_are_held_against_the_best_of_their_mission_s_world():
    """Of version 0.2, against that before the first."""
    results = results_by_hand().isel(run=[0, 1, 2, 3])
    now = worlds_table(results)["lost while learning", "value"]
    assert now.tolist() == pytest.approx([(4 + 5 + 8 + 9) / 16])
    old = worlds_table(results.drop_vars(["best", "best_followed"]))
    assert old["lost while learning", "value"].tolist() == pytest.approx([26 / 16 + 3 - 0.5])
