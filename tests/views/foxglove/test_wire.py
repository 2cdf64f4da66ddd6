"""foxglove.sdk.v1 byte for byte: what is expected here was said by the server of foxglove-sdk 0.30.3, or sent to it."""

import json
import struct

import pytest

from zbridge.errors import ProtocolError
from zbridge.views.foxglove import replies, requests
from zbridge.views.foxglove.replies import PlaybackStatus, Service
from zbridge.views.foxglove.requests import PlaybackRequest, Published, ServiceCall
from zbridge.views.pictures import ViewerChannel
from zbridge.views.schemas import Schema, foxglove_schema

POSE = ViewerChannel("/r1/pose", "pose", foxglove_schema("PoseInFrame"))
JSON = ViewerChannel("/r1/x", "x", Schema("x", "jsonschema", b'{"type":"object"}', "json"))
CALL = ServiceCall(1, 77, "json", b"{}")

BINARY = [
    (replies.message_data(7, 0x1122, b"\x01\x02"), "010700000022110000000000000102"),
    (replies.time(77), "024d00000000000000"),
    (replies.service_response(CALL, b'{"ok":true}'), "03010000004d000000040000006a736f6e7b226f6b223a747275657d"),
    (
        replies.playback_state(PlaybackStatus.PLAYING, 5, 1.0, sought=True, request_id="abc"),
        "050005000000000000000000803f0103000000616263",
    ),
    (
        replies.playback_state(PlaybackStatus.PAUSED, 5, 1.5, sought=False, request_id=""),
        "050105000000000000000000c03f0000000000",
    ),
]

TEXT = [
    (
        replies.server_info("zb", ["clientPublish", "time"], "17", {"a": "b"}, (1, 2_000_000_000)),
        '{"op":"serverInfo","name":"zb","capabilities":["clientPublish","time"],"supportedEncodings":["json"],'
        '"metadata":{"a":"b"},"sessionId":"17","dataStartTime":{"sec":0,"nsec":1},"dataEndTime":{"sec":2,"nsec":0}}',
    ),
    (replies.text("unadvertise", channelIds=[2]), '{"op":"unadvertise","channelIds":[2]}'),
    (replies.warning("Unknown"), '{"op":"status","level":1,"message":"Unknown"}'),
    (replies.warning("Unknown", "it"), '{"op":"status","level":1,"message":"Unknown","id":"it"}'),
    (
        replies.service_failure(ServiceCall(99, 78, "json", b""), "Unknown service"),
        '{"op":"serviceCallFailure","serviceId":99,"callId":78,"message":"Unknown service"}',
    ),
    (
        replies.parameter_values({"r1.lidar": True, "s": "a"}, "q1"),
        '{"op":"parameterValues","parameters":[{"name":"r1.lidar","value":true},{"name":"s","value":"a"}],"id":"q1"}',
    ),
    (
        replies.advertise([replies.channel_entry(2, JSON)]),
        '{"op":"advertise","channels":[{"id":2,"topic":"/r1/x","encoding":"json","schemaName":"x",'
        '"schemaEncoding":"jsonschema","schema":"{\\"type\\":\\"object\\"}"}]}',
    ),
]


@pytest.mark.parametrize(("written", "expected"), BINARY)
def test_binary_messages_are_those_of_the_sdk(written: bytes, expected: str) -> None:
    assert written.hex() == expected


@pytest.mark.parametrize(("written", "expected"), TEXT)
def test_text_messages_are_those_of_the_sdk(written: str, expected: str) -> None:
    assert json.loads(written) == json.loads(expected)


def test_a_binary_schema_is_told_as_base64() -> None:
    (entry,) = json.loads(replies.advertise([replies.channel_entry(1, POSE)]))["channels"]
    assert (entry["encoding"], entry["schemaEncoding"], entry["schemaName"]) == (
        "protobuf",
        "protobuf",
        "foxglove.PoseInFrame",
    )
    assert entry["schema"].startswith("CnMKGWZveGdsb3ZlL1F1YXRlcm5pb24ucHJvdG8SCGZveGdsb3Zl")


def test_services_are_told_with_the_schemas_of_both_ways() -> None:
    request, response = (
        replies.json_schema(f"zbridge/Stop{way}", {"type": "object"}) for way in ("Request", "Response")
    )
    service = Service(1, "/r1/stop", "zbridge/Stop", request, response)
    (entry,) = json.loads(replies.advertise_services([service]))["services"]
    assert (entry["id"], entry["name"], entry["type"]) == (1, "/r1/stop", "zbridge/Stop")
    assert entry["request"]["encoding"] == entry["response"]["encoding"] == "json"
    assert entry["response"]["schemaName"] == "zbridge/StopResponse"
    assert json.loads(entry["request"]["schema"]) == {"type": "object"}


SAID = [
    (b"\x01" + struct.pack("<I", 1) + b"{}", Published(1, b"{}")),
    (b"\x02" + struct.pack("<III", 1, 77, 4) + b"json{}", CALL),
    (
        b"\x03\x00" + struct.pack("<f", 2.0) + b"\x01" + struct.pack("<QI", 1_000_000_000, 3) + b"abc",
        PlaybackRequest(True, 2.0, 1_000_000_000, "abc"),
    ),
    (b"\x03\x01" + struct.pack("<f", 1.0) + b"\x00" + struct.pack("<QI", 9, 0), PlaybackRequest(False, 1.0, None, "")),
]


@pytest.mark.parametrize(("data", "expected"), SAID)
def test_binary_requests_are_read(data: bytes, expected: object) -> None:
    assert requests.read_binary(data) == expected


@pytest.mark.parametrize("data", [data for data, _ in SAID])
def test_a_binary_request_that_is_cut_is_malformed_or_shorter(data: bytes) -> None:
    for end in range(len(data)):
        try:
            said = requests.read_binary(data[:end])
        except ProtocolError:
            continue
        assert isinstance(said, Published | ServiceCall)


SPOILED = [
    b"",
    b"\x99abc",
    b"\x02" + struct.pack("<III", 1, 1, 2**32 - 1) + b"json",
    b"\x02" + struct.pack("<III", 1, 1, 2) + b"\xff\xff",
    b"\x03\x07" + struct.pack("<f", 1.0) + b"\x00" + struct.pack("<QI", 0, 0),
    b"\x03\x00" + struct.pack("<f", 0.0) + b"\x00" + struct.pack("<QI", 0, 0),
    b"\x03\x00" + struct.pack("<f", float("nan")) + b"\x00" + struct.pack("<QI", 0, 0),
]


@pytest.mark.parametrize("data", SPOILED)
def test_a_spoiled_binary_request_is_malformed(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        requests.read_binary(data)


def test_text_requests_are_read_and_unknown_fields_ignored() -> None:
    subscribe = requests.read_text('{"op":"subscribe","subscriptions":[{"id":7,"channelId":3}],"more":1}')
    assert subscribe == requests.Subscribe((requests.Subscription(7, 3),))
    channel = '{"id":1,"topic":"/r1/cmd_vel","encoding":"json","schemaName":"geometry_msgs/Twist","schema":""}'
    advertise = requests.read_text(f'{{"op":"advertise","channels":[{channel}]}}')
    expected = requests.ClientChannel(1, "/r1/cmd_vel", "json", "geometry_msgs/Twist")
    assert advertise == requests.Advertise((expected,))
    asked = requests.read_text('{"op":"setParameters","parameters":[{"name":"r1.lidar","value":true}],"id":"q2"}')
    assert asked == requests.SetParameters((requests.Parameter("r1.lidar", True),), "q2")


@pytest.mark.parametrize(
    "text",
    [
        "garbage",
        "{}",
        '{"op":"nonsense"}',
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":3}]}',
        '{"op":"unsubscribe","subscriptionIds":["a"]}',
        '{"op":"unadvertise","channelIds":[' + "1," * 5000 + "1]}",
        '{"op":"setParameters","parameters":[{"name":"x","value":' + "[" * 100_000 + "]" * 100_000 + "}]}",
    ],
)
def test_spoiled_text_is_malformed(text: str) -> None:
    with pytest.raises(ProtocolError):
        requests.read_text(text)
