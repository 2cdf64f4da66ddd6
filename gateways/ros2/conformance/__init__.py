"""Peers as strict as can be, for tests of the gateway and of others; they share no code with it.

``strict_robot`` is a ROS 2 robot whose base believes every command and holds it for ever.
"""
