"""ROS 2 node that passes contact, markers and statuses to `trustbo live FOLDER --udp 8738`.

Run it where ROS 2 is; trustbo need not be installed there:
    python3 trustbo_live.py --ros-args -p robots:="['r1', 'r2']" -p udp:=8738
With `-p token:=TOKEN`, the token that `trustbo live` printed, the plan is published on
/mission/plan in CRS metres, and datagrams may go to another machine, `-p host:=10.0.0.7`.
"""

import json
import socket
import urllib.request

TYPES = {"contact": "std_msgs/msg/Bool", "bound": "std_msgs/msg/String",
         "status": "std_msgs/msg/String", "plan": "nav_msgs/msg/Path"}  # fmt: skip


def line_of(kind, robot, message, t, token=""):
    """Line of JSON for a message of a topic."""
    if kind == "contact":
        record = {"contact": {robot: bool(message.data)}}
    elif kind == "bound":  # JSON with bound and cell, as in bags
        record = json.loads(message.data)
    else:
        record = {"status": message.data}
    return json.dumps(record | {"t": t} | ({"token": token} if token else {})).encode()


def fill_plan(path, plan, new_pose):
    """Fill a nav_msgs/Path with the positions of a plan, see GET /api/plan."""
    path.header.frame_id = "map"
    for x, y in plan["positions"]:
        pose = new_pose()
        pose.header.frame_id = "map"
        pose.pose.position.x, pose.pose.position.y, pose.pose.orientation.w = x, y, 1.0
        path.poses.append(pose)
    return path


def main() -> None:
    """Subscribe, and pass messages on until the node is stopped."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.msg import Path
    from std_msgs.msg import Bool, String

    rclpy.init()
    node = rclpy.create_node("trustbo_live")
    defaults = {
        "robots": ["r1", "r2", "r3"],
        "host": "127.0.0.1",
        "udp": 8738,
        "http": 8737,
        "token": "",
    }
    of = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
    sender = socket.socket(type=socket.SOCK_DGRAM)

    def send(kind, robot, message):
        t = node.get_clock().now().nanoseconds / 1e9
        sender.sendto(line_of(kind, robot, message, t, of["token"]), (of["host"], of["udp"]))

    for robot in of["robots"]:
        node.create_subscription(
            Bool, f"/{robot}/contact", lambda m, r=robot: send("contact", r, m), 10
        )
    for kind in ("bound", "status"):
        node.create_subscription(String, f"/mission/{kind}", lambda m, k=kind: send(k, "", m), 10)
    publisher = node.create_publisher(Path, "/mission/plan", 1)

    def publish():
        head = {"Authorization": f"Bearer {of['token']}"}
        url = f"http://{of['host']}:{of['http']}/api/plan"
        try:
            with urllib.request.urlopen(
                urllib.request.Request(url, headers=head), timeout=5
            ) as got:
                publisher.publish(fill_plan(Path(), json.load(got), PoseStamped))
        except OSError as error:
            node.get_logger().warning(f"no plan: {error}")

    if of["token"]:
        node.create_timer(5.0, publish)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
