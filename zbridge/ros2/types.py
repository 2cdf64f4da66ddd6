"""Types of messages: their hashes (RIHS01, after REP 2011), and messages to CDR and back, through rosbags."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, lru_cache
from typing import Any

from zbridge.errors import ConfigError, EncodeError, ProtocolError

DISTROS = ("humble", "iron", "jazzy", "kilted", "lyrical")
"""The distributions of ROS 2 whose types are known and for which rmw_zenoh exists."""
NO_HASH = "TypeHashNotSupported"
"""Stands in place of the hash in the keys and tokens of humble."""
_MOST_ITEMS = 2**24
"""Items of the longest sequence that is read."""

_SERVICES: Mapping[str, tuple[str, str]] = {
    "std_srvs/srv/Trigger": ("", "bool success\nstring message"),
    "std_srvs/srv/SetBool": ("bool data", "bool success\nstring message"),
    "example_interfaces/srv/AddTwoInts": ("int64 a\nint64 b", "int64 sum"),
}
"""The definitions of services: rosbags knows messages only."""
_EVENT_INFO = "uint8 event_type\nbuiltin_interfaces/Time stamp\nuint8[16] client_gid\nint64 sequence_number"
"""``service_msgs/msg/ServiceEventInfo`` as ROS hashes it: what .msg files call char is uint8."""

_Plan = tuple[Any, dict[str, Any], dict[str, tuple[str, str | None]]]
"""A type's class, its zeros by attribute, and by field: its attribute, and the type of its parts if it has any."""


class Types:
    """The types of one distribution. Make it with :func:`types_of`."""

    def __init__(self, distro: str, store: Any) -> None:
        self.distro = distro
        self._store = store
        self.computed_hash: Callable[[str], str] = cache(store.hash_rihs01)
        """Returns the hash of a type of a message or service; raises KeyError for an unknown type."""
        self._made: dict[str, _Plan] = {}
        for service in _SERVICES:
            _add_service(store, service)

    def __repr__(self) -> str:
        return f"<Types of {self.distro}>"

    def hash(self, type_name: str) -> str:
        """Return the hash of a type as it stands in keys: ``RIHS01_...``; for humble :data:`NO_HASH`. Or KeyError."""
        return NO_HASH if self.distro == "humble" else self.computed_hash(type_name)

    def message(self, type_name: str, /, **fields: Any) -> Any:
        """Make a message; a field that is left out is zero, empty or a message of such.

        A field that this distribution does not have is left out: later ones have more. A part may be a message, or a
        dict of its fields. Arrays are numpy arrays. What was left out is shared by all messages: it must not be
        changed.
        """
        plan = self._made.get(type_name)
        if plan is None:
            plan = self._made[type_name] = self._plan(type_name)
        build, zeros, attributes = plan
        given = dict(zeros)
        for name, value in fields.items():
            if name in attributes:
                attribute, part = attributes[name]
                given[attribute] = self._part(part, value) if part else value
        return build(**given)

    def _part(self, type_name: str, value: Any) -> Any:
        if type(value) is list:
            return [self._part(type_name, each) for each in value]
        return self.message(type_name, **value) if type(value) is dict else value

    def encode(self, message: Any) -> bytes:
        """Write a message as CDR, little-endian; raise EncodeError if a value does not fit."""
        try:
            return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))
        except Exception as error:  # struct.error, AttributeError, AssertionError ...: whatever the value is
            raise EncodeError(f"{getattr(message, '__msgtype__', message)}: {error}") from error

    def decode(self, type_name: str, payload: bytes) -> Any:
        """Read a message of CDR; raise ProtocolError."""
        try:
            return self._store.deserialize_cdr(payload, type_name)
        except Exception as error:  # rosbags reads what it was not made for: strange bytes raise strange errors
            raise ProtocolError(f"{type_name} of {len(payload)} bytes: {error}") from error

    def _plan(self, type_name: str) -> _Plan:
        from rosbags.typesys.base import normalize_fieldname

        fields = self._store.fielddefs[type_name][1]
        attributes = {name: (normalize_fieldname(name), _part_of(kind)) for name, kind in fields}
        zeros = {attributes[name][0]: self._zero(kind) for name, kind in fields}
        return self._store.types[type_name], zeros, attributes

    def _zero(self, kind: Any) -> Any:
        import numpy as np
        from rosbags.interfaces import Nodetype

        node, inner = kind
        if node == Nodetype.NAME:
            return self.message(inner)
        if node == Nodetype.BASE:
            return _ZEROS.get(inner[0], 0)
        (item, of), length = inner
        length = length if node == Nodetype.ARRAY else 0
        if item == Nodetype.BASE and of[0] != "string":
            return np.zeros(length, _DTYPES.get(of[0], of[0]))
        return [self._zero(inner[0]) for _ in range(length)]


@lru_cache(maxsize=len(DISTROS))
def types_of(distro: str) -> Types:
    """Return the types of a distribution, made once; raise ConfigError for an unknown one or without rosbags."""
    if distro not in DISTROS:
        raise ConfigError(f"distro = {distro!r}: expected one of {', '.join(DISTROS)}")
    try:
        import xxhash  # noqa: F401 - missing now is better than missing with the first gid
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ConfigError(f"{error}: expected what `pip install 'zbridge[ros2]'` installs") from error
    store = get_typestore(Stores(f"ros2_{distro}"))
    store.max_sequence_length = _MOST_ITEMS
    return Types(distro, store)


def _part_of(kind: Any) -> str | None:
    """Return the type of a field that is a message or a list of messages; None of any other field."""
    from rosbags.interfaces import Nodetype

    node, inner = kind[1][0] if kind[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else kind
    return inner if node == Nodetype.NAME else None


def _add_service(store: Any, service: str) -> None:
    """Add a service's two messages, and what its hash is made of: REP 2011 hashes request, response and event."""
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import get_types_from_msg

    request, response, event = f"{service}_Request", f"{service}_Response", f"{service}_Event"
    for name, definition in zip((request, response), _SERVICES[service], strict=True):
        ((_, parsed),) = get_types_from_msg(definition or "uint8 structure_needs_at_least_one_member", name).items()
        store.register({name: parsed})
    info = "service_msgs/msg/ServiceEventInfo"
    store.fielddefs |= get_types_from_msg(_EVENT_INFO, info)
    parts = (("request", request), ("response", response))
    lists = [(field, (Nodetype.SEQUENCE, ((Nodetype.NAME, name), 1))) for field, name in parts]
    store.fielddefs[event] = ([], [("info", (Nodetype.NAME, info)), *lists])
    messages = [(f"{field}_message", (Nodetype.NAME, name)) for field, name in (*parts, ("event", event))]
    store.fielddefs[service] = ([], messages)


_ZEROS: Mapping[str, Any] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
_DTYPES = {"byte": "uint8", "char": "uint8", "octet": "uint8"}
