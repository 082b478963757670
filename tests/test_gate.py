"""The checks of tracked files and the gate fail on planted faults, and pass a clean repository."""

import subprocess
from pathlib import Path

import check_files
import closure
import compare_notebooks
import gate
import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

TABLE = "\n| method | loss |\n|---|---:|\n| default | 0.5 |\n"
CODE = '''"""Module."""

import sys

LOSS = 0.5


class Model:
    """Model."""

    scale = 1.0

    def loss(self):
        return LOSS * self.scale

    def unused(self):
        return 0.0


if __name__ == "__main__":
    print(Model().loss())
'''
MANIFEST = """
[results]
shows = ["README.md#results", "notebooks/small.ipynb"]
run = "python src/model.py"
commit = "unknown"
"""
HOME = "/".join(["", "home", "me", "maps"])  # in parts, as this file is checked, too
REGISTRY = "-".join(["pip install --index", "url"])


@pytest.fixture
def repository(tmp_path):
    """A repository with a notebook, a table on a page, the code of both, and a manifest."""
    git(tmp_path, "init", "-q")
    write(tmp_path, "README.md", f"# Project\n\n## Results\n{TABLE}")
    write(tmp_path, "src/model.py", CODE)
    traced = Path(closure.__file__).parent / "traced" / "sitecustomize.py"
    write(tmp_path, "scripts/traced/sitecustomize.py", traced.read_text())
    write_notebook(tmp_path, "notebooks/small.ipynb", small())
    write(tmp_path, gate.MANIFEST, MANIFEST)
    write(tmp_path, ".gitignore", "__pycache__/\n")
    commit(tmp_path)
    gate.record(tmp_path, "results")
    commit(tmp_path)
    return tmp_path


def git(root, *command):
    author = ("-c", "user.name=me", "-c", "user.email=me@example.org")
    command = ["git", "-C", str(root), *author, *command]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def write(root, name, text):
    (root / name).parent.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(text)


def write_notebook(root, name, notebook):
    write(root, name, nbformat.writes(notebook))


def commit(root):
    git(root, "add", "--all")
    git(root, "commit", "-q", "-m", "Change files")


def small(printed="0.75", text="The share is 75 %, or 0.8."):
    """A notebook that prints 0.75."""
    output = new_output("stream", name="stdout", text=f"{printed}\n")
    cell = new_code_cell("print(3 / 4)", outputs=[output], execution_count=1)
    return new_notebook(cells=[new_markdown_cell(text), cell])


def test_a_clean_repository_passes(repository):
    assert list(check_files.faults(repository)) == []
    assert list(gate.faults(repository)) == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("campaign.json", "{}"),
        ("own/missions.csv", "mission,bound\n"),
        ("docs/maps.nc", "maps"),
        ("docs/long.md", 101_000 * "x"),
        ("docs/log.md", f"Results are in {HOME}."),
        ("examples/run.py", f'FOLDER = "{HOME}"\n'),
        ("docs/install.md", f"{REGISTRY} https://example.org"),
    ],
)
def test_a_file_that_does_not_belong_into_the_repository_is_listed(repository, name, text):
    write(repository, name, text)
    git(repository, "add", "--all")
    [fault] = check_files.faults(repository)
    assert fault.startswith(f"{name}: ")


def stored_with_an_error():
    notebook = small()
    error = new_output("error", ename="ValueError", evalue="no path", traceback=[])
    notebook.cells[1].outputs.append(error)
    return notebook


def run_out_of_order():
    notebook = small()
    notebook.cells.append(new_code_cell("x = 1", execution_count=1))
    notebook.cells[1].execution_count = 2
    return notebook


def not_run():
    notebook = small()
    notebook.cells.append(new_code_cell("x = 1"))
    return notebook


def run_at_home():
    return small(printed=f"results are in {HOME}")


@pytest.mark.parametrize("make", [stored_with_an_error, run_out_of_order, not_run, run_at_home])
def test_a_notebook_that_is_not_one_clean_run_is_listed(repository, make):
    write_notebook(repository, "notebooks/small.ipynb", make())
    [fault] = check_files.faults(repository)
    assert fault.startswith("notebooks/small.ipynb: ")


def test_a_table_without_a_commit_is_listed(repository):
    write(repository, "docs/worlds.md", f"# Worlds\n\n```sh\n# comment\n```\n{TABLE}")
    git(repository, "add", "--all")
    [fault] = gate.faults(repository)
    assert fault.startswith("docs/worlds.md#worlds: method: ")


@pytest.mark.parametrize("name", ["docs/figures/map.png", "benchmarks/reference/worlds.csv"])
def test_a_figure_or_stored_results_without_a_commit_are_listed(repository, name):
    write(repository, name, "0.5\n")
    git(repository, "add", "--all")
    [fault] = gate.faults(repository)
    assert fault.startswith(f"{name}: ")


def test_pages_that_are_written_from_stored_rows_need_no_entry(repository):
    write(repository, "docs/evidence/contact.md", f"# Contact\n{TABLE}")
    git(repository, "add", "--all")
    assert list(gate.faults(repository)) == []


def test_an_entry_may_stand_for_all_files_of_a_kind(repository):
    for name in ("one", "two"):
        write(repository, f"benchmarks/reference/contact/{name}.csv", "0.5\n")
    text = (repository / gate.MANIFEST).read_text()
    more = 'shows = ["benchmarks/reference/contact/*.csv", "README.md#results"'
    write(repository, gate.MANIFEST, text.replace('shows = ["README.md#results"', more))
    git(repository, "add", "--all")
    assert list(gate.faults(repository)) == []


def test_titles_with_brackets_name_their_tables():
    """Brackets have a meaning in patterns of files."""
    result = "README.md#results: difference [95 %]"
    assert gate.covers(result, result)
    assert not gate.covers(result, "README.md#results: difference 9")


def test_results_whose_code_was_never_recorded_are_listed(repository):
    write(repository, gate.MANIFEST, MANIFEST)
    [fault] = gate.faults(repository)
    assert fault.startswith("results: nobody has recorded")


def test_an_entry_whose_table_is_gone_is_listed(repository):
    write(repository, "README.md", "# Project\n")
    [fault] = gate.faults(repository)
    assert fault.startswith("results: README.md#results ")


@pytest.mark.parametrize("has_commit", [False, True])
@pytest.mark.parametrize(
    ("before", "after", "what"),
    [
        ("LOSS = 0.5", "LOSS = 0.6", "src/model.py"),
        ("scale = 1.0", "scale = 2.0", "src/model.py"),
        ("LOSS * self.scale", "LOSS", "src/model.py Model.loss"),
    ],
)
def test_a_table_is_stale_if_code_that_ran_has_changed(repository, before, after, what, has_commit):
    write(repository, "src/model.py", CODE.replace(before, after))
    if has_commit:
        commit(repository)
    [fault] = gate.faults(repository)
    assert fault.startswith("results: code has changed since ")
    assert f": {what}\n" in fault


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('"""Module."""', '"""Loss."""'),
        ('    """Model."""\n\n', "    # Model.\n"),
        ("LOSS = 0.5", "# In bounds.\nLOSS = (\n    0.5\n)"),
        ("return 0.0", "return 1.0"),
        ("import sys", "import os\nimport sys"),
    ],
)
def test_texts_imports_and_functions_that_did_not_run_make_no_table_stale(
    repository, before, after
):
    assert before in CODE
    write(repository, "src/model.py", CODE.replace(before, after))
    write(repository, "src/other.py", "LOSS = 1\n")
    assert list(gate.faults(repository)) == []


def test_compiled_functions_count_if_their_module_is_imported():
    text = "@kernel()\ndef loop(x):\n    return x\n"
    assert "loop" not in closure.functions_of(text)
    assert closure.functions_of(text) != closure.functions_of(text.replace("x\n", "-x\n"))


def test_code_is_recorded_only_after_a_commit_and_a_command_that_succeeds(repository):
    write(repository, "src/model.py", CODE.replace("0.5", "0.6"))
    with pytest.raises(SystemExit, match="results"):  # no commit contains it
        gate.record(repository, "results")
    commit(repository)
    with pytest.raises(SystemExit, match="failed"):
        gate.record(repository, "results", "python src/model.py && exit 3")
    gate.record(repository, "results")
    assert list(gate.faults(repository)) == []


def test_entries_are_recorded_one_after_another_and_keep_comments(repository):
    """The results of the first are not committed when the second is computed."""
    more = '[more]\nshows = ["README.md#results"]\nrun = "python src/model.py"\n'
    write(repository, gate.MANIFEST, f"{MANIFEST}\n# More\n\n{more}")
    commit(repository)
    gate.record(repository, "results")
    gate.record(repository, "more")
    assert list(gate.faults(repository)) == []
    above, _, below = (repository / gate.MANIFEST).read_text().partition("\n\n# More\n\n")
    assert above.count("digest") == below.count("digest") == 1


def test_a_part_that_was_run_again_is_recorded_beside_the_code(repository):
    write(repository, "src/model.py", CODE.replace("0.5", "5e-1 + 0.0"))
    commit(repository)
    assert "code has changed" in "".join(gate.faults(repository))

    part = 'python -c "import model"'
    write(repository, "pyproject.toml", "")
    gate.record(repository, "results", f"cd src && {part}")
    (entry,) = gate.read_manifest(repository)
    assert entry.part == f"cd src && {part}"
    assert git(repository, "rev-parse", "HEAD").startswith(entry.commit)
    assert not [*gate.faults(repository)]
    assert "Model.loss" in gate.file_of(repository, "results").read_text()  # which it did not call

    commit(repository)
    gate.record(repository, "results")
    (entry,) = gate.read_manifest(repository)
    assert entry.part == ""
    assert not [*gate.faults(repository)]


def test_functions_in_other_processes_are_recorded(repository):
    script = (
        "import subprocess, sys\nsubprocess.run([sys.executable, 'src/model.py'], check=True)\n"
    )
    write(repository, "benchmarks/run.py", script)
    found = closure.run_traced(repository, "python benchmarks/run.py")
    assert found["src/model.py"] >= {"Model.loss"}
    assert "Model.unused" not in found["src/model.py"]


def test_an_unknown_name_is_refused(repository):
    with pytest.raises(SystemExit, match="tables"):
        gate.record(repository, "tables")


def test_a_notebook_is_run_and_what_does_not_agree_is_listed(tmp_path, capsys):
    notebook = small(text="The share is 75 %, or 0.8. The loss is 1.9.")
    stale = new_output("stream", name="stdout", text="1.85\n")
    notebook.cells.append(new_code_cell("print(7 / 4)", outputs=[stale], execution_count=2))
    write_notebook(tmp_path, "small.ipynb", notebook)

    assert compare_notebooks.compare(tmp_path / "small.ipynb", 0.05) == 2
    printed = capsys.readouterr().out
    assert "stored: 1.85" in printed
    assert "number 1.9 " in printed


@pytest.mark.parametrize(
    ("before", "after", "different"),
    [
        ("8  0.18  0.15", "8  0.18  0.19", True),
        ("8  0.180  0.002", "8  0.181  0.004", False),
        ("kish 448", "kish 440", False),
        ("kish 448", "kish 413", True),
        ("(29, 0) (28, 0)", "(29, 0) (28, 1)", True),
        ("3 missions", "3 bounds", True),
        ("0.5", "0.5 0.5", True),
    ],
)
def test_lines_differ_if_a_number_does_by_more_than_rounding(before, after, different):
    assert compare_notebooks.differ(before, after, 0.05) == different


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("0.75 of 3 and 4, -0.75, .8, 75 % and 1", []),
        ("0.74, 0.750001 and .6", ["0.74", "0.750001", ".6"]),
        ("74 % and 75 m", ["74", "75"]),
        ("[page](page-12.md#34), [arXiv 2201.01878](https://arxiv.org/abs/2201.01878)", []),
        ("50 000 draws", ["50000"]),
        ("`beta0`, 3-fold, 12 missions, eight missions", ["12"]),
    ],
)
def test_numbers_of_a_text_that_no_output_shows_are_found(text, found):
    unshown = compare_notebooks.unshown(small(text=text))
    assert [number for number, _ in unshown] == found
