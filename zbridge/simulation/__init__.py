"""Simulated peers: the world they live in, and the code that simulators and judges share.

For the author of a protocol: :class:`SimulatedRobot` and :func:`serve` (a simulated robot), :class:`Scene` (tests
without a link), ``world`` (the room), and ``check``, the conformance kit.

``timing`` decides when peers act and measures how late they were; ``simulator`` serves a simulated robot with several
clients and links. ``judge`` has what a judge records; ``fragile`` its tasks and its connection, as a robot;
``hq_program`` the same as an HQ program; ``sockets`` opens the connections. Knows no bus, no gateway and no protocol.
"""

from zbridge.simulation.scene import Scene
from zbridge.simulation.simulated import STEP_S, SimulatedRobot, serve

__all__ = ["STEP_S", "Scene", "SimulatedRobot", "serve"]
