"""ROS 2 robots whose nodes use rmw_zenoh: read and driven over plain Zenoh, without ROS.

``messages`` declares the messages; ``graph`` knows who publishes and who subscribes to commands; ``session`` holds the
conversation; ``translate`` is the device side, ``options`` its options. ``simulator`` is a simulated robot. HQ programs
of other protocols drive it; it has no HQ side of its own: what ROS users see is ``zbridge ros2``.
"""

from __future__ import annotations

from typing import Any

from gateways.ros2.options import RosOptions
from zbridge.protocol import (
    Codec,
    KeyedSample,
    Metrics,
    Protocol,
    RobotSide,
    SampleKind,
    Simulation,
    read_sample,
    sample_end,
    write_sample,
)

TEMPLATE = """\
[device]
protocol = "ros2"
connect = ["tcp://127.0.0.1:7447"]      # ROS's router (rmw_zenohd), never the fleet's

[device.options]
# namespace = "/r1"                     # of the robot's nodes
domain = 0                              # ROS_DOMAIN_ID
distro = "jazzy"                        # humble, iron, jazzy, kilted or lyrical
# scan = "scan"                         # LaserScan; a topic in the namespace, one with "/" first is absolute, "": none
# odom = "odom"                         # Odometry
# map = "map"                           # OccupancyGrid
# imu = "imu"                           # Imu
# battery_state = "battery_state"       # BatteryState
# image = "image/compressed"            # CompressedImage
# cmd_vel = "cmd_vel"                   # Twist or TwistStamped, as its subscriber has it
# cmd_vel_hz = 10.0                     # how often a drive is repeated
speed_full_mps = 0.5                    # the speed of a drive of 1
turn_full_radps = 1.0                   # the turn of a drive of 1
sideways = false                        # true: it moves sideways too
shared = false                          # true: another node (Nav2) drives it too; then nothing is sent while nobody
                                        # drives it here, and what others send is not overruled
# scan_yaw_deg = 0.0                    # where the lidar's 0 looks, counter-clockwise
# silent_s = 2.0                        # without any message for so long it counts as lost
"""


def _robot(options: RosOptions, links: int, metrics: Metrics) -> RobotSide:
    from gateways.ros2.translate import RosRobot  # loads numpy

    return RosRobot(options, links, metrics)


async def _simulate(simulation: Simulation) -> None:
    from gateways.ros2.simulator import simulate

    await simulate(simulation)


SIMULATED: dict[str, Any] = {"speed_full_mps": 1.0, "turn_full_radps": 2.0}
PROTOCOL = Protocol(
    name="ros2",
    summary="ROS 2 robots over rmw_zenoh, without ROS",
    options=RosOptions,
    links=1,
    robot=_robot,
    simulate=_simulate,
    simulated=SIMULATED,
    template=TEMPLATE,
    codecs=(Codec("samples", write_sample, read_sample, sample_end, tuple(map(KeyedSample, SampleKind))),),
    keyed=True,
    requires=("rosbags", "xxhash"),
    plausible={"battery.voltage": (1.0, 100.0), "battery.current": (-1000.0, 1000.0)},
)
