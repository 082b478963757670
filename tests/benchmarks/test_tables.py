"""The pages of docs/evidence are written from rows, and their intervals are those of t tests."""

import contact
import numpy as np
import pandas as pd
import pytest
import tables
from scipy import stats

GROUNDS = "synthetic-0", "synthetic-1", "synthetic-2", "wellington", "tahoe"


def row(ground, courses, method, lost):
    missions = range(contact.MISSIONS)
    return {
        "world": ground, "kind": "right", "case": "right", "ground": ground, "courses": courses,
        "method": method, **{f"lost_{k + 1}": lost + 0.01 * k for k in missions},
        **{f"p_{k + 1}": 0.9 for k in missions}, "status": "s" + "." * (contact.MISSIONS - 1),
    }  # fmt: skip


@pytest.fixture
def rows(tmp_path, monkeypatch):
    """Rows of two methods in both settings; every terrain has one world."""
    rng = np.random.default_rng(0)
    found = {}
    for setting, of_setting in contact.SETTINGS.items():
        for method in ("trustbo", "running mean"):
            of_method = [
                row(ground, courses, method, rng.uniform())
                for ground in GROUNDS
                for courses in of_setting
            ]
            found[setting, method] = pd.DataFrame(of_method)
            found[setting, method].to_csv(tmp_path / f"{setting}_{method}.csv", index=False)
    monkeypatch.setattr(tables, "REFERENCE", tmp_path)
    return found


def test_a_difference_is_that_of_a_paired_t_test_over_terrains(rows):
    table = tables.of_worlds(tables.rows_of("changing"), "lost")
    means = [
        rows["changing", method].groupby("world", sort=False)["lost_8"].mean().to_numpy()
        for method in ("trustbo", "running mean")
    ]
    found = tables.difference(table, "running mean")
    expected = stats.ttest_rel(*means)
    interval = expected.confidence_interval(0.95)
    want = [(means[0] - means[1]).mean(), interval.low, interval.high, expected.pvalue]
    np.testing.assert_allclose(found, want, rtol=1e-9)


def test_a_page_shows_the_means_and_arrivals_of_its_rows(rows):
    page = tables.contact()
    mean = tables.of_worlds(tables.rows_of("one"), "lost")["trustbo"].mean()
    assert f"| map right (5) | {mean:.3f} |" in page
    assert f"0%, {14 / 15:.1%}" in page  # the first mission of each campaign failed


def test_a_page_that_differs_from_its_rows_is_listed(rows, tmp_path):
    assert tables.stale(tmp_path) == ["contact"]
    (tmp_path / "contact.md").write_text(tables.contact())
    assert tables.stale(tmp_path) == []
    (tmp_path / "contact.md").write_text(tables.contact().replace("0.", "1.", 1))
    assert tables.stale(tmp_path) == ["contact"]
