"""Files for Nav2 in addition to the route graph: waypoints of robots, and filters of costmaps."""

import math
from pathlib import Path

import numpy as np
import yaml

from trustbo.campaign.result import Result
from trustbo.errors import TrustboError, require_choice, require_not_negative
from trustbo.export.checks import LEAD
from trustbo.export.frame import AT_START, Frame, PlacedFrame, frame_file, placed, save_beside
from trustbo.export.layers import plan_of
from trustbo.export.poses import onward, towards
from trustbo.export.schedule import complete_routes
from trustbo.files import FilePath, require_file, write_text
from trustbo.planning import Plan


def write_waypoints(
    path: FilePath,
    plan: Plan | Result,
    *,
    robot: str = LEAD,
    frame: Frame | PlacedFrame = AT_START,
) -> None:
    """Write the stops of a robot in order as a goal of the action FollowWaypoints of Nav2.

    They are the lead's stops, each towards the next; of another robot its posts, each towards the
    lead's next stop, then its place at the goal. No robot waits for the others by the file: send T2
    on when the lead has stopped, and the lead when T2 has. A file of the frame is written as by
    `write_ros_map`.

    Args:
        path: .yaml or .yml file to write, or to replace.
        plan: Plan, or result whose recommended path is meant, on a terrain in memory.
        robot: Name of a robot of T2, or `"lead"`.
        frame: Frame, by default at the start of the path.

    Raises:
        TrustboError: An unknown robot; one that has no way in a bound; no terrain in memory; or an
            argument is refused by `write_ros_map`.
    """
    target = require_file(path, ".yaml", ".yml")
    frame_file(target)
    plan = plan_of(plan)
    require_choice("robot", robot, (LEAD, *plan.workspace.team.names))
    place = placed(frame, plan.workspace, plan.path[0])
    poses = [
        {
            "header": {"frame_id": place.name},
            "pose": {
                "position": {"x": x, "y": y, "z": 0.0},
                "orientation": {
                    "x": 0.0, "y": 0.0, "z": math.sin(0.5 * turn), "w": math.cos(0.5 * turn)
                },
            },
        }
        for x, y, turn in stops_of(plan, robot, place).tolist()
    ]  # fmt: skip
    about = (
        "# Goal of the action FollowWaypoints of Nav2:\n"
        "#   ros2 action send_goal /follow_waypoints nav2_msgs/action/FollowWaypoints "
        f'"$(cat {target.name})"\n'
        "# It does not have the robot wait for the others.\n"
    )
    write_text(target, about + yaml.safe_dump({"poses": poses}, sort_keys=False))
    save_beside(target, frame, place, plan.workspace)


def stops_of(plan: Plan, robot: str, place: PlacedFrame) -> np.ndarray:
    """Poses of a robot's stops in a frame, (stop, 3); TrustboError: it has no way in a bound."""
    ways = complete_routes(plan)[robot]
    assert plan.stops is not None and plan.posts is not None  # noqa: S101, PT018  # it has ways
    of_lead = place.of_crs(plan.stops)
    if robot == LEAD:
        return onward(of_lead)
    posts = place.of_crs(plan.posts[:, plan.workspace.team.names.index(robot)])
    stops = np.vstack([posts, place.of_crs(ways[-1][-1:])])
    watched = np.vstack([of_lead[1:], of_lead[-1:]])
    return towards(stops, watched - stops)


def write_costmap_filters(path: FilePath, *, slowest: float = 0.5, frame: Frame = AT_START) -> None:
    """Write parameters of nodes by which costmaps of Nav2 heed a map of `write_ros_map`.

    The map is the mask of both filters. Keepout: impassable cells are closed, and those of a high
    cost are avoided. Speed: from full speed where the cost is 0 down to `slowest` at 1, in percent
    of the robot's.

    Args:
        path: .yaml or .yml file of the map; the parameters are written to a file in its folder with
            the suffix _filters.yaml.
        slowest: Share of its speed that a robot keeps where the cost is 1, in (0, 1].
        frame: Frame of the map, of which the name is written.

    Raises:
        TrustboError: A share outside (0, 1], or the file cannot be written.
    """
    target = require_file(path, ".yaml", ".yml")
    share = require_not_negative("slowest", slowest)
    if not 0.0 < share <= 1.0:
        raise TrustboError(f"slowest must be a share in (0, 1]; got {slowest!r}.")
    nodes, plugins = {}, []
    for name, kind, base, step in (
        ("keepout", 0, 0.0, 1.0),
        ("speed", 1, 100.0, share - 1.0),  # percent; the mask is 0 to 100
    ):
        mask, info = f"/{name}_filter_mask", f"/{name}_costmap_filter_info"
        nodes[f"{name}_filter_mask_server"] = {
            "yaml_filename": target.name, "topic_name": mask, "frame_id": frame.name
        }  # fmt: skip
        nodes[f"{name}_costmap_filter_info_server"] = {
            "type": kind, "filter_info_topic": info, "mask_topic": mask, "base": base,
            "multiplier": step,
        }  # fmt: skip
        plugin = f"nav2_costmap_2d::{name.capitalize()}Filter"
        plugins.append(f"#   {name}_filter: {{plugin: {plugin}, filter_info_topic: {info}}}\n")
    about = (
        "# Filters of costmaps of Nav2; give yaml_filename as a path on the robot. Servers are\n"
        "# map_server and costmap_filter_info_server of nav2_map_server, lifecycle nodes by these\n"
        "# names; a costmap has filters: [keepout_filter, speed_filter]\n"
    )
    record = {name: {"ros__parameters": values} for name, values in nodes.items()}
    text = yaml.safe_dump(record, sort_keys=False)
    write_text(filters_file(target), about + "".join(plugins) + text)


def filters_file(path: Path) -> Path:
    """Return the file with the filters of costmaps by a map, in the same folder."""
    return require_file(path.with_name(f"{path.stem}_filters.yaml"))
