"""Fleet messages as a viewer shows them: Foxglove's messages where one fits, else JSON with a schema. Sans-IO.

``drawing`` encodes Foxglove's messages, ``schemas`` tells their schemas and those of the JSON ones, ``robot`` decides
which pictures a fleet message of a robot has, and in which frames they stand.
"""

from __future__ import annotations

from zbridge.views.pictures.robot import Channel, Picture, RobotPictures, channels_of, sources_of
from zbridge.views.pictures.schemas import Schema, foxglove_schema, json_schema

__all__ = [
    "Channel",
    "Picture",
    "RobotPictures",
    "Schema",
    "channels_of",
    "foxglove_schema",
    "json_schema",
    "sources_of",
]
