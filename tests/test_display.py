"""What a terminal and a notebook show of an object."""

import io
import sys
import time
from xml.etree import ElementTree

import numpy as np
import numpyro.distributions as dist
import pytest
from numba import njit

import trustbo as tb
from trustbo import display
from trustbo.display import Summary
from trustbo.hazard.given import GivenRisk
from trustbo.models import (
    CoupledTrust,
    HierarchicalTrust,
    HumanTrust,
    PooledTrust,
    Priors,
    TrustParams,
    default_model,
)


class Odd(Summary):
    def _rows(self):
        return [("<script>", "</td>&"), ("long", "x" * 500)]


def test_text_of_the_user_cannot_break_the_page():
    html = Odd()._repr_html_()
    ElementTree.fromstring(f"<div>{html}</div>")
    assert "<script>" not in html


def test_an_object_in_a_notebook_is_a_table_of_its_rows():
    html = ElementTree.fromstring(f"<div>{Odd()._repr_html_()}</div>")
    assert html.findtext("b") == "Odd"
    assert [[cell.text for cell in row] for row in html.iter("tr")] == [
        ["<script>", "</td>&"],
        ["long", "x" * 500],
    ]


def test_lines_are_wrapped_at_the_width_of_a_terminal_and_long_texts_are_cut():
    lines = repr(Odd()).splitlines()
    assert max(map(len, lines)) == 100
    assert len(lines) == 5
    assert lines[-1].endswith("...")


def test_every_object_is_displayed():
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 1), 0.5))
    params = TrustParams(0.5, np.ones(1), 0.0, 0.1, 0.1)
    planner = tb.planning.Planner(workspace, (2, 0), (0, 2))
    simulator = tb.simulation.ModelSimulator(workspace, params)
    mission = simulator.run([(2, 0), (1, 1), (0, 2)], seed=0)
    objects = [
        workspace, workspace.grid, workspace.team, mission,
        planner, planner.plan(params), params, Priors(), PooledTrust(), simulator,
        default_model(), CoupledTrust(Priors.for_cells()), HierarchicalTrust(), HumanTrust(),
        GivenRisk(np.full((8, 3, 3, 9), 0.1)),
    ]  # fmt: skip
    for one in objects:
        assert 1 < len(repr(one).splitlines()) < 20
        ElementTree.fromstring(f"<div>{one._repr_html_()}</div>")


def test_a_campaign_and_what_it_makes_are_displayed_in_a_few_lines():
    workspace = tb.Workspace.from_awareness(np.full((2, 3, 3, 1), 0.5))
    campaign = tb.Campaign(workspace, (2, 0), (0, 2))
    follower = tb.Follower(campaign)
    for one in (campaign, campaign.risk, follower, follower.ahead()):
        text = repr(one)
        assert 1 < len(text.splitlines()) < 20
        assert " at 0x" not in text
        assert max(map(len, text.splitlines())) <= 100

    follower.begin(0.0)
    follower.tick(1.0, [1, 0])
    follower.end(2.0)
    (bound,) = follower.bounds
    assert "contact_rate=[1.000, 0.000]" in repr(bound)
    assert len(repr(bound).splitlines()) == 1


def test_a_model_shows_its_effects_and_the_priors_that_it_uses():
    text = repr(default_model(priors=Priors(tau=dist.HalfNormal(0.7), beta0=dist.Beta(3.0, 5.0))))
    assert "PlaceEffect(tau_s=" in text
    assert "Beta(concentration1=3" in text
    assert "0.7" not in text
    assert "0.7" in repr(HierarchicalTrust(Priors(tau=dist.HalfNormal(0.7))))


def test_kernels_of_this_package_are_announced_once_per_subpackage(capsys):
    display.say_once.cache_clear()  # a new process
    announced = {
        "__main__": 0,
        "trustbo.workspace.sight": 1,
        "trustbo.workspace.routes": 0,
        "trustbo.planning.labels": 1,
    }
    for module, expected in announced.items():
        function = eval("lambda x: x + 1")
        function.__module__ = module
        njit(function)(1)
        assert capsys.readouterr().err.count("kernels") == expected


def test_slow_work_is_announced_once(capsys, monkeypatch):
    monkeypatch.setattr(display, "_PATIENCE", 0.02)
    display.say_once.cache_clear()
    for seconds in (0.0, 0.2, 0.2):
        with display.announced("measuring"):
            time.sleep(seconds)
    assert capsys.readouterr().err == "measuring\n"


def test_a_bar_moves_while_nothing_updates_it(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stderr", stream)
    with display.bar(True, total=2) as shown, display.refreshing(shown):
        time.sleep(1.5)
    assert "00:01<" in stream.getvalue()


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_bar_is_shown_in_a_terminal_but_not_in_a_log(monkeypatch, is_terminal):
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: is_terminal, raising=False)
    monkeypatch.setattr(sys, "stderr", stream)
    with display.bar(True, desc="missions", total=2) as shown, display.bar(False) as hidden:
        shown.update()
        assert hidden.disable
        assert shown.disable is not is_terminal
    assert ("missions" in stream.getvalue()) == is_terminal


def test_a_campaign_without_progress_shows_none_of_what_it_calls(monkeypatch, capsys):
    monkeypatch.setattr(display, "_PATIENCE", 0.0)
    monkeypatch.setattr(display, "shows_bars", lambda: True)
    terrain = tb.terrain.synthetic_terrain((90.0, 90.0), seed=5, relief=6.0)
    workspace = tb.Workspace.from_terrain(terrain, (3, 3), n_posts=1)
    for progress in (False, True):
        display.say_once.cache_clear()
        capsys.readouterr()
        campaign = tb.Campaign(workspace, (2, 0), (0, 2), progress=progress)
        campaign.ask()
        assert ("difficulty of bounds" in capsys.readouterr().err) == progress
        workspace = tb.Workspace.from_terrain(terrain, (3, 3), n_posts=1)
