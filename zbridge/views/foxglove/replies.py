"""What the server sends in ``foxglove.sdk.v1``: text messages as ``str``, binary ones as ``bytes``. Sans-IO."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Any

import msgspec

from zbridge.views.foxglove.requests import ServiceCall
from zbridge.views.pictures import ViewerChannel

SUBPROTOCOL = "foxglove.sdk.v1"
_S_NS = 1_000_000_000
_WARNING = 1
_MESSAGE = struct.Struct("<BIQ")
_REPLY = struct.Struct("<BIII")
_STATE = struct.Struct("<BBQfBI")
_TIME = struct.Struct("<BQ")
_encode = msgspec.json.Encoder().encode


class Service(msgspec.Struct, frozen=True):
    """A service that viewers can call. request, response: of :func:`json_schema`."""

    id: int
    name: str
    type: str
    request: Mapping[str, str]
    response: Mapping[str, str]


class PlaybackStatus(IntEnum):
    """What becomes of a recording."""

    PLAYING = 0
    PAUSED = 1
    ENDED = 3


def text(op: str, **fields: Any) -> str:
    """Write a text message."""
    return _encode({"op": op, **fields}).decode()


def server_info(
    name: str,
    capabilities: Sequence[str],
    session_id: str,
    metadata: Mapping[str, str],
    times_ns: tuple[int, int] | None = None,
) -> str:
    """Write the first message. times_ns: the first and the last time of a recording."""
    times = zip(("dataStartTime", "dataEndTime"), times_ns or (), strict=False)
    return text(
        "serverInfo",
        name=name,
        capabilities=capabilities,
        supportedEncodings=["json"] if {"clientPublish", "services"} & set(capabilities) else [],
        metadata=metadata,
        sessionId=session_id,
        **{key: {"sec": at_ns // _S_NS, "nsec": at_ns % _S_NS} for key, at_ns in times},
    )


def channel_entry(channel_id: int, channel: ViewerChannel) -> msgspec.Raw:
    """Write a channel as ``advertise`` lists it; a binary schema as base64."""
    schema = channel.schema
    is_binary = schema.encoding in ("protobuf", "flatbuffer")
    fields = {
        "id": channel_id,
        "topic": channel.topic,
        "encoding": schema.message_encoding,
        "schemaName": schema.name,
        "schemaEncoding": schema.encoding,
        "schema": base64.b64encode(schema.data).decode() if is_binary else schema.data.decode("utf-8", "replace"),
    }
    return msgspec.Raw(_encode(fields))


def advertise(entries: Iterable[msgspec.Raw]) -> str:
    """Offer channels."""
    return text("advertise", channels=list(entries))


def message_data(subscription_id: int, log_ns: int, payload: bytes) -> bytes:
    """Write a message of a channel. log_ns: Unix nanoseconds."""
    return _MESSAGE.pack(1, subscription_id, log_ns) + payload


def warning(message: str, name: str | None = None) -> str:
    """Tell people something. name: of what holds until ``removeStatus``, or until it is told anew."""
    return text("status", level=_WARNING, message=message, **({"id": name} if name is not None else {}))


def advertise_services(services: Iterable[Service]) -> str:
    """Offer services."""
    return text("advertiseServices", services=list(services))


def service_response(call: ServiceCall, payload: bytes) -> bytes:
    """Answer a call with JSON."""
    return _REPLY.pack(3, call.service_id, call.call_id, 4) + b"json" + payload


def service_failure(call: ServiceCall, why: str) -> str:
    """Return why a call was not carried out."""
    return text("serviceCallFailure", serviceId=call.service_id, callId=call.call_id, message=why)


def parameter_values(values: Mapping[str, Any], request_id: str | None = None) -> str:
    """Tell parameters. request_id: of the request that is answered."""
    listed = [{"name": name, "value": value} for name, value in values.items()]
    return text("parameterValues", parameters=listed, **({"id": request_id} if request_id is not None else {}))


def time(now_ns: int) -> bytes:
    """Tell the time of a recording, Unix nanoseconds."""
    return _TIME.pack(2, now_ns)


def playback_state(status: PlaybackStatus, now_ns: int, speed: float, *, sought: bool, request_id: str) -> bytes:
    """Tell how a recording is played. sought: the time has jumped."""
    encoded = request_id.encode()
    return _STATE.pack(5, status, now_ns, speed, sought, len(encoded)) + encoded


def json_schema(name: str, schema: Mapping[str, Any]) -> dict[str, str]:
    """Write a schema of a service's request or response."""
    return {
        "encoding": "json",
        "schemaName": name,
        "schemaEncoding": "jsonschema",
        "schema": _encode(schema).decode(),
    }
