"""What viewers send in ``foxglove.sdk.v1``, Foxglove's WebSocket protocol. Sans-IO.

Text messages are JSON objects with an ``op``; binary ones begin with an opcode, and their numbers are little-endian.
Reading raises ProtocolError and nothing else; of a Twist, Malformed.
"""

from __future__ import annotations

import math
import struct
from typing import Annotated, Any

import msgspec

from zbridge.errors import Malformed, ProtocolError
from zbridge.fleet.messages import Drive
from zbridge.protocol.kinematics import within_full_scale

LISTED = 4096
"""Most entries of a list in one message."""

U32 = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
U64 = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Name = Annotated[str, msgspec.Meta(max_length=1024)]
Names = Annotated[tuple[Name, ...], msgspec.Meta(max_length=LISTED)]
Ids = Annotated[tuple[U64, ...], msgspec.Meta(max_length=LISTED)]


class _Struct(msgspec.Struct, frozen=True, rename="camel"):
    """Part of a message, with the names of the protocol."""


class _Op(_Struct, frozen=True, tag_field="op", tag=lambda name: name[0].lower() + name[1:]):
    """A text message; its ``op`` is the name of the class."""


class Subscription(_Struct, frozen=True):
    """id: the viewer's own, which the messages of the channel will carry."""

    id: U32
    channel_id: U64


class Subscribe(_Op, frozen=True):
    """Send me the messages of these channels."""

    subscriptions: Annotated[tuple[Subscription, ...], msgspec.Meta(max_length=LISTED)]


class Unsubscribe(_Op, frozen=True):
    """Send me no more of these subscriptions."""

    subscription_ids: Ids


class ClientChannel(_Struct, frozen=True):
    """A channel on which a viewer publishes."""

    id: U32
    topic: Name
    encoding: Name
    schema_name: Name = ""


class Advertise(_Op, frozen=True):
    """I will publish on these channels."""

    channels: Annotated[tuple[ClientChannel, ...], msgspec.Meta(max_length=LISTED)]


class Unadvertise(_Op, frozen=True):
    """I publish on these channels no more."""

    channel_ids: Ids


class Parameter(_Struct, frozen=True):
    """A value by name; None: no value."""

    name: Name
    value: Any = None
    type: str | None = None


class GetParameters(_Op, frozen=True):
    """Tell me these parameters; none named: all."""

    parameter_names: Names
    id: Name | None = None


class SetParameters(_Op, frozen=True):
    """Change these parameters."""

    parameters: Annotated[tuple[Parameter, ...], msgspec.Meta(max_length=LISTED)]
    id: Name | None = None


class SubscribeParameterUpdates(_Op, frozen=True):
    """Tell me when these parameters change; none named: all."""

    parameter_names: Names


class UnsubscribeParameterUpdates(_Op, frozen=True):
    """Tell me no more of these parameters; none named: all."""

    parameter_names: Names


class Published(msgspec.Struct, frozen=True):
    """A message on one of the viewer's channels."""

    channel_id: int
    payload: bytes


class ServiceCall(msgspec.Struct, frozen=True):
    """A call of a service."""

    service_id: int
    call_id: int
    encoding: str
    payload: bytes


class PlaybackRequest(msgspec.Struct, frozen=True):
    """Play or pause a recording, at so many times its speed; seek_ns: Unix nanoseconds, None: continue from here."""

    play: bool
    speed: float
    seek_ns: int | None
    request_id: str


class Scale(msgspec.Struct, frozen=True):
    """The speeds of a robot at full scale: m/s over ground, and rad/s."""

    speed_full_mps: float = 1.0
    turn_full_radps: float = 1.0


class _Vector(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class _Twist(msgspec.Struct, frozen=True):
    linear: _Vector = _Vector()
    angular: _Vector = _Vector()


TextMessage = (
    Subscribe
    | Unsubscribe
    | Advertise
    | Unadvertise
    | GetParameters
    | SetParameters
    | SubscribeParameterUpdates
    | UnsubscribeParameterUpdates
)
_TEXT_MESSAGES: msgspec.json.Decoder[TextMessage] = msgspec.json.Decoder(TextMessage)
_TWIST = msgspec.json.Decoder(_Twist)
_U32 = struct.Struct("<I")
_CALL = struct.Struct("<III")
_PLAYBACK = struct.Struct("<BfBQI")


def read_text(text: str) -> TextMessage:
    """Read a viewer's text message."""
    try:
        return _TEXT_MESSAGES.decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise ProtocolError(f"text message: {error}") from error


def read_binary(data: bytes) -> Published | ServiceCall | PlaybackRequest:
    """Read a viewer's binary message."""
    try:
        if data[:1] == b"\x01":
            return Published(_U32.unpack_from(data, 1)[0], data[5:])
        if data[:1] == b"\x02":
            service_id, call_id, length = _CALL.unpack_from(data, 1)
            encoding, payload = _counted(data, 1 + _CALL.size, length)
            return ServiceCall(service_id, call_id, encoding, payload)
        if data[:1] == b"\x03":
            return _playback(data)
    except (struct.error, UnicodeError) as error:
        raise ProtocolError(f"binary message of {len(data)} bytes: {error}") from error
    raise ProtocolError(f"binary message with the opcode {data[:1].hex() or 'of nothing'}")


def read_twist(payload: bytes, scale: Scale) -> Drive:
    """Read a Twist in JSON; raise Malformed. Above full scale all parts are scaled down alike: the curve stays."""
    try:
        twist = _TWIST.decode(payload)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise Malformed(f"Twist: {error}") from error
    parts = (
        twist.linear.x / scale.speed_full_mps,
        twist.linear.y / scale.speed_full_mps,
        twist.angular.z / scale.turn_full_radps,
    )
    if not all(map(math.isfinite, parts)):
        raise Malformed("Twist: expected finite numbers")
    return within_full_scale(*parts)


def _playback(data: bytes) -> PlaybackRequest:
    command, speed, seeks, seek_ns, length = _PLAYBACK.unpack_from(data, 1)
    if command > 1 or not 0 < speed <= 1000:
        raise ProtocolError(f"playback command {command} at speed {speed:g}")
    request_id, _ = _counted(data, 1 + _PLAYBACK.size, length)
    return PlaybackRequest(command == 0, speed, seek_ns if seeks else None, request_id)


def _counted(data: bytes, at: int, length: int) -> tuple[str, bytes]:
    """Split a string of a stated length from what follows it."""
    if at + length > len(data):
        raise ProtocolError(f"string of {length} bytes in a message of {len(data)}")
    return data[at : at + length].decode(), data[at + length :]
