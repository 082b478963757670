"""Missions in files: netCDF, tables and ROS bags (README.md: which file holds what)."""

from trustbo.logs.bag import read_bag, write_bag
from trustbo.logs.messages import Topics
from trustbo.logs.netcdf import read_missions, write_missions
from trustbo.logs.table import read_table, write_table
from trustbo.renamed import moved

__all__ = [
    "Topics", "read_bag", "read_missions", "read_table", "write_bag", "write_missions",
    "write_table",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
__getattr__ = moved(__name__, {"trustbo.logs.netcdf": ["STATES"]})  # name of version 0.2
