"""A folder keeps what others wrote, and a campaign in it is replaced as a whole or not at all."""

import hashlib
import os
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.campaign import replacing
from trustbo.campaign.replacing import current, own_files
from trustbo.models import TrustParams

ENDS = ((2, 0), (0, 2))
FOREIGN = (
    "notes.txt", "results.csv", ".bashrc.1", ".notes.2024.csv", "posteriors/mine.nc",
    "posteriors/.draft.12.nc", "ticks/readme.7", "sub/.survey.2023.tif", "sub/.git/.x.12",
)  # fmt: skip


@pytest.fixture(scope="module")
def workspace():
    return random_cells(2, 3)


def run(workspace, folder, seed=0, n=2, **options):
    return tb.iterate(
        workspace, *ENDS, n_iterations=n, simulator=ModelSimulator(workspace), checkpoint=folder,
        seed=seed, sampler="exact", policy="random", progress=False, **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def kept(workspace, tmp_path_factory):
    """Folder of a campaign of two missions; tests copy it."""
    folder = tmp_path_factory.mktemp("kept") / "campaign"
    run(workspace, folder)
    return folder


@pytest.fixture
def folder(kept, tmp_path):
    return Path(shutil.copytree(kept, tmp_path / "folder"))


def add_foreign(folder, parent):
    """Files of others in a folder, and links to a file and a folder elsewhere."""
    elsewhere = parent / "elsewhere"
    (elsewhere / "posteriors").mkdir(parents=True, exist_ok=True)
    (elsewhere / ".a.12").write_text("elsewhere")
    (elsewhere / "posteriors" / "0001.nc").write_text("elsewhere")
    for name in FOREIGN:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"mine: {name}")
    (folder / "posteriors" / "linked.nc").symlink_to(elsewhere / ".a.12")
    (folder / ".linked.12").symlink_to(elsewhere / ".a.12")
    (folder / "linked").symlink_to(elsewhere)
    return [elsewhere, *(folder / name for name in (*FOREIGN, "posteriors/linked.nc",
                                                    ".linked.12", "linked"))]  # fmt: skip


def contents(paths):
    """What is at paths, links not followed."""
    found = {}
    for path in paths:
        inside = [path, *path.rglob("*")] if path.is_dir() and not path.is_symlink() else [path]
        for file in inside:
            if file.is_symlink():
                found[file] = os.readlink(file)
            elif not file.is_dir():
                found[file] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


def replacements(workspace):
    """Ways to replace the campaign in a folder."""

    def keep(folder, other):
        with tb.Campaign.load(other) as campaign:
            campaign.save(folder, keep=True)

    def save(folder, other):
        with tb.Campaign.load(other) as campaign:
            campaign.save(folder)

    def begin(folder, other):
        run(tb.load_result(folder).workspace, folder, seed=1, n=1)

    def set_aside(folder, other):
        with tb.Campaign.load(folder) as campaign:
            campaign.set_aside("a test")

    def save_result(folder, other):
        for record in (folder / "campaign.json", folder / ".campaign.json.sha256"):
            record.unlink()  # else it is refused
        tb.load_result(other).save(folder)

    return {f.__name__: f for f in (keep, save, begin, set_aside, save_result)}


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """Folder of a campaign on other awareness, of one mission."""
    folder = tmp_path_factory.mktemp("other") / "campaign"
    awareness = np.random.default_rng(5).uniform(size=(2, 3, 3, 2))
    run(tb.Workspace.from_awareness(awareness), folder, seed=3, n=1)
    return folder


@pytest.mark.parametrize("how", [*replacements(None), "resume", "load"])
def test_files_of_others_are_kept(how, workspace, folder, other, tmp_path):
    before = contents(add_foreign(folder, tmp_path))
    if how == "resume":
        tb.resume(folder, simulator=ModelSimulator(workspace), n_iterations=3, progress=False)
    elif how == "load":
        with tb.Campaign.load(folder):
            pass
    else:
        replacements(workspace)[how](folder, other)
    assert contents(before) == before
    stems = {f.stem for f in (folder / "posteriors").glob("0*.nc")}
    n = {"resume": 3, "load": 2, "set_aside": 2}.get(how, 1)
    assert stems == {f"{j + 1:04d}" for j in range(n)}
    assert not [f.name for f in folder.iterdir() if f.name.startswith((".trustbo-",))]


def test_a_folder_of_other_files_is_used_with_a_warning(workspace, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    before = contents(add_foreign(folder, tmp_path))
    with pytest.warns(UserWarning, match=r"folder' holds other files too .linked, notes.txt, pos"):
        run(workspace, folder, n=1)
    assert contents(before) == before
    with tb.Campaign.load(folder):  # and silently later, as warnings are errors here
        pass


@pytest.mark.parametrize(
    "name", ["history.csv", "result.json", "measured.nc", "posteriors/0001.nc", "ticks/0002.nc"]
)
def test_a_file_of_others_with_our_name_is_not_replaced(name, workspace, kept, tmp_path):
    mine = tmp_path / "folder" / name
    mine.parent.mkdir(parents=True)
    mine.write_text('{"mine": 1}')
    result = tb.load_result(kept)
    for replace in (
        lambda: tb.Campaign(workspace, *ENDS, directory=tmp_path / "folder"),
        lambda: run(workspace, tmp_path / "folder"),
        lambda: result.save(tmp_path / "folder"),
    ):
        with pytest.raises(tb.TrustboError, match=f"{name}' was not written by trustbo, and wou"):
            replace()
    assert [f.read_text() for f in (tmp_path / "folder").rglob("*") if f.suffix == mine.suffix] == [
        '{"mine": 1}'
    ]


def test_a_linked_folder_of_posteriors_is_not_written_to(workspace, folder, other):
    (folder / "posteriors").rename(folder.parent / "posteriors")
    (folder / "posteriors").symlink_to(folder.parent / "posteriors")
    before = contents([folder.parent / "posteriors"])
    with pytest.raises(tb.TrustboError, match="posteriors' is a link; files are replaced there"):
        run(workspace, folder)
    assert contents(before) == before
    assert len(tb.load_result(folder).posteriors[0].children) > 0  # it is read


def test_a_result_does_not_replace_a_campaign(folder, other):
    result = tb.load_result(other)
    before = contents([folder])
    with pytest.raises(tb.TrustboError, match="holds a campaign, with missions as they were told"):
        result.save(folder)
    assert contents([folder]) == before
    tb.load_result(folder).save(folder)  # its own is there already
    assert contents([folder]) == before


def numbers(folder):
    """What a reader finds: of the result, None if there is none; and of the campaign."""
    try:
        result = tb.load_result(folder)
        read = (
            len(result.missions), result.workspace.awareness.values.tobytes(), tuple(result.path),
            result.history["state"].values.tolist(), result.trust.tobytes(),
            [p and p["posterior"]["b"].values.tobytes() for p in result.posteriors],
            [m.contact_rate.tobytes() for m in result.missions],
        )  # fmt: skip
    except tb.DamagedFileError:
        raise
    except tb.TrustboError:
        read = None
    if not (current(folder) / "campaign.json").exists():
        return read, None
    copy = folder.with_name(f"{folder.name}-opened")
    shutil.copytree(folder, copy, symlinks=True)
    try:
        with tb.Campaign.load(copy) as campaign:
            rates = [mission.contact_rate.tobytes() for mission in campaign.state.measured]
            states = [entry.state for entry in campaign.state.entries]
            whole = (
                rates,
                states,
                campaign.workspace.awareness.values.tobytes(),
                campaign.state.seed,
            )
    finally:
        shutil.rmtree(copy)
    return read, whole


def moments_of(folder, copies, monkeypatch):
    """Copy the folder just before each change of it, as a kill then leaves it."""

    def watched(change):
        def changes(file, *others, **options):
            if folder in Path(file).parents and os.path.lexists(file):
                copies.append(copies[0].with_name(f"moment{len(copies)}"))
                shutil.copytree(folder, copies[-1], symlinks=True)
            return change(file, *others, **options)

        return changes

    for name in ("replace", "rename", "link"):
        monkeypatch.setattr(os, name, watched(getattr(os, name)))
    for name in ("unlink", "rmdir"):
        monkeypatch.setattr(Path, name, watched(getattr(Path, name)))


WAYS = (*replacements(None),)


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("how", WAYS)
def test_wherever_it_dies_there_is_the_old_campaign_or_the_new(
    how, every, workspace, folder, other, tmp_path, monkeypatch
):
    """Read at every moment; or each way at other moments, which all end in the same renames."""
    replace, copies = replacements(workspace)[how], [tmp_path / "moment0"]
    shutil.copytree(folder, copies[0])
    if how == "save_result":
        for record in ("campaign.json", ".campaign.json.sha256"):
            (copies[0] / record).unlink()
            (folder / record).unlink()
    found = [numbers(copies[0])]
    with monkeypatch.context() as patch:
        moments_of(folder, copies, patch)
        if how == "save_result":
            tb.load_result(other).save(folder)
        elif how == "begin":  # what comes after is no replacement
            tb.Campaign(tb.load_result(folder).workspace, *ENDS, seed=1).save(folder, keep=True)
        else:
            replace(folder, other)
    assert len(copies) > 30
    read = copies[1:] if every else copies[1 + 2 * WAYS.index(how) :: 2 * len(WAYS)]
    found += [numbers(copy) for copy in (*read, folder)]
    old, new = found[0], found[-1]
    assert old != new
    assert all(each in (old, new) for each in found)
    turns = sum(a != b for a, b in pairwise(found))
    assert turns == 1


def test_a_replacement_that_fails_leaves_everything(workspace, folder, monkeypatch):
    before = contents(own_files(folder))
    with tb.Campaign.load(folder) as campaign, monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.storage.write_missions", None)
        with pytest.raises(TypeError):
            campaign.save(folder)
        patch.undo()
        assert contents(before) == before
        assert not [f.name for f in folder.iterdir() if f.name.startswith(".trustbo-")]
        campaign.save(folder)


def test_without_hard_links_files_are_copied(folder, other, monkeypatch):
    def refuse(*names):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    replacements(None)["save"](folder, other)
    assert numbers(folder) == numbers(other)


def test_a_replacement_cut_off_in_a_process_that_goes_on_loses_no_mission(tmp_path, monkeypatch):
    """The successor is read from its name on: what is told then must not be written beside it."""
    workspace = random_cells(3, 3)
    truth = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    folder = tmp_path / "kept"
    campaign = tb.Campaign(workspace, (2, 0), (0, 2), sampler="exact", directory=folder)

    def drive():
        path = campaign.ask().path
        campaign.tell(simulator.run(path, seed=campaign.seed_of("mission")))

    drive()
    drive()
    with monkeypatch.context() as patch:
        link, calls = replacing._link, []

        def cut_off(source, target):
            calls.append(target)
            if len(calls) == 2:
                raise OSError(5, "Input/output error")
            link(source, target)

        patch.setattr("trustbo.campaign.replacing._link", cut_off)
        with pytest.raises(OSError, match="Input/output error"):
            campaign.set_aside("a bad day")
    drive()
    drive()
    states = [str(state) for state in campaign.history["state"].values]
    with campaign:
        pass
    again = tb.Campaign.load(folder)
    assert [str(state) for state in again.history["state"].values] == states
    assert states == ["learned", "set aside", "learned", "learned"]
    for mine, kept in zip(campaign.posteriors, again.posteriors, strict=True):
        np.testing.assert_array_equal(mine["posterior"]["beta0"], kept["posterior"]["beta0"])
        np.testing.assert_array_equal(*(np.ravel(p.attrs["missions"]) for p in (mine, kept)))
    with again:
        pass


def test_saving_to_its_own_folder_keeps_hold_of_it_when_it_fails(tmp_path, monkeypatch):
    workspace = random_cells(3, 3)
    campaign = tb.Campaign(workspace, (2, 0), (0, 2), directory=tmp_path / "kept")

    def refuse(*args, **kwargs):
        raise tb.TrustboError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.storage.write_checked", refuse)
        with pytest.raises(tb.TrustboError, match="the disk is full"):
            campaign.save(tmp_path / "kept")
    with pytest.raises(tb.TrustboError, match="another campaign is at work"):
        tb.Campaign.load(tmp_path / "kept")
    with campaign:
        pass


def test_a_copy_that_is_saved_is_not_held_and_one_that_is_kept_follows(tmp_path):
    with tb.Campaign(random_cells(3, 3), (2, 0), (0, 2), directory=tmp_path / "first") as campaign:
        campaign.save(tmp_path / "copy")
        with tb.Campaign.load(tmp_path / "copy") as copy:
            assert copy.settings == campaign.settings
        campaign.save(tmp_path / "second", keep=True)
        path = campaign.ask().path
    with tb.Campaign.load(tmp_path / "first") as first:
        assert first.state.suggested is None
    with tb.Campaign.load(tmp_path / "second") as second:
        assert second.state.suggested.path == path
