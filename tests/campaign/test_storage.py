"""The folder of a campaign: a process that dies at any write resumes with identical results."""

import json
import os
import re
import shutil
from dataclasses import fields

import numpy as np
import pytest
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.data import Bound
from trustbo.models import PooledTrust, Priors

ENDS = ((2, 0), (0, 2))
OPTIONS = {"policy": "thompson", "sampler": "importance", "seed": 3, "fit": {"draws": 50}}


@pytest.fixture(scope="module")
def workspace():
    return random_cells(2, 3)


def numbers(result):
    """All numbers of a result by name."""
    found = {
        "path": np.array(result.path),
        "trust": result.plan.trust,
        "map": result.trust_map.values,
    }
    for name, column in result.history.data_vars.items():
        found[name] = column.values
    for j, tree in enumerate(result.posteriors):
        for group in {"posterior", "places", "robots", "hazard"} & {
            *(tree.children if tree else ())
        }:
            for name, values in tree[group].data_vars.items():
                found[f"{group} {name} after {j + 1}"] = values.values
    for j, mission in enumerate(result.missions):
        found[f"awareness of {j + 1}"] = mission.awareness
        found[f"rates of {j + 1}"] = mission.contact_rate
    return found | {"failures": np.array([str(f) for f in result.state.failures])}


def same(one, other):
    one, other = numbers(one), numbers(other)
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def drive(campaign):
    """Run a campaign of four missions, of which one fails, one is given up, one is excluded."""
    state, simulator = campaign.state, ModelSimulator(campaign.workspace, blind=True)
    if not state.entries:
        campaign.tell(simulator.run(campaign.ask().path, seed=state.seed_of("mission")))
    if len(state.entries) == 1 and not state.failures:
        campaign.ask()
        campaign.fail("stuck", where=campaign.ask().path[1])
    for n in (1, 2, 3):
        if len(state.entries) == n:
            simulator.fail_at = 1 if n == 2 else None
            campaign.tell(simulator.run(campaign.ask().path, seed=state.seed_of("mission")))
        if n == 2 and len(state.entries) == 3 and not state.indices("excluded"):
            campaign.exclude(1, "the lidar was covered")
    return campaign


class Dead(BaseException):
    """The process ends here."""


@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_campaign_that_dies_at_any_write_resumes_identically(
    workspace, tmp_path, monkeypatch, moment, every
):
    """At every write of the campaign; or at the last of each kind, which is faster."""
    rename, targets = os.replace, []

    def dies_at(n):
        targets.clear()

        def replace(source, target):
            if isinstance(target, str):  # numba's, which keeps what it compiles
                return rename(source, target)
            targets.append(re.sub(r"\d+", "N", target.name))
            if len(targets) == n and moment == "before":
                raise Dead
            rename(source, target)
            if len(targets) == n:
                raise Dead
            return None

        return replace

    monkeypatch.setattr(os, "replace", dies_at(0))
    with tb.Campaign(workspace, *ENDS, directory=tmp_path / "whole", **OPTIONS) as campaign:
        whole = drive(campaign)
    writes = dict(enumerate(targets, start=1))
    assert len(writes) > 18
    last = {target: n for n, target in writes.items()}
    assert set(last) == {"workspace.nc", "N.nc", "N-N.nc", "campaign.json"}
    for n in writes if every else (1, 2, 4, *last.values()):
        folder = tmp_path / str(n)
        monkeypatch.setattr(os, "replace", dies_at(n))
        with pytest.raises(Dead):
            drive(tb.Campaign(workspace, *ENDS, directory=folder, **OPTIONS))
        monkeypatch.setattr(os, "replace", rename)
        if not (folder / "campaign.json").exists():  # nothing had begun
            assert n <= 2
            continue
        with tb.Campaign.load(folder) as campaign:
            same(drive(campaign), whole)
        same(tb.load_result(folder), whole)


@pytest.fixture(scope="module")
def folder(workspace, tmp_path_factory):
    """Folder of a campaign that was driven; tests copy it."""
    path = tmp_path_factory.mktemp("campaign") / "kept"
    with tb.Campaign(workspace, *ENDS, directory=path, **OPTIONS) as campaign:
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
        assert again.state.indices("learned") == [0]
        same(drive(again), tb.load_result(folder))


def test_folder_holds_a_file_a_mission_and_posterior_and_a_record(folder):
    files = {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}
    numbered = {f"missions/000{n}.nc" for n in (1, 2, 3, 4)}
    numbered |= {f"posteriors/{name}.nc" for name in ("0001", "0002", "0003", "0003-1", "0004-1")}
    assert files == {".lock", "campaign.json", "workspace.nc", *numbered}
    record = json.loads((folder / "campaign.json").read_text())
    assert (record["settings"]["start"], len(record["rows"])) == ([2, 0], 4)


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


def test_folder_is_locked_for_one_campaign_at_a_time(workspace, tmp_path):
    with tb.Campaign(workspace, *ENDS, directory=tmp_path / "a"):
        with pytest.raises(tb.TrustboError, match="another campaign"):
            tb.Campaign.load(tmp_path / "a")
    with tb.Campaign.load(tmp_path / "a"):
        pass
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
    record = json.loads((copy / "campaign.json").read_text())
    for name in ("rows", "posteriors"):
        del record[name][-1]
    (copy / "campaign.json").write_text(json.dumps(record))
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
    for wrong in (None, PooledTrust()):
        with pytest.raises(tb.TrustboError, match="model"):
            tb.Campaign.load(tmp_path, policy=straight, model=wrong)
    with tb.Campaign.load(tmp_path, policy=straight, model=model) as again:
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
