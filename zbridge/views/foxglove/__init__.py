"""A server for Foxglove: robots of the bus live, or a recording, over ``foxglove.sdk.v1``.

Theory of operation. ``server`` accepts WebSocket connections that ``admission`` lets in and makes a ``viewer`` of each.
A viewer reads ``requests``, asks the ``source`` (``live``: the bus; ``playback``: a file) and its ``commands`` to carry
them out, and has an ``outbox``. The ``hub`` knows the channels, and which viewers subscribed to them: a source works
for what is wanted. A viewer that may drive has a ``pilot`` for each robot it drives, which holds the lease in its name.

The protocol is served here, and not by the SDK's server: that one accepts every Origin and asks for no token, so it
would have to listen at a port of its own that must not be reached by others. There is no such port.
"""
