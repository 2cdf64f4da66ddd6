"""All errors that zbridge raises on purpose.

ZbridgeError
├── ProtocolError    a peer's bytes are not what its protocol says
├── EncodeError      a message holds a value that the protocol cannot carry
├── PayloadError     a payload on the bus is not the message that its key announces
├── Refused          a command or query is not carried out
│   ├── Held         ... because another program holds the lease                     held
│   ├── Latched      ... because a latched stop is in force                          latched
│   ├── LeaseLost    ... because there is no lease, or it has ended                  no_lease, lease_ended
│   ├── NeutralFirst ... because a neutral must come before motion                   neutral_first
│   ├── Stale        ... because it was given too long ago                           stale
│   ├── NotReady     ... because the robot or its gateway accepts none now           not_ready, busy, closing
│   ├── Unsupported  ... because this robot cannot do it                             unsupported
│   ├── Malformed    ... because it cannot be read, or its number is out of order    malformed, out_of_order
│   └── RateLimited      ... because commands come faster than allowed                   rate
├── LinkError        an address is not valid, or a connection cannot be made
├── BusError         the bus cannot be opened, or a query has no answer
├── HandoverError    a restarted gateway cannot take over what the one before it hands over
└── ConfigError      a configuration cannot be used
"""

from __future__ import annotations

import traceback
from enum import StrEnum
from typing import ClassVar

FAULT = "a fault of the protocol: "
"""Begins the reason where the code of a protocol raised what it must not."""


def describe(error: BaseException) -> str:
    """Return what was raised, and where: ``KeyError: 1 in HqRole.decode (session.py:36)``."""
    where = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        code = frame.f_code
        if "importlib" in code.co_filename:  # of a module that cannot be imported: who imports it
            continue
        where = f" in {code.co_qualname.rpartition('<locals>.')[2]} ({code.co_filename.rpartition('/')[2]}:{line})"
    return f"{type(error).__name__}: {error}{where}"


class Code(StrEnum):
    """Why a command is refused: programs act on the code, people read the text."""

    NO_LEASE = "no_lease"
    """There was no lease."""
    LEASE_ENDED = "lease_ended"
    """The lease has ended; the reason says why."""
    HELD = "held"
    """Somebody else has the lease; ``holder`` names them."""
    NEUTRAL_FIRST = "neutral_first"
    """A neutral must come before motion."""
    NOT_READY = "not_ready"
    """The robot accepts no such command now: it is away, or its link is stalled."""
    BUSY = "busy"
    """The robot is occupied."""
    UNSUPPORTED = "unsupported"
    """The robot does not support it, or the key names no command."""
    MALFORMED = "malformed"
    """It cannot be decoded, or its proof or key is wrong."""
    OUT_OF_ORDER = "out_of_order"
    """Its number was used or passed."""
    RATE = "rate"
    """Too many arrived."""
    CLOSING = "closing"
    """The gateway is ending."""
    STALE = "stale"
    """The motion command is too old: the network delayed it."""
    LATCHED = "latched"
    """A latched stop is in force; the reason says whose."""


class ZbridgeError(Exception):
    """The root of the tree."""


class ProtocolError(ZbridgeError):
    """A peer's bytes are not what its protocol says. Decoding raises nothing else."""


class EncodeError(ZbridgeError):
    """A message holds a value that its wire type cannot carry."""


class PayloadError(ZbridgeError):
    """A payload on the bus is not the fleet message that its key announces."""


class Refused(ZbridgeError):
    """A command is not carried out: ``code`` says why to programs, the text to people.

    Raise one of the classes below. holder: who holds the lease, if that is the reason. who: who sent the command, if
    its proof shows it.
    """

    codes: ClassVar[tuple[Code, ...]]
    """The codes of this class; the first is the default."""

    def __init__(
        self, text: str, code: Code | None = None, *, holder: str | None = None, who: str | None = None
    ) -> None:
        super().__init__(text)
        self.code = code or self.codes[0]
        self.holder = holder
        self.who = who


class Held(Refused):
    """Another program holds the lease; ``holder`` names it."""

    codes = (Code.HELD,)


class Latched(Refused):
    """A latched stop is in force; the text says whose, and why."""

    codes = (Code.LATCHED,)


class LeaseLost(Refused):
    """There is no lease, or it has ended; the text says why, and who holds one now."""

    expired = False
    """Whether the program did not renew the lease in time: it was paused, or cut off. What happened meanwhile is not
    known: somebody may have stopped the robot."""
    codes = (Code.LEASE_ENDED, Code.NO_LEASE)


class NeutralFirst(Refused):
    """The robot was stopped: a neutral must come before motion (``Driver.neutral``)."""

    codes = (Code.NEUTRAL_FIRST,)


class Stale(Refused):
    """The command is too old on arrival: the network delayed it."""

    codes = (Code.STALE,)


class NotReady(Refused):
    """The robot or its gateway accepts no commands now."""

    codes = (Code.NOT_READY, Code.BUSY, Code.CLOSING)


class Unsupported(Refused):
    """This robot cannot do it."""

    codes = (Code.UNSUPPORTED,)


class Malformed(Refused):
    """The command cannot be read, or its number is not above the last one."""

    codes = (Code.MALFORMED, Code.OUT_OF_ORDER)


class RateLimited(Refused):
    """Commands come faster than allowed."""

    codes = (Code.RATE,)


_FAMILIES: dict[str, type[Refused]] = {code: family for family in Refused.__subclasses__() for code in family.codes}


def refusal(code: str, text: str, *, holder: str | None = None) -> Refused:
    """Return the exception for a code received from the bus; Unsupported for an unknown one."""
    family = _FAMILIES.get(code)
    if family is None:
        return Unsupported(text, holder=holder)
    return family(text, Code(code), holder=holder)


class LinkError(ZbridgeError):
    """An address is not valid, or a connection to a peer cannot be made."""


class BusError(ZbridgeError):
    """The bus cannot be opened, or a query on it has no answer."""


class BusRefused(BusError):
    """The bus cannot be opened, and trying again soon helps nobody: the text says who refused whom, and why."""


class HandoverError(ZbridgeError):
    """A restarted gateway cannot take over what the one before it hands over, or got nothing."""


class ConfigError(ZbridgeError):
    """A configuration is not valid; the text names file, key, value and what was expected."""
