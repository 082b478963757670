"""Records changed at random: a folder opens, or one line names what is wrong."""

import copy
import json
import shutil
import warnings

import numpy as np
import pytest
from typer.testing import CliRunner

import trustbo as tb
from trustbo.cli import app

ENDS = ((1, 0), (0, 1))
VALUES = (
    None, True, -1, 0, 3, 10**400, -(10**25), 0.5, float("nan"), float("inf"), "", "x", "0" * 5000,
    [], [[]], [None], ["a", 1], [[1, 2], [3]], {}, {"a": 1}, {"": None}, [[[[1]]]], [10**9] * 3,
)  # fmt: skip


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Folder of a campaign that `trustbo resume` can go on with."""
    folder = tmp_path_factory.mktemp("kept") / "campaign"
    terrain = tb.terrain.synthetic_terrain((60.0, 60.0), resolution=2.0, seed=1, relief=5.0)
    workspace = tb.Workspace.from_terrain(terrain, (2, 2), tb.Team(2))
    with tb.Campaign(workspace, *ENDS, sampler="exact", directory=folder) as campaign:
        for _ in campaign.run(n_iterations=1):
            pass
        campaign.fail("stuck", where=campaign.ask().path[-1])
        campaign.ask()
    return folder


def places(value, at=()):
    """Every place within a record."""
    yield at
    inside = value.items() if isinstance(value, dict) else ()
    for name, part in enumerate(value) if isinstance(value, list) else inside:
        yield from places(part, (*at, name))


def edited(record, rng):
    """Text of the record after one random change."""
    record, kind = copy.deepcopy(record), rng.integers(8)
    text = json.dumps(record)
    if kind == 0:
        return text[: rng.integers(len(text))]
    if kind == 1:
        cut = rng.integers(len(text))
        return text[:cut] + str(rng.choice(["[", "}", '"', "\x00", "é", "1e999"])) + text[cut + 1 :]
    chosen = list(places(record))[1:]
    *way, last = chosen[rng.integers(len(chosen))]
    holder = record
    for name in way:
        holder = holder[name]
    if kind == 2:
        del holder[last]
    elif kind == 3:
        deep = holder[last]
        for _ in range(int(rng.choice([1, 2, 900]))):
            deep = [deep]
        holder[last] = deep
    elif kind == 4 and isinstance(holder, list):
        holder.append(holder[0])
    elif kind == 5 and isinstance(holder, dict):
        holder[f"{last}_2"] = holder.pop(last)
    else:
        holder[last] = VALUES[rng.integers(len(VALUES))]
    return json.dumps(record)


def look(folder, n_commands):
    """Open a folder in every way; a TrustboError each time is as good as what was asked for."""
    errors = []

    def load():
        result = tb.load_result(folder)
        assert repr(result)
        assert result.plan.path

    def go_on():
        with tb.Campaign.load(folder) as campaign:
            assert len(campaign.missions) == 1
            assert repr(campaign.table())
            assert campaign.ask().path

    def resume():
        assert tb.resume(folder, n_iterations=1, progress=False).missions

    for opens in (load, go_on, resume):
        try:
            opens()
        except tb.TrustboError as error:
            errors.append(error)
    for command in (["export", str(folder), "--format", "csv"], ["resume", str(folder), "--quiet",
                    "--iterations", "1"])[:n_commands]:  # fmt: skip
        done = CliRunner().invoke(app, command)
        assert done.exit_code in (0, 1, 2, 3), done.exception
        assert isinstance(done.exception, SystemExit | None), done.exception
    return errors


def fuzz(kept, tmp_path, seeds, n_commands):
    """Number of edits that were noticed."""
    refused = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        folder = tmp_path / str(seed)
        shutil.copytree(kept, folder)
        name = ("campaign.json", "result.json")[seed % 2]
        (folder / name).write_text(edited(json.loads((kept / name).read_text()), rng))
        (folder / f".{name}.sha256").unlink()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                refused += bool(look(folder, n_commands))
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise
        shutil.rmtree(folder)
    return refused


def test_every_edit_of_a_record_is_taken_or_refused_in_a_line(kept, tmp_path):
    assert fuzz(kept, tmp_path, range(4), 0) > 1


@pytest.mark.slow  # minutes
def test_every_one_of_many_edits_is_taken_or_refused_in_a_line(
    kept, tmp_path, leave_figures_blank, monkeypatch
):
    leave_figures_blank(monkeypatch)
    assert fuzz(kept, tmp_path, range(4, 340), 2) > 100
