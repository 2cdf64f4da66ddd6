"""A ROS 2 robot over plain Zenoh, written from rmw_zenoh's sources alone: it records whatever differs from them.

It keeps the last commanded velocity for ever, as the worst drivers do: only a command stops it. Each command must have
a whole attachment, the gid of a publisher whose token is alive, numbers without gaps, a time that rises, and
a payload of the exact size. CDR is written and read here by :mod:`struct`; the type hashes are those that ROS prints.
"""

from __future__ import annotations

import json
import math
import struct
import threading
import time
from collections import Counter
from typing import Any, NamedTuple

import xxhash
import zenoh
import zenoh.ext

from zbridge.simulation.judge import Judge

HASHES = {
    "LaserScan": "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "OccupancyGrid": "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    "Twist": "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "TwistStamped": "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
}
PACKAGES = {"LaserScan": "sensor_msgs", "Odometry": "nav_msgs", "OccupancyGrid": "nav_msgs"}
SENSOR, RELIABLE, LATCHED = "2::,5:,:,:,,", "::,10:,:,:,,", ":1:,1:,:,:,,"
CDR = bytes((0, 1, 0, 0))
SIDE, CELL_M = 40, 0.1
"""Cells along a side of the map."""
POINTS = 360
GRACE_S = 1.0
"""Seconds by which the news of a token may be later than a command, or a command later than the end of its token."""
LATE_S = 5.0
"""Seconds by which the time of an attachment may be wrong."""
SKIPS = 5
"""Numbers that may go up at once: Zenoh drops commands between ROS nodes too, where a router is late by 20 ms."""


class JudgedCommand(NamedTuple):
    """One command: when it came, from which gid, m/s forward and to the left, rad/s."""

    at: float
    gid: bytes
    forward: float
    left: float
    turn: float

    @property
    def moves(self) -> bool:
        """Whether it is motion."""
        return bool(self.forward or self.left or self.turn)


def config(router: str) -> zenoh.Config:
    """Configure a session as a client of a router at ``tcp/host:port``."""
    made = zenoh.Config()
    values = {"mode": "client", "connect/endpoints": [router], "scouting/multicast/enabled": False}
    for key, value in {**values, "timestamping/enabled": True, "connect/timeout_ms": 10_000}.items():
        made.insert_json5(key, json.dumps(value))
    return made


def gid_of(token: str) -> bytes:
    """Hash a token: the low half first, each little-endian."""
    return b"".join(
        half.to_bytes(8, "little") for half in divmod(xxhash.xxh3_128_intdigest(token.encode()), 2**64)[::-1]
    )


class StrictRobot(Judge):
    """The robot. namespace: with ``/`` first, or empty; stamped: its base subscribes to TwistStamped."""

    def __init__(self, router: str, *, namespace: str = "", stamped: bool = False, domain: int = 0) -> None:
        super().__init__()
        self.session = zenoh.open(config(router))
        self.commands: list[JudgedCommand] = []
        self.velocity = (0.0, 0.0, 0.0)
        self.x = self.y = self.heading = 0.0
        self.clock_ns = time.time_ns
        """The robot's own clock; tests replace it."""
        self._zid, self._domain, self._prefix = str(self.session.zid()), domain, namespace
        self._command = "TwistStamped" if stamped else "Twist"
        self._numbers: Counter[str] = Counter()
        self._last: dict[bytes, tuple[int, int]] = {}
        self._gids: dict[str, bytes] = {}
        self._lock = threading.Lock()
        self._ends = threading.Event()
        self.tokens: dict[str, Any] = {}
        """What it has declared; a test undeclares tokens."""
        self._hangs = False
        self._alive: dict[bytes, float] = {}
        """The gids of tokens, and until when they count: news of tokens and commands come on different threads."""
        self._declare()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    def _declare(self) -> None:
        session, topic = self.session, f"@ros2_lv/{self._domain}/*/*/*/MP/*/*/*/{self._mangled('cmd_vel')}/**"
        self._watch = session.liveliness().declare_subscriber(topic, self._on_token, history=True)
        self._commands = session.declare_subscriber(self._key("cmd_vel", self._command), self._on_command)
        self.announce(0, "NN", None)
        self.announce(1, "MS", "cmd_vel", self._command)
        for number, (name, kind, qos) in enumerate(
            (("scan", "LaserScan", SENSOR), ("odom", "Odometry", RELIABLE), ("map", "OccupancyGrid", LATCHED)), 2
        ):
            self._gids[name] = gid_of(self.announce(number, "MP", name, kind, qos))
        self._scans = session.declare_publisher(self._key("scan", "LaserScan"))
        self._odometry = session.declare_publisher(self._key("odom", "Odometry"))
        self._maps = zenoh.ext.declare_advanced_publisher(
            session, self._key("map", "OccupancyGrid"), cache=zenoh.ext.CacheConfig(1), publisher_detection=True
        )
        self._maps.put(self._map(), attachment=self._attachment("map"))

    def _mangled(self, name: str) -> str:
        return f"{self._prefix}/{name}".replace("/", "%")

    def _key(self, name: str, kind: str) -> str:
        package = PACKAGES.get(kind, "geometry_msgs")
        return f"{self._domain}/{f'{self._prefix}/{name}'.strip('/')}/{package}::msg::dds_::{kind}_/{HASHES[kind]}"

    def announce(self, number: int, kind: str, name: str | None, type_name: str = "", qos: str = RELIABLE) -> str:
        """Declare the token of the node or of one endpoint; give it."""
        token = f"@ros2_lv/{self._domain}/{self._zid}/0/{number}/{kind}/%/{self._prefix.replace('/', '%') or '%'}/base"
        if name is not None:
            package = PACKAGES.get(type_name, "geometry_msgs")
            token += f"/{self._mangled(name)}/{package}::msg::dds_::{type_name}_/{HASHES[type_name]}/{qos}"
        self.tokens[token] = self.session.liveliness().declare_token(token)
        return token

    # Commands

    def _on_token(self, sample: zenoh.Sample) -> None:
        gid = gid_of(str(sample.key_expr))
        here = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            self._alive[gid] = math.inf if here else time.monotonic() + GRACE_S

    def _on_command(self, sample: zenoh.Sample) -> None:
        at = time.monotonic()
        attachment, payload = sample.attachment, sample.payload.to_bytes()
        try:
            gid = self._judge(attachment.to_bytes() if attachment is not None else b"")
            values = self._twist(payload)
        except ValueError as error:
            self._violate(str(error))
            return
        forward, left, up, roll, pitch, turn = values
        if up or roll or pitch or not all(map(math.isfinite, values)):
            self._violate(f"twist {values}")
        self.velocity = (forward, left, turn)
        self.commands.append(JudgedCommand(at, gid, forward, left, turn))

    def _judge(self, attachment: bytes) -> bytes:
        if len(attachment) != 33 or attachment[16] != 16:
            raise ValueError(f"attachment of {len(attachment)} bytes")
        number, sent_ns = struct.unpack_from("<qq", attachment)
        gid = attachment[17:]
        given_up_at = time.monotonic() + GRACE_S
        while not self._is_alive(gid):
            if time.monotonic() > given_up_at:
                raise ValueError("a gid whose token is not alive")
            time.sleep(0.01)
        before, before_ns = self._last.get(gid, (number - 1, 0))
        self._last[gid] = number, sent_ns
        if number < 1 or not before < number <= before + SKIPS:
            self._violate(f"number {number} after {before}")
        if sent_ns < before_ns or abs(sent_ns - time.time_ns()) > LATE_S * 1e9:
            self._violate(f"sent at {sent_ns}, after {before_ns}, now {time.time_ns()}")
        return gid

    def _is_alive(self, gid: bytes) -> bool:
        with self._lock:
            return self._alive.get(gid, 0.0) > time.monotonic()

    def _twist(self, payload: bytes) -> tuple[float, ...]:
        at = 4
        if payload[:4] != CDR:
            raise ValueError(f"encapsulation {payload[:4].hex()}")
        if self._command == "TwistStamped":
            seconds, nanoseconds, length = struct.unpack_from("<iII", payload, at)
            stamp_ns = seconds * 1_000_000_000 + nanoseconds
            if stamp_ns and abs(stamp_ns - self.clock_ns()) > LATE_S * 1e9:
                self._violate(f"stamped {stamp_ns}, the robot's clock is {self.clock_ns()}")
            at += 12 + length
            at += -(at - 4) % 8
        if len(payload) != at + 48:
            raise ValueError(f"payload of {len(payload)} bytes, expected {at + 48}")
        return struct.unpack_from("<6d", payload, at)

    # Life

    def _live(self) -> None:
        last, steps = time.monotonic(), 0
        while not self._ends.wait(0.05):
            now = time.monotonic()
            forward, left, turn = self.velocity
            passed_s, last = now - last, now
            self.heading += turn * passed_s
            self.x += (forward * math.cos(self.heading) - left * math.sin(self.heading)) * passed_s
            self.y += (forward * math.sin(self.heading) + left * math.cos(self.heading)) * passed_s
            steps += 1
            if self._hangs:
                continue
            self._odometry.put(self._odom(), attachment=self._attachment("odom"))
            if steps % 2 == 0:
                self._scans.put(self._scan(), attachment=self._attachment("scan"))

    def _attachment(self, name: str) -> bytes:
        self._numbers[name] += 1
        return struct.pack("<qqB", self._numbers[name], time.time_ns(), 16) + self._gids[name]

    def _header(self, frame: bytes) -> bytes:
        seconds, nanoseconds = divmod(self.clock_ns(), 1_000_000_000)
        return struct.pack("<iII", seconds, nanoseconds, len(frame) + 1) + frame + b"\0"

    def _scan(self) -> bytes:
        """Walls 1 m away on the left, 2 m on the right; every tenth point sees nothing."""
        body = self._header(b"laser")
        body += bytes(-len(body) % 4)
        ranges = [math.inf if n % 10 == 0 else 2.0 if n < POINTS // 2 else 1.0 for n in range(POINTS)]
        step = 2 * math.pi / POINTS
        body += struct.pack("<7f", -math.pi, math.pi - step, step, 0.0, 0.1, 0.1, 10.0)
        body += struct.pack(f"<I{POINTS}fI", POINTS, *ranges, 0)
        return CDR + body

    def _odom(self) -> bytes:
        body = self._header(b"odom")
        body += bytes(-len(body) % 4) + struct.pack("<I", 10) + b"base_link\0"
        body += bytes(-len(body) % 8)
        forward, left, turn = self.velocity
        body += struct.pack("<7d", self.x, self.y, 0, 0, 0, math.sin(self.heading / 2), math.cos(self.heading / 2))
        body += bytes(36 * 8) + struct.pack("<6d", forward, left, 0, 0, 0, turn) + bytes(36 * 8)
        return CDR + body

    def _map(self) -> bytes:
        """Draw a map whose left half is free, right half unknown, and last row occupied."""
        body = self._header(b"map")
        body += bytes(-len(body) % 4) + struct.pack("<iIfII", 0, 0, CELL_M, SIDE, SIDE)
        body += bytes(-len(body) % 8) + struct.pack("<7d", -2.0, -2.0, 0, 0, 0, 0, 1)
        row = b"\0" * (SIDE // 2) + b"\xff" * (SIDE // 2)
        return CDR + body + struct.pack("<I", SIDE * SIDE) + row * (SIDE - 1) + b"\x64" * SIDE

    def hang(self, hangs: bool) -> None:
        """Publish nothing while it hangs; commands are obeyed."""
        self._hangs = hangs

    def close(self) -> None:
        """Leave."""
        self._ends.set()
        self._thread.join()
        self.session.close()  # type: ignore[no-untyped-call]
