"""Missions in netCDF files: as they were; damage is an error."""

import signal
from dataclasses import replace

import netCDF4
import numpy as np
import pytest
import xarray as xr
from worlds import hillside

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.logs import read_missions, write_missions
from trustbo.logs.netcdf import read_tree, write_tree


@pytest.fixture(scope="module")
def driven():
    """Two missions with ticks, the first with states too, and one of a log without."""
    terrain = hillside()
    workspace = tb.Workspace.from_terrain(terrain, (3, 3), tb.Team(n_robots=2))
    plain = tb.simulation.KinematicSimulator(workspace).run([(2, 0), (1, 1)], seed=0)
    shape = *plain.bounds[0].contact.shape, len(tb.logs.netcdf.STATES)
    states = np.random.default_rng(0).uniform(size=shape)
    missions = [replace(plain, bounds=(replace(plain.bounds[0], states=states),)), plain]
    z, names = np.full((1, 2, 3), 0.5), workspace.features
    log = Mission.from_arrays([(2, 0), (1, 1)], z, np.full((1, 2), 0.5), features=names)
    return [*missions, log]


def test_ticks_and_states_come_back_as_they_were(driven, tmp_path):
    write_missions(tmp_path / "missions.nc", driven)
    assert sorted(f.name for f in (tmp_path / "missions.ticks").glob("*.nc")) == [
        "0001.nc",
        "0002.nc",
    ]
    with xr.open_dataset(tmp_path / "missions.ticks" / "0001.nc") as ticks:
        assert list(ticks["state"].values) == list(tb.logs.netcdf.STATES)
    again = read_missions(tmp_path / "missions.nc")
    for one, other in zip(again, driven, strict=True):
        a, b = one.bounds[0], other.bounds[0]
        for name in ("awareness", "contact_rate", "duration", "n_ticks"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        assert (a.poses is None) == (b.poses is None)
        assert (a.states is None) == (b.states is None)
    for name in ("poses", "contact", "states"):
        np.testing.assert_array_equal(
            getattr(again[0].bounds[0], name), getattr(driven[0].bounds[0], name)
        )
    write_missions(tmp_path / "missions.nc", [driven[0], driven[2]])  # the second without ticks
    assert [f.name for f in (tmp_path / "missions.ticks").glob("*.nc")] == ["0001.nc"]
    (tmp_path / "missions.ticks" / "0001.nc").unlink()  # the rates are known without
    assert read_missions(tmp_path / "missions.nc")[0].bounds[0].poses is None


def test_a_tree_is_written_as_xarray_writes_it(tmp_path):
    of_row = {"row": [0, 1], "height": ("row", [1.5, np.nan])}
    flags = {"flag": ("row", [True, False]), "count": ("row", [1, 2]), "empty": ("row", ["", "a"])}
    terrain = xr.Dataset({"dem": ("row", np.float32([1, 2]), {"units": "m"})}, of_row)
    terrain["dem"].encoding |= {"dtype": "int16", "scale_factor": 0.5, "_FillValue": -1}
    tree = xr.DataTree.from_dict(
        {"/": xr.Dataset(attrs={"n": 1}), "deep/cells": xr.Dataset(flags, of_row, {"names": ["a"]}),
         "terrain": terrain}
    )  # fmt: skip
    write_tree(tmp_path / "ours.nc", tree)
    (tmp_path / "theirs.nc").write_bytes(tree.to_netcdf())

    def content(group):
        yield (
            group.path,
            [(k, str(group.getncattr(k))) for k in group.ncattrs()],
            {name: len(dim) for name, dim in group.dimensions.items()},
        )
        for name, array in group.variables.items():
            array.set_auto_maskandscale(False)
            attrs = [(k, str(array.getncattr(k))) for k in array.ncattrs()]
            yield name, str(array.dtype), array.dimensions, attrs, repr(array[...])
        for inner in group.groups.values():
            yield from content(inner)

    found, expected = (
        [*content(netCDF4.Dataset("a file", memory=(tmp_path / name).read_bytes()))]
        for name in ("ours.nc", "theirs.nc")
    )
    assert found == expected
    assert len(found) == 12
    xr.testing.assert_identical(read_tree(tmp_path / "ours.nc"), read_tree(tmp_path / "theirs.nc"))


def test_states_of_another_number_of_ticks_are_refused(driven, tmp_path):
    short = replace(driven[0].bounds[0], states=driven[0].bounds[0].states[:3])
    with pytest.raises(TrustboError, match=r"bound 1: states must be .*\(3, 2, 5\)"):
        write_missions(tmp_path / "missions.nc", [replace(driven[0], bounds=(short,))])
    assert not list(tmp_path.rglob("*.nc"))


class Pressed(xr.DataTree):
    """A tree during whose serialisation Ctrl-C is pressed."""

    @property
    def subtree(self):
        for node in super().subtree:
            yield node
            signal.raise_signal(signal.SIGINT)


def test_damage_is_named_with_its_file(driven, tmp_path):
    file = tmp_path / "missions.nc"
    with pytest.raises(DamagedFileError, match=r"missions.nc' is missing"):
        read_missions(file)
    write_missions(file, driven)
    other = tmp_path / "other.nc"
    other.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(DamagedFileError, match=r"other.nc' is damaged, or no netCDF"):
        read_missions(other)
    write_tree(other, xr.DataTree(xr.Dataset({"x": 1})))
    with pytest.raises(DamagedFileError, match=r"other.nc' holds no missions: it lacks 'Could not"):
        read_missions(other)
