"""What a gateway and its successor say to each other, as MessagePack maps with a ``type``."""

from __future__ import annotations

import msgspec

from zbridge.protocol.kept import Exported
from zbridge.wire.frames import Partial

VERSION = 2
"""The form of :class:`Given`. Raise it with every change of what is ``kept`` and of the maps around it."""


class Hello(msgspec.Struct, tag="hello", frozen=True):
    """Successor: I have read the configuration and joined the bus; ``version`` is the form that I understand."""

    version: int
    pid: int


class Given(msgspec.Struct, tag="given", frozen=True):
    """Gateway: nothing is read or written any more; take this over, and ``descriptors`` descriptors behind it.

    setup: what must be the same in both configurations. claim: on the robot, None where it is not owned. device: None
    where it is not served. listeners: in the order of the configuration; none of a gateway that died: the successor
    binds its own. metrics: numbers of sockets in the parcel. partials: of a gateway that died, the incomplete frame of
    each stream, in the order of the device's links.
    """

    version: int
    setup: Exported
    descriptors: int
    claim: Exported | None = None
    device: Exported | None = None
    listeners: tuple[Exported, ...] = ()
    metrics: tuple[int, ...] = ()
    partials: tuple[Partial, ...] = ()


class Up(msgspec.Struct, tag="up", frozen=True):
    """Successor: everything is taken over and declared; I read and write nothing before :class:`Go`."""


class Go(msgspec.Struct, tag="go", frozen=True):
    """Gateway: all is yours."""


class Failed(msgspec.Struct, tag="failed", frozen=True):
    """Either: it is over, for this reason. The gateway goes on as before."""

    reason: str


Message = Hello | Given | Up | Go | Failed
encode = msgspec.msgpack.Encoder().encode
decode = msgspec.msgpack.Decoder(Message).decode
