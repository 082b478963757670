"""ROS 2 node that follows missions and passes each completed mission to a campaign.

The node needs ROS 2 (rclpy, std_msgs) and trustbo in the same Python. First create a campaign with
a folder, `trustbo.Campaign(workspace, start, goal, directory="out/field")`. Then start the node:

    python3 ros2_node.py --ros-args -p folder:=out/field

The node subscribes to these topics, which `trustbo.logs.read_bag` can also read from bags:

    /<robot>/contact  std_msgs/Bool    whether the robot has contact with the lead, at each tick
    /mission/bound    std_msgs/String  {"bound": 2, "cell": [8, 1]} when bound 2 begins
    /mission/status   std_msgs/String  ok, stuck, ... when a bound ends; aborted, also between
                                       bounds, ends the mission

A status that arrives up to 1 s after the marker of the next bound still belongs to the bound before
if this bound had no status; as in `read_bag`, unless it is a failure and a robot has already sent
its contact twice. After the marker of a bound that follows a bound without a status, messages are
therefore processed with a delay of 1 s.

If a bound fails and the lead can still move, the node plans the rest of the mission again. The new
path first leads back to the previous cell; the way back is a bound with its own messages.

After each of these messages, the node publishes:

    /mission/trust    std_msgs/Float64MultiArray  trust in each robot: all means, then all sds
    /mission/path     std_msgs/String             cells of the whole mission as JSON, including
                                                  those that were driven
"""

import json

import numpy as np

import trustbo as tb

REPLANNED = set(tb.hazard.CAUSES) - {"tipped"}
"""Statuses after which the rest of the mission is planned again; a lead that tipped cannot move."""
LATE = 1.0
"""Time after a marker in which the status of the bound before may arrive, s."""


def take(follower, robots, topic, data, t, held):
    """Pass a message to a follower, and return whether the mission is over.

    The list `held` stores the marker that follows a bound without a status, and the messages after
    it, until the status of this bound arrives or is late. A new mission needs a new list.
    """
    if not held:
        if topic == "bound" and follower.running:
            held.append((topic, data, t))
            return False
        return process(follower, robots, topic, data, t)

    _, _, begin = held[0]
    is_late = t - begin > LATE
    if topic in robots and not is_late:
        held.append((topic, data, t))
        return False

    waiting = [*held]
    held.clear()
    senders = [sender for sender, _, _ in waiting[1:]]
    repeats = len(set(senders)) < len(senders)
    if topic == "status" and not is_late and (data == "ok" or not repeats):
        waiting.insert(0, (topic, data, begin))
        return any(process(follower, robots, *message) for message in waiting)

    for message in waiting:
        process(follower, robots, *message)
    return take(follower, robots, topic, data, t, held)


def process(follower, robots, topic, data, t):
    """Pass a message to a follower without delay, and return whether the mission is over.

    The topic is "bound", "status", or the name of a robot (its contact). Contact between bounds is
    ignored. A bound that is still in progress when the next bound begins ends with status ok.
    """
    if topic == "bound":
        marker = json.loads(data)
        if follower.running:
            follower.end(t)
        if marker["bound"] > 0:  # bound 0 is the start
            follower.begin(t, marker.get("cell"))
    elif topic == "status" and data == "aborted" and not follower.running:
        return True
    elif topic == "status":
        follower.end(t, data)
        if data in REPLANNED:
            return not replan(follower)
        return data != "ok" or len(follower.rest) == 1
    elif follower.running:
        follower.tick(t, np.where(np.array(robots) == topic, float(data), np.nan))
    return False


def replan(follower):
    """Plan the rest of the mission again, and return whether the goal can still be reached."""
    try:
        follower.replan()
    except tb.NoPathError:
        return False
    return True


def main():
    """Follow missions, one after the other, until the node is stopped."""
    import rclpy
    from std_msgs.msg import Bool, Float64MultiArray, String

    rclpy.init()
    node = rclpy.create_node("trustbo")
    campaign = tb.Campaign.load(node.declare_parameter("folder", "out/field").value)
    follower, robots = tb.Follower(campaign), campaign.workspace.team.names
    held = []
    trust = node.create_publisher(Float64MultiArray, "/mission/trust", 10)
    path = node.create_publisher(String, "/mission/path", 10)

    def on(topic, message):
        nonlocal follower
        t = node.get_clock().now().nanoseconds / 1e9
        try:
            if take(follower, robots, topic, message.data, t, held):
                campaign.tell(follower.to_mission())  # may take seconds
                follower = tb.Follower(campaign)
                held.clear()
        except (tb.TrustboError, ValueError, KeyError) as error:
            node.get_logger().warning(f"{topic}: {error}")
        trust.publish(Float64MultiArray(data=[float(x) for x in np.ravel(follower.trust)]))
        path.publish(String(data=json.dumps(follower.path)))

    for name, kind in (("bound", String), ("status", String)):
        node.create_subscription(kind, f"/mission/{name}", lambda m, n=name: on(n, m), 10)
    for name in robots:
        node.create_subscription(Bool, f"/{name}/contact", lambda m, n=name: on(n, m), 10)
    with campaign:
        rclpy.spin(node)


if __name__ == "__main__":
    main()
