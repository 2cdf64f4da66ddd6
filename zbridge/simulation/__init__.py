"""Simulated peers: the room they live in, what all simulators share, and the scaffold that all judges share.

``world`` is the room; ``timing`` says when peers act and how late they were; ``simulator`` serves a robot to play with.
``judge`` is what a judge records; ``fragile`` its tasks and its connection, as a robot; ``hq_program`` the same as an
HQ program; ``sockets`` opens the connections. ``check`` is the conformance kit. Knows no bus, no gateway and no
protocol.
"""
