"""Missions of each robot as .plan files of QGroundControl."""

import math
import warnings
from pathlib import Path

from trustbo.campaign.result import Result
from trustbo.errors import require_choice
from trustbo.export.checks import LEAD, require_crs
from trustbo.export.layers import degrees_of, plan_of
from trustbo.export.schedule import Stand, schedule_of
from trustbo.files import FilePath, require_file, to_json, write_text
from trustbo.planning import Plan

_AUTOPILOTS = {"px4": 12, "ardupilot": 3}
"""Numbers of MAV_AUTOPILOT."""
_ROVER, _WAYPOINT, _RELATIVE = 10, 16, 3
"""MAV_TYPE_GROUND_ROVER, MAV_CMD_NAV_WAYPOINT, MAV_FRAME_GLOBAL_RELATIVE_ALT."""


def write_qgc(
    path: FilePath, plan: Plan | Result, *, robot: str = LEAD, autopilot: str = "px4"
) -> None:
    """Write the ways and stops of a robot as a .plan of QGroundControl, one file for each robot.

    Waypoints are the stops and the bends of its ways. Robots cannot wait for each other in this
    format: at each stop a robot holds as long as the others should need, in whole seconds. A
    warning is given.

    Args:
        path: .plan file to write, or to replace.
        plan: Plan, or result whose recommended path is meant, on a terrain in memory.
        robot: Name of a robot of T2, or `"lead"`.
        autopilot: `"px4"` or `"ardupilot"`.

    Raises:
        TrustboError: An unknown robot or autopilot; no CRS or no terrain in memory; a robot that
            has no way in a bound; or the file cannot be written.
    """
    target = require_file(path, ".plan")
    plan = plan_of(plan)
    require_choice("robot", robot, (LEAD, *plan.workspace.team.names))
    firmware = _AUTOPILOTS[require_choice("autopilot", autopilot, _AUTOPILOTS)]
    require_crs(plan.workspace)
    save_qgc(target, plan, robot, firmware)
    warn_of_holds(target.name)


def warn_of_holds(file: str) -> None:
    """Warn that robots do not wait for each other by a file."""
    warnings.warn(
        f"robots hold at the stops of {file} for the planned times, and do not wait for each "
        "other: have an operator see that they keep to them.",
        stacklevel=3,
    )


def save_qgc(target: Path, plan: Plan, robot: str, firmware: int = _AUTOPILOTS["px4"]) -> None:
    """Write a mission without the warning; see `write_qgc`."""
    team, stands = plan.workspace.team, schedule_of(plan).robots[robot]
    speed = (team.lead if robot == LEAD else team.robots[team.names.index(robot)]).speed
    items = _items(plan, stands)
    mission = {
        "version": 2, "firmwareType": firmware, "vehicleType": _ROVER, "cruiseSpeed": speed,
        "hoverSpeed": speed, "globalPlanAltitudeMode": 1,
        "plannedHomePosition": [*items[0]["params"][4:6], 0.0], "items": items,
    }  # fmt: skip
    record = {
        "fileType": "Plan", "version": 1, "groundStation": "QGroundControl",
        "geoFence": {"version": 2, "circles": [], "polygons": []},
        "rallyPoints": {"version": 2, "points": []},
        "mission": mission,
    }  # fmt: skip
    write_text(target, to_json(record))


def _items(plan: Plan, stands: list[Stand]) -> list[dict]:
    """Waypoints: bends of the ways without a hold, and stops with the time of theirs."""
    items = []
    for k, stand in enumerate(stands):
        points = stand.way if k == 0 else stand.way[1:]
        for n, (lon, lat) in enumerate(degrees_of(plan.workspace, points).tolist(), start=1):
            hold = math.ceil(stand.hold) if n == len(points) and stand.bound else 0
            items.append(
                {
                    "type": "SimpleItem", "command": _WAYPOINT, "frame": _RELATIVE,
                    "doJumpId": len(items) + 1, "autoContinue": True,
                    "AMSLAltAboveTerrain": None, "Altitude": 0, "AltitudeMode": 1,
                    "params": [hold, 0, 0, None, round(lat, 8), round(lon, 8), 0],
                }
            )  # fmt: skip
    return items
