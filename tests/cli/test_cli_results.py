"""`trustbo export`, the help of all commands, and how fast it comes."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
import typer
import yaml

from trustbo.cli import app, main
from trustbo.export import FORMATS
from trustbo.inference.samplers.choice import SAMPLERS
from trustbo.models.families import FAMILIES
from trustbo.planning import OBJECTIVES, POLICIES
from trustbo.study.methods import MODELS
from trustbo.workspace.sight import SIGHT_MODES

COMMANDS = ("demo", "info", "run", "resume", "export", "worlds")


def test_export_writes_what_is_asked_for(invoke, finished, tmp_path):
    folder, _ = finished
    formats = ("--format", "geojson", "--format", "csv", "--format", "geojson")
    done = invoke("export", folder, *formats, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    names = ["path.geojson", "missions.csv"]
    assert done.output.splitlines() == [str(tmp_path / name) for name in names]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)


def test_export_puts_maps_for_ros_into_a_frame(invoke, finished, tmp_path):
    folder, _ = finished
    ask = ("export", folder, "--format", "ros_map", "--out", tmp_path)
    done = invoke(*ask, "--origin", "auto", "--rotation", 90, "--frame", "odom")
    assert done.exit_code == 0, done.output
    assert "frame.yaml" in done.output
    frame = yaml.safe_load((tmp_path / "frame.yaml").read_text())
    assert frame["rotation"] == pytest.approx(np.pi / 2)
    x, y = frame["origin"]
    written = {file: file.read_bytes() for file in tmp_path.iterdir()}
    for file in written:
        file.unlink()
    done = invoke(*ask, "--origin", f"{x},{y}", "--rotation", 90, "--frame", "odom")
    assert done.exit_code == 0, done.output
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == written
    done = invoke(*ask, "--origin", "there")
    assert done.exit_code == 2
    assert "got 'there'" in done.output


def test_export_writes_all_there_is_and_says_what_there_is_not(invoke, finished, tmp_path):
    folder, _ = finished
    ask = ("export", folder, "--format", "all", "--resolution", 10, "--out", tmp_path)
    done = invoke(*ask)
    assert done.exit_code == 0, done.output
    assert "left out" not in done.stderr
    assert len(done.stdout.splitlines()) > len(FORMATS)
    (tmp_path / "missions.csv").unlink()
    (tmp_path / "missions.csv").mkdir()
    again = invoke(*ask)
    assert again.exit_code == 0, again.output
    assert "left out csv: cannot write" in again.stderr
    strict = invoke(*ask, "--format", "csv")
    assert strict.exit_code == 2
    assert strict.stderr.startswith("error: ")
    assert strict.stdout == ""


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            ("geojson", "--resolution", 5),
            "--resolution 5 is of files for robots; leave it out, or ask for",
        ),
        (("ros_map", "--resolution", 0), "resolution must be positive and finite; got 0.0"),
    ],
)
def test_a_resolution_that_cannot_be_is_refused(ask, message, invoke, finished, tmp_path):
    done = invoke("export", finished[0], "--out", tmp_path / "never", "--format", *ask)
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "never").exists()


def test_an_unknown_format_lists_the_choices(invoke, finished, tmp_path):
    folder, _ = finished
    done = invoke("export", folder, "--format", "dwg", "--out", tmp_path / "never")
    assert done.exit_code == 2
    assert done.stderr == f"error: unknown format 'dwg'; choose one of {', '.join(FORMATS)}, all.\n"
    assert not (tmp_path / "never").exists()


def test_a_folder_without_a_result_is_refused(invoke, tmp_path):
    done = invoke("export", "--format", "csv", tmp_path)
    assert done.exit_code == 2
    assert "holds no result" in done.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_by_example(command, invoke):
    shown = invoke(command, "--help").output
    assert f"Example: trustbo {command} " in shown
    assert "Exit codes: 0 done;" in shown
    assert "unforeseen" in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


def test_the_program_names_its_commands_and_its_version(invoke):
    shown = invoke("--help").output
    assert all(f" {command} " in shown for command in COMMANDS)
    assert invoke("--version").output.startswith("trustbo 0.")


@pytest.mark.parametrize("command", [(), *((command,) for command in COMMANDS)])
def test_help_gives_flags_without_a_value_no_type(command, invoke):
    shown = invoke(*command, "--help").output
    assert "--help" in shown
    assert "bool" not in shown.lower()


def test_help_of_export_names_every_format(invoke):
    shown = invoke("export", "--help").output
    assert all(re.search(rf"\b{name}\b", shown) for name in FORMATS)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (
            ["run", "--dem", "x.tif"],
            2,
            "error: missing options --start, --goal.\nhint: trustbo run --help ",
        ),
        (["run"], 2, "error: missing options --dem, --start, --goal.\nhint: trustbo run "),
        (["export"], 2, "error: missing arguments FOLDER, --format.\nhint: trustbo export "),
        (["run", "--robots", "two"], 2, "error: --robots must be a whole number; got 'two'.\n"),
        (["run", "--max-slope", "a"], 2, "error: --max-slope must be a number; got 'a'.\n"),
        (
            ["run", "--stop-regret", "5%"],
            2,
            "error: --stop-regret must be a number, such as 0.05; got '5%'.\n",
        ),
        (
            ["resume", "--out", "x"],
            2,
            "error: unknown option --out; give it without a flag: trustbo resume FOLDER\n",
        ),
        (
            ["run", "--itertions", "3"],
            2,
            "error: unknown option --itertions; did you mean --iterations?\nhint: trustbo run ",
        ),
        (["run", "--dme", "x"], 2, "error: unknown option --dme; did you mean --dem?\n"),
        (["run", "--zz"], 2, "error: unknown option --zz.\nhint: trustbo run --help "),
        (["fly"], 2, "error: No such command 'fly'.\nhint: trustbo --help "),
        (["resume", "nowhere"], 2, "error: 'nowhere' holds no campaign;"),
        (["--version"], 0, ""),
        ([], 0, ""),
    ],
)
def test_misuse_is_a_line_and_a_hint(words, code, said, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == code
    error = capsys.readouterr().err
    assert error.startswith(said)
    assert len(error.splitlines()) <= 2


def complete(line, **more):
    """What bash would be given, by the protocol of its completion."""
    words = {
        "_TRUSTBO_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": line.count(" "),
    }
    done = subprocess.run(
        [sys.executable, "-m", "trustbo"],
        env=os.environ | {name: str(value) for name, value in (words | more).items()},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split()


def test_shells_complete_commands_flags_and_names():
    assert complete("trustbo re") == ["resume"]
    assert complete("trustbo run --pol") == ["--policy"]
    assert complete("trustbo run --policy ") == [*POLICIES]
    assert complete("trustbo demo --policy g") == ["greedy"]
    script = complete("", _TRUSTBO_COMPLETE="source_bash")
    assert "_TRUSTBO_COMPLETE=complete_bash" in script


@pytest.mark.parametrize(
    ("option", "names"),
    [
        ("policy", POLICIES), ("objective", OBJECTIVES), ("sampler", SAMPLERS),
        ("model", MODELS), ("observation", [*FAMILIES]),
        ("sight", SIGHT_MODES),
    ],
)  # fmt: skip
def test_the_names_that_shells_complete_are_all_there_are(option, names):
    options = typer.main.get_command(app).commands["run"].params
    (flag,) = [each for each in options if each.name == option]
    context = typer.Context(typer.main.get_command(app).commands["run"])
    assert {item.value for item in flag.shell_complete(context, "")} == set(names)


ENDS = "--dem x.tif --start 1,1 --goal 0,0"


def test_what_the_words_alone_tell_imports_nothing_heavy():
    said = {
        "--help": "",
        "run --zz": "unknown option --zz",
        f"run {ENDS} --policy fly": "unknown policy 'fly'; choose one of greedy, optimistic, ",
        f"run {ENDS} --shape 10": "--shape must be rows and columns, such as 10,12; got '10'",
        f"run {ENDS} --max-slope 90": "--max-slope must be between 0 and 90 degrees; got 90",
        "export nowhere --format csv": "'nowhere' holds no result; give the --out of trustbo run",
    }
    program = (
        "import sys\nfrom trustbo.cli import main\nfor words in sys.argv[1:]:\n"
        "    try: main(words.split())\n    except SystemExit: print('loaded', *sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *said], capture_output=True, text=True, check=True
    )
    assert [text for text in said.values() if text not in done.stderr] == []
    heavy = {"jax", "xarray", "matplotlib", "scipy", "jinja2", "pandas"}
    loaded = [line.split() for line in done.stdout.splitlines() if line.startswith("loaded")]
    assert [heavy.intersection(modules) for modules in loaded] == [set()] * len(said)
