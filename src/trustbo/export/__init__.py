"""Results as files for other programs: GIS, robots, tables."""

from trustbo.export.everything import FORMATS, export_result
from trustbo.export.frame import Frame, write_frame
from trustbo.export.nav2 import write_waypoints
from trustbo.export.paths import path_frame, write_path
from trustbo.export.rasters import write_geotiff
from trustbo.export.ros import write_ros_map
from trustbo.export.route_graph import RouteGraph
from trustbo.export.route_graph_file import edge_updates, write_route_graph
from trustbo.export.tables import write_csv

__all__ = [
    "FORMATS",
    "Frame",
    "RouteGraph",
    "edge_updates",
    "export_result",
    "path_frame",
    "write_csv",
    "write_frame",
    "write_geotiff",
    "write_path",
    "write_ros_map",
    "write_route_graph",
    "write_waypoints",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
