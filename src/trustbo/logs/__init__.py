"""Missions in files: netCDF, tables and ROS bags (README.md: which file holds what)."""

from trustbo.logs.bag import read_bag, write_bag
from trustbo.logs.messages import Topics
from trustbo.logs.netcdf import STATES, read_missions, write_missions
from trustbo.logs.table import read_table, write_table

__all__ = [
    "STATES",
    "Topics",
    "read_bag",
    "read_missions",
    "read_table",
    "write_bag",
    "write_missions",
    "write_table",
]
__dir__ = __all__.copy  # completion lists public names alone
