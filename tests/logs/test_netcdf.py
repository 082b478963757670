"""Missions as trees: files of version 0.1 are still read."""

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.logs.netcdf import missions_from_tree, missions_to_tree, read_tree


def test_the_variable_exposure_of_version_0_1_is_read_as_n_ticks(tmp_path):
    n_ticks = np.array([[7, 7], [3, 3]])
    path = [(2, 0), (1, 1), (0, 2)]
    mission = Mission.from_arrays(path, np.full((2, 2, 1), 0.5), 1.0 / n_ticks, n_ticks=n_ticks)
    tree = missions_to_tree([mission])
    table = tree["missions"].to_dataset().rename(n_ticks="exposure")
    old = xr.DataTree.from_dict({"missions": table, "ticks": tree["ticks"].to_dataset()})
    old.to_netcdf(tmp_path / "missions.nc")
    (read,) = missions_from_tree(read_tree(tmp_path / "missions.nc"))
    np.testing.assert_array_equal(read.n_ticks, n_ticks)
    np.testing.assert_array_equal(read.contact_rate, mission.contact_rate)
