"""A node of dora-rs' ROS 2 bridge, an implementation of rmw_zenoh's format in Rust that others wrote. Not of the suite.

``python -m tests.e2e.measured.dora_node ENDPOINT FOLDER`` runs in an environment of its own (dora-rs 1.1.0, pyarrow,
rosbags): writes types to FOLDER, listens to three robots, drives them by Twist, then by TwistStamped, calls a service
of each, drives on, and ends while it does. What came is printed as one JSON object a line; monotonic seconds. It
imports nothing of zbridge. Each topic has a thread of its own. :mod:`tests.e2e.measured.dora_ros2` starts and judges
it.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import dora
import pyarrow as pa
import rosbags.typesys.store as stores
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.e2e.rigs.lines import Lines

LISTENED = {
    "/alf/scan": ("sensor_msgs/LaserScan", False),
    "/alf/odom": ("nav_msgs/Odometry", True),
    "/alf/imu": ("sensor_msgs/Imu", False),
    "/tcpudp/odom": ("nav_msgs/Odometry", True),
    "/tcpudp/pose": ("geometry_msgs/PoseStamped", True),
    "/wc2ec/scan": ("sensor_msgs/LaserScan", False),
    "/wc2ec/range/ds0": ("sensor_msgs/Range", False),
    "/tf": ("tf2_msgs/TFMessage", True),
}
"""Topics, their types, and whether they are reliable."""
KEPT = {
    "/tcpudp/map": "nav_msgs/OccupancyGrid",
    "/alf/robot_description": "std_msgs/String",
    "/tf_static": "tf2_msgs/TFMessage",
}
"""Topics whose last message was there before this node, and must come to it."""
ROBOTS = {"tcpudp": 0.0, "alf": 0.5, "wc2ec": 0.5}
"""The robots, and the turn rate of their curve in rad/s: the first one turns or moves, not both at once."""
FORWARD_MPS, EVERY_S, ZERO_S, MOVING_S, PAUSE_S = 0.25, 0.05, 1.2, 3.0, 1.3
SERVICES = {"std_srvs/srv/Trigger": ("", "bool success\nstring message")}
PACKAGES = {"sensor_msgs", "nav_msgs", "tf2_msgs", "geometry_msgs", "std_msgs", "builtin_interfaces"}


say = Lines(sys.stdout)


# Types


class Descriptions:
    """Writes definitions of types, and their descriptions as REP 2016 has them: what rosbags hashes."""

    def __init__(self, folder: Path) -> None:
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._folder = folder

    def write(self) -> None:
        """Write all that the node needs."""
        for name in list(self._store.types):
            if name.partition("/")[0] in PACKAGES:
                text = self._store.generate_msgdef(name, ros_version=2)[0].partition("=" * 80)[0]
                self._write(name, text)
        for name, (request, response) in SERVICES.items():
            self._add_service(name, request, response)
            self._write(name, f"{request}\n---\n{response}\n")

    def _add_service(self, service: str, request: str, response: str) -> None:
        """Add what REP 2011 makes the hash of a service of: its request, response and event."""
        store, number, info = self._store, (Nodetype.BASE, ("uint8", 0)), "service_msgs/msg/ServiceEventInfo"
        parts = {"request": (f"{service}_Request", request), "response": (f"{service}_Response", response)}
        for name, text in parts.values():
            (parsed,) = get_types_from_msg(text or "uint8 structure_needs_at_least_one_member", name).values()
            store.register({name: parsed})
        store.fielddefs[info] = (
            [],
            [
                ("event_type", number),
                ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time")),
                ("client_gid", (Nodetype.ARRAY, (number, 16))),
                ("sequence_number", (Nodetype.BASE, ("int64", 0))),
            ],
        )
        lists = [(part, (Nodetype.SEQUENCE, ((Nodetype.NAME, name), 1))) for part, (name, _) in parts.items()]
        store.fielddefs[f"{service}_Event"] = ([], [("info", (Nodetype.NAME, info)), *lists])
        whole = {**{part: name for part, (name, _) in parts.items()}, "event": f"{service}_Event"}
        store.fielddefs[service] = ([], [(f"{part}_message", (Nodetype.NAME, name)) for part, name in whole.items()])

    def _write(self, name: str, text: str) -> None:
        package, kind, short = name.split("/")
        place = self._folder / "share" / package / kind
        place.mkdir(parents=True, exist_ok=True)
        manifest = f'<package format="3"><name>{package}</name><version>1.0.0</version></package>'
        (place.parent / "package.xml").write_text(manifest)
        (place / f"{short}.{kind}").write_text(text)
        (place / f"{short}.json").write_text(json.dumps(self._described(name)))

    def _described(self, name: str) -> dict[str, Any]:
        seen: list[dict[str, Any]] = []
        real = stores.json.dumps

        def dumps(value: Any, **more: Any) -> str:
            seen.append(value)
            return real(value, **more)

        stores.json.dumps = dumps  # type: ignore[assignment]
        hashes = [{"type_name": name, "hash_string": self._store.hash_rihs01(name)}]
        described = seen[0]
        for inner in described["referenced_type_descriptions"]:
            text = self._store.hash_rihs01(inner["type_name"])
            hashes.append({"type_name": inner["type_name"], "hash_string": text})
        stores.json.dumps = real  # type: ignore[assignment]
        for part in (described["type_description"], *described["referenced_type_descriptions"]):
            for field in part["fields"]:
                field["default_value"] = ""
        return {"type_description_msg": described, "type_hashes": hashes}


# The node


class Judge:
    """Listens and drives."""

    def __init__(self, endpoint: str, folder: Path) -> None:
        config = folder / "zenoh.json5"
        multicast = {"multicast": {"enabled": False}}
        config.write_text(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": multicast}))
        os.environ["AMENT_PREFIX_PATH"] = str(folder)  # where descriptions are looked for
        self._context = dora.Ros2Context([str(folder)], dora.Ros2Transport.zenoh("rep2016", str(config)), 0)
        self._node = self._context.new_node("dora", "/judge", dora.Ros2NodeOptions(rosout=False))
        self._joined = time.time()
        self.counts = dict.fromkeys((*LISTENED, *KEPT), 0)
        self._publishers = {(robot, kind): self._publisher(robot, kind) for robot in ROBOTS for kind in TWISTS}

    def _topic(self, name: str, kind: str, *, reliable: bool = True, kept: bool = False) -> tuple[Any, Any]:
        durability = dora.Ros2Durability.TransientLocal if kept else dora.Ros2Durability.Volatile
        qos = dora.Ros2QosPolicies(reliable=reliable, durability=durability, keep_last=1 if kept else 10)
        return self._node.create_topic(name, kind, qos), qos

    def _publisher(self, robot: str, kind: str) -> Any:
        return self._node.create_publisher(*self._topic(f"/{robot}/cmd_vel", kind))

    def listen(self) -> None:
        """Subscribe to everything, each on a thread of its own."""
        for name, (kind, reliable) in LISTENED.items():
            self._start(name, *self._topic(name, kind, reliable=reliable))
        for name, kind in KEPT.items():
            self._start(name, *self._topic(name, kind, kept=True))

    def _start(self, name: str, topic: Any, qos: Any) -> None:
        subscription = self._node.create_subscription(topic, qos)
        threading.Thread(target=self._take, args=(name, subscription), daemon=True).start()

    def _take(self, name: str, subscription: Any) -> None:
        while True:
            message = subscription.next()
            if message is None:
                time.sleep(0.005)
                continue
            if not self.counts[name]:
                self._first(name, message.to_pylist()[0])
            self.counts[name] += 1

    def _first(self, name: str, message: dict[str, Any]) -> None:
        """Show a first message, when it came, and how old it was when this node joined; seconds."""
        stamped = message if "header" in message else (message.get("transforms") or [{}])[0]
        stamp = stamped.get("header", {}).get("stamp")
        age_s = self._joined - stamp["sec"] - stamp["nanosec"] / 1e9 if stamp else None
        say(first=name, after_s=time.time() - self._joined, age_s=age_s, text=str(message)[:200])

    def drive(self, kind: str, seconds: float, *, moving: bool) -> None:
        """Publish at 20 Hz on each cmd_vel."""
        begun = time.monotonic()
        while time.monotonic() < begun + seconds:
            for robot, turn_radps in ROBOTS.items():
                twist = twist_of(FORWARD_MPS, turn_radps) if moving else twist_of(0.0, 0.0)
                message = twist if kind == TWISTS[0] else {"header": {"stamp": STAMP, "frame_id": ""}, "twist": twist}
                self._publishers[robot, kind].publish(pa.array([message]))
            time.sleep(EVERY_S)
        if moving:
            say(drove=kind, since=begun, until=time.monotonic())

    def stop(self) -> None:
        """Call each robot's stop."""
        for robot in ROBOTS:
            begun, qos = time.monotonic(), dora.Ros2QosPolicies(reliable=True, keep_last=10)  # equal to the server's
            try:
                client = self._node.create_service_client(f"/{robot}/stop", "std_srvs/Trigger", qos)
                (answer,) = client.call(pa.array([{}]), 10.0).to_pylist()
            except RuntimeError as error:
                answer = {"success": False, "message": str(error).partition("\n")[0]}
            say(stopped=robot, since=begun, until=time.monotonic(), answer=answer)


TWISTS = ("geometry_msgs/Twist", "geometry_msgs/TwistStamped")
STAMP = {"sec": pa.scalar(0, pa.int32()), "nanosec": pa.scalar(0, pa.uint32())}


def twist_of(forward_mps: float, turn_radps: float) -> dict[str, Any]:
    """Make a Twist."""
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    return {"linear": {**zero, "x": forward_mps}, "angular": {**zero, "z": turn_radps}}


def main() -> None:
    """Listen, drive by each type, stop by the service, and end in the middle of driving."""
    endpoint, folder = sys.argv[1], Path(sys.argv[2])
    Descriptions(folder).write()
    judge = Judge(endpoint, folder)
    judge.listen()
    time.sleep(PAUSE_S)
    for kind in TWISTS:
        judge.drive(kind, ZERO_S, moving=False)
        judge.drive(kind, MOVING_S, moving=True)
        judge.stop()
        time.sleep(PAUSE_S)
    judge.drive(TWISTS[0], ZERO_S, moving=False)
    judge.drive(TWISTS[0], MOVING_S, moving=True)
    say(counts=judge.counts)
    os._exit(0)  # as a node does that crashes: nothing is taken back


if __name__ == "__main__":
    main()
