"""Waypoints of robots for Nav2."""

import math

import numpy as np
import yaml

from trustbo.campaign.result import Result
from trustbo.errors import require_choice
from trustbo.export.checks import LEAD
from trustbo.export.frame import AT_START, Frame, PlacedFrame, frame_file, placed, save_beside
from trustbo.export.layers import complete_routes, plan_of
from trustbo.export.poses import onward, towards
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
