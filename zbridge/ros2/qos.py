"""The quality of service of an endpoint, as it stands in its token."""

from __future__ import annotations

from enum import IntEnum

import msgspec

_DEFAULT_DEPTH = 42
"""rmw_zenoh's default, which it leaves out."""


class Reliability(IntEnum):
    """rmw_qos_reliability_policy_e."""

    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(IntEnum):
    """rmw_qos_durability_policy_e."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class QoS(msgspec.Struct, frozen=True):
    """How an endpoint sends or wants messages. depth: kept messages; 0: all of them.

    Deadline, lifespan and liveliness are always the defaults.
    """

    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    depth: int = 10

    def __str__(self) -> str:
        """Write it as in tokens: a field that has rmw_zenoh's default is empty."""
        reliability = "" if self.reliability is Reliability.RELIABLE else str(int(self.reliability))
        durability = "" if self.durability is Durability.VOLATILE else str(int(self.durability))
        history = "" if self.depth else "2"
        depth = str(self.depth) if self.depth and self.depth != _DEFAULT_DEPTH else ""
        return f"{reliability}:{durability}:{history},{depth}:,:,:,,"


def read_qos(text: str) -> QoS | None:
    """Read the quality of service of a token; None where it is none. Only the first three fields are looked at."""
    parts = text.split(":")
    if len(parts) < 6:
        return None
    history, comma, depth = parts[2].partition(",")
    if not comma:
        return None
    reliability, durability = _RELIABILITIES.get(parts[0]), _DURABILITIES.get(parts[1])
    if reliability is None or durability is None or history not in ("", "0", "1", "2", "3"):
        return None
    if depth and not (depth.isascii() and depth.isdigit() and len(depth) < 19):
        return None
    return QoS(reliability, durability, 0 if history == "2" else int(depth or _DEFAULT_DEPTH))


_RELIABILITIES = {
    "": Reliability.RELIABLE,
    "0": Reliability.RELIABLE,
    "1": Reliability.RELIABLE,
    "2": Reliability.BEST_EFFORT,
    "3": Reliability.RELIABLE,
}
_DURABILITIES = {
    "": Durability.VOLATILE,
    "0": Durability.VOLATILE,
    "1": Durability.TRANSIENT_LOCAL,
    "2": Durability.VOLATILE,
    "3": Durability.VOLATILE,
}
KEEP_LAST_10 = QoS()
SENSOR_DATA = QoS(Reliability.BEST_EFFORT, depth=5)
"""rmw_qos_profile_sensor_data."""
LATCHED = QoS(durability=Durability.TRANSIENT_LOCAL, depth=1)
"""Who comes late gets the last message."""
SERVICES = KEEP_LAST_10
"""rmw_qos_profile_services_default."""
