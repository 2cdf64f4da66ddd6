"""Simulated peers: the room they live in, what all simulators share, and what all judges share.

``world`` is the room; ``ticker`` the rhythm; ``simulator`` serves a robot to play with. ``judge`` keeps the accounts of
a fragile peer; ``fragile``, ``sockets`` and ``stream_reader`` connect it. ``check`` is
the conformance kit. Knows no bus, no gateway and no protocol.
"""
