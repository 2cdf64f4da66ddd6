"""Listeners for HQ programs: each client sees the robot of the bus, and drives it as far as it may.

Knows the robot only by its keys, and no protocol in particular.
"""
