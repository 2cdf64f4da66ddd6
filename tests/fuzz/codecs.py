"""Targets of the decoders of the legacy protocols: one for each side and dialect, as the conformance kit has them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from tests.conformance.side import Side
from tests.fuzz.target import Target, comparable, cut, require_same
from tests.gateways.alf import golden as alf
from tests.gateways.tcpudp import golden as tcpudp
from tests.gateways.wc2ec import golden as wc2ec
from zbridge.errors import EncodeError, ProtocolError

SIDES = {"alf": alf.SIDES, "tcpudp": tcpudp.SIDES, "wc2ec": wc2ec.SIDES}
WIRE = ("zbridge/wire/binary.py", "zbridge/wire/text.py", "zbridge/wire/frames.py")


def read_both_ways(side: Side, data: bytes) -> None:
    """Read bytes as one frame, and as a stream in two cuts."""
    if not data:
        return
    seed, body = data[0], data[1:]
    if body:  # no frame is empty
        survives(side.read, side.write, body)
    whole, broke = received(side, [body])
    parts, broke_too = received(side, list(cut(body, seed)))
    require_same(f"{side}: whether the stream broke depends on its cut", broke, broke_too)
    if broke:  # one broken read gives none of its messages
        parts = parts[: len(whole)]
        whole = whole[: len(parts)]
    require_same(f"{side}: the messages depend on the cut", whole, parts)


def survives(read: Callable[[bytes], Any], write: Callable[[Any], bytes], frame: bytes) -> None:
    """Require that what was read is written, and read again as the same; ProtocolError and EncodeError are allowed.

    A text may have more digits than are written: then what was read of our own text is what must stay.
    """
    with contextlib.suppress(ProtocolError, EncodeError):
        message = read(frame)
        if b"|" in frame:
            message = read(bytes(write(message)))
        require_same("written and read again", comparable(read(bytes(write(message)))), comparable(message))


def received(side: Side, reads: list[bytes]) -> tuple[list[str], bool]:
    """Return what a receiver makes of reads, and whether the stream broke."""
    receive, messages = side.receiver(), []
    try:
        for read in reads:
            messages += receive(read)
    except ProtocolError:
        return list(map(comparable, messages)), True
    return list(map(comparable, messages)), False


def targets() -> Iterator[Target]:
    """Yield a target for each side."""
    for protocol, sides in SIDES.items():
        for side in sides:
            yield _target(protocol, side)


def _target(protocol: str, side: Side) -> Target:
    frames = [frame for _, frame in side.golden]

    def seeds() -> list[bytes]:
        joined = b"".join(frame for _, frame in side.stream)
        return [*(bytes([number % 256]) + frame for number, frame in enumerate(frames)), b"\x07" + joined]

    name = f"codec-{side.name}".lower().replace(" ", "-").replace("/", "-").replace("_", "-")
    covers = (f"gateways/{protocol}/messages.py", *WIRE)
    return Target(name, lambda data: read_both_ways(side, data), seeds, covers)
