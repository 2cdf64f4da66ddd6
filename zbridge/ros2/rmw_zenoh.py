"""The format of rmw_zenoh: names and keys, liveliness tokens with their quality of service, and attachments. Sans-IO.

``@ros2_lv/<domain>/<zid>/<nid>/<id>/<kind>/<enclave>/<namespace>/<node>`` is the token of a node; that of an endpoint
has ``/<topic>/<type>/<hash>/<qos>`` after it. ``/`` within a part is ``%``; an empty part is ``%``. An attachment has
33 bytes: number, time and gid of a sample, request or reply.
"""

from __future__ import annotations

import re
import struct
from enum import Enum

import msgspec

from zbridge.errors import ProtocolError

_TOKEN = r"[A-Za-z_][A-Za-z0-9_]*"
_NAME = re.compile(rf"(/{_TOKEN})+")
_TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)/(msg|srv|action)/([A-Za-z][A-Za-z0-9_]*)")
_DDS = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::(msg|srv|action)::dds_::([A-Za-z][A-Za-z0-9_]*)_")
_OUTSIDE = re.compile(r"[^A-Za-z0-9_]")


def is_ros_name(name: str) -> bool:
    """Return whether this is the full name of a topic, a service or a namespace: ``/r1/scan``."""
    return _NAME.fullmatch(name) is not None


def ros_name(name: str) -> str:
    """Write any name as one part of a ROS name: letters, digits and ``_``, no digit first, empty as ``_``.

    Different names may give the same part: who writes several has to look.
    """
    part = _OUTSIDE.sub("_", name)
    return part if part and not part[0].isdigit() else f"_{part}"


def dds_type(ros_type: str) -> str:
    """Write a type as it stands in keys: ``sensor_msgs::msg::dds_::Imu_`` of ``sensor_msgs/msg/Imu``; or ValueError."""
    match = _TYPE.fullmatch(ros_type)
    if match is None:
        raise ValueError(f"type {ros_type!r}: expected package/msg/Name")
    package, kind, name = match.groups()
    return f"{package}::{kind}::dds_::{name}_"


def ros_type(dds_type: str) -> str | None:
    """Read a type as it stands in keys; None if it is none."""
    match = _DDS.fullmatch(dds_type)
    return "/".join(match.groups()) if match is not None else None


def topic_key(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """Write the key of a topic or service. name: ``/r1/scan``; type_name: ``sensor_msgs/msg/LaserScan``."""
    return f"{domain}/{name.strip('/')}/{dds_type(type_name)}/{type_hash}"


_DEFAULT_DEPTH = 42
"""rmw_zenoh's default, which it leaves out."""


class RosQoS(msgspec.Struct, frozen=True):
    """How an endpoint sends or wants messages. depth: kept messages; 0: all of them.

    best_effort: not reliable. transient_local: not volatile. Deadline, lifespan and liveliness are always the defaults.
    """

    best_effort: bool = False
    transient_local: bool = False
    depth: int = 10

    def __str__(self) -> str:
        """Write it as in tokens: a field that has rmw_zenoh's default is empty."""
        reliability, durability = "2" if self.best_effort else "", "1" if self.transient_local else ""
        history = "" if self.depth else "2"
        depth = str(self.depth) if self.depth and self.depth != _DEFAULT_DEPTH else ""
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


def read_qos(text: str) -> RosQoS | None:
    """Read the quality of service of a token; None if it is none. Only the first three fields are looked at."""
    found = _QOS.fullmatch(text)
    if found is None:
        return None
    reliability, durability, history, depth = found.groups()
    return RosQoS(reliability == "2", durability == "1", 0 if history == "2" else int(depth or _DEFAULT_DEPTH))


_QOS = re.compile(r"([0-3]?):([0-3]?):([0-3]?),([0-9]{0,18})(?::[^:]*){3,}")
"""Reliability, durability and history as rmw numbers them, empty: its default; and the depth."""
KEEP_LAST_10 = RosQoS()
SENSOR_DATA = RosQoS(best_effort=True, depth=5)
"""rmw_qos_profile_sensor_data."""
LATCHED = RosQoS(transient_local=True, depth=1)
"""Who comes late gets the last message."""
SERVICES = KEEP_LAST_10
"""rmw_qos_profile_services_default."""


_FORMAT = struct.Struct("<qqB16s")
GID_BYTES = 16
_NAMED = b"\x0fsequence_number"
"""How attachments began that rmw_zenoh wrote before its release 0.2.5 (jazzy) and 0.1.2 (humble)."""


class Attachment(msgspec.Struct, frozen=True):
    """number: from 1, rising with each message of a publisher. stamp_ns: when it was sent, Unix nanoseconds.

    gid: 16 bytes, of the publisher's or client's token.
    """

    number: int
    stamp_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Write it; numbers beyond 64 bits raise struct.error."""
        return _FORMAT.pack(self.number, self.stamp_ns, GID_BYTES, self.gid)


def read_attachment(data: bytes | None) -> Attachment:
    """Read it; raise ProtocolError if it is missing, has another length, or negative numbers."""
    if data is not None and data.startswith(_NAMED):
        raise ProtocolError("attachment of an old rmw_zenoh: expected 0.2.5 (jazzy), 0.1.2 (humble) or later")
    if data is None or len(data) != _FORMAT.size:
        raise ProtocolError(f"attachment of {len(data or b'')} bytes: expected {_FORMAT.size}")
    number, stamp_ns, length, gid = _FORMAT.unpack(data)
    if length != GID_BYTES or number < 0 or stamp_ns < 0:
        raise ProtocolError(f"attachment: number {number}, time {stamp_ns}, gid of {length} bytes")
    return Attachment(number, stamp_ns, gid)


LONGEST = 2048
"""Characters of the longest token that is read."""
_NODE_PARTS, _ENDPOINT_PARTS = 9, 13


class Kind(Enum):
    """What a token shows."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIBER = "MS"
    SERVER = "SS"
    CLIENT = "SC"


class Node(msgspec.Struct, frozen=True):
    """A node. number: of the node within its session; of others' nodes it may be any text. zid: of its Zenoh session.

    namespace: ``/r1``, or ``/``.
    """

    domain: int
    zid: str
    number: int | str
    namespace: str
    name: str
    enclave: str = "/"

    @property
    def full_name(self) -> str:
        """The name that ``ros2 node list`` shows: ``/r1/zbridge``."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    def token(self) -> str:
        """Write the node's own token."""
        return self._token(self.number, Kind.NODE)

    def _token(self, number: int | str, kind: Kind) -> str:
        names = "/".join(map(_mangle, (self.enclave.rstrip("/"), self.namespace.rstrip("/"), self.name)))
        return f"@ros2_lv/{self.domain}/{self.zid}/{self.number}/{number}/{kind.value}/{names}"


class Endpoint(msgspec.Struct, frozen=True):
    """A publisher, subscriber, server or client of a node.

    number: within its session, different for all nodes and endpoints. name: of the topic, ``/r1/scan``; type_name:
    ``sensor_msgs/msg/LaserScan``. token_read: the token as it was read, whose gid this is; None: as it is written.
    """

    node: Node
    number: int | str
    kind: Kind
    name: str
    type_name: str
    type_hash: str
    qos: RosQoS = KEEP_LAST_10
    token_read: str | None = None

    @property
    def key(self) -> str:
        """The key of its topic or service."""
        return topic_key(self.node.domain, self.name, self.type_name, self.type_hash)

    def token(self) -> str:
        """Write its token."""
        if self.token_read is not None:
            return self.token_read
        parts = map(_mangle, (self.name, dds_type(self.type_name), self.type_hash))
        return f"{self.node._token(self.number, self.kind)}/{'/'.join(parts)}/{self.qos}"

    def gid(self) -> bytes:
        """Return its gid, 16 bytes: the hash of its token. It stands in the attachments of what it sends."""
        return gid_of(self.token())

    def gids(self) -> tuple[bytes, ...]:
        """Return the gids that it may send with: rmw_zenoh's, and that of dora-rs (half the zid, then the number)."""
        try:
            zid, number = int(self.node.zid, 16), int(self.number)
        except ValueError:
            return (self.gid(),)
        half = 2**64 - 1
        return (self.gid(), (zid & half).to_bytes(8, "little") + (number & half).to_bytes(8, "little"))


def gid_of(token: str) -> bytes:
    """Return the gid of a token: XXH3-128, the low half first, each little-endian."""
    import xxhash  # an extra

    number = xxhash.xxh3_128_intdigest(token.encode())
    return (number & (2**64 - 1)).to_bytes(8, "little") + (number >> 64).to_bytes(8, "little")


def endpoints_of(domain: int, kind: Kind, name: str) -> str:
    """Write the key expression of the tokens of a topic's endpoints of a kind."""
    return f"@ros2_lv/{domain}/*/*/*/{kind.value}/*/*/*/{_mangle(name)}/*/*/*"


def read_token(token: str) -> Node | Endpoint | None:
    """Read a token; None if it is none, or none that can be understood."""
    parts = token.split("/") if len(token) <= LONGEST else []
    if len(parts) < _NODE_PARTS or parts[0] != "@ros2_lv" or "" in parts:
        return None
    kind, domain, node_number, number = _KINDS.get(parts[5]), *map(_number, (parts[1], parts[3], parts[4]))
    if kind is None or not isinstance(domain, int):
        return None
    enclave, namespace, name = map(_demangle, parts[6:9])
    node = Node(domain, parts[2], node_number, namespace or "/", name, enclave or "/")
    if kind is Kind.NODE:
        return node if len(parts) == _NODE_PARTS else None
    if len(parts) < _ENDPOINT_PARTS:  # later versions may say more after the QoS
        return None
    type_name, qos = ros_type(_demangle(parts[10])), read_qos(parts[12])
    if type_name is None or qos is None:
        return None
    return Endpoint(node, number, kind, _demangle(parts[9]), type_name, _demangle(parts[11]), qos, token)


def _number(text: str) -> int | str:
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 and str(int(text)) == text else text


def _mangle(name: str) -> str:
    return name.replace("/", "%") or "%"


def _demangle(part: str) -> str:
    return "" if part == "%" else part.replace("%", "/")


_KINDS = {kind.value: kind for kind in Kind}
