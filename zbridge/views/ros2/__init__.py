"""Robots as nodes of ROS 2, over rmw_zenoh: topics, frames, services, and driving by Twist.

Theory of operation. Two Zenoh sessions: one on the fleet's bus, one to ROS's router, which are never the same.
``server`` opens both and makes a ``node`` for each robot whose gateway lives. A node declares its ``outlets``, and
reads from the fleet what somebody on ROS's side listens to: ``pictures`` makes ROS messages of it (``shapes``,
``diagnostics``). Streams go all this way on the thread of Zenoh's that brings them, under a lock of their node's; all
else is the event loop's. With driving allowed, ``teleop`` receives Twists (``cmd_vel``), asks the machine ``driving``
what may be carried out, and holds the lease through pilots; ``services`` answers calls. All but ``server``, ``node``,
``outlets``, ``teleop`` and ``services`` is sans-IO.
"""
