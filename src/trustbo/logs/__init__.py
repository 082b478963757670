"""Reading and writing of mission files, robot logs and trust reports."""

from trustbo.logs.bag import read_bag
from trustbo.logs.mapping import read_columns
from trustbo.logs.netcdf import read_missions, write_missions
from trustbo.logs.reports import read_reports
from trustbo.logs.table import read_table, to_frame
from trustbo.logs.tracks import read_tracks

__all__ = [
    "read_bag", "read_columns", "read_missions", "read_reports", "read_table", "read_tracks",
    "to_frame", "write_missions",
]  # fmt: skip
__dir__ = __all__.copy  # tab completion lists only public names
