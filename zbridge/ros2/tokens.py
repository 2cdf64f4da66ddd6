"""Liveliness tokens make nodes and endpoints visible: they are written and read here.

``@ros2_lv/<domain>/<zid>/<nid>/<id>/<kind>/<enclave>/<namespace>/<node>``, and for endpoints
``/<topic>/<type>/<hash>/<qos>`` after it. ``/`` within a part is ``%``; an empty part is ``%``.
"""

from __future__ import annotations

from enum import Enum

import msgspec

from zbridge.ros2.names import dds_type, ros_type, topic_key
from zbridge.ros2.qos import KEEP_LAST_10, QoS, read_qos

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
    qos: QoS = KEEP_LAST_10
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


def all_tokens(domain: int) -> str:
    """Write the key expression of all tokens of a domain."""
    return f"@ros2_lv/{domain}/**"


def endpoints_of(domain: int, kind: Kind, name: str = "*") -> str:
    """Write the key expression of the tokens of the endpoints of a kind, of a topic or of all (``*``)."""
    topic = name if name == "*" else _mangle(name)
    return f"@ros2_lv/{domain}/*/*/*/{kind.value}/*/*/*/{topic}/*/*/*"


def read_token(token: str) -> Node | Endpoint | None:
    """Read a token; None where it is none, or none that can be understood."""
    parts = token.split("/") if len(token) <= LONGEST else []
    if len(parts) < _NODE_PARTS or parts[0] != "@ros2_lv" or "" in parts:
        return None
    kind, domain = _KINDS.get(parts[5]), _number(parts[1])
    if kind is None or not isinstance(domain, int):
        return None
    node_number, number = _number(parts[3]), _number(parts[4])
    enclave, namespace, name = map(_demangle, parts[6:9])
    node = Node(domain, parts[2], node_number, namespace or "/", name, enclave or "/")
    if kind is Kind.NODE:
        return node if len(parts) == _NODE_PARTS else None
    return _read_endpoint(node, number, kind, parts, token)


def _read_endpoint(node: Node, number: int | str, kind: Kind, parts: list[str], token: str) -> Endpoint | None:
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
