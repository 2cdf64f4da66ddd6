"""What each key of the bus is in a recording: its topic, its encoding, its schema. Sans-IO.

The topic is the Zenoh key. A fleet message is recorded as it was, encoding ``msgpack``; its schema is a JSON Schema
(``jsonschema``) made of its declaration, in which ``bin`` has ``contentEncoding: binary``. Raw legacy frames are
``octet-stream`` without a schema; datagrams have a channel of their own on the same topic. Beside each command stands
``<key>/@sent``: whose lease its attachment claims, and the attachment itself.
"""

from __future__ import annotations

import json
from typing import Any

import msgspec

from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Authorization, FleetMessage, Sessions, Text
from zbridge.fleet.topics import split_key

MSGPACK, OCTETS, JSON = "msgpack", "octet-stream", "json"
JSONSCHEMA = "jsonschema"
SENT = "/@sent"
"""Ends the topic that stands beside a command's."""
_TRANSPORT = "transport"


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


class Schema(msgspec.Struct, frozen=True):
    """The schema of a channel."""

    name: str
    encoding: str
    data: bytes


class ChannelKind(msgspec.Struct, frozen=True):
    """A channel: what its messages are. metadata: pairs that tell channels of one topic apart."""

    topic: str
    encoding: str
    schema: Schema | None = None
    metadata: tuple[tuple[str, str], ...] = ()


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
    topic = topics.find(path)
    return topic.message if topic is not None and not path.startswith("@rpc/") else None


def is_wire(key: str) -> bool:
    """Tell whether raw legacy frames travel on a key."""
    return "/@wire/" in key


def is_command(key: str) -> bool:
    """Tell whether commands travel on a key."""
    return "/@cmd/" in key


def channel_of(key: str, *, datagram: bool = False) -> ChannelKind:
    """Describe the channel of a key."""
    if is_wire(key):
        return ChannelKind(key, OCTETS, None, ((_TRANSPORT, "datagram"),) if datagram else ())
    message = message_of(key)
    return ChannelKind(key, MSGPACK, schema_of(message) if message is not None else None)


def schema_of(message: type[FleetMessage]) -> Schema:
    """Make the schema of a message of its declaration."""
    text = msgspec.json.schema(message, schema_hook=_unknown)
    return Schema(payloads.schema(message), JSONSCHEMA, json.dumps(_binary(text), sort_keys=True).encode())


def read_sender(attachment: bytes | None) -> bytes | None:
    """Read which lease an attachment claims; None where it claims none."""
    if not attachment:
        return None
    try:
        return payloads.decode(Authorization, attachment).lease
    except PayloadError:
        return None


def _unknown(kind: type) -> dict[str, Any]:
    return {"description": kind.__name__}


def _binary(value: Any) -> Any:
    """Say ``binary`` where the schema of the JSON form says base64."""
    if isinstance(value, dict):
        return {key: "binary" if item == "base64" else _binary(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_binary(item) for item in value]
    return value
