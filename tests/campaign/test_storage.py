"""The folder of a campaign: a process that dies at any write resumes with identical results."""

import copy
import errno
import json
import os
import re
import shutil
import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from folders import ENDS, OPTIONS, begin, drive, numbers, same
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.campaign.replace import has_campaign
from trustbo.data import Bound
from trustbo.models import PooledTrust, Priors


@pytest.fixture(scope="module")
def workspace():
    return random_cells(2, 3)


class Dead(BaseException):
    """The process ends here."""


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_campaign_that_dies_at_any_write_resumes_identically(
    workspace, tmp_path, monkeypatch, every
):
    """Before and after every write of the campaign; or the last of each kind, which is faster.

    The folder is copied at these moments, as a process that dies would leave it.
    """
    rename, kinds, left = os.replace, [], {}

    def replace(source, target):
        if isinstance(target, str):  # numba's, which keeps what it compiles
            rename(source, target)
            return
        kinds.append(re.sub(r"\d+", "N", target.name))
        n = len(kinds)
        left[n] = [tmp_path / f"{moment} {n}" for moment in ("before", "after")]
        shutil.copytree(tmp_path / "whole", left[n][0])
        rename(source, target)
        shutil.copytree(tmp_path / "whole", left[n][1])

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace)
        with tb.Campaign(workspace, *ENDS, directory=tmp_path / "whole", **OPTIONS) as campaign:
            whole = numbers(drive(campaign))
    assert len(kinds) > 18
    last = {kind: n for n, kind in enumerate(kinds, start=1)}
    assert set(last) == {"workspace.nc", "N.nc", "N-N.nc", "campaign.json"}
    assert not (left[4][0] / "campaign.json").exists()  # it was in a folder beside
    assert (left[4][1] / "campaign.json").exists()
    n_begun = 0
    for n in left if every else sorted({2, 3, 4, *last.values()}):
        for folder in left[n]:
            if has_campaign(folder):
                n_begun += 1
                with warnings.catch_warnings():
                    warnings.filterwarnings("ignore", "mission . was written")
                    campaign = tb.Campaign.load(folder)
                with campaign:
                    drive(campaign)
                same(tb.load_result(folder), whole)
    assert n_begun > 9


def test_loading_says_that_it_learns_from_a_mission(workspace, tmp_path, capsys):
    field = tmp_path / "field"
    with tb.Campaign(workspace, *ENDS, directory=field, **OPTIONS) as campaign:
        campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
        wait(campaign)

    for progress in (True, False):
        copy = shutil.copytree(field, tmp_path / str(progress))
        with tb.Campaign.load(copy, progress=progress) as again:
            assert again.table()["state"].tolist() == ["learned"]
        assert ("fitting mission 1" in capsys.readouterr().err) == progress


def wait(campaign):
    """Write the folder that remains if the process dies while it learns from the last mission."""
    *before, last = campaign.state.entries
    posterior = before[-1].posterior if before else None
    entries = (*before, replace(last, posterior=posterior))
    fitted = posterior.used if posterior else ()
    campaign.storage.write(replace(campaign.state, entries=entries, fitted=fitted, asked=None))


@pytest.fixture(scope="module")
def folder(workspace, tmp_path_factory):
    """Folder of a campaign that was driven; tests copy it."""
    path = tmp_path_factory.mktemp("campaign") / "kept"
    with tb.Campaign(workspace, *ENDS, directory=path, **OPTIONS) as campaign:
        drive(campaign)
    return path


@pytest.fixture(scope="module")
def another(tmp_path_factory):
    """Folder of another campaign."""
    path = tmp_path_factory.mktemp("another")
    with begin(random_cells(3, 3), path, seed=8) as campaign:
        drive(campaign)
    return path


def test_campaign_that_dies_while_it_learns_learns_when_it_is_loaded(
    workspace, folder, tmp_path, monkeypatch
):
    def die(*args, **kwargs):
        raise Dead

    with tb.Campaign(workspace, *ENDS, directory=tmp_path, **OPTIONS) as campaign:
        simulator = ModelSimulator(workspace, blind=True)
        mission = simulator.run(campaign.ask().path, seed=campaign.state.seed_of("mission"))
        with monkeypatch.context() as patch:
            patch.setattr("trustbo.campaign.learning.fit", die)
            with pytest.raises(Dead):
                campaign.tell(mission)
    with tb.Campaign.load(tmp_path) as again:
        assert again.table()["state"].tolist() == ["learned"]
        same(drive(again), tb.load_result(folder))


def test_folder_holds_a_file_a_mission_and_posterior_and_a_record(folder):
    files = {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}
    numbered = {f"missions/000{n}.nc" for n in (1, 2, 3, 4)}
    numbered |= {f"posteriors/{name}.nc" for name in ("0001", "0002", "0003", "0003-1", "0004-1")}
    assert files == {".lock", "campaign.json", "workspace.nc", *numbered}
    record = json.loads((folder / "campaign.json").read_text())
    assert (record["settings"]["start"], len(record["exclusions"])) == ([2, 0], 4)
    assert record["files"].keys() == files - {".lock", "campaign.json"}


def test_save_writes_the_folder_of_a_campaign(folder, tmp_path):
    first = tb.load_result(folder)
    first.save(tmp_path / "copy")
    again = tb.load_result(tmp_path / "copy")
    same(again, first)
    assert again.settings == first.settings
    assert again.table().equals(first.table())
    with tb.Campaign.load(tmp_path / "copy") as campaign:
        same(campaign, first)
        assert campaign.ask().path is not None
    again.save(tmp_path / "copy", overwrite=True)  # its posteriors are in the files that go
    same(tb.load_result(tmp_path / "copy"), first)


def test_folder_that_holds_a_campaign_is_refused_or_replaced(workspace, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "notes.txt").write_text("mine")
    before = {f: f.read_bytes() for f in copy.rglob("*.*") if f.is_file()}
    result = tb.load_result(copy)
    for way in (
        lambda: tb.Campaign(workspace, *ENDS, directory=copy),
        lambda: tb.iterate(workspace, *ENDS, simulator=ModelSimulator(workspace), directory=copy),
        lambda: result.save(copy),
    ):
        with pytest.raises(tb.TrustboError, match="overwrite"):
            way()
    assert {f: f.read_bytes() for f in copy.rglob("*.*") if f.is_file()} == before
    with tb.Campaign(workspace, *ENDS, directory=copy, overwrite=True, seed=9):
        pass
    assert not list(copy.glob("*/*.nc"))
    assert (copy / "notes.txt").exists()
    with tb.Campaign.load(copy) as again:
        assert (again.state.settings["seed"], again.missions) == (9, [])
    with pytest.raises(tb.TrustboError, match="mission"):
        tb.load_result(copy)


def test_folder_is_locked_for_one_campaign_at_a_time(workspace, elsewhere, tmp_path):
    load_it = f"import trustbo as tb; tb.Campaign.load({str(tmp_path / 'a')!r}).close()"
    with tb.Campaign(workspace, *ENDS, directory=tmp_path / "a") as campaign:
        assert "another campaign" in elsewhere(load_it)
        with pytest.raises(tb.TrustboError, match="another campaign"):
            campaign.save(tmp_path / "a", overwrite=True)
    assert elsewhere(load_it) == ""
    for load in (tb.Campaign.load, tb.load_result, tb.resume):
        with pytest.raises(tb.TrustboError, match="nothing"):
            load(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(tb.TrustboError, match="file"):
        tb.Campaign(workspace, *ENDS, directory=tmp_path / "file" / "deep")


def test_closed_campaign_records_nothing_more(workspace, tmp_path):
    with tb.Campaign(workspace, *ENDS, directory=tmp_path) as campaign:
        mission = ModelSimulator(workspace).run(campaign.ask().path, seed=0)
    for change in (lambda: campaign.tell(mission), lambda: campaign.fail("rain")):
        with pytest.raises(tb.TrustboError, match="closed"):
            change()
    assert tb.Campaign.load(tmp_path).missions == []


def test_a_mission_that_waits_to_be_learned_is_in_the_result(folder, tmp_path):
    whole, copy = tb.load_result(folder), shutil.copytree(folder, tmp_path / "copy")
    with tb.Campaign.load(copy) as campaign:
        assert campaign.table()["state"].dropna().iloc[-1] == "learned"
        wait(campaign)
    waiting = tb.load_result(copy)
    assert len(waiting.missions) == len(whole.missions)
    assert waiting.table()["state"].dropna().iloc[-1] == "told"


def test_custom_objects_are_required_again(workspace, tmp_path):
    def straight(rng, draws, planner):
        return planner.evaluate([(2, 0), (1, 1), (0, 2)], draws.mean())

    model = PooledTrust(priors=Priors(x0_mean=0.4))
    options = OPTIONS | {"policy": straight}
    with tb.Campaign(workspace, *ENDS, model=model, directory=tmp_path, **options) as campaign:
        campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=0))
        expected = campaign
    for wrong in (None, tb.planning.POLICIES["greedy"]):
        with pytest.raises(tb.TrustboError, match="policy"):
            tb.Campaign.load(tmp_path, policy=wrong, model=model)
    with pytest.raises(tb.TrustboError, match="model"):
        tb.Campaign.load(tmp_path, policy=straight, model=PooledTrust())
    for given in (None, model):  # priors of NumPyro's classes are stored
        with tb.Campaign.load(tmp_path, policy=straight, model=given) as again:
            same(again, expected)
    same(tb.load_result(tmp_path), expected)  # which needs none of them


@pytest.mark.parametrize(
    "name", ["campaign.json", "workspace.nc", "missions/0002.nc", "posteriors/0004-1.nc"]
)
@pytest.mark.parametrize("damage", ["missing", "empty", "cut"])
def test_damaged_file_is_named(folder, tmp_path, name, damage):
    copy = shutil.copytree(folder, tmp_path / "copy")
    content = (copy / name).read_bytes()
    (copy / name).unlink()
    if damage != "missing":
        (copy / name).write_bytes(content[:600] if damage == "cut" else b"")
    for load in (tb.Campaign.load, tb.load_result):
        with pytest.raises(tb.TrustboError) as error:
            _ = load(copy).posterior
        if (name, damage) != ("campaign.json", "missing"):
            assert name in str(error.value)


@pytest.mark.parametrize("content", [b"{", b"{}", b"[1]", b"\xff", b"[" * 100000])
def test_record_with_other_contents_is_named(folder, tmp_path, content):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "campaign.json").write_bytes(content)
    for load in (tb.Campaign.load, tb.load_result):
        with pytest.raises(tb.TrustboError, match=r"campaign\.json"):
            load(copy)


def test_missions_and_workspace_on_terrain_are_read_back_with_ticks(tmp_path):
    terrain = tb.terrain.synthetic_terrain((60.0, 60.0), resolution=2.0, seed=1, relief=5.0)
    workspace = tb.Workspace.from_terrain(terrain, (2, 2), tb.Team(2))
    first = tb.iterate(
        workspace, (1, 0), (0, 1), n_iterations=2, directory=tmp_path, progress=False,
        fit={"draws": 50},
    )  # fmt: skip
    again = tb.load_result(tmp_path)
    same(again, first)
    one, other = workspace, again.workspace
    assert (one.grid, one.team, one.sight) == (other.grid, other.team, other.sight)
    for name in ("awareness", "passable", "terrain", "pixels"):
        assert getattr(one, name).identical(getattr(other, name)), name
    read = tb.logs.read_missions(tmp_path)
    assert read[0].bounds[0].poses is not None
    for entry, mission in zip(first.state.entries, read, strict=True):
        for a, b in zip(entry.measured.bounds, mission.bounds, strict=True):
            for field in fields(Bound):
                np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_files_of_a_campaign_do_not_grow_with_its_missions(workspace, tmp_path):
    tb.iterate(
        workspace, *ENDS, n_iterations=4, simulator=ModelSimulator(workspace, blind=True),
        directory=tmp_path, model=PooledTrust(), sampler="importance", progress=False,
    )  # fmt: skip
    for room in ("missions", "posteriors"):
        sizes = [file.stat().st_size for file in (tmp_path / room).glob("*.nc")]
        assert max(sizes) < 0.4e6
        assert max(sizes) < 1.1 * min(sizes)


# --- what others do to the folder ---


def test_cell_of_a_notebook_can_be_run_again(workspace, tmp_path):
    def cell(**options):
        return begin(workspace, tmp_path / "field", **options)

    first = cell()
    mission = ModelSimulator(workspace).run(first.ask().path, seed=0)
    second = cell(overwrite=True)
    with pytest.raises(tb.TrustboError, match="opened again"):
        first.tell(mission)
    second.tell(mission)
    third = tb.Campaign.load(tmp_path / "field")
    assert len(third.missions) == 1
    with pytest.raises(tb.TrustboError, match="opened again"):
        second.fail("rain")
    third.close()
    third.close()
    with pytest.raises(tb.TrustboError, match="contains a campaign"):
        cell()


def same_draws(one, other):
    for name, values in one["posterior"].data_vars.items():
        np.testing.assert_array_equal(values, other["posterior"][name])


def test_folder_that_was_moved_or_deleted_is_noticed_before_anything_is_written(
    workspace, tmp_path
):
    campaign = begin(workspace, tmp_path / "field")
    mission = ModelSimulator(workspace).run(campaign.ask().path, seed=0)
    (tmp_path / "field").rename(tmp_path / "moved")
    for change in (lambda: campaign.tell(mission), lambda: campaign.fail("rain")):
        with pytest.raises(tb.TrustboError, match="moved"):
            change()
        assert not (tmp_path / "field").exists()
    (tmp_path / "field").mkdir()
    with pytest.raises(tb.TrustboError, match="moved"):
        campaign.tell(mission)
    (tmp_path / "field").rmdir()
    (tmp_path / "moved").rename(tmp_path / "field")
    campaign.tell(mission)
    campaign.tell(ModelSimulator(workspace).run(campaign.ask().path, seed=1))
    shutil.rmtree(tmp_path / "field")
    with pytest.raises(tb.TrustboError, match="moved"):
        campaign.tell(mission, again=True)
    with pytest.warns(UserWarning, match="posteriors"):
        campaign.save(tmp_path / "rescued")
    with tb.Campaign.load(tmp_path / "rescued") as rescued:
        assert len(rescued.missions) == 2
        assert rescued.posteriors[0] is None
        same_draws(rescued.posteriors[1], campaign.state.posterior)


def test_record_that_another_program_changed_is_noticed(workspace, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    with tb.Campaign.load(copy) as campaign:
        (copy / ".lock").unlink()  # as somebody who tidies up
        campaign.fail("rain")
        record = (copy / "campaign.json").read_bytes()
        (copy / "campaign.json").unlink()
        campaign.fail("rain")  # it is written again
        (copy / "campaign.json").write_bytes(record)
        with pytest.raises(tb.TrustboError, match=r"campaign\.json"):
            campaign.fail("rain")
        assert len(campaign.state.failures) == 3


def test_deleted_lock_does_not_let_two_processes_in(workspace, elsewhere, tmp_path):
    with begin(workspace, tmp_path) as campaign:
        (tmp_path / ".lock").unlink()
        load_it = f"import trustbo as tb; other = tb.Campaign.load({str(tmp_path)!r})"
        assert elsewhere(load_it) == ""
        with pytest.raises(tb.TrustboError, match="another campaign"):
            campaign.fail("rain")
        assert elsewhere("other.close()") == ""
        campaign.fail("rain")


def test_file_system_without_locks_is_used_with_a_warning(workspace, tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.warns(UserWarning, match="no locks"):
        campaign = begin(workspace, tmp_path)
    campaign.fail("rain")
    other = (tmp_path / "campaign.json").read_bytes()
    (tmp_path / "campaign.json").unlink()
    (tmp_path / "campaign.json").write_bytes(other)  # as by another process
    with pytest.raises(tb.TrustboError, match="another program"):
        campaign.fail("rain")
    campaign.close()


FORK = """
import os
import trustbo as tb

campaign = tb.Campaign.load({!r})
child = os.fork()
try:
    campaign.fail("rain")
except tb.TrustboError as error:
    assert child == 0 and "fork" in str(error)
    os._exit(7)
assert child and os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
campaign.fail("rain")
campaign.close()
"""


def test_copy_of_the_process_cannot_record(workspace, elsewhere, tmp_path):
    begin(workspace, tmp_path).close()
    assert elsewhere(FORK.format(str(tmp_path))) == ""
    with tb.Campaign.load(tmp_path) as campaign:
        assert len(campaign.state.failures) == 2


def test_files_of_others_are_never_deleted(workspace, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "missions" / "thesis.nc").write_text("mine")
    begin(workspace, copy, overwrite=True).close()
    assert (copy / "missions" / "thesis.nc").read_text() == "mine"
    for name in ("workspace.nc", "missions/0001.nc"):
        other = tmp_path / name[:4]
        (other / name).parent.mkdir(parents=True)
        (other / name).write_text("mine")
        with pytest.raises(tb.TrustboError, match=name):
            begin(workspace, other, overwrite=True).tell(
                ModelSimulator(workspace).run(((2, 0), (1, 1), (0, 2)), seed=0)
            )
        assert (other / name).read_text() == "mine"


def test_campaign_is_not_replaced_through_a_link(workspace, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "missions").rename(tmp_path / "big disk")
    (copy / "missions").symlink_to(tmp_path / "big disk")
    files = sorted((tmp_path / "big disk").iterdir())
    with pytest.raises(tb.TrustboError, match="link"):
        begin(workspace, copy, overwrite=True)
    assert sorted((tmp_path / "big disk").iterdir()) == files
    same(tb.load_result(copy), tb.load_result(folder))


def test_another_version_is_named_before_anything_else_is_read(folder, tmp_path):
    for versions in ({"trustbo": "0.3.0"}, {"trustbo": "9.9"}, {}, None):
        copy = tmp_path / str(versions)
        copy.mkdir()
        (copy / "campaign.json").write_text(json.dumps({"rows": 3, "versions": versions}))
        for load in (tb.Campaign.load, tb.load_result):
            with pytest.raises(tb.TrustboError) as error:
                load(copy)
            assert tb.__version__ in str(error.value)
            assert (versions or {}).get("trustbo", "unknown") in str(error.value)


def test_missions_that_an_older_record_does_not_list_are_named(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    for n in (5, 6):
        shutil.copy(copy / "missions" / "0001.nc", copy / "missions" / f"000{n}.nc")
    for load in (tb.Campaign.load, tb.load_result):
        with pytest.raises(tb.TrustboError, match=r"0006\.nc"):
            load(copy)


def test_mission_of_a_process_that_died_before_it_recorded_it_is_set_aside(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    left = copy / "missions" / "0005.nc"
    left.write_text("of a process that died")
    with pytest.warns(UserWarning, match=r"0005\.nc"):
        campaign = tb.Campaign.load(copy)
    with campaign:
        assert len(campaign.missions) == 4
        campaign.tell(ModelSimulator(campaign.workspace).run(campaign.ask().path, seed=5))
        expected = numbers(campaign)
    assert left.with_suffix(".unrecorded").read_text() == "of a process that died"
    same(tb.load_result(copy), expected)


@pytest.mark.parametrize("name", ["workspace.nc", "missions/0002.nc", "posteriors/0004-1.nc"])
def test_file_of_another_campaign_is_noticed(folder, another, tmp_path, name):
    copy = shutil.copytree(folder, tmp_path / "copy")
    shutil.copy(another / name, copy / name)
    with pytest.raises(tb.TrustboError, match="replaced"):
        _ = tb.load_result(copy).posterior


@pytest.mark.parametrize(
    "name", ["workspace.nc", "missions/0002.nc", "posteriors/0002.nc", "campaign.json"]
)
@pytest.mark.slow
def test_flipped_bit_is_never_silent(folder, tmp_path, name):
    copy = shutil.copytree(folder, tmp_path / "copy")
    content = (copy / name).read_bytes()
    places = np.random.default_rng(0).integers(len(content), size=30)
    for k, place in enumerate(places):
        changed = bytearray(content)
        changed[place] ^= 1 << k % 8
        (copy / name).write_bytes(changed)
        with pytest.raises(tb.TrustboError, match=name):
            _ = tb.load_result(copy).posteriors


def test_flipped_bit_in_a_mission_that_waits_is_never_silent(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    with tb.Campaign.load(copy) as campaign:
        wait(campaign)
    file = copy / "missions" / "0004.nc"
    content = file.read_bytes()
    for k, place in enumerate(np.random.default_rng(0).integers(len(content), size=30)):
        changed = bytearray(content)
        changed[place] ^= 1 << k % 8
        file.write_bytes(changed)
        with pytest.raises(tb.TrustboError, match=r"0004\.nc"):
            tb.load_result(copy)


def test_campaign_in_another_folder_needs_the_old_one_no_more(workspace, folder, tmp_path):
    old = shutil.copytree(folder, tmp_path / "old")
    campaign = tb.Campaign.load(old)
    campaign.store_in(tmp_path / "new")
    shutil.rmtree(old)
    posteriors = campaign.posteriors
    campaign.fail("rain")
    campaign.close()
    for one, other in zip(posteriors, tb.load_result(tmp_path / "new").posteriors, strict=True):
        same_draws(one, other)


def test_missions_of_a_lost_campaign_do_not_become_those_of_a_new_one(workspace, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    (copy / "campaign.json").unlink()
    missions = {file.name: file.read_bytes() for file in (copy / "missions").iterdir()}
    with pytest.raises(tb.TrustboError, match="0001"):
        begin(workspace, copy)
    assert {file.name: file.read_bytes() for file in (copy / "missions").iterdir()} == missions
    assert not (copy / "campaign.json").exists()

    copy = shutil.copytree(folder, tmp_path / "gap")
    shutil.copy(copy / "missions" / "0001.nc", copy / "missions" / "0009.nc")
    with pytest.raises(tb.TrustboError, match="0009"):
        begin(workspace, copy, overwrite=True)


def test_hidden_files_of_other_programs_are_not_deleted(workspace, tmp_path):
    others = [tmp_path / ".next" / "page.js", tmp_path / ".new-year" / "a", tmp_path / ".tmp-notes"]
    for file in others:
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")
    begin(workspace, tmp_path).close()
    begin(workspace, tmp_path, overwrite=True).close()
    tb.Campaign.load(tmp_path).close()
    assert all(file.read_text() == "mine" for file in others)


def test_folder_that_another_process_filled_first_is_kept(workspace, folder, tmp_path, monkeypatch):
    """Another process writes a campaign after this one has found no folder."""
    make = Path.mkdir

    def mkdir(path, **options):
        if path == tmp_path / "new" and not path.exists():
            shutil.copytree(folder, path)
        make(path, **options)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    with pytest.raises(tb.TrustboError, match="contains a campaign"):
        begin(workspace, tmp_path / "new")
    same(tb.load_result(tmp_path / "new"), tb.load_result(folder))


def test_saved_result_with_a_waiting_mission_learns_when_it_is_loaded(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    with tb.Campaign.load(copy) as campaign:
        campaign.ask()
        wait(campaign)
    tb.load_result(copy).save(tmp_path / "saved")

    with tb.Campaign.load(copy) as whole, tb.Campaign.load(tmp_path / "saved") as saved:
        assert saved.state.asked is None  # that path was driven
        same(saved, whole)


def test_saved_result_whose_last_posterior_is_damaged_learns_it_again(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    last = tb.load_result(copy).state.last
    last.file[0].write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="posteriors"):
        tb.load_result(copy).save(tmp_path / "saved")
    with tb.Campaign.load(tmp_path / "saved") as campaign:
        assert campaign.state.last is not None
        missions = campaign.state.posterior.attrs["missions"]
        np.testing.assert_array_equal(missions, tb.load_result(folder).posterior.attrs["missions"])


def test_copy_of_a_campaign_leaves_the_original_as_it_is(folder, tmp_path):
    original = tb.Campaign.load(shutil.copytree(folder, tmp_path / "copy"))
    n_missions = len(original.missions)
    states = original.table()["state"].tolist()

    other = copy.copy(original)
    simulator = ModelSimulator(other.workspace)
    other.tell(simulator.run(other.ask().path, seed=5))
    other.fail("rain")
    other.exclude(2, "the lidar was covered")
    assert len(original.missions) == n_missions
    assert original.table()["state"].tolist() == states

    original.tell(simulator.run(original.ask().path, seed=6))
    original.close()
    same(tb.load_result(tmp_path / "copy"), original)
