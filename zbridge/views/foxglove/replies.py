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
from zbridge.views.schemas import Schema

SUBPROTOCOL = "foxglove.sdk.v1"
_S_NS = 1_000_000_000


class StatusLevel(IntEnum):
    """How bad the news of a ``status`` is."""

    INFO = 0
    WARNING = 1
    ERROR = 2


_MESSAGE = struct.Struct("<BIQ")
_REPLY = struct.Struct("<BIII")
_STATE = struct.Struct("<BBQfBI")
_TIME = struct.Struct("<BQ")
_encode = msgspec.json.Encoder().encode


class Service(msgspec.Struct, frozen=True):
    """A service that viewers can call. request, response: JSON schemas."""

    id: int
    name: str
    type: str
    request: Mapping[str, Any]
    response: Mapping[str, Any]


def server_info(
    name: str,
    capabilities: Sequence[str],
    session_id: str,
    metadata: Mapping[str, str],
    times_ns: tuple[int, int] | None = None,
) -> str:
    """Write the first message. times_ns: the first and the last time of a recording."""
    fields: dict[str, Any] = {
        "op": "serverInfo",
        "name": name,
        "capabilities": capabilities,
        "supportedEncodings": ["json"] if "clientPublish" in capabilities or "services" in capabilities else [],
        "metadata": metadata,
        "sessionId": session_id,
    }
    if times_ns is not None:
        fields |= {"dataStartTime": _time_of(times_ns[0]), "dataEndTime": _time_of(times_ns[1])}
    return _text(fields)


def channel_entry(channel_id: int, channel: ViewerChannel) -> msgspec.Raw:
    """Write a channel as ``advertise`` lists it; a binary schema as base64."""
    schema = channel.schema
    return msgspec.Raw(
        _encode(
            {
                "id": channel_id,
                "topic": channel.topic,
                "encoding": schema.message_encoding,
                "schemaName": schema.name,
                "schemaEncoding": schema.encoding,
                "schema": _schema_text(schema),
            }
        )
    )


def advertise(entries: Iterable[msgspec.Raw]) -> str:
    """Offer channels."""
    return _text({"op": "advertise", "channels": list(entries)})


def unadvertise(channel_ids: Sequence[int]) -> str:
    """Withdraw channels."""
    return _text({"op": "unadvertise", "channelIds": channel_ids})


def message_data(subscription_id: int, log_ns: int, payload: bytes) -> bytes:
    """Write a message of a channel. log_ns: Unix nanoseconds."""
    return _MESSAGE.pack(1, subscription_id, log_ns) + payload


def status(level: StatusLevel, text: str, name: str | None = None) -> str:
    """Tell people something. name: of what holds until :func:`remove_status`, or until it is told anew."""
    named = {"id": name} if name is not None else {}
    return _text({"op": "status", "level": int(level), "message": text} | named)


def remove_status(names: Sequence[str]) -> str:
    """Take back what does not hold any more."""
    return _text({"op": "removeStatus", "statusIds": names})


def advertise_services(services: Iterable[Service]) -> str:
    """Offer services."""
    entries = [
        {
            "id": service.id,
            "name": service.name,
            "type": service.type,
            "request": _json_schema(f"{service.type}Request", service.request),
            "response": _json_schema(f"{service.type}Response", service.response),
        }
        for service in services
    ]
    return _text({"op": "advertiseServices", "services": entries})


def unadvertise_services(service_ids: Sequence[int]) -> str:
    """Withdraw services."""
    return _text({"op": "unadvertiseServices", "serviceIds": service_ids})


def service_response(call: ServiceCall, payload: bytes) -> bytes:
    """Answer a call with JSON."""
    return _REPLY.pack(3, call.service_id, call.call_id, 4) + b"json" + payload


def service_failure(call: ServiceCall, text: str) -> str:
    """Say why a call was not carried out."""
    return _text({"op": "serviceCallFailure", "serviceId": call.service_id, "callId": call.call_id, "message": text})


def parameter_values(values: Mapping[str, Any], request_id: str | None = None) -> str:
    """Tell parameters. request_id: of the request that is answered."""
    fields: dict[str, Any] = {
        "op": "parameterValues",
        "parameters": [{"name": name, "value": value} for name, value in values.items()],
    }
    return _text(fields | ({"id": request_id} if request_id is not None else {}))


def time(now_ns: int) -> bytes:
    """Tell the time of a recording, Unix nanoseconds."""
    return _TIME.pack(2, now_ns)


class PlaybackStatus(IntEnum):
    """What becomes of a recording."""

    PLAYING = 0
    PAUSED = 1
    ENDED = 3


def playback_state(status: PlaybackStatus, now_ns: int, speed: float, *, sought: bool, request_id: str) -> bytes:
    """Tell how a recording is played. sought: the time has jumped."""
    encoded = request_id.encode()
    return _STATE.pack(5, status, now_ns, speed, sought, len(encoded)) + encoded


def _text(fields: Mapping[str, Any]) -> str:
    return _encode(fields).decode()


def _time_of(stamp_ns: int) -> dict[str, int]:
    seconds, nanoseconds = divmod(stamp_ns, _S_NS)
    return {"sec": seconds, "nsec": nanoseconds}


def _schema_text(schema: Schema) -> str:
    if schema.encoding in ("protobuf", "flatbuffer"):
        return base64.b64encode(schema.data).decode()
    return schema.data.decode("utf-8", "replace")


def _json_schema(name: str, schema: Mapping[str, Any]) -> dict[str, str]:
    text = _encode(schema).decode()
    return {"encoding": "json", "schemaName": name, "schemaEncoding": "jsonschema", "schema": text}
