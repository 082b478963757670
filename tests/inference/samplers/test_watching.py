"""Progress of NUTS: what is said of a long run, and that a short one is quiet."""

import numpy as np
import pytest

from trustbo.inference.samplers import watching
from trustbo.inference.samplers.settings import NutsSettings
from trustbo.inference.samplers.watching import Watch, about

SETTINGS = NutsSettings(300, 1000, 4)  # 5200 draws


def run(watch, seconds):
    """Show a trial of draws of 8 leapfrog steps, of so many seconds, after dearer ones."""
    with watch.running(SETTINGS) as seen:
        seen.compiled()
        for n_steps in (500, 8, 8, 8, 8, 8):
            seen.advanced(seconds / 8 * 10 * 4 * n_steps, stats_of(10, n_steps))


def stats_of(n, n_steps=8, n_divergences=1):
    diverging = np.zeros((4, n), dtype=bool)
    diverging[0, :n_divergences] = True
    return {"n_steps": np.full((4, n), n_steps), "diverging": diverging}


@pytest.mark.parametrize(("show", "said"), [(True, 1), (False, 0)])
def test_a_long_run_is_announced_once_with_what_is_faster(show, said, capsys):
    run(Watch(show, 'sampler "exact" takes seconds'), 0.05)
    expected = 'NUTS: 4 chains of 300 + 1000 draws, about 4 min. Faster: sampler "exact" takes'
    assert capsys.readouterr().err.count(expected) == said


def test_a_short_run_is_not_announced_nor_one_whose_time_is_known(capsys):
    run(Watch(True), 0.0015)
    run(Watch(True, estimates=False), 1.0)
    assert "NUTS: " not in capsys.readouterr().err


def test_the_bar_names_the_chains_the_phase_and_divergences_after_the_warm_up(capsys):
    with Watch(True).running(SETTINGS) as seen:
        for _ in range(5):
            seen.advanced(0.2, stats_of(130, n_divergences=3))
            seen._bar.refresh()
    shown = capsys.readouterr().err
    assert "NUTS, compiling, some 10 s:   0%" in shown
    assert "NUTS, 4 chains, warm-up:  10%" in shown
    assert "NUTS, 4 chains, draws:  50%" in shown
    assert "8 steps a draw, 6 divergences" in shown


def test_divergences_of_a_piece_across_the_end_of_the_warm_up_are_counted_by_draw(capsys):
    with Watch(True).running(SETTINGS) as seen:
        seen.advanced(0.2, stats_of(290, n_divergences=290))
        seen.advanced(0.2, stats_of(20, n_divergences=20))
        seen._bar.refresh()
    assert ", 10 divergences" in capsys.readouterr().err


def test_a_second_run_says_that_it_is_one_and_why(capsys):
    watch = Watch(True)
    run(watch, 0.0)
    watch.retry(SETTINGS.longer, ["R-hat of b is 1.050 (limit 1.01)", "2 others"])
    assert capsys.readouterr().err.endswith(
        "NUTS again, for longer (4 chains of 600 + 2000 draws, target_accept 0.98): R-hat of b is "
        "1.050 (limit 1.01) and 1 more.\n"
    )
    run(watch, 0.1)
    assert "NUTS, second run: 4 chains of 300 + 1000 draws, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(12, "about 10 s"), (94, "about 90 s"), (141, "about 2 min"), (9000, "about 2 h")],
)
def test_rough_times_are_round(seconds, text):
    assert about(seconds) == text


def test_a_slow_stage_is_shown_at_once_and_others_from_the_first_second_on(monkeypatch, capsys):
    with Watch(True) as watch:
        watch.stage("seeks the mode")
        assert "NUTS: " not in capsys.readouterr().err
        watch.stage("compiles", slow=True)
        watch.stage("weighs points")
    shown = capsys.readouterr().err
    assert shown.index("fit, after 0 s: compiles") < shown.index("fit, after 0 s: weighs points")
    assert shown.endswith("\r")  # gone
    monkeypatch.setattr(watching, "_QUICK", -1.0)
    with Watch(True) as watch:
        watch.stage("seeks the mode")
    assert "seeks the mode" in capsys.readouterr().err
