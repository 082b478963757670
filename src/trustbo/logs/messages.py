"""ROS messages of standard types: topics and readers."""

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trustbo.errors import TrustboError, require_pair, require_whole

TEXT = "std_msgs/msg/String"
FLAG = "std_msgs/msg/Bool"
NUMBERS = "std_msgs/msg/Float64MultiArray"
POSE = "geometry_msgs/msg/PoseStamped"

MARKER_TYPES = (TEXT, "std_msgs/msg/Int32MultiArray")
STATUS_TYPES = (TEXT,)
CONTACT_TYPES = (FLAG, "std_msgs/msg/Float32", "std_msgs/msg/Float64")
AWARENESS_TYPES = (NUMBERS, "std_msgs/msg/Float32MultiArray")
POSE_TYPES = ("nav_msgs/msg/Odometry", POSE, "geometry_msgs/msg/PoseWithCovarianceStamped")


@dataclass(frozen=True)
class Topics:
    """Names of topics; `{robot}` stands for the name of a robot, or of the lead.

    Attributes:
        bound: Markers of the starts of bounds.
        status: Statuses of bounds and missions.
        contact: Contact of each robot.
        awareness: Awareness of each robot.
        pose: Pose of each robot and the lead.
        state: State of each robot.
        lead: Name of the lead.
        seen: Names of the robots that each robot sees, in logs of detections.

    Raises:
        TrustboError: A topic of each robot without `{robot}`.
    """

    bound: str = "/mission/bound"
    status: str = "/mission/status"
    contact: str = "/{robot}/contact"
    awareness: str = "/{robot}/awareness"
    pose: str = "/{robot}/odom"
    lead: str = "lead"
    state: str = "/{robot}/state"
    seen: str = "/{robot}/seen"

    def __post_init__(self) -> None:
        for name in ("contact", "awareness", "pose", "state", "seen"):
            if getattr(self, name).count("{robot}") != 1:
                raise TrustboError(
                    f"Topics.{name} must name the robot's place, e.g. '/{{robot}}/{name}'; got "
                    f"{getattr(self, name)!r}."
                )

    def of(self, kind: str, robots: Sequence[str]) -> list[str]:
        """Topics of one kind, e.g. "contact", of several robots."""
        return [getattr(self, kind).replace("{robot}", robot) for robot in robots]


def require_topic_names(lead: str, robots: Sequence[str]) -> None:
    """Refuse names of the lead and the robots that topics cannot hold: TrustboError."""
    for robot in (lead, *robots):
        if not re.fullmatch("[A-Za-z][A-Za-z0-9_]*", robot):
            raise TrustboError(
                f"robot {robot!r} cannot be in a topic: take a letter, then letters, digits, _."
            )
    if lead in robots:
        raise TrustboError(f"a robot is called as the lead, {lead!r}; see Topics.lead.")


def read_marker(message: Any) -> dict[str, Any]:
    """Read a marker: `bound`, `cell`, and `path`, `robots`, `features`, empty if not given.

    TrustboError: neither JSON with a bound and a cell, nor [bound, row, col].
    """
    try:
        if isinstance(message.data, str):
            content = json.loads(message.data)
        else:
            bound, *cell = message.data.tolist()
            content = {"bound": bound, "cell": cell}
        return {
            "bound": require_whole("bound", content["bound"], 0),
            "cell": require_pair("cell", content["cell"]),
            "path": tuple(require_pair("path", cell) for cell in content.get("path", ())),
            "robots": tuple(map(str, content.get("robots", ()))),
            "features": tuple(map(str, content.get("features", ()))),
        }
    except (AttributeError, KeyError, TypeError, ValueError):
        raise TrustboError(
            "a marker must be JSON with a bound and a cell, or [bound, row, col]; got "
            f"{message.data!r}."
        ) from None


def read_contact(message: Any) -> float:
    """Contact in [0, 1], NaN if it was not measured; TrustboError for other numbers."""
    value = float(message.data)
    if not (0.0 <= value <= 1.0 or math.isnan(value)):
        raise TrustboError(
            f"contact {value:g} is outside [0, 1]; publish a Bool, divide percentages by 100, and "
            "write NaN for a look that failed."
        )
    return value


def read_numbers(message: Any) -> tuple[tuple[str, ...], np.ndarray]:
    """Read the names, if any, and values of a vector; TrustboError if their numbers differ."""
    values = np.asarray(message.data, dtype=float)
    label = message.layout.dim[0].label if len(message.layout.dim) else ""
    names = tuple(name.strip() for name in label.split(",")) if label.strip() else ()
    if names and len(names) != len(values):
        raise TrustboError(f"it has {len(values)} values named {label!r}.")
    return names, values


def read_pose(message: Any) -> np.ndarray:
    """Position x and y, and heading in rad from the x axis, in [-pi, pi]; shape (3,)."""
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    p, q = pose.position, pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))
    return np.array([p.x, p.y, yaw])


def stamp_of(message: Any) -> int:
    """Time in the header of a message, ns."""
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


READERS: dict[tuple[str, ...], Callable[[Any], Any]] = {
    MARKER_TYPES: read_marker,
    STATUS_TYPES: lambda message: str(message.data),
    CONTACT_TYPES: read_contact,
    AWARENESS_TYPES: read_numbers,
    POSE_TYPES: read_pose,
}
"""Readers of messages by their types."""
