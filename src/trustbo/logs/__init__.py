"""Missions in files, and logs of robots as missions (README.md: which file holds what)."""

from trustbo.logs.bag import read_bag
from trustbo.logs.geometry import geometry
from trustbo.logs.log import Log, read_log
from trustbo.logs.messages import Topics
from trustbo.logs.mrclam import read_mrclam
from trustbo.logs.netcdf import read_missions, write_missions
from trustbo.logs.reports import read_reports
from trustbo.logs.sensor import Sensor, fit_sensor
from trustbo.logs.synthetic import synthetic_log
from trustbo.logs.table import read_table, to_frame
from trustbo.logs.windows import join_missions, missions_of

__all__ = [
    "Log", "Sensor", "Topics", "fit_sensor", "geometry", "join_missions", "missions_of",
    "read_bag", "read_log", "read_missions", "read_mrclam", "read_reports", "read_table",
    "synthetic_log", "to_frame", "write_missions",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
