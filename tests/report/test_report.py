"""The report page: well-formed, self-contained, and its numbers are the result's."""

import base64
import dataclasses
import html
import html.parser
import re

import numpy as np
import pytest
import xarray as xr
from worlds import hillside

import trustbo as tb
from trustbo.models import CoupledTrust, TrustParams
from trustbo.models.params import CoupledParams
from trustbo.report import write_report
from trustbo.report.numbers import decimals_for, number
from trustbo.report.summary import facts_of
from trustbo.report.tables import parameter_table

VOID = {"meta", "link", "img", "source", "br"}


class Page(html.parser.HTMLParser):
    """What a page consists of; refuses tags that are not closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.headings, self.tables, self.text = [], [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text.append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data


@pytest.fixture(scope="module")
def result():
    terrain = hillside()
    workspace = tb.Workspace.from_terrain(terrain, (3, 3))
    return tb.iterate(
        workspace, (2, 0), (0, 2), n_iterations=2, sampler="exact", seed=1, progress=False
    )


@pytest.fixture(scope="module")
def hostile():
    """Without terrain, robots each on their own, one with a name that would break a page."""
    team = tb.Team(names=("<b>r&1", 'r"2'), n_robots=2)
    awareness = np.random.default_rng(0).uniform(size=(2, 3, 3, 2))
    workspace = tb.Workspace.from_awareness(awareness, team=team)
    truth = TrustParams(0.4, np.array([0.5, 0.2]), 0.1, 0.05, 0.05)
    return tb.iterate(
        workspace,
        (2, 0),
        (0, 2),
        n_iterations=2,
        model=CoupledTrust(inter_robot="none"),
        sampler="exact",
        simulator=tb.simulation.ModelSimulator(workspace, truth),
        progress=False,
    )


def write(result, folder, **options):
    write_report(folder / "report.html", result, **options)
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def text(result, tmp_path_factory):
    return write(result, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_the_page_is_whole_and_needs_nothing_else(page, text):
    assert page.headings[0] == 1
    assert page.headings.count(1) == 1
    assert all(b - a <= 1 for a, b in zip(page.headings, page.headings[1:], strict=False))
    names = [tag for tag, _ in page.tags]
    assert {"header", "main", "section", "footer", "figure", "figcaption", "caption"} <= set(names)
    assert "script" not in names
    assert dict(page.tags)["html"]["lang"] == "en"
    for tag, own in page.tags:
        for name in ("src", "href"):
            if name in own:
                if own[name] != "explore.html":  # the interactive page beside it
                    assert own[name].startswith(("data:", "#")), own[name][:80]
        if tag == "img":
            assert len(own["alt"]) > 30
            assert own["src"].startswith("data:image/svg+xml;base64,")
    links = {own["href"] for tag, own in page.tags if tag == "a"}
    anchors = {link[1:] for link in links - {"explore.html"}}
    assert anchors < {own.get("id") for _, own in page.tags}
    assert "url(" not in text
    assert "@import" not in text


@pytest.mark.usefixtures("blank_figures")
def test_the_interactive_page_is_a_file_beside_it(result, tmp_path):
    text = write(result, tmp_path)
    assert '<a href="explore.html">' in text
    assert (tmp_path / "explore.html").stat().st_size < 5e6
    write_report(tmp_path / "north.html", result)
    assert '<a href="north-explore.html">' in (tmp_path / "north.html").read_text()
    assert (tmp_path / "north-explore.html").exists()


def test_figures_have_text_as_outlines_and_need_no_other_file(page):
    drawn = [own for tag, own in page.tags if tag == "img"]
    assert len(drawn) == 10
    for own in drawn:
        svg = base64.b64decode(own["src"].partition(",")[2]).decode()
        assert "<text" not in svg  # needs no font
        assert "http-equiv" not in svg
        assert not re.search(r'href="(?!#|data:)', svg)


def test_the_tables_numbers_are_the_result_s(page, result):
    bounds, parameters, history, settings = page.tables
    plan = result.plan
    assert [row[1] for row in bounds[1:]] == [f"{r},{c}" for r, c in result.path[1:]]
    shown = re.fullmatch(r"(\S+) \((\S+) to (\S+)\)", bounds[1][2]).groups()
    expected = plan.trust[0, 0], plan.bands[0, 0, 0], plan.bands[-1, 0, 0]
    np.testing.assert_allclose([read(s) for s in shown], expected, atol=0.006)
    assert parameters[0] == ["parameter", "mean", "sd", "5 %", "95 %"]
    draws = result.posterior["posterior"]["beta"].sel(feature="visibility").values
    (row,) = [row for row in parameters if row[0] == "beta[visibility]"]
    truth = draws.mean(), draws.std(), *np.quantile(draws, (0.05, 0.95))
    np.testing.assert_allclose([read(s) for s in row[1:]], truth, atol=0.06 * draws.std())
    assert [row[0] for row in history[1:]] == ["1", "2"]
    assert [row[1] for row in history[1:]] == ["ok", "ok"]
    k_hat = [read(row[history[0].index("k-hat")]) for row in history[1:]]
    np.testing.assert_allclose(k_hat, result.history["k_hat"], atol=0.006)
    assert ["seed", "1"] in settings
    assert ["start", "2, 0"] in settings
    assert ["trustbo version", result.settings["trustbo_version"]] in settings


def test_the_summary_says_what_is_recommended_and_how_sure_that_is(page, result):
    facts = {fact.name: fact for fact in facts_of(result)}
    said = " ".join("".join(page.text).split())
    for fact in facts.values():
        assert fact.text in said
    assert "2 missions on 3 × 3 cells, 90 m × 90 m" in facts["The campaign"].text  # noqa: RUF001
    assert facts["Recommended"].text.endswith(" → ".join(f"{r},{c}" for r, c in result.path) + ".")
    assert facts["Value"].text.startswith(number(result.value))
    assert facts["Value"].good
    assert facts["Posteriors"].good
    assert "k-hat" in facts["Posteriors"].text


def test_the_value_has_its_band_over_draws(result):
    low, high = result.plan.value_band
    assert f"({number(low)} to {number(high)} in 90 % of the draws)" in facts_of(result)[2].text


def test_memory_that_cannot_be_weighed_says_why(hostile):
    facts = {fact.name: fact for fact in facts_of(hostile)}
    assert re.match(r"Not weighed: .*PooledTrust.*got CoupledTrust", facts["Memory"].text)


@pytest.mark.parametrize(
    ("rhat", "ess", "divergences", "good"),
    [
        (1.004, 900.0, 0, True),
        (1.02, 900.0, 0, False),
        (1.0, 90.0, 0, False),
        (1.0, 900.0, 3, False),
    ],
)
def test_doubtful_posteriors_are_called_so(rhat, ess, divergences, good, result):
    n = result.history.sizes["iteration"]
    columns = {"r_hat": rhat, "ess_bulk": ess, "divergences": divergences}
    history = result.history.drop_vars(["k_hat", "kish"]).assign(
        {name: ("iteration", np.full(n, value)) for name, value in columns.items()}
    )
    (fact,) = [
        fact
        for fact in facts_of(dataclasses.replace(result, history=history))
        if fact.name == "Posteriors"
    ]
    assert fact.good is good
    assert fact.text.startswith("They are well sampled" if good else "Do not rely on them")


def test_missions_that_failed_and_tolls_on_length_are_said(result):
    history = result.history.assign(status=("iteration", ["ok", "lost_contact"]))
    settings = {**result.settings, "length_weight": 0.1}
    facts = facts_of(dataclasses.replace(result, history=history, settings=settings))
    assert facts[0].text.endswith("1 of them did not reach the goal (lost contact).")
    assert "less the toll on its length" in facts[2].text


def test_reasons_to_end_are_sentences(result):
    for reason, sentence in (
        ("n_iterations", "All missions asked for were run."),
        ("interrupted", "It was interrupted, or is still under way: trustbo resume goes on."),
        ("regret_bound: P(regret <= 0.05) = 1", "The recommended path is good enough: P(regret"),
        ("seconds: 60", "The time was up, in seconds: 60."),
        ("mine", "A rule to stop said: mine."),
    ):
        end = facts_of(dataclasses.replace(result, stop_reason=reason))[-1]
        assert end.text.startswith(sentence)


@pytest.mark.parametrize("simulator", [None, "ModelSimulator"])
def test_what_the_program_cannot_resume_goes_on_in_python(simulator, result):
    settings = {**result.settings, "simulator": simulator}
    if simulator is None:  # as of a campaign that was asked and told
        del settings["simulator"]
    under_way = dataclasses.replace(result, settings=settings, stop_reason="interrupted")
    end = facts_of(under_way)[-1]
    assert end.text == "It is under way, or was interrupted: Campaign.load(folder) goes on."


@pytest.mark.usefixtures("blank_figures")
def test_names_cannot_break_the_page_and_a_result_needs_no_terrain(hostile, tmp_path):
    text = write(hostile, tmp_path, title="<script>alert(1)</script>")
    page = Page(text)
    assert "script" not in [tag for tag, _ in page.tags]
    assert "<b>r&1" not in text
    assert page.tables[0][0] == ["bound", "cell", "<b>r&1", 'r"2']
    assert "Terrain" not in page.text
    assert "beta0[<b>r&1]" in [row[0] for row in page.tables[1]]


def test_the_coupled_model_s_parameters_are_listed_with_their_diagnostics(result):
    rng = np.random.default_rng(0)
    sites = {
        name: (("chain", "draw", *axes), rng.normal(size=(4, 100, *(2 for _ in axes))))
        for name, axes in CoupledParams.AXES.items()
    }
    robots = {"robot": ["r1", "r2"], "feature": ["traversability", "visibility"]}
    posterior = xr.DataTree.from_dict({"posterior": xr.Dataset(sites, robots)})
    posterior.attrs["sampler"] = "nuts"
    table = parameter_table(dataclasses.replace(result, posteriors=[posterior]))
    assert table.head[-2:] == ["bulk ESS", "R-hat"]
    assert len(table.rows) == 8 + 4 + 2 + 4 + 4
    b = next(row for row in table.rows if row[0] == "b[r2]")
    np.testing.assert_allclose(read(b[1]), sites["b"][1][..., 1].mean(), atol=0.06)
    assert 0.98 < read(b[-1]) < 1.05
    assert 100 < read(b[-2]) < 800


@pytest.mark.slow  # every figure is drawn again
def test_the_same_result_gives_the_same_bytes(result, text, tmp_path):
    result.save(tmp_path / "kept")
    assert write(tb.load_result(tmp_path / "kept"), tmp_path) == text


def test_a_result_without_missions_is_refused(result, tmp_path):
    with pytest.raises(tb.TrustboError, match="the result has no mission; run one first"):
        write(dataclasses.replace(result, missions=[]), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_page_that_cannot_be_written_is_refused_before_it_is_drawn(result, tmp_path):
    (tmp_path / "file").touch()
    broken = dataclasses.replace(result, posteriors=[])  # of which nothing could be drawn
    for path, message in (
        (tmp_path, r"cannot write '.*': it is a folder; name a file in it"),
        (tmp_path / "file" / "report.html", r"cannot write to '.*file': .*file' is a file"),
    ):
        with pytest.raises(tb.TrustboError, match=message):
            write_report(path, broken)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_numbers_have_the_digits_they_are_sure_of():
    shown = [number(x) for x in (0.12345, 1.2345, 12.345, 1234.5, 0.0, 2e-5, -0.5, np.nan, np.inf)]
    assert shown == ["0.123", "1.23", "12.3", "1234", "0.000", "2.0e−05", "−0.500", "–", "∞"]  # noqa: RUF001
    assert number(-0.0001, 2) == "0.00"
    assert [decimals_for(sd) for sd in (0.012, 0.12, 1.2, 120.0, 0.0, np.nan)] == [3, 2, 1, 0, 3, 3]


def read(text):
    return float(text.replace("\N{MINUS SIGN}", "-"))


def test_evidence_of_the_exact_sampler_is_k_hat_on_card_and_page(result, page):
    khat, kish = (float(result.history[name][-1]) for name in ("k_hat", "kish"))
    assert f"exact: k-hat {khat:.2f} (good below 0.5), Kish size {kish:.0f}" in repr(result)
    caption = parameter_table(result).caption
    assert f"k-hat {khat:.2f} and Kish size {kish:.0f}: the evidence" in caption
    assert "these are the evidence, as R-hat and ESS" in " ".join(page.text)
