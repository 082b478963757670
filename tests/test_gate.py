"""The checks of tracked files and the gate fail on planted faults, and pass a clean repository."""

import re
import subprocess

import check_files
import compare_notebooks
import gate
import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

TABLE = "\n| method | loss |\n|---|---:|\n| default | 0.5 |\n"
CODE = '"""Module."""\n\nLOSS = 0.5\n'
HOME = "/".join(["", "home", "me", "maps"])  # in parts, as this file is checked, too
REGISTRY = "-".join(["pip install --index", "url"])


@pytest.fixture
def repository(tmp_path):
    """A repository with a notebook, a table on a page, the code of both, and a manifest."""
    git(tmp_path, "init", "-q")
    write(tmp_path, "README.md", f"# Project\n\n## Results\n{TABLE}")
    write(tmp_path, "src/model.py", CODE)
    write_notebook(tmp_path, "notebooks/small.ipynb", small())
    commit(tmp_path)
    of_code = git(tmp_path, "rev-parse", "HEAD").strip()
    write(tmp_path, gate.MANIFEST, manifest(of_code))
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


def manifest(commit):
    return f"""
        [code]
        models = ["src"]

        [results]
        shows = ["README.md#results", "notebooks/small.ipynb"]
        run = "python src/model.py"
        commit = "{commit}"
        code = ["models"]
    """.replace("        ", "")


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


@pytest.mark.parametrize("commit", ["unknown", "0123abcd"])
def test_results_of_an_unknown_commit_are_listed(repository, commit):
    write(repository, gate.MANIFEST, manifest(commit))
    [fault] = gate.faults(repository)
    assert fault.startswith("results: ")


def test_an_entry_whose_table_is_gone_is_listed(repository):
    write(repository, "README.md", "# Project\n")
    [fault] = gate.faults(repository)
    assert fault.startswith("results: README.md#results ")


def test_a_misspelt_path_of_code_is_listed(repository):
    text = (repository / gate.MANIFEST).read_text()
    write(repository, gate.MANIFEST, text.replace('["models"]', '["models", "scr"]'))
    [fault] = gate.faults(repository)
    assert fault.startswith("results: ")


@pytest.mark.parametrize("has_commit", [False, True])
def test_a_table_is_stale_if_its_code_has_changed(repository, has_commit):
    write(repository, "src/model.py", CODE.replace("0.5", "0.6"))
    if has_commit:
        commit(repository)
    [fault] = gate.faults(repository)
    assert fault.startswith("results: ")
    assert "src/model.py" in fault


@pytest.mark.parametrize("name", ["src/new.py", "src/table.csv"])
def test_a_table_is_stale_if_a_file_is_added_to_its_code(repository, name):
    write(repository, name, "1\n")
    commit(repository)
    [fault] = gate.faults(repository)
    assert name in fault


def test_changed_comments_and_docstrings_do_not_make_a_table_stale(repository):
    write(repository, "src/model.py", '"""Loss."""\n\n# In bounds.\nLOSS = (\n    0.5\n)\n')
    commit(repository)
    assert list(gate.faults(repository)) == []


def test_a_stamp_records_the_present_commit(repository):
    write(repository, "src/model.py", CODE.replace("0.5", "0.6"))
    with pytest.raises(SystemExit, match="results"):  # which no commit contains
        gate.stamp(repository, "results")

    commit(repository)
    gate.stamp(repository, "results")
    assert list(gate.faults(repository)) == []


def test_a_part_that_was_run_again_is_recorded_beside_the_commit(repository):
    of_results = gate.read_manifest(repository)[0].commit
    write(repository, "src/model.py", CODE.replace("0.5", "5e-1 + 0.0"))
    commit(repository)
    assert "code has changed" in "".join(gate.faults(repository))

    part = 'python src/model.py --method "small"'
    gate.stamp(repository, "results", part)
    (entry,) = gate.read_manifest(repository)
    assert (entry.commit, entry.part) == (of_results, part)
    assert git(repository, "rev-parse", "HEAD").startswith(entry.same)
    assert not [*gate.faults(repository)]

    gate.stamp(repository, "results")
    (entry,) = gate.read_manifest(repository)
    assert (entry.same, entry.part) == ("", "")
    assert not [*gate.faults(repository)]


def test_a_stamp_of_an_unknown_name_is_refused(repository):
    with pytest.raises(SystemExit, match="tables"):
        gate.stamp(repository, "tables")


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


def test_claims_of_the_readme_name_the_commits_of_their_entries():
    page = (gate.ROOT / "docs" / "benchmarks.md").read_text()
    claims = page.partition("## Claims of README\n")[2]
    named = re.findall(r"\| `([\w-]+)`, ([0-9a-f]{8}) \|\n", claims)
    commits = {entry.name: entry.commit for entry in gate.read_manifest(gate.ROOT)}
    assert len(named) > 5
    assert named == [(name, commits[name]) for name, _ in named]
