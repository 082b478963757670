"""Missions in netCDF files: as they were; damage is an error."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from missions import assert_same_missions, missions

from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.logs import read_missions, write_missions
from trustbo.logs.netcdf import write_tree


@settings(max_examples=20, deadline=None)
@given(missions())
def test_missions_come_back_with_ticks_and_states_to_the_last_bit(tmp_path_factory, made):
    file = tmp_path_factory.mktemp("log") / "missions.nc"
    write_missions(file, made)
    assert_same_missions(read_missions(file), made)


def test_damage_is_named_with_its_file(tmp_path):
    file, other = tmp_path / "missions.nc", tmp_path / "other.nc"
    with pytest.raises(TrustboError, match=r"missions.nc"):
        read_missions(file)
    write_missions(
        file, [Mission.from_arrays([(2, 0), (1, 1)], np.ones((1, 2, 3)), np.ones((1, 2)))]
    )
    other.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(TrustboError, match=r"other.nc"):
        read_missions(other)
    write_tree(other, xr.DataTree(xr.Dataset({"x": 1})))
    with pytest.raises(TrustboError, match=r"other.nc"):
        read_missions(other)


def test_missions_of_several_files_and_folders_are_read_in_their_order(tmp_path):
    told = [
        Mission.from_arrays([(2, 0), (1, 1)], np.ones((1, 2, 3)), np.full((1, 2), rate))
        for rate in (0.25, 0.5, 0.75)
    ]
    for n, mission in enumerate(told):
        write_missions(tmp_path / f"campaign/missions/000{n}.nc", [mission])
    write_missions(tmp_path / "others.nc", told[::-1])
    read = read_missions([tmp_path / "others.nc", str(tmp_path / "campaign")])
    assert [mission.contact_rate[0, 0] for mission in read] == [0.75, 0.5, 0.25, 0.25, 0.5, 0.75]


@pytest.mark.parametrize(
    "copy",
    [
        "0002.sync-conflict-20260401-100237-ABCDEFG.nc", "0001 (1).nc", "0001 - Copy.nc",
        "0001_conflict-20260401.nc", "1.nc", "0001-LAPTOP.nc", "00\u0661\u0662.nc",
    ],
)  # fmt: skip
def test_copies_of_sync_programs_are_left_out_with_a_warning(tmp_path, copy):
    told = [
        Mission.from_arrays([(2, 0), (1, 1)], np.ones((1, 2, 3)), np.full((1, 2), rate))
        for rate in (0.25, 0.5)
    ]
    for name, mission in (("0001.nc", told[0]), ("10000.nc", told[1]), (copy, told[1])):
        write_missions(tmp_path / "missions" / name, [mission])
    (tmp_path / "missions/.tmp-12ab.nc").touch()

    with pytest.warns(UserWarning, match="left out") as warned:
        assert_same_missions(read_missions(tmp_path), told)
    assert len(warned) == 1
    assert copy in str(warned[0].message)
    assert_same_missions(read_missions(tmp_path / "missions" / copy), told[1:])
