"""The version table: what peers of each generation send, understand and know. Sans-IO.

Source: "Settings and version negotiation" and "The gateway as robot" of the protocol page.
"""

from __future__ import annotations

from collections.abc import Collection

import msgspec

from gateways.tcpudp.settings import HQ_BLOCKS, Feature
from zbridge.protocol import newest, parse_versions

LISTED = ("1.1", "1.2", "1.3")
"""What peers of version 1.3 list; with other lists deployed robots of 1.3 and "1.4" may crash."""
_LISTED = ",".join(LISTED)


class Version(msgspec.Struct, frozen=True):
    """One row. ``listed``: what a robot of this version sends.

    ``answer``: the list that such a robot understands from an HQ; None: its own, verbatim. ``known_to_hq``: the packet
    ids that an HQ of this version knows; an unknown one cripples it.
    """

    listed: str
    answer: str | None
    known_to_hq: frozenset[int]


_HQ_11 = frozenset({1, 2, 4, 6, 51, 53, 55})
_HQ_12 = _HQ_11 | {60}
VERSIONS = {
    "1.1": Version("1.1", None, _HQ_11),
    "1.2": Version("1.2", None, _HQ_12),
    "1.3": Version(_LISTED, _LISTED, _HQ_12),
    "1.4": Version(f"{_LISTED},1.4", _LISTED, _HQ_12 | {56}),  # exists on robots only
}


ANNOUNCED = (Feature.UDP, Feature.LIDAR_SIM)
"""What deployed HQ programs announce."""


def announced(listed: str, features: Collection[Feature]) -> bytes:
    """Write the settings block of an HQ that lists these versions, as far as the block has flags for the features."""
    block = HQ_BLOCKS[newest(parse_versions(listed), known=HQ_BLOCKS) or "1.1"]
    return block(**{feature.value: True for feature in features if hasattr(block, feature.value)}).encode()
