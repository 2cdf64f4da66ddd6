"""A robot's camera: its MJPEG stream over HTTP, fetched while somebody watches, published as images and relayed.

``mjpeg`` and ``pace`` are sans-IO; ``upstream`` fetches, ``relay`` serves HQ programs, ``camera`` puts them
together, and is imported where a configuration names a camera. Knows no protocol: a camera is a device of its own
beside the robot's links.
"""

from zbridge.camera.settings import CameraPlan, CameraSettings, plan_camera

__all__ = ["CameraPlan", "CameraSettings", "plan_camera"]
