"""Simulated peers: the world they live in, and the code that simulators and judges share.

``world`` is the room; ``timing`` decides when peers act and measures how late they were; ``simulator`` serves a
simulated robot. ``judge`` has what a judge records; ``fragile`` its tasks and its connection, as a robot;
``hq_program`` the same as an HQ program; ``sockets`` opens the connections. ``check`` is the conformance kit. Knows no
bus, no gateway and no protocol.
"""
