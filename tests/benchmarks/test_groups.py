"""Groups and kinds of worlds: means, differences and p-values of results made by hand."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import groups
import numpy as np
import pandas as pd
import pytest
from groups import (
    ALIKE,
    GROUPS,
    KINDS,
    LOST,
    OURS,
    arrivals,
    beside,
    by_group,
    by_kind,
    by_limit,
    clustered,
    grounds_of,
    holm,
    report_groups,
    rows_of,
)
from scipy import stats
from world_set import worlds

METHODS = (OURS, "running mean", "residual process", "line of sight")
LOSES = {OURS: 0.1, "running mean": 0.3, "residual process": 0.2, "line of sight": 0.9}


def made(lost):
    """Rows of all worlds on two courses; `lost(method, world, course)`."""
    rows = [
        {
            "world": world.name, "kind": world.kind, "course": course, "method": method,
            "lost_while_learning": lost(method, world, course), "regret_now": 1.0, "arrive": 0.9,
            LOST: lost(method, world, course), "arrive_first_3": 0.5, "arrive_later": 1.0,
        }
        for world in worlds().values() for course in ("sw-ne", "nw-se") for method in METHODS
    ]  # fmt: skip
    return pd.DataFrame(rows)


def of_row(table, **labels):
    some = table
    for name, label in labels.items():
        some = some[some[name] == label]
    assert len(some) == 1
    return some.iloc[0]


def test_every_kind_of_world_is_in_one_of_the_groups():
    assert set(KINDS) == {world.kind for world in worlds().values()}
    assert sorted(kind for kinds in ALIKE.values() for kind in kinds) == sorted(KINDS)
    assert set(GROUPS["all but wrong slope limits"]) == set(KINDS) - {"limit"}


def test_groups_have_the_means_of_their_worlds_and_the_best_baseline():
    """Worlds differ by far more than methods do, and paired differences by nothing."""
    levels = {world: 3.0 * i for i, world in enumerate(worlds())}
    table = by_group(made(lambda method, world, course: LOSES[method] + levels[world.name]))
    for group, kinds in GROUPS.items():
        names = [world.name for world in worlds().values() if world.kind in kinds]
        own = of_row(table, group=group, what=OURS)
        assert own["n"] == len(names)
        assert own["value"] == pytest.approx(0.1 + np.mean([levels[name] for name in names]))
        assert own["low"] < own["value"] - 1.0
        assert own["high"] > own["value"] + 1.0
        best = of_row(table, group=group, what=f"{OURS} minus the best (residual process)")
        assert best[["value", "low", "high"]].tolist() == pytest.approx([-0.1] * 3)
        sight = of_row(table, group=group, what=f"{OURS} minus line of sight")
        assert sight["value"] == pytest.approx(-0.8)


def test_worlds_of_one_terrain_enter_an_interval_together():
    """Differences that are a terrain's own: as wide as of as many values as terrains."""
    terrains = sorted({world.ground for world in worlds().values()})
    shift = dict(zip(terrains, np.linspace(-1.0, 1.0, len(terrains)), strict=True))
    table = by_group(made(
        lambda method, world, course: shift[world.ground] if method == OURS else 0.0
    ))  # fmt: skip
    row = of_row(table, group="all", what=f"{OURS} minus running mean")
    sd = np.std([shift[world.ground] for world in worlds().values()])
    assert (row["high"] - row["low"]) / (2 * 1.96) > 0.8 * sd / np.sqrt(len(terrains))


def test_only_worlds_that_all_methods_have_are_compared():
    rows = made(lambda method, world, course: LOSES[method] + 9.0 * (world.name == "tahoe"))
    gone = (rows["world"] == "tahoe") & (rows["method"] == "running mean")
    table = by_group(rows[~gone])
    assert of_row(table, group="all", what=OURS)["value"] == pytest.approx(0.1)


def test_each_kind_is_held_against_its_own_best_baseline():
    def lost(method, world, course):
        good = "line of sight" if world.kind == "right" else "running mean"
        noise = np.random.default_rng([len(world.name), world.ground.encode()[-1]]).normal()
        return 0.0 if method == good else 1.0 + 0.01 * noise if method == OURS else 2.0

    table = by_kind(made(lost))
    assert table["kind"].tolist() == list(KINDS)
    assert of_row(table, kind="right")["best"] == "line of sight"
    assert of_row(table, kind="days")["best"] == "running mean"
    assert table["value"].to_numpy() == pytest.approx(1.0, abs=0.05)
    assert (table["p_holm"] >= table["p"]).all()
    assert (table["p_holm"] < 0.05).all()


def test_p_values_of_unrelated_values_are_those_of_the_t_test():
    values = np.random.default_rng(0).normal(0.3, 1.0, 12)
    mean, low, high, p = clustered(values, np.arange(12))
    expected = stats.ttest_1samp(values, 0.0)
    assert (mean, p) == pytest.approx((values.mean(), expected.pvalue))
    assert (low, high) == pytest.approx(tuple(expected.confidence_interval(0.95)))


def test_clustered_errors_are_those_of_statsmodels():
    sm = pytest.importorskip("statsmodels.api")
    rng = np.random.default_rng(1)
    clusters = rng.integers(5, size=30)
    values = rng.normal(size=5)[clusters] + 0.2 * rng.normal(size=30)
    fitted = sm.OLS(values, np.ones(30)).fit(
        cov_type="cluster", cov_kwds={"groups": clusters, "df_correction": True}, use_t=True
    )
    # Its small-sample factor has (n - 1) / (n - k) too, which is 1 for a mean.
    mean, low, high, p = clustered(values, clusters)
    assert mean == pytest.approx(fitted.params[0])
    assert p == pytest.approx(fitted.pvalues[0])
    assert (low, high) == pytest.approx(tuple(fitted.conf_int()[0]))


def test_one_terrain_has_no_interval_and_equal_values_no_doubt():
    assert np.isnan(clustered(np.array([1.0, 2.0]), np.array(["a", "a"]))[1:]).all()
    assert clustered(np.zeros(3), np.arange(3)) == (0.0, 0.0, 0.0, 1.0)
    assert clustered(np.ones(3), np.arange(3))[3] == 0.0


def test_holm_corrects_as_by_hand_and_as_statsmodels_does():
    corrected = holm([0.01, 0.04, np.nan, 0.03, 0.5])
    # 4 x .01, then 3 x .03, then 2 x .04 which is less than that, then .5.
    np.testing.assert_allclose(corrected, [0.04, 0.09, np.nan, 0.09, 0.5])
    np.testing.assert_allclose(holm([0.6, 0.7]), [1.0, 1.0])
    multitest = pytest.importorskip("statsmodels.stats.multitest")
    p = np.random.default_rng(2).uniform(size=20) ** 3
    np.testing.assert_allclose(holm(p), multitest.multipletests(p, method="holm")[1])


def test_rows_count_arrivals_of_the_first_three_missions_apart():
    labels = {"world": "tahoe", "kind": "right", "course": "sw-ne", "method": OURS}
    results = pd.DataFrame({
        "case": OURS, "scene": "tahoe, sw-ne", "seed": [0, 1],
        **{name: labels[name] for name in ("world", "kind", "course")},
        "regret now": 1.0, "lost while learning": 2.0, "lost with failures": [4.0, 6.0],
        "arrive": [3 / 5, 3 / 4], "arrive of the first 3": [1 / 3, 2 / 3], "arrive later": 1.0,
    })  # fmt: skip
    row = of_row(rows_of(results), **labels)
    assert row[LOST] == 5.0
    assert row["lost_while_learning"] == 2.0
    assert row["arrive_first_3"] == pytest.approx((1 / 3 + 2 / 3) / 2)
    assert row["arrive_later"] == 1.0
    assert row["arrive"] == pytest.approx((3 / 5 + 3 / 4) / 2)
    home = arrivals(rows_of(results))
    assert home.loc[("right", OURS), "arrive_later"] == 1.0


def test_an_earlier_version_is_compared_on_the_worlds_that_both_have():
    rows = made(lambda method, world, course: 0.2)
    before = made(lambda method, world, course: 0.5)
    before = before[before["world"] != "tahoe"]
    table = beside(rows, before)
    assert of_row(table, what="right")["n"] == sum(w.kind == "right" for w in worlds().values()) - 1
    assert of_row(table, what="right")["value"] == pytest.approx(-0.3)
    assert of_row(table, what="limit")["0.5"] == pytest.approx(0.5)


def test_wrong_limits_are_averaged_by_how_wrong_they_are():
    rows = made(lambda method, world, course: 0.1 if world.case == "limit-low-3" else 0.6)
    limits = by_limit(rows)
    assert limits.index.levels[0].tolist() == ["limit-1", "limit-2", "limit-4", "limit-low-3"]
    assert limits.loc[("limit-low-3", OURS), LOST] == pytest.approx(0.1)
    assert limits.loc[("limit-2", OURS), LOST] == pytest.approx(0.6)


def test_the_report_has_every_group_and_kind(capsys):
    report_groups(made(lambda method, world, course: LOSES[method]))
    text = capsys.readouterr().out
    assert "| robots, weather, changes (" in text
    assert text.count("| limit, ") == 2
    assert all(f"| {kind} (" in text for kind in KINDS)


def test_help_is_printed_without_reading_a_table(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["groups.py", "--help"])
    monkeypatch.setattr("sys.excepthook", sys.excepthook)  # which the script replaces
    monkeypatch.setattr(pd, "read_csv", None)
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(groups.__file__, run_name="__main__")
    assert ended.value.code == 0
    found = capsys.readouterr().out
    assert found.startswith("usage: groups.py")
    assert "FILE" in found


def test_a_script_ends_without_a_traceback_if_nothing_reads_its_output():
    """As all scripts that parse their arguments; groups.py itself takes long to import."""
    program = "from common import arguments, parsed; parsed(arguments('')); print(10**5 * 'row ')"
    command = [sys.executable, "-c", program]
    environment = os.environ | {"PYTHONPATH": str(Path(groups.__file__).parent)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as script:
        script.stdout.close()
        complaint = script.stderr.read()
    assert complaint.startswith("stopped: ")
    assert len(complaint.splitlines()) == 1


def test_worlds_are_of_their_terrains():
    by_name = worlds()
    assert grounds_of(by_name).tolist() == [world.ground for world in by_name.values()]
