"""The week of eight missions at a shell in examples/week, and its recorded output."""

import importlib.util
import re
from pathlib import Path

import pytest
from commands import call

FOLDER = Path(__file__).parent.parent / "examples" / "week"


def loaded(name):
    """Script of the folder as a module."""
    spec = importlib.util.spec_from_file_location(f"week_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def without_numbers(text):
    """Words of an output; numbers and times differ between processors, and so do ends of lines."""
    untimed = re.sub(r"^\[.* s\]$", "", text, flags=re.MULTILINE)
    return re.findall(r"[A-Za-z_]+", untimed)


def test_the_week_runs_as_recorded(tmp_path, monkeypatch, capsys):
    week, robots = loaded("week"), loaded("robots")
    week.prepare(tmp_path)
    monkeypatch.chdir(tmp_path)

    def run(words):
        capsys.readouterr()
        code = robots.main(words[1:]) if words[0] == week.DRIVES else call(*words[1:])
        return code or 0, capsys.readouterr().out

    lines = []
    for line, output, _ in week.run_week(run):
        is_command = line and not line.startswith("#")
        lines += [f"$ {line}" if is_command else line, output]

    recorded = (FOLDER / "output.txt").read_text(encoding="utf-8")
    recorded, _, _ = recorded.partition("commands, no line of Python")
    assert without_numbers("\n".join(lines)) == without_numbers(recorded)
    for what, difference in week.apart().items():
        assert difference == pytest.approx(0.0, abs=1e-3 if what.startswith("way") else 1e-9), what
