"""Rovers as robots: the gateway is the ground station of one ArduRover.

``options``: its options. ``helm``: whose mode the rover is in. ``requests``: what it is asked for once. ``session``:
the conversation. ``telemetry`` and ``translate``: from its messages, and from commands to messages. ``advice``: what
rovers suffer from.
"""
