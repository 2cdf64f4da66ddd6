"""Targets of what comes over the bus, from viewers and from other processes of the host: payloads and their parts."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import msgspec

from tests.fleet.test_payload import PAYLOADS
from tests.fuzz.target import Target, comparable, require_same
from zbridge.app.handover import channel as handover
from zbridge.control.admission import is_stop
from zbridge.control.latch import STOPS, Latches, LatchRecord, read_stop
from zbridge.errors import LinkError, Malformed, PayloadError, ProtocolError, Unsupported
from zbridge.fleet import lease_messages, messages, payload, processes, topics
from zbridge.fleet.lease_messages import Authorization
from zbridge.fleet.messages import FleetMessage, Stop
from zbridge.fleet.payload import with_stamp
from zbridge.host import fd_channel as supervisor
from zbridge.lease.proof import Verifier, read
from zbridge.protocol.address import Address, parse_device_address
from zbridge.protocol.samples import KeyedSample, SampleKind, read_sample, write_sample
from zbridge.robot import claim
from zbridge.ros2.rmw_zenoh import Attachment, read_attachment, read_token
from zbridge.ros2.types import types_of
from zbridge.views.foxglove import requests
from zbridge.views.foxglove.requests import Scale
from zbridge.views.foxglove.requests import read_twist as read_json_twist
from zbridge.views.ros2.cmd_vel import STAMPED, TWIST
from zbridge.views.ros2.cmd_vel import read_twist as read_cdr_twist
from zbridge.views.ros2.settings import RobotBody

KINDS = sorted(
    {
        kind
        for kind in (*vars(messages).values(), *vars(lease_messages).values(), *vars(processes).values())
        if isinstance(kind, type) and issubclass(kind, FleetMessage)
    },
    key=lambda kind: kind.__name__,
)
ROS_TYPES = (
    "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/CompressedImage", TWIST, STAMPED,
)  # fmt: skip
TYPES = types_of("jazzy")
KEY = "fleet/r1/@cmd/drive"
LATER_NS = 1_800_000_000_000_000_000


def read_fleet(data: bytes) -> None:
    """Read a payload as the message that the first byte chooses; move its stamp, as a replay does."""
    if not data:
        return
    kind, body = KINDS[data[0] % len(KINDS)], data[1:]
    with contextlib.suppress(PayloadError):
        found = payload.decode(kind, body)
        require_same(
            "written and read again", comparable(payload.decode(kind, payload.encode(found))), comparable(found)
        )
        payload.decode(kind, body, arrays=False)
    moved = with_stamp(body, LATER_NS)
    with contextlib.suppress(PayloadError):
        found, again = payload.decode(kind, body), payload.decode(kind, moved)
        if body and len(payload.unpack(body)) != body[0] % 16:  # a name twice: which one counts is not defined
            return
        if found.stamp_ns is not msgspec.UNSET:
            found = msgspec.structs.replace(found, stamp_ns=LATER_NS)
        require_same("a stamp that was moved changes nothing else", comparable(again), comparable(found))


def read_authorization(data: bytes) -> None:
    """Read what proves a command; nothing but the holder's bytes may pass."""
    verifier = Verifier(b"\1" * 8, b"\2" * 32)
    verifier.plausible(data)
    with contextlib.suppress(Malformed):
        found = read(data)
        require_same("written and read again", read(msgspec.msgpack.encode(found)), found)
        assert found.lease != verifier.lease or not verifier.proves(found, KEY, b"")
        assert len(data) <= 128


def read_stops(data: bytes) -> None:
    """Read a stop, and let it latch: a stop is never refused."""
    stop, latches = read_stop(data), Latches()
    latch = latches.take(stop, fleet=bool(data and data[0] % 2))
    if latch is not None:
        record = msgspec.msgpack.decode(msgspec.msgpack.encode(latches.record), type=LatchRecord)
        require_same("latches are read again", Latches(record).in_force, latches.in_force)
        assert latches.described
        latches.release(latch.id, fleet=latch.fleet)
        assert not latches
    assert len(latches.in_force) <= STOPS


def read_claim(data: bytes) -> None:
    """Read what another gateway claims, and what it asks."""
    for reader in (claim._read, claim._read_question):
        with contextlib.suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            found: Any = reader(data)
            require_same("written and read again", comparable(reader(claim.write(found))), comparable(found))
            if isinstance(found, claim.Claim) and found.plausible:
                own = claim.Claim(held_s=5.0, healthy=True, yielded=found.yielded)
                assert found.better_than(own, "a", "b") != own.better_than(found, "b", "a"), "one of two is better"


def read_process(data: bytes) -> None:
    """Read what processes of a host tell each other, and the state that one hands to another."""
    for decode, encode in (
        (handover.decode, handover.encode),
        (msgspec.msgpack.Decoder(supervisor.Message).decode, msgspec.msgpack.Encoder().encode),
    ):
        with contextlib.suppress(msgspec.MsgspecError, UnicodeError, RecursionError):
            found = decode(data)
            require_same("written and read again", comparable(decode(encode(found))), comparable(found))


def read_key(data: bytes) -> None:
    """Read a key of the bus and the names in it, a token of ROS 2, and an address."""
    with contextlib.suppress(UnicodeDecodeError):
        text = data.decode()
        split, found = topics.split_key(text), topics.find(text)
        is_stop(text)
        assert split is None or f"{split[1]}/{split[2]}" in text
        assert found is None or found.path.partition("/")[0] == text.partition("/")[0]
        require_same("a name in a key", topics.unescape(topics.escape(text)), text)
        token = read_token(text)
        if token is not None and not isinstance(token.number, str):
            assert token.token()
        for parse in (Address.parse, Address.parse_listener, parse_device_address):
            with contextlib.suppress(LinkError):
                address = parse(text)
                require_same("an address written and read again", parse(str(address)), address)


def read_keyed(data: bytes) -> None:
    """Read a sample of a ROS 2 robot's link, and its attachment."""
    with contextlib.suppress(ProtocolError):
        found = read_sample(data)
        require_same("written and read again", read_sample(write_sample(found)), found)
    with contextlib.suppress(ProtocolError):
        attachment = read_attachment(data)
        require_same("written and read again", read_attachment(attachment.encode()), attachment)


def read_cdr(data: bytes) -> None:
    """Read a ROS 2 message of the type that the first byte chooses, and a Twist as a command."""
    if not data:
        return
    kind, body = ROS_TYPES[data[0] % len(ROS_TYPES)], data[1:]
    with contextlib.suppress(ProtocolError):
        found = TYPES.decode(kind, body)
        written = TYPES.encode(found)
        require_same("written and read again", TYPES.encode(TYPES.decode(kind, written)), written)
    for twist in (TWIST, STAMPED):
        with contextlib.suppress(ProtocolError, Malformed, Unsupported):
            drive = read_cdr_twist(TYPES, twist, body, RobotBody())
            require_drivable(drive)


def read_viewer(data: bytes) -> None:
    """Read what a viewer of Foxglove says: text, binary, a Twist."""
    for reader in (requests.read_text, requests.read_binary):
        with contextlib.suppress(ProtocolError):
            reader(data if reader is requests.read_binary else data.decode("utf-8", "replace"))
    with contextlib.suppress(Malformed):
        require_drivable(read_json_twist(data, Scale()))


def require_drivable(drive: messages.Drive) -> None:
    """Require that a drive is one that the bus carries."""
    payload.decode(messages.Drive, payload.encode(drive))


def targets() -> Iterator[Target]:
    """Yield the targets."""
    yield Target("fleet-payload", read_fleet, _fleet, ("zbridge/fleet/payload.py",))
    yield Target("authorization", read_authorization, _authorizations, (), 256)
    yield Target("stop", read_stops, _stops, ("zbridge/control/latch.py",), 512)
    yield Target("claim", read_claim, _claims, ())
    yield Target("process", read_process, _processes, ())
    yield Target("key", read_key, _keys, ("zbridge/fleet/topics.py", "zbridge/ros2/rmw_zenoh.py",
                                           "zbridge/protocol/address.py"), 512)  # fmt: skip
    yield Target("keyed-sample", read_keyed, _samples, ("zbridge/protocol/samples.py", "zbridge/ros2/rmw_zenoh.py"))
    yield Target("cdr", read_cdr, _cdr, ("zbridge/ros2/types.py", "zbridge/views/ros2/cmd_vel.py"))
    yield Target("viewer", read_viewer, _viewer, ("zbridge/views/foxglove/requests.py",))


def _fleet() -> Iterator[bytes]:
    for message, _ in PAYLOADS:
        yield bytes([KINDS.index(type(message))]) + payload.encode(message)


def _authorizations() -> Iterator[bytes]:
    yield msgspec.msgpack.encode(Authorization(lease=b"\1" * 8, seq=1, proof=b"\3" * 16))
    yield msgspec.msgpack.encode(Authorization(lease=b"\1" * 8, seq=2**40, proof=b"\3" * 16, t=2**50))


def _stops() -> Iterator[bytes]:
    yield b""
    yield payload.encode(Stop(id=b"\4" * 16))
    yield payload.encode(Stop(id=b"\4" * 16, latch=True, who="ann", reason="a cable is loose"))


def _claims() -> Iterator[bytes]:
    yield claim.write(claim.Claim(held_s=3.0, healthy=True, connected_s=2.0))
    yield claim.write(claim.ClaimQuestion("cafe", True))


def _processes() -> Iterator[bytes]:
    said: list[Any] = [
        handover.Hello(2, 1), handover.HandoverState(2, {"a": 1}, 3, listeners=({"b": b"c"},), metrics=(1,)),
        handover.Up(), handover.Failed("no"),
        supervisor.Heartbeat(), supervisor.Opened(1, "robot"), supervisor.Deposited(((1, 2),), 1, 9),
        supervisor.Fork("r1.toml", "r1"), supervisor.Forked(7), supervisor.Ready(),
    ]  # fmt: skip
    yield from map(msgspec.msgpack.encode, said)


def _keys() -> Iterator[bytes]:
    yield from (b"fleet/r1/@cmd/stop", b"fleet/*/@cmd/stop", b"fleet/r1/sensor/front%20left", b"sensor/front%20left")
    yield from (b"tcp://127.0.0.1:11001", b"tls://[::1]:1", b"serial:///dev/ttyUSB0?baud=57600", b"@cmd/motor/left")
    yield b"@ros2_lv/0/feed/0/1/MP/%/%/base/%scan/sensor_msgs::msg::dds_::LaserScan_/RIHS01_00/::,10:,:,:,,"
    yield b"@ros2_lv/0/feed/0/0/NN/%/%r1/zbridge"


def _samples() -> Iterator[bytes]:
    yield write_sample(KeyedSample(SampleKind.SAMPLE, "0/scan", b"\0\1", Attachment(1, 2, b"\5" * 16).encode(), 3))
    yield write_sample(KeyedSample(SampleKind.OPENED, payload=b"cafe"))
    yield Attachment(1, 2, b"\5" * 16).encode()
    yield b"\x0fsequence_number"


def _cdr() -> Iterator[bytes]:
    for number, kind in enumerate(ROS_TYPES):
        yield bytes([number]) + TYPES.encode(TYPES.message(kind))


def _viewer() -> Iterator[bytes]:
    yield b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":2}]}'
    yield b'{"op":"advertise","channels":[{"id":1,"topic":"/r1/cmd_vel","encoding":"json","schemaName":"x"}]}'
    yield b'{"op":"setParameters","parameters":[{"name":"r1.stop","value":true}],"id":"7"}'
    yield b'{"linear":{"x":0.5,"y":0,"z":0},"angular":{"z":-1e3}}'
    yield b'\1\1\0\0\0{"linear":{"x":1}}'
    yield b"\2\1\0\0\0\2\0\0\0\4\0\0\0json{}"
