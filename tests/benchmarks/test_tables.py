"""The pages of docs/evidence are written from rows, and their intervals are those of t tests."""

import common
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


def test_tables_show_the_means_and_arrivals_of_their_rows(rows):
    mean = tables.of_worlds(tables.rows_of("one"), "lost")["trustbo"].mean()
    assert f"| map right (5) | {mean:.3f} |" in tables.means("one")
    assert tables.mean("one", "all", "trustbo") == f"{mean:.3f}"
    assert "0.0 %, 93.3 %" in tables.arrivals("one")  # the first mission of each campaign failed
    assert tables.arrive("one", "right", "trustbo", "first") == "0.0 %"


def test_texts_are_filled_with_numbers_of_their_rows(rows):
    *ends, p = tables.difference(tables.of_worlds(tables.rows_of("one"), "lost"), "running mean")
    found = tables.filled("less by {{ less | one | all | best }} in {{worlds|one}} worlds")
    assert found == f"less by {tables.interval(*ends)}, p = {p:.2g} in 5 worlds"


def test_a_stored_table_is_shown_as_it_was_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tables, "STORED", tmp_path)
    monkeypatch.setattr(common.Table, "folder", tmp_path / "tables")
    table = common.Table("fit", "CPU s", "CPU s", name="fits")
    table.row("3 missions", "0.10", 5)
    printed = [line.replace(" ", "") for line in capsys.readouterr().out.splitlines()]
    assert tables.stored("fits").replace(" ", "").splitlines() == printed
    assert tables.cell("fits", "3 missions", "CPU s") == "0.10"
    assert tables.stored("fits", "fit", "CPU s").splitlines()[-1] == "| 3 missions | 0.10 |"


def test_a_page_that_differs_from_its_rows_is_listed(rows, tmp_path, monkeypatch):
    texts, docs = tmp_path / "pages", tmp_path / "docs"
    for folder in (texts, docs):
        (folder / "evidence").mkdir(parents=True)
    page = texts / "evidence" / "contact.md"
    page.write_text("{{ means | one }}\n")
    monkeypatch.setattr(tables, "TEXTS", texts)

    assert tables.stale(docs) == ["evidence/contact.md"]
    written = docs / "evidence" / "contact.md"
    written.write_text(f"{tables.means('one')}\n")
    assert tables.stale(docs) == []
    written.write_text(written.read_text().replace("0.", "1.", 1))
    assert tables.stale(docs) == ["evidence/contact.md"]


def test_the_pages_of_the_documentation_are_those_of_their_rows():
    assert tables.stale() == []


def test_a_group_that_does_not_exist_is_not_a_number_that_is_missing(rows):
    assert tables.filled("{{ mean | one | limit too low | trustbo }}") == tables.MISSING
    with pytest.raises(ValueError, match="limit too wide"):
        tables.filled("{{ mean | one | limit too wide | trustbo }}")
