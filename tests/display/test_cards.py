"""What a cell of a notebook, and a terminal, show of an object."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

import trustbo as tb
from trustbo.display.bars import NOTEBOOK, bar_in
from trustbo.display.card import Card
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    PlaceEffect,
    PooledTrust,
    Priors,
    TrustParams,
)
from trustbo.simulation import KinematicSimulator, ModelSimulator, Truth


@pytest.fixture(scope="module")
def shown():
    """One of each class that is displayed."""
    terrain = tb.terrain.synthetic_terrain((80.0, 60.0), 2.0, seed=0, relief=4.0)
    workspace = tb.Workspace.from_terrain(terrain, (4, 3))
    params = TrustParams(np.full(5, 0.3), np.full((5, 3), 0.1), np.full(5, 0.4), 0.05, 0.05)
    simulator = ModelSimulator(workspace, params.mean())
    campaign = tb.Campaign(workspace, (3, 0), (0, 2), sampler="exact")
    fresh = repr(campaign)
    for _ in campaign.run(simulator, n_iterations=2):
        pass
    result, mission = campaign.result(), campaign.missions[0]
    objects = [
        workspace, workspace.grid, workspace.team, workspace.team.lead, mission, mission.bounds[0],
        result.plan, result.planner, campaign, result, params, params.mean(), Priors(),
        PooledTrust(), HierarchicalTrust(), CoupledTrust(), simulator,
        KinematicSimulator(workspace), Truth.of(simulator),
    ]  # fmt: skip
    assert "0 missions" in fresh
    return {type(one).__name__: one for one in objects}


def test_texts_are_short_and_cards_are_small_and_whole(shown):
    assert len(shown) == 18
    for name, one in shown.items():
        lines = repr(one).splitlines()
        assert len(lines) <= 12, name
        assert max(map(len, lines)) <= 100, name
        html = one._repr_html_()
        assert len(html) < 100_000, name
        ElementTree.fromstring(f"<div>{html}</div>")  # every tag is closed, all text escaped
        assert not re.search(r"array\(|\[\[", html), name  # no array is dumped
        assert re.search(r"color:\s*(#|black|white)", html) is None, name  # the page's colours


def test_numbers_have_their_units(shown):
    assert "20 m x 20 m" in repr(shown["Workspace"])
    assert "slope limit  45 degrees" in repr(shown["Robot"])
    assert "range 100 m, 45 degrees vertically" in repr(shown["Robot"])
    assert re.search(r"contact rate +0\.\d{3} on average; 0 of \d+ missing", repr(shown["Mission"]))


def test_the_model_of_a_campaign_is_a_few_words(shown):
    row = re.search(r"^  model +(.*)$", repr(shown["Campaign"]), re.M)[1]
    assert row == "PooledTrust, places, robots, gaussian"
    assert CoupledTrust(inter_robot="none").in_short() == "CoupledTrust, gaussian, inter_robot none"
    placed = PooledTrust(observation="censored", place=PlaceEffect(bounds=False, shared=False))
    assert placed.in_short() == "PooledTrust, places, censored"
    assert re.search(r"^  places +of cells, by robot$", repr(placed), re.M)
    assert all("PlaceEffect(" not in one._repr_html_() for one in shown.values())


def test_params_show_each_coefficient_with_its_spread():
    draws = TrustParams(np.array([0.1, 0.3]), np.array([[1.0], [2.0]]), np.zeros(2), 0.05, 0.05)
    text = repr(draws)
    assert "2 draws" in text
    assert re.search(r"beta0 +0\.2 \+- 0\.1\n", text)
    assert re.search(r"beta +1\.5 \+- 0\.5\n", text)
    assert "+-" not in repr(draws.mean())


def test_a_mission_without_any_rate_is_shown():
    mission = tb.Mission.from_arrays([(1, 0), (0, 0)], np.zeros((1, 2, 2)), np.full((1, 2), np.nan))
    assert "not measured" in repr(mission)


def test_a_plan_that_was_only_evaluated_says_so():
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 1), 0.5))
    params = TrustParams(0.5, np.ones(1), 0.0, 0.1, 0.1)
    planner = tb.planning.Planner(workspace, (2, 0), (0, 2))
    assert "a policy's choice" in repr(planner.evaluate([(2, 0), (1, 1), (0, 2)], params))


def test_long_cards_say_how_much_is_left_out():
    card = Card("Many", [(f"name {i}", "x" * 200) for i in range(30)])
    lines = card.text().splitlines()
    assert len(lines) == 12
    assert lines[-1].split() == ["...", "20", "more"]
    assert all(len(line) <= 100 for line in lines)


def test_text_of_the_user_cannot_break_the_page():
    card = Card("<b>&", [("<script>", "</td>")])
    ElementTree.fromstring(f"<div>{card.html()}</div>")
    assert "<script>" not in card.html()


# --- the live map of a notebook ---

CELL = """
import numpy as np, trustbo as tb
workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 4, 4, 2)))
params = tb.models.TrustParams(0.3, np.array([0.2, 0.1]), 0.4, 0.05, 0.05)
simulator = tb.simulation.ModelSimulator(workspace, params)
tb.iterate(workspace, (3, 0), (0, 3), n_iterations=2, simulator=simulator, progress={progress})
"""


@pytest.mark.slow  # a kernel of Jupyter
def test_a_notebook_shows_the_campaign_while_it_runs_and_the_result_alone_at_the_end():
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.v4.new_notebook()
    notebook.cells = [nbformat.v4.new_code_cell(CELL.format(progress=p)) for p in ("True", "'bar'")]
    shown = [], []

    class Watching(nbclient.NotebookClient):
        def process_message(self, msg, cell, cell_index):
            if html := msg["content"].get("data", {}).get("text/html"):
                shown[cell_index].append(re.search(r"<b>(\w+: \d+ missions?)</b>", html)[1])
            return super().process_message(msg, cell, cell_index)

    Watching(notebook).execute()
    live, bar = shown
    numbers = ("0 missions", "1 mission", "2 missions")
    assert live == [*(f"Campaign: {n}" for n in numbers), "Result: 2 missions"]
    assert bar == ["Result: 2 missions"]
    for cell in notebook.cells:  # what is left of them
        html = ["".join(o.data.get("text/html", "")) for o in cell.outputs if "data" in o]
        assert sum("tb-card" in each for each in html) == 1


def test_bars_of_text_in_a_notebook_share_a_line(capsys):
    """A cell's output knows no way up: a second line would be printed anew at each refresh."""
    with bar_in(NOTEBOOK, total=3, desc="missions") as outer:
        with bar_in(NOTEBOOK, total=9, desc="draws", leave=False) as inner:
            for _ in range(3):
                inner.update()
                inner.refresh()
        outer.update(3)
        outer.refresh()
        said = capsys.readouterr().out
    assert "draws:  33%" in said
    assert "missions: 100%" in said
    assert "\n" not in said
    assert "\x1b" not in said
