"""``python -m gateways.ros2 FILE``: ``zbridge run`` for this protocol only."""

from zbridge.cli import run_only

run_only("ros2")
