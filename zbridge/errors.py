"""Every error zbridge raises on purpose.

ZbridgeError
├── ProtocolError    a peer's bytes are not what its protocol says
├── EncodeError      we were asked to send what the protocol cannot say
├── PayloadError     a payload on the bus is not the message its key promises
├── Refused          a command was understood and will not be carried out
│   ├── Held         ... because somebody else holds the robot
│   └── LeaseLost    ... because the lease it was given under has ended
├── LinkError        a transport connection could not be made
├── BusError         the bus could not be opened or asked
└── ConfigError      a configuration cannot be used
"""


class ZbridgeError(Exception):
    """The root of the tree."""


class ProtocolError(ZbridgeError):
    """A peer's bytes break its protocol; decoding raises nothing else."""


class EncodeError(ZbridgeError):
    """A message holds a value its wire type cannot carry."""


class PayloadError(ZbridgeError):
    """A payload on the bus is not the fleet message its key promises."""


class Refused(ZbridgeError):
    """A command will not be carried out; the text says why, for people."""


class Held(Refused):
    """Somebody else holds the robot; ``holder`` names them."""

    def __init__(self, text: str, holder: str) -> None:
        super().__init__(text)
        self.holder = holder


class LeaseLost(Refused):
    """The lease has ended; the text says why, and who holds the robot now."""


class LinkError(ZbridgeError):
    """A connection to a peer failed or was not possible."""


class BusError(ZbridgeError):
    """The bus could not be opened, or a query on it got no answer."""


class ConfigError(ZbridgeError):
    """A configuration cannot be used; the text names file, key, value and what was expected."""
