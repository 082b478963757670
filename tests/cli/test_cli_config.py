"""`--config`: a file says what flags would, and flags win."""

import json

import pytest

from trustbo.cli.config import flags_of
from trustbo.cli.program import main
from trustbo.errors import TrustboError


def test_a_file_gives_every_flag_and_flags_win(finished):
    folder, _ = finished
    record = json.loads((folder / "result.json").read_text())
    settings = record["settings"]
    assert (record["n_missions"], settings["seed"]) == (2, 1)
    assert (settings["max_failure"], settings["failure_cost"]) == (0.5, 2.5)
    assert (settings["start"], settings["sampler"]) == ([2, 0], "exact")


def test_what_must_be_a_number_is_one(invoke, rasters):
    ends = ("--dem", rasters / "dem.tif", "--start", "2,0", "--goal", "0,2")
    done = invoke("run", *ends, "--max-failure", "ten")
    assert done.exit_code == 2
    assert "must be a number; got 'ten'" in done.output


KNOWN = ("dem", "dsm", "start", "max_slope", "max_bounds", "crs", "quiet", "policy")


def test_values_are_as_they_would_be_typed(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("dem: maps/a.tif\nstart: [9, 0]\nmax-slope: 30\ncrs: null\nquiet: yes\n")
    assert flags_of(file, KNOWN) == {
        "dem": str(tmp_path / "maps" / "a.tif"),
        "start": "9,0",
        "max_slope": "30",
        "quiet": "True",
    }
    file.write_text("dem: /maps/a.tif\n")
    assert flags_of(file, KNOWN) == {"dem": "/maps/a.tif"}
    file.write_text("")
    assert flags_of(file, KNOWN) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("max-slop: 3", r"a.yaml: unknown flag 'max-slop'; did you mean max-slope"),
        ("zzzz: 3", r"unknown flag 'zzzz'; choose one of dem, dsm, start, max-slope"),
        ("config: b.yaml", r"unknown flag 'config'"),
        ("max-slope: 3\nmax_slope: 4", r"max-slope is given twice; leave one out"),
        ("crs: {row: 1}", r"crs must be a number, a name or a pair .* got {'row': 1}"),
        ("start: [a, 2]", r"start must be a number, a name or a pair .* got \['a', 2\]"),
        ("- dem", r"must hold flags and their values, e.g. seed: 1; got \['dem'\]"),
        ("dem: [", r"is no YAML: while parsing"),
    ],
)
def test_what_no_flag_could_be_is_refused(text, message, tmp_path):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(TrustboError, match=message) as refused:
        flags_of(tmp_path / "a.yaml", KNOWN)
    assert "\n" not in str(refused.value)


def test_the_program_says_so_in_one_line(invoke, tmp_path):
    (tmp_path / "a.yaml").write_text("polcy: greedy")
    for name, message in (
        ("a.yaml", "unknown flag 'polcy'; did you mean policy"),
        ("b", "No such"),
    ):
        done = invoke("demo", "--config", tmp_path / name, "--out", tmp_path / "never")
        assert done.exit_code == 2
        assert done.stderr.startswith("error: ")
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (tmp_path / "never").exists()


def test_a_number_that_is_none_is_refused_with_its_file(tmp_path, capsys):
    file, never = tmp_path / "a.yaml", tmp_path / "never"
    file.write_text("iterations: three")
    for words, message in {
        (): f"error: {file}: iterations must be a whole number; got 'three'.",
        ("--iterations", "four"): "error: --iterations must be a whole number; got 'four'.",
    }.items():
        with pytest.raises(SystemExit) as caught:
            main(["demo", "--config", str(file), *words, "--out", str(never)])
        assert caught.value.code == 2
        assert capsys.readouterr().err.startswith(message)
    assert not never.exists()
