"""A node of dora-rs' ROS 2 bridge, an implementation of rmw_zenoh's format in Rust that others wrote. Not of the suite.

``python -m tests.e2e.dora_node ENDPOINT FOLDER`` runs in an environment of its own (dora-rs 1.1.0, pyarrow, rosbags):
writes types to FOLDER, listens to /r1/scan, /r1/odom, /tf and, late, to /r1/map, and publishes Twists on /r1/cmd_vel.
Prints what came, and imports nothing of zbridge. :mod:`tests.e2e.dora_ros2` starts it.
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
from rosbags.typesys import Stores, get_typestore

LISTENED = {
    "/r1/scan": ("sensor_msgs/LaserScan", False),
    "/r1/odom": ("nav_msgs/Odometry", True),
    "/tf": ("tf2_msgs/TFMessage", True),
    "/r1/map": ("nav_msgs/OccupancyGrid", True),
}
TWISTS, EVERY_S = 100, 0.05


def write_types(folder: Path) -> None:
    """Write each type's definition, and its description as REP 2016 has it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    described: list[dict[str, Any]] = []
    real = stores.json.dumps

    def dumps(value: Any, **more: Any) -> str:
        described.append(value)
        return real(value, **more)

    stores.json.dumps = dumps  # type: ignore[assignment]
    for name in store.types:
        package, _, short = name.split("/")
        if package not in PACKAGES:
            continue
        described.clear()
        hashes = [{"type_name": name, "hash_string": store.hash_rihs01(name)}]
        (description,) = described
        for inner in description["referenced_type_descriptions"]:
            text = store.hash_rihs01(inner["type_name"])
            hashes.append({"type_name": inner["type_name"], "hash_string": text})
        for part in (description["type_description"], *description["referenced_type_descriptions"]):
            for field in part["fields"]:
                field["default_value"] = ""
        place = folder / "share" / package / "msg"
        place.mkdir(parents=True, exist_ok=True)
        manifest = f'<package format="3"><name>{package}</name><version>1.0.0</version></package>'
        (place.parent / "package.xml").write_text(manifest)
        (place / f"{short}.msg").write_text(store.generate_msgdef(name, ros_version=2)[0].partition("=" * 80)[0])
        (place / f"{short}.json").write_text(real({"type_description_msg": description, "type_hashes": hashes}))
    stores.json.dumps = real  # type: ignore[assignment]


PACKAGES = {"sensor_msgs", "nav_msgs", "tf2_msgs", "geometry_msgs", "std_msgs", "builtin_interfaces"}


def main() -> None:
    """Listen and drive."""
    endpoint, folder = sys.argv[1], Path(sys.argv[2])
    write_types(folder)
    config = folder / "zenoh.json5"
    connected = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    config.write_text(json.dumps(connected))
    os.environ["AMENT_PREFIX_PATH"] = str(folder)  # where descriptions are looked for
    transport = dora.Ros2Transport.zenoh(sys.argv[3] if len(sys.argv) > 3 else "rep2016", str(config))
    context = dora.Ros2Context([str(folder)], transport, 0)
    node = context.new_node("dora", "/judge", dora.Ros2NodeOptions(rosout=False))
    counts = dict.fromkeys(LISTENED, 0)

    def listen(name: str) -> None:
        kind, reliable = LISTENED[name]
        durability = dora.Ros2Durability.TransientLocal if name == "/r1/map" else dora.Ros2Durability.Volatile
        qos = dora.Ros2QosPolicies(reliable=reliable, durability=durability, keep_last=10)
        subscription = node.create_subscription(node.create_topic(name, kind, qos), qos)
        while True:
            message = subscription.next()
            if message is not None:
                if not counts[name]:
                    print(f"{name}: {str(message.to_pylist())[:300]}", flush=True)
                counts[name] += 1
            else:
                time.sleep(0.005)

    for name in LISTENED:
        threading.Thread(target=listen, args=(name,), daemon=True).start()
    qos = dora.Ros2QosPolicies(reliable=True, keep_last=10)
    publisher = node.create_publisher(node.create_topic("/r1/cmd_vel", "geometry_msgs/Twist", qos), qos)
    time.sleep(2.0)
    for number in range(TWISTS):
        forward = 0.0 if number < 20 else 0.25
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        publisher.publish(pa.array([{"linear": {**zero, "x": forward}, "angular": zero}]))
        time.sleep(EVERY_S)
    print(f"counts {json.dumps(counts)}", flush=True)


if __name__ == "__main__":
    main()
