"""A folder that holds a campaign is refused, unless it may be replaced."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from worlds import ModelSimulator, moments_of, random_cells

import trustbo as tb

ENDS = ((2, 0), (0, 2))


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


def contents(folder):
    return {f: f.read_bytes() for f in folder.rglob("*") if f.is_file() and f.suffix != ".lock"}


def test_a_folder_that_holds_a_campaign_or_a_result_is_refused(workspace, folder, tmp_path):
    result, before = tb.load_result(folder), contents(folder)
    campaign = tb.Campaign(workspace, *ENDS)
    ways = [
        lambda: tb.Campaign(workspace, *ENDS, directory=folder),
        lambda: run(workspace, folder),
        lambda: campaign.save(folder),
        lambda: result.save(folder),
    ]
    for way in ways:
        with pytest.raises(tb.TrustboError, match="holds a campaign already"):
            way()
    assert contents(folder) == before
    for name in ("campaign.json", "result.json", "measured.nc"):
        (folder / name).unlink()
        with pytest.raises(tb.TrustboError, match=r"holds \w+\.\w+, which would be replaced"):
            campaign.save(folder)
    result.save(tmp_path / "result")
    with pytest.raises(tb.TrustboError, match=r"holds result\.json, which would be replaced"):
        result.save(tmp_path / "result")


def test_overwriting_removes_the_campaign_before_and_no_other_file(workspace, folder):
    (folder / "notes.txt").write_text("mine")
    result = run(workspace, folder, seed=1, n=1, overwrite=True)
    assert [f.name for f in (folder / "posteriors").iterdir()] == ["0001.nc"]
    assert (folder / "notes.txt").read_text() == "mine"
    with tb.Campaign.load(folder) as again:
        assert again.state.seed == 1
        assert [m.path for m in again.missions] == [m.path for m in result.missions]


def test_what_was_read_from_a_folder_is_written_over_it(folder):
    result = tb.load_result(folder)
    with tb.Campaign.load(folder) as campaign:
        pass
    campaign.save(folder, overwrite=True)
    result.save(folder, overwrite=True)  # its posteriors are in the files that go
    again = tb.load_result(folder)
    assert not (folder / "campaign.json").exists()
    for one, other in zip(result.posteriors, again.posteriors, strict=True):
        np.testing.assert_array_equal(one["posterior"]["b"], other["posterior"]["b"])


def test_wherever_setting_a_mission_aside_is_cut_off_it_is_set_aside_or_not(
    folder, tmp_path, monkeypatch
):
    def learned(folder):
        with tb.Campaign.load(folder) as campaign:
            numbers = campaign.state.numbers("learned")
            posterior = campaign.state.last_tree
            assert np.ravel(posterior.attrs["missions"]).tolist() == numbers
            b = posterior["posterior"]["b"].values.tobytes()
        assert len(tb.load_result(folder).missions) == 2
        return numbers, b, campaign.ask().path

    copies = [tmp_path / "moment0"]
    before = learned(shutil.copytree(folder, copies[0]))
    with monkeypatch.context() as patch:
        moments_of(folder, copies, patch)
        with tb.Campaign.load(folder) as campaign:
            campaign.set_aside("a test", 1)
    found = [learned(copy) for copy in (*copies[1:], folder)]
    assert len(found) > 5
    assert found[-1] != before
    assert found[-1][0] == [1]
    assert all(each in (before, found[-1]) for each in found)


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


def test_saving_to_its_own_folder_keeps_hold_of_it_when_it_fails(tmp_path, monkeypatch):
    campaign = tb.Campaign(random_cells(3, 3), (2, 0), (0, 2), directory=tmp_path / "kept")

    def refuse(*args, **kwargs):
        raise tb.TrustboError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("trustbo.campaign.storage.write_tree", refuse)
        with pytest.raises(tb.TrustboError, match="the disk is full"):
            campaign.save(tmp_path / "kept")
    with pytest.raises(tb.TrustboError, match="another campaign is at work"):
        tb.Campaign.load(tmp_path / "kept")
    with campaign:
        pass
