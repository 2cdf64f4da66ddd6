"""Every key below ``<realm>/<robot>/``, declared once: its path, its message, and its class of delivery.

Names in keys: bytes outside ``[A-Za-z0-9_.-]`` become ``%XX``; an empty name is ``%``. Sans-IO.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from functools import lru_cache
from urllib.parse import unquote

import msgspec

from zbridge.fleet.incidents import ReadIncident
from zbridge.fleet.lease_messages import Acquire, Authorization, Unlatch
from zbridge.fleet.messages import (
    Battery,
    Control,
    Devices,
    Drive,
    FleetMessage,
    Image,
    Map,
    Mode,
    Motion,
    Motor,
    Pose,
    Query,
    Raw,
    Reading,
    Refusals,
    Scan,
    Scanner,
    SensorSetting,
    Status,
    Stop,
    Switch,
    Text,
)
from zbridge.fleet.processes import Stats


class Delivery(Enum):
    """The classes of the design's key table; :data:`QOS` has the quality of service of each."""

    STREAM = "stream"
    STATE = "state"
    COMMAND = "command"
    QUERY = "query"


class Congestion(Enum):
    """What happens to a message where the transmission queue is full."""

    DROP = "drop"
    BLOCK = "block"


class Priority(Enum):
    """The bus priorities in use."""

    DATA = "data"
    DATA_HIGH = "data high"
    REAL_TIME = "real time"


class QoS(msgspec.Struct, frozen=True):
    """How the bus treats a class of messages.

    newest: of a key only the newest message waits where the bus is slower, whatever ``bus.stream`` says.
    """

    priority: Priority
    congestion: Congestion
    express: bool = False
    keeps_last: bool = False
    newest: bool = False


class Topic(msgspec.Struct, frozen=True):
    """One key of a robot: ``path`` below ``<realm>/<robot>/``.

    most_bytes: bound of payload and attachment together, of a command or a query; None: unbounded.
    """

    path: str
    message: type[FleetMessage]
    delivery: Delivery
    most_bytes: int | None = None

    @property
    def qos(self) -> QoS:
        """The quality of service. A drive is dropped under congestion: the next one comes soon. An image is large."""
        return _SPECIAL_QOS.get(self.message) or QOS[self.delivery]


SizeBounds = Sequence[tuple[tuple[str, ...], int]]
"""Key expressions, and the bound of payload and attachment together on each, in bytes."""
Family = Callable[[str], Topic]
"""Topics that share all but the last chunk: ``SENSOR("front left")``."""

QOS = {
    Delivery.STREAM: QoS(Priority.DATA, Congestion.DROP),
    Delivery.STATE: QoS(Priority.DATA_HIGH, Congestion.BLOCK, keeps_last=True),
    Delivery.COMMAND: QoS(Priority.REAL_TIME, Congestion.BLOCK, express=True),
    Delivery.QUERY: QoS(Priority.REAL_TIME, Congestion.BLOCK, express=True),
}
_SPECIAL_QOS: dict[type[FleetMessage], QoS] = {
    Drive: QoS(Priority.REAL_TIME, Congestion.DROP, express=True),
    Image: QoS(Priority.DATA, Congestion.DROP, newest=True),
}

SMALL_BYTES = 256
"""Bound of a small message: a motion, a switch, a proof."""
QUERY_BYTES = 1024
"""Bound of a query: an acquire with the longest names."""
SETTING_BYTES = 16_384
"""Bound of a sensor setting (1 000 values), of a listener's report of refusals, and of queries that are not known."""
LARGE_BYTES = 65_536
"""Bound of a scan (16 000 points), a text and a raw message."""

WIRE_DATAGRAM = b"datagram"
"""Attachment of a raw frame (``@wire``) that went by datagram; others have none."""

_NAME = re.compile(r"[A-Za-z0-9_.-]+")
_ESCAPED = re.compile(rb"[^A-Za-z0-9_.-]")


def is_name(name: str) -> bool:
    """Return whether ``name`` is a key chunk without escapes."""
    return _NAME.fullmatch(name) is not None


def escape(name: str) -> str:
    """Write any name as one key chunk; :func:`unescape` reverses it."""
    if not name:
        return "%"
    return _ESCAPED.sub(lambda match: b"%%%02X" % match.group()[0], name.encode("utf-8", "surrogateescape")).decode()


def unescape(chunk: str) -> str:
    """Read a name from its key chunk."""
    return "" if chunk == "%" else unquote(chunk, errors="surrogateescape")


def speaks_for(who: str, chunk: str) -> bool:
    """Return whether a program that queries this key chunk may call itself ``who``: the chunk's name, or name.suffix.

    Access rules on keys can so restrict each program to its own name.
    """
    name = escape(who)
    return name == chunk or name.startswith(f"{chunk}.")


def may_name_token(alive: str, chunk: str) -> bool:
    """Return whether a program that queries this key chunk may name the liveliness token ``@alive/<alive>`` as its own.

    Access rules let each program declare tokens of its own name only: ``operator.<name>.<id>``, ``hq.<name>.<id>``.
    """
    begins = (f"{chunk}.",) if chunk.startswith("hq.") else (f"operator.{chunk}.", f"hq.{chunk}.")
    return alive.startswith(begins)


def is_concrete(key: str) -> bool:
    """Tell a key from an expression with wildcards."""
    return "*" not in key


_FAMILIES: dict[str, Family] = {}


def _family(prefix: str, message: type[FleetMessage], delivery: Delivery, most_bytes: int | None = None) -> Family:
    @lru_cache(maxsize=1024)
    def topic(name: str) -> Topic:
        return Topic(f"{prefix}/{escape(name)}", message, delivery, most_bytes)

    _FAMILIES[prefix] = topic
    return topic


SCAN = Topic("scan", Scan, Delivery.STREAM)
"""A sweep of an ALF vehicle or a ROS 2 robot; a Webots robot's distance sensors by bearing; simulated lidar data."""
MOTION = Topic("motion", Motion, Delivery.STREAM)
"""Speed, accelerations, gyro, temperature."""
POSE = Topic("pose", Pose, Delivery.STREAM)
"""Where the robot is on its own map."""
TEXT = Topic("text", Text, Delivery.STREAM)
"""A text of the robot for people, or its request for simulated lidar data."""
IMAGE = Topic("image", Image, Delivery.STREAM)
"""One picture of ``[camera]``, or of a ROS 2 robot; only while somebody subscribes."""
BATTERY = Topic("battery", Battery, Delivery.STREAM)
"""Level, voltage, current."""
SENSOR = _family("sensor", Reading, Delivery.STREAM)
"""One sensor's value."""
RAW = _family("raw", Raw, Delivery.STREAM)
"""Legacy messages that no fleet message represents, by protocol: ``raw/tcpudp``."""

STATUS = Topic("status", Status, Delivery.STATE)
"""Whether the robot can be used, its version and links, what it accepts now; also once a second."""
CONTROL = Topic("control", Control, Delivery.STATE)
"""Who drives, latched stops, recent stops and refusals; also once a second."""
SCANNER = Topic("scanner", Scanner, Delivery.STATE)
"""The geometry of the scanner."""
MAP = Topic("map", Map, Delivery.STATE)
"""The robot's occupancy map."""
LIDAR = Topic("lidar", Switch, Delivery.STATE)
"""Whether the lidar is on."""
CAMERA = Topic("camera", Switch, Delivery.STATE)
"""Whether the camera is on."""
DEVICES = Topic("devices", Devices, Delivery.STATE)
"""The device table of a Webots robot."""
STATS = Topic("@gateway/stats", Stats, Delivery.STATE)
"""What the gateway does and uses, once a second; no wildcard of data such as ``fleet/r1/**`` includes it."""

CMD_DRIVE = Topic("@cmd/drive", Drive, Delivery.COMMAND, SMALL_BYTES)
"""Motion, or neutral; needs the lease."""
CMD_STOP = Topic("@cmd/stop", Stop, Delivery.COMMAND, SMALL_BYTES)
"""Stops the robot now; open to everyone. An empty payload is a plain stop."""
CMD_MODE = Topic("@cmd/mode", Mode, Delivery.COMMAND, SMALL_BYTES)
"""Who moves the robot; needs the lease."""
CMD_LIGHT = Topic("@cmd/light", Switch, Delivery.COMMAND, SMALL_BYTES)
"""Switches the light; needs no lease."""
CMD_LIDAR = Topic("@cmd/lidar", Switch, Delivery.COMMAND, SMALL_BYTES)
"""Switches the lidar; needs no lease."""
CMD_CAMERA = Topic("@cmd/camera", Switch, Delivery.COMMAND, SMALL_BYTES)
"""Switches the camera; needs no lease."""
CMD_TEXT = Topic("@cmd/text", Text, Delivery.COMMAND, LARGE_BYTES)
"""A text for the robot; needs no lease."""
CMD_SCAN = Topic("@cmd/scan", Scan, Delivery.COMMAND, LARGE_BYTES)
"""Simulated lidar data for a TCP/UDP robot; needs no lease."""
CMD_MOTOR = _family("@cmd/motor", Motor, Delivery.COMMAND, SMALL_BYTES)
"""One motor of a Webots robot; needs the lease."""
CMD_SENSOR = _family("@cmd/sensor", SensorSetting, Delivery.COMMAND, SETTING_BYTES)
"""Settings of one sensor; needs no lease."""
CMD_RAW = _family("@cmd/raw", Raw, Delivery.COMMAND, LARGE_BYTES)
"""A legacy message for the robot, by protocol; needs the lease."""

RPC_SESSIONS = _family("@rpc/sessions", Query, Delivery.QUERY, QUERY_BYTES)
"""The sessions of one process with robots and HQ programs: ``gateway``, ``hq.<name>.<zid>``; ``*``: of all."""
RPC_MAP = Topic("@rpc/map", Query, Delivery.QUERY, QUERY_BYTES)
"""Asks the robot for its map now; answered or refused within 2 s."""
RPC_POSE = Topic("@rpc/pose", Query, Delivery.QUERY, QUERY_BYTES)
"""Asks the robot for its pose now; answered or refused within 2 s."""
RPC_ACQUIRE = _family("@rpc/control/acquire", Acquire, Delivery.QUERY, QUERY_BYTES)
"""Asks for the lease, by the name of the one who asks."""
RPC_TAKEOVER = _family("@rpc/control/takeover", Acquire, Delivery.QUERY, QUERY_BYTES)
"""Takes the lease from whoever has it."""
RPC_RENEW = Topic("@rpc/control/renew", Authorization, Delivery.QUERY, SMALL_BYTES)
"""Extends the lease."""
RPC_RELEASE = Topic("@rpc/control/release", Authorization, Delivery.QUERY, SMALL_BYTES)
"""Gives the lease back."""
RPC_UNLATCH = _family("@rpc/control/unlatch", Unlatch, Delivery.QUERY, SMALL_BYTES)
"""Releases a latched stop of this robot."""
RPC_UNLATCH_FLEET = _family("@rpc/control/unlatch_fleet", Unlatch, Delivery.QUERY, SMALL_BYTES)
"""Releases a latched stop of the whole fleet."""
RPC_LATCH = Topic("@rpc/latch", Query, Delivery.QUERY, SMALL_BYTES)
"""The fleet's latched stops that this gateway knows, and the last 64 ids released."""
RPC_REFUSED = _family("@rpc/control/refused", Refusals, Delivery.QUERY, SETTING_BYTES)
"""A listener reports what it refused its HQ programs, at ``hq.<listener>``."""
RPC_RESTART = _family("@rpc/restart", Query, Delivery.QUERY, QUERY_BYTES)
"""The gateway hands everything over to a new process; replies once that is done, or refused with the reason."""

RPC_INCIDENTS = Topic("@rpc/blackbox/incidents", Query, Delivery.QUERY, SMALL_BYTES)
"""The incidents that the black box of this gateway keeps."""
RPC_INCIDENT_READ = _family("@rpc/blackbox/read", ReadIncident, Delivery.QUERY, QUERY_BYTES)
"""A part of an incident's file, by the name of the one who asks."""
RPC_INCIDENT_KEEP = _family("@rpc/blackbox/keep", Text, Delivery.QUERY, SETTING_BYTES)
"""Keeps the minutes before now, by the name of the one who asks; the text says why."""

_TOPICS = {topic.path: topic for topic in list(globals().values()) if isinstance(topic, Topic)}


def _bounded() -> Iterator[tuple[str, int]]:
    """Yield every command and query below a robot and its bound; a family with a wildcard."""
    for topic in _TOPICS.values():
        if topic.most_bytes is not None:
            yield topic.path, topic.most_bytes
    for prefix, family in _FAMILIES.items():
        most_bytes = family("").most_bytes
        if most_bytes is not None:
            yield f"{prefix}/*", most_bytes


def size_bounds() -> SizeBounds:
    """Return the bounds of all commands and queries of any robot, for the bus to enforce.

    All other keys below ``@cmd`` and ``@rpc``, and puts with wildcards, have bounds too. A message must keep within
    every bound whose key expression intersects its key: a bound of all keys below a chunk is that of the largest.
    """
    groups: dict[int, list[str]] = {LARGE_BYTES: ["**/@cmd/**"], SETTING_BYTES: ["**/@rpc/**"]}
    for path, most_bytes in _bounded():
        groups.setdefault(most_bytes, []).append(f"**/{path}")
    return tuple((tuple(key_exprs), most_bytes) for most_bytes, key_exprs in sorted(groups.items()))


def find(path: str) -> Topic | None:
    """Return the topic of a path below ``<realm>/<robot>/``; None for an unknown path."""
    topic = _TOPICS.get(path)
    if topic is None:
        prefix, _, name = path.rpartition("/")
        family = _FAMILIES.get(prefix)
        topic = family(unescape(name)) if family and name else None
    return topic


class KeySpace(msgspec.Struct, frozen=True):
    """The keys of one robot."""

    realm: str
    robot: str

    def key(self, path: str) -> str:
        """Write the full key of a path."""
        return f"{self.realm}/{self.robot}/{path}"

    def path(self, key: str) -> str:
        """Read the path back from a full key of this robot."""
        return key.removeprefix(f"{self.realm}/{self.robot}/")

    def alive(self, who: str) -> str:
        """Write the key of a liveliness token."""
        return self.key(f"@alive/{who}")


def whoami(realm: str, name: str) -> str:
    """Write the key at which a router answers one member what it knows of it; ``*``: all members."""
    return f"{realm}/@bus/whoami/{name}"


def split_key(key: str) -> tuple[str, str, str] | None:
    """Split a full key into realm, robot and path; None if it has fewer chunks."""
    realm, _, rest = key.partition("/")
    robot, _, path = rest.partition("/")
    return (realm, robot, path) if path else None


@lru_cache(maxsize=65536)
def matches(key_expr: str, key: str) -> bool:
    """Return whether a key expression matches a key, as on the bus: ``@...`` matches only itself."""
    return _follow(tuple(key_expr.split("/")), tuple(key.split("/")))


def _follow(expression: tuple[str, ...], chunks: tuple[str, ...]) -> bool:
    """Follow all positions of the expression that the chunks so far may have reached."""
    places = _behind_wildcards(expression, {0})
    for chunk in chunks:
        plain = not chunk.startswith("@")
        reached = set()
        for place in places:
            if place < len(expression):
                wanted = expression[place]
                if wanted == "**" and plain:
                    reached.add(place)
                elif wanted == chunk or (wanted == "*" and plain):
                    reached.add(place + 1)
        places = _behind_wildcards(expression, reached)
    return len(expression) in places


def _behind_wildcards(expression: tuple[str, ...], places: set[int]) -> set[int]:
    """Add the places behind each ``**``, which may stand for nothing."""
    found = set(places)
    for place in sorted(places):
        while place < len(expression) and expression[place] == "**":
            place += 1
            found.add(place)
    return found


def gateways_of(key_expr: str) -> str:
    """Write the key expression of the liveliness tokens of the gateways whose keys an expression may match."""
    realm, robot, *_ = (*key_expr.split("/"), "**")
    if "**" in (realm, robot):
        realm, robot = "*" if realm == "**" else realm, "*"
    return f"{realm}/{robot}/@alive/gateway"


def of_robot(key_expr: str, realm: str, robot: str) -> str:
    """Narrow a key expression to the keys of one robot, where ``**`` does not stand for a part of realm or robot."""
    chunks = key_expr.split("/")
    if chunks[1:] == ["**"] and chunks[0] != "**":
        return f"{realm}/{robot}/**"
    if "**" in chunks[:2]:
        return key_expr
    return "/".join((realm, robot, *chunks[2:]))
