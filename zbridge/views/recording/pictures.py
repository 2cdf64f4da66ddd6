"""The pictures of all robots of a recording, as channels of its file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from zbridge.errors import ConfigError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.topics import Topic, split_key
from zbridge.views.recording.channels import ChannelKind, Schema
from zbridge.views.recording.files import EXTRA

if TYPE_CHECKING:
    from zbridge.views.pictures import Channel, RobotPictures

ROBOTS = 1024
"""Robots that are drawn; those of others are recorded without pictures."""


class Pictures:
    """Draws what robots publish. Raises ConfigError where Foxglove's messages are not installed."""

    def __init__(self) -> None:
        try:
            from zbridge.views.pictures import RobotPictures
        except ImportError as error:
            raise ConfigError(f"pictures {EXTRA}, or --only fleet") from error
        self.undrawn = 0
        """Messages that could not be read."""
        self._make = RobotPictures
        self._robots: dict[str, RobotPictures] = {}
        self._kinds: dict[Channel, ChannelKind] = {}

    def __repr__(self) -> str:
        return f"<Pictures of {len(self._robots)} robots>"

    def draw(self, key: str, topic: Topic, payload: bytes, now_ns: int) -> Iterator[tuple[ChannelKind, int, bytes]]:
        """Yield the pictures of a message: channel, publish time, payload."""
        split = split_key(key)
        if split is None:
            return
        robot = self._robots.get(split[1])
        if robot is None:
            if len(self._robots) >= ROBOTS:
                return
            robot = self._robots[split[1]] = self._make(split[1])
        try:
            message = payloads.decode(topic.message, payload)
        except PayloadError:
            self.undrawn += 1
            return
        for picture in robot.draw(topic, message, now_ns):
            yield self._kind(picture.channel), picture.stamp_ns, picture.payload

    def _kind(self, channel: Channel) -> ChannelKind:
        kind = self._kinds.get(channel)
        if kind is None:
            schema = Schema(channel.schema.name, channel.schema.encoding, channel.schema.data)
            kind = self._kinds[channel] = ChannelKind(channel.topic, channel.schema.message_encoding, schema)
        return kind
