"""ROS bags as robots write them, by rosbags alone: the reader of trustbo has no part in them."""

import json

S = 1_000_000_000  # ns


class Log:
    """A log of standard messages, in the order in which they are said."""

    def __init__(self, version=2):
        from rosbags.typesys import Stores, get_typestore

        self.version, self.messages = version, []
        self.store = get_typestore(Stores.ROS2_HUMBLE if version == 2 else Stores.ROS1_NOETIC)

    def type(self, name):
        return self.store.types[name]

    def say(self, seconds, topic, kind, **fields):
        self.messages.append((round(seconds * S), topic, kind, self.type(kind)(**fields)))

    def bound(self, seconds, k, *cell):
        self.text(seconds, "/mission/bound", json.dumps({"bound": k, "cell": cell}))

    def text(self, seconds, topic, text):
        self.say(seconds, topic, "std_msgs/msg/String", data=text)

    def contact(self, robot, *looks, kind="std_msgs/msg/Bool"):
        for seconds, value in looks:
            self.say(seconds, f"/{robot}/contact", kind, data=value)

    def save(self, path, storage="sqlite3"):
        from rosbags import rosbag1, rosbag2

        if self.version == 1:
            writer = rosbag1.Writer(path)
        else:
            plugin = rosbag2.StoragePlugin[storage.upper()]
            writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
        serialize = self.store.serialize_cdr if self.version == 2 else self.store.serialize_ros1
        topics = {}
        with writer:
            for time, topic, kind, message in self.messages:
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(topics[topic], time, serialize(message, kind))
        return path


def record(missions, path, *, storage="sqlite3", names=None):
    """Write what robots publish on missions; `names` has other topics. Missions are 1 s apart."""
    log, now = Log(1 if path.suffix == ".bag" else 2), S
    for mission in missions:
        start = end = now
        cells = [[int(row), int(col)] for row, col in mission.path]
        plan = {"path": cells, "robots": mission.robots, "features": mission.features}
        log.text(start / S, "/mission/bound", json.dumps({"bound": 0, "cell": cells[0], **plan}))
        for k, bound in enumerate(mission.bounds, start=1):
            begin, end = max(end, start + round(bound.t0 * S)), start + round(bound.t1 * S)
            marker = {"bound": k, "cell": cells[k]}
            log.text(begin / S, "/mission/bound", json.dumps(marker))
            for tick in range(len(bound.contact)):
                time = (begin + (end - begin) * (tick + 1) // len(bound.contact)) / S
                for robot, seen in zip(mission.robots, bound.contact[tick].tolist(), strict=True):
                    log.contact(robot, (time, seen))
            log.text(end / S, "/mission/status", bound.status)
        if mission.status != mission.bounds[-1].status:
            log.text((end + 1) / S, "/mission/status", mission.status)
        now = end + S
    log.messages = [(time, (names or {}).get(on, on), *rest) for time, on, *rest in log.messages]
    return log.save(path, storage)
