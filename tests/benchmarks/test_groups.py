"""Groups and kinds of worlds, and the t test of all tables."""

import os
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
    clustered,
    grounds_of,
    groups_in,
    holm,
    interval,
    over_worlds,
)
from scipy import stats
from world_set import worlds


def test_every_kind_of_world_is_in_one_of_the_groups():
    assert set(KINDS) == {world.kind for world in worlds().values()}
    assert sorted(kind for kinds in ALIKE.values() for kind in kinds) == sorted(KINDS)
    assert set(GROUPS["all but wrong slope limits"]) == set(KINDS) - {"limit"}


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


def test_limits_too_high_and_too_low_are_groups_of_their_own():
    every = worlds().values()
    table = pd.DataFrame({"kind": [w.kind for w in every], "case": [w.case for w in every]})
    some = dict(groups_in(table))
    assert set(some) == {*GROUPS, "limit too high", "limit too low"}
    assert len(some["all"]) == len(table)
    wrong = some["wrong slope limit"]
    parts = [some["limit too high"], some["limit too low"]]
    assert sorted(pd.concat(parts).index) == sorted(wrong.index)
    assert set(parts[1]["case"]) == {"limit-low-3"}


def test_values_that_are_missing_do_not_count():
    names = ["synthetic-0", "synthetic-1", "wellington", "tahoe"]
    values = np.array([0.1, np.nan, 0.4, 0.2])
    expected = clustered(values[[0, 2, 3]], np.arange(3))
    assert over_worlds(values, names) == pytest.approx(expected)
    assert np.isnan(over_worlds(np.full(4, np.nan), names)).all()
    assert interval(np.nan, np.nan, np.nan) == "-"
    assert interval(0.25, np.nan, np.nan, 2) == "0.25 [-]"
    assert interval(-0.0001, -0.5, 0.25, 2) == "0.00 [-0.50, 0.25]"
