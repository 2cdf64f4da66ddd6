"""Reads Foxglove's messages by Google's protobuf and the schema that a viewer is given."""

from __future__ import annotations

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

from zbridge.views.schemas import Schema


def read(schema: Schema, payload: bytes) -> dict[str, Any]:
    """Give all fields of a message, the absent ones with their default; bytes as base64, times as RFC 3339."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(payload)
    return json_format.MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
