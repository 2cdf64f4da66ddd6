"""What a recording holds: the channels of keys and pictures, and the configuration of a gateway.

The topic is the Zenoh key. A fleet message is recorded as it was, encoding ``msgpack``; its schema is a JSON Schema
(``jsonschema``) made of its declaration, in which ``bin`` has ``contentEncoding: binary``. Raw legacy frames are
``octet-stream`` without a schema; datagrams have a channel of their own on the same topic. Beside each command stands
``<key>/@sent``: whose lease its attachment claims, and the attachment itself.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from zbridge.blackbox.segments import LOG, LogLine
from zbridge.errors import ConfigError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Authorization
from zbridge.fleet.messages import FleetMessage, Text
from zbridge.fleet.processes import Sessions
from zbridge.fleet.topics import Topic, split_key
from zbridge.toml import read_toml, without_secrets
from zbridge.views.recording.reader import EXTRA
from zbridge.views.schemas import Schema

if TYPE_CHECKING:
    from zbridge.views.pictures import FoxglovePictures, ViewerChannel

MSGPACK, OCTETS = "msgpack", "octet-stream"
SENT = "/@sent"
"""Ends the topic that stands beside a command's."""


class Sent(FleetMessage, frozen=True):
    """Who sent a command: the lease that its attachment claims, and who held that lease when it arrived.

    holder: None where ``control`` has shown no holder of that lease. attachment: as it was, b"" where there was none.
    """

    lease: bytes | None = None
    holder: str | None = None
    attachment: bytes = b""


class Alive(FleetMessage, frozen=True):
    """A liveliness token came or went."""

    alive: bool


class ChannelKind(msgspec.Struct, frozen=True):
    """A channel: what its messages are. datagram: raw frames that went by datagram."""

    topic: str
    encoding: str
    schema: Schema | None = None
    datagram: bool = False


def message_of(key: str) -> type[FleetMessage] | None:
    """Return what travels on a key; None for raw frames and unknown keys."""
    split = split_key(key)
    if split is None:
        return Text if key.endswith("/@mark") else None
    path = split[2]
    if path.endswith(SENT):
        return Sent
    if path.startswith("@alive/"):
        return Alive
    if path.startswith("@rpc/sessions/"):
        return Sessions
    if path == LOG:
        return LogLine
    topic = topics.find(path)
    return topic.message if topic is not None and not path.startswith("@rpc/") else None


def is_log(key: str) -> bool:
    """Return whether a key has lines of a gateway's log, from its black box."""
    return key.endswith(f"/{LOG}")


def is_wire(key: str) -> bool:
    """Return whether raw legacy frames travel on a key."""
    return "/@wire/" in key


def channel_of(key: str, *, datagram: bool = False) -> ChannelKind:
    """Describe the channel of a key."""
    if is_wire(key):
        return ChannelKind(key, OCTETS, datagram=datagram)
    message = message_of(key)
    return ChannelKind(key, MSGPACK, schema_of(message) if message is not None else None)


def schema_of(message: type[FleetMessage]) -> Schema:
    """Make the schema of a message of its declaration."""
    text = msgspec.json.schema(message, schema_hook=lambda kind: {"description": kind.__name__})
    return Schema(payloads.schema(message), "jsonschema", json.dumps(_binary(text), sort_keys=True).encode(), MSGPACK)


def read_sender(attachment: bytes | None) -> bytes | None:
    """Read which lease an attachment claims; None if it claims none."""
    if not attachment:
        return None
    try:
        return payloads.decode(Authorization, attachment).lease
    except PayloadError:
        return None


def _binary(value: Any) -> Any:
    """Say ``binary`` where the schema of the JSON form says base64."""
    if isinstance(value, dict):
        return {key: "binary" if item == "base64" else _binary(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_binary(item) for item in value]
    return value


ROBOTS = 1024
"""Robots that are drawn; those of others are recorded without pictures."""


class Pictures:
    """Draws what robots publish. Raises ConfigError where Foxglove's messages are not installed."""

    def __init__(self) -> None:
        try:
            from zbridge.views.pictures import FoxglovePictures
        except ImportError as error:
            raise ConfigError(f"pictures {EXTRA}, or --only fleet") from error
        self._make = FoxglovePictures
        self._robots: dict[str, FoxglovePictures] = {}

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
            return
        for picture in robot.draw(topic, message, now_ns):
            yield _drawn_on(picture.channel), picture.stamp_ns, picture.payload

    def draw_line(self, key: str, payload: bytes, now_ns: int) -> Iterator[tuple[ChannelKind, bytes]]:
        """Yield the picture of a log line: channel, payload."""
        from zbridge.views.pictures import line_picture

        split = split_key(key)
        if split is not None:
            with contextlib.suppress(PayloadError):
                picture = line_picture(split[1], payloads.decode(LogLine, payload), now_ns)
                yield _drawn_on(picture.channel), picture.payload


@lru_cache(maxsize=ROBOTS * 16)
def _drawn_on(channel: ViewerChannel) -> ChannelKind:
    return ChannelKind(channel.topic, channel.schema.message_encoding, channel.schema)


def describe_configuration(path: Path) -> dict[str, str]:
    """Return the metadata of a configuration file; raise ConfigError. ``${VAR}`` is not replaced."""
    return {"file": path.name, "configuration": json.dumps(without_secrets(read_toml(path)), default=str)}
