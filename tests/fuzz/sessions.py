"""Targets of the sessions, in both roles, with the translation behind them: what a peer may send at any time.

An input is a byte that chooses the cuts and one that chooses the pauses, then the stream. It is read three times: whole
and cut, at one moment, which must give the same messages (but for those of unknown ids) and the same end; and with
pauses, timers, datagrams and all that is written, which may raise nothing.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from gateways.alf import PROTOCOL as ALF
from gateways.mavlink import PROTOCOL as MAVLINK
from gateways.ros2 import PROTOCOL as ROS2
from gateways.tcpudp import PROTOCOL as TCPUDP
from gateways.wc2ec import PROTOCOL as WC2EC
from gateways.wc2ec import SIMULATED
from tests.bounds import most_kept
from tests.captures import stream
from tests.fuzz.target import Target, chances, comparable, cut, require_same
from tests.gateways.alf import golden as alf
from tests.gateways.tcpudp import golden as tcpudp
from tests.gateways.wc2ec import golden as wc2ec
from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Switch
from zbridge.fleet.view import RobotView
from zbridge.metrics import Metrics
from zbridge.protocol import Limits, Protocol
from zbridge.protocol.session import Session

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples" / "khepera"
FRAMES = 2000
"""More frames than this after one input are a session that does not come to rest."""
PAUSES_S = (0.0, 0.001, 0.02, 0.1, 0.5, 2.0, 6.0)
BOUNDS = Limits(frame_bytes=1 << 20, handshake_s=5.0, rate_hz=1000.0)
SHARED = ("zbridge/protocol/session.py", "zbridge/protocol/outbox.py")

Tell = Callable[[Any], object]
"""Translates one message, as the process that runs the session does."""
Make = Callable[[], tuple[Session[Any], Tell, Callable[[float], object]]]
"""Makes a session, what translates its messages, and what a robot's side is told meanwhile."""


def converse(make: Make, data: bytes) -> None:
    """Read one input three times."""
    cuts, pauses, body = data[:1], data[1:2], data[2:]
    if not body:
        return
    require_same("the session depends on the cut", _at_once(make, [body]), _at_once(make, list(cut(body, cuts[0]))))
    _in_time(make, cut(body, cuts[0]), chances(pauses[0]))


def _at_once(make: Make, reads: Iterable[bytes]) -> list[Any]:
    session, _, _ = make()
    session.open(0.0)
    told = (message for read in reads for message in session.receive(read, 0.0))
    heard = [comparable(message) for message in told if getattr(message, "message", message) is not None]
    return [heard, session.state, (session.reason or "").partition(":")[0]]  # then it may quote bytes of the read


def _in_time(make: Make, reads: Iterable[bytes], chance: Iterator[int]) -> None:
    session, tell, command = make()
    now = 100.0
    session.open(now)
    for read in reads:
        now += PAUSES_S[next(chance) % len(PAUSES_S)]
        _run_timers(session, now)
        way = next(chance) % 16
        heard = session.receive_datagram(read[: way * len(read)], now) if way < 2 else session.receive(read, now)
        for message in heard:
            with contextlib.suppress(ProtocolError, EncodeError):
                tell(message)
        with contextlib.suppress(Refused, EncodeError):
            command(now)
        _drain(session, now)
        assert most_kept(session) <= session.limits.frame_bytes
    session.snapshot()
    session.close("the end", now)
    _run_timers(session, now + 10.0)
    assert session.over


def _run_timers(session: Session[Any], until: float) -> None:
    for _ in range(FRAMES):
        due = session.deadline()
        if due is None or due > until:
            return
        session.expire(due)
        _drain(session, due)
    raise AssertionError("a timer fires again and again")


def _drain(session: Session[Any], now: float) -> None:
    for _ in range(FRAMES):
        if session.outgoing(now) is None:
            return
    raise AssertionError("a session writes without end")


def _robot(protocol: Protocol, **options: Any) -> Make:
    """Make the session of a gateway with a robot; its messages become payloads."""
    chosen = msgspec.convert(options, protocol.options)

    def make() -> tuple[Session[Any], Tell, Callable[[float], object]]:
        robot = protocol.robot(chosen, 1, Metrics())
        session = robot.session(robot.link_names[0], "tcp://robot.test:1")
        numbers = itertools.count()

        def tell(message: Any) -> None:
            for topic, telemetry in robot.telemetry(message, 1_700_000_000_000_000_000):
                payloads.decode(topic.message, payloads.encode(telemetry))

        def command(now: float) -> None:
            topic, message = COMMANDS[next(numbers) % len(COMMANDS)]
            robot.stop(now, now + 1.0) if message is None else robot.command(topic, message, now)

        return session, tell, command

    return make


def _listener(protocol: Protocol, **options: Any) -> Make:
    """Make the session of a listener with an HQ program; its messages become commands."""
    assert protocol.hq is not None
    make_side, chosen = protocol.hq, msgspec.convert(options, protocol.hq_options)

    def make() -> tuple[Session[Any], Tell, Callable[[float], object]]:
        side = make_side(chosen, RobotView(), Metrics())
        session = side.session(1, BOUNDS)
        begun: list[Session[Any]] = []

        def tell(message: Any) -> None:
            for topic, command in side.take(session, message):
                payloads.decode(topic.message, payloads.encode(command))

        def command(now: float) -> None:
            if session.state.value == "established" and not begun:
                begun.append(session)
                side.begin(session, now)
            if now >= side.deadline(session):
                list(side.expire(session, now))

        return session, tell, command

    return make


COMMANDS: tuple[tuple[topics.Topic, Any], ...] = (
    (topics.CMD_DRIVE, Drive(forward=0.5)),
    (topics.CMD_MODE, Mode(mode="manual")),
    (topics.CMD_DRIVE, None),
    (topics.CMD_LIGHT, Switch(on=True)),
)
"""What the robot is told between two reads; None: its stop."""


def targets() -> Iterator[Target]:
    """Yield a target for each role and dialect."""
    for name, make, covered, captured in ROLES:
        sides = GOLDEN[name.split("-")[1]].SIDES
        spoken = [b"".join(frame for _, frame in side.stream) for side in sides]
        yield _target(name, make, covered, [*filter(None, [captured[:2000]]), *spoken])
    yield _target(
        "session-ros2-robot", _robot(ROS2), ("gateways/ros2/session.py", "gateways/ros2/graph.py"), _samples()
    )
    for name, make, writer in _MAVLINK:
        yield _target(f"session-mavlink-{name}", make, _MAVLINK_COVERS, _mavlink_streams(writer))
    yield _target("session-exchange-robot", _khepera(), ("zbridge/protocol/exchange.py", "zbridge/wire/lines.py"), [
        b"b,5,2\ne,1,-1\nn,1,2,3,4,5,6,7,8\nh,100,-100\n"
    ])  # fmt: skip


def _target(name: str, make: Make, covers: tuple[str, ...], streams: list[bytes]) -> Target:
    def seeds() -> list[bytes]:
        return [bytes([number * 37 % 256, number]) + each for number, each in enumerate(streams)]

    check = _paced if "exchange" in name else converse
    return Target(name, lambda data: check(make, data), seeds, covers + SHARED)


def _paced(make: Make, data: bytes) -> None:
    """Read an input in time only: whose request an answer belongs to depends on when it comes."""
    if len(data) > 2:
        _in_time(make, cut(data[2:], data[0]), chances(data[1]))


def _khepera() -> Make:
    """Make a session of requests and answers: that of the example in the plug-in guide."""
    sys.path.insert(0, str(EXAMPLES))
    try:
        from khepera import PROTOCOL
    finally:
        sys.path.remove(str(EXAMPLES))
    return _robot(PROTOCOL)


def _samples() -> list[bytes]:
    """Write what the link of a ROS 2 robot brings: the link opens, a publisher appears, odometry comes."""
    from tests.gateways.ros2 import scene
    from zbridge.protocol import KeyedSample, SampleKind, write_sample
    from zbridge.ros2.rmw_zenoh import gid_of

    made = []
    for number, (topic, kind) in enumerate(scene.KINDS.items()):
        by = scene.token(topic, kind, number=number)
        shown = number.to_bytes(8, "little") + bytes(8) + b"\x10" + gid_of(by)
        message = scene.TYPES.encode(scene.TYPES.message(kind))
        made.append(
            b"".join(
                map(
                    write_sample,
                    (
                        KeyedSample(SampleKind.OPENED, payload=b"cafe"),
                        KeyedSample(SampleKind.APPEARED, by),
                        KeyedSample(SampleKind.SAMPLE, scene.key(topic, kind), message, shown, 1),
                        KeyedSample(SampleKind.DROPPED, payload=b"\x01\0\0\0"),
                        KeyedSample(SampleKind.GONE, by),
                    ),
                )
            )
        )
    return made


def _mavlink_streams(sender: tuple[int, int]) -> list[bytes]:
    """Write what the link of a rover, or of a ground station, brings: frames of every message, and noise."""
    from gateways.mavlink.frames import write_frame
    from gateways.mavlink.messages import MESSAGES

    frames = [write_frame(spec.message(), number, *sender) for number, spec in enumerate(MESSAGES.values())]
    beats = bytes.fromhex("fd0900000001010000000f0000000a03c10403ac7c") * 3
    ordered = "fd20000000ffbe4c00000000803f000080400000000000000000000000000000000000000000b00001010e93"
    stick = bytes.fromhex("fd0b000000ffbe450000000006fff401000000000146e7")
    return [beats + b"".join(frames[:17]), beats + b"".join(frames[17:]), bytes.fromhex(ordered) + stick + b"\xfd" * 20]


GOLDEN: dict[str, Any] = {"alf": alf, "tcpudp": tcpudp, "wc2ec": wc2ec}
_ALF = ("gateways/alf/session.py", "gateways/alf/translate.py", "gateways/alf/hq.py")
_WC2EC = ("gateways/wc2ec/session.py", "gateways/wc2ec/devices.py", "gateways/wc2ec/translate.py")
_TCPUDP = ("gateways/tcpudp/session/robot_role.py", "gateways/tcpudp/session/hq_role.py",
           "gateways/tcpudp/session/signs.py", "gateways/tcpudp/settings.py",
           "gateways/tcpudp/telemetry.py", "gateways/tcpudp/hq_client.py")  # fmt: skip
ROLES: tuple[tuple[str, Make, tuple[str, ...], bytes], ...] = (
    ("session-alf-robot-text", _robot(ALF, points=3), _ALF, stream("alf-laser.hex", source=16667)),
    ("session-alf-robot-scanner", _robot(ALF, points_from_scanner=True), _ALF, stream("alf-laser.hex", source=16667)),
    ("session-alf-robot-binary", _robot(ALF, dialect="binary", points=3), _ALF, b""),
    ("session-alf-hq-text", _listener(ALF), _ALF, stream("alf-drive.hex", destination=16668)),
    ("session-alf-hq-binary", _listener(ALF, dialect="binary"), _ALF, b""),
    ("session-tcpudp-robot", _robot(TCPUDP), _TCPUDP, stream("tcpudp-1.1-tcp.hex", source=11001)),
    ("session-tcpudp-hq", _listener(TCPUDP, versions=["1.1", "1.2", "1.3", "1.4"]), _TCPUDP,
     stream("tcpudp-1.3-udp.hex", destination=11001)),
    ("session-wc2ec-robot", _robot(WC2EC, **SIMULATED), _WC2EC, stream("wc2ec-deployed.hex", source=27515)),
    ("session-wc2ec-robot-draft", _robot(WC2EC, dialect="draft", devices=[{"name": "light0", "number": 0}]), _WC2EC,
     b""),
    ("session-wc2ec-hq", _listener(WC2EC), _WC2EC, stream("wc2ec-deployed.hex", destination=27515)),
    ("session-wc2ec-hq-draft", _listener(WC2EC, dialect="draft", devices=[{"name": "light0", "number": 0}]), _WC2EC,
     b""),
)  # fmt: skip
_MAVLINK_COVERS = (
    "gateways/mavlink/frames.py",
    "gateways/mavlink/rover/session.py",
    "gateways/mavlink/station/session.py",
    "gateways/mavlink/station/hq.py",
)
_MAVLINK: tuple[tuple[str, Make, tuple[int, int]], ...] = (
    ("rover", _robot(MAVLINK, arm="drive"), (1, 1)),
    ("rover-manual", _robot(MAVLINK, arm="drive", drive="manual", vehicle_id=1), (1, 1)),
    ("station", _listener(MAVLINK, system_id=1), (255, 190)),
)
