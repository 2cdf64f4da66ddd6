"""Every error zbridge raises on purpose.

ZbridgeError
├── ProtocolError    a peer's bytes are not what its protocol says
├── EncodeError      we were asked to send what the protocol cannot say
├── PayloadError     a payload on the bus is not the message its key promises
├── Refused          a command or query was understood and will not be carried out
│   ├── Held         ... because somebody else holds the robot                       held
│   ├── LeaseLost    ... because there is no lease, or it has ended                  no_lease, lease_ended
│   ├── NeutralFirst ... because motion must wait for a neutral                      neutral_first
│   ├── NotReady     ... because the robot or its gateway takes none now             not_ready, busy, closing
│   ├── Unsupported  ... because this robot cannot do it                             unsupported
│   ├── Malformed    ... because it cannot be read, or is not the next of its lease  malformed, out_of_order
│   └── TooFast      ... because too many came                                       rate
├── LinkError        a transport connection could not be made
├── BusError         the bus could not be opened or asked
└── ConfigError      a configuration cannot be used
"""

from __future__ import annotations

from enum import StrEnum
from typing import ClassVar


class Code(StrEnum):
    """Why something was refused: what programs act on, while people read the text."""

    NO_LEASE = "no_lease"
    LEASE_ENDED = "lease_ended"
    HELD = "held"
    NEUTRAL_FIRST = "neutral_first"
    NOT_READY = "not_ready"
    BUSY = "busy"
    UNSUPPORTED = "unsupported"
    MALFORMED = "malformed"
    OUT_OF_ORDER = "out_of_order"
    RATE = "rate"
    CLOSING = "closing"


class ZbridgeError(Exception):
    """The root of the tree."""


class ProtocolError(ZbridgeError):
    """A peer's bytes break its protocol; decoding raises nothing else."""


class EncodeError(ZbridgeError):
    """A message holds a value its wire type cannot carry."""


class PayloadError(ZbridgeError):
    """A payload on the bus is not the fleet message its key promises."""


class Refused(ZbridgeError):
    """A command will not be carried out: ``code`` says why for programs, the text for people.

    Raise one of the classes below. holder: who has the robot, where that is why. who: whose command it was, where its
    proof shows that.
    """

    codes: ClassVar[tuple[Code, ...]]
    """The codes of this family, the usual one first."""

    def __init__(
        self, text: str, code: Code | None = None, *, holder: str | None = None, who: str | None = None
    ) -> None:
        super().__init__(text)
        self.code = code or self.codes[0]
        self.holder = holder
        self.who = who


class Held(Refused):
    """Somebody else holds the robot; ``holder`` names them."""

    codes = (Code.HELD,)


class LeaseLost(Refused):
    """There is no lease, or it has ended; the text says why, and who holds the robot now."""

    codes = (Code.LEASE_ENDED, Code.NO_LEASE)


class NeutralFirst(Refused):
    """The robot was stopped: motion must wait for a neutral."""

    codes = (Code.NEUTRAL_FIRST,)


class NotReady(Refused):
    """The robot or its gateway takes no commands now."""

    codes = (Code.NOT_READY, Code.BUSY, Code.CLOSING)


class Unsupported(Refused):
    """This robot cannot do it."""

    codes = (Code.UNSUPPORTED,)


class Malformed(Refused):
    """It cannot be read, or its number was used or passed."""

    codes = (Code.MALFORMED, Code.OUT_OF_ORDER)


class TooFast(Refused):
    """Too many came."""

    codes = (Code.RATE,)


_FAMILIES: dict[str, type[Refused]] = {code: family for family in Refused.__subclasses__() for code in family.codes}


def refusal(code: str, text: str, *, holder: str | None = None) -> Refused:
    """Make the exception of a code that came from elsewhere; one that is not known here is Unsupported."""
    family = _FAMILIES.get(code)
    if family is None:
        return Unsupported(text, holder=holder)
    return family(text, Code(code), holder=holder)


class LinkError(ZbridgeError):
    """A connection to a peer failed or was not possible."""


class BusError(ZbridgeError):
    """The bus could not be opened, or a query on it got no answer."""


class ConfigError(ZbridgeError):
    """A configuration cannot be used; the text names file, key, value and what was expected."""
