"""Reader of the recorded sessions in ``tests/vectors``.

Each ``.hex`` file there is one session between two legacy programs. A line is one TCP segment or one datagram:
seconds since the first packet, transport, ``source port->destination port``, then either a payload length and the
payload in hex, or the name of a connection event (``SYN``, ``SYN+ACK``, ``FIN``).
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

VECTORS = Path(__file__).parent / "vectors"


@dataclass(frozen=True)
class Record:
    """One line of a capture: a segment, a datagram, or a connection event."""

    seconds: float
    transport: str
    source: int
    destination: int
    payload: bytes
    event: str = ""


def _parse(line: str) -> Record:
    seconds, transport, ports, *rest = line.split()
    source, destination = (int(port) for port in ports.split("->"))
    if len(rest) == 1:
        return Record(float(seconds), transport, source, destination, b"", rest[0])
    size, text = rest
    payload = bytes.fromhex(text)
    assert len(payload) == int(size), line[:60]
    return Record(float(seconds), transport, source, destination, payload)


@cache
def records(name: str) -> tuple[Record, ...]:
    """Every record of the capture file ``name``, connection events included, in the order of recording."""
    lines = (VECTORS / name).read_text(encoding="ascii").splitlines()
    return tuple(_parse(line) for line in lines if line.strip())


def payloads(
    name: str, *, transport: str | None = None, source: int | None = None, destination: int | None = None
) -> list[Record]:
    """The records of ``name`` that carry bytes, narrowed to a transport or to one direction by a port."""
    return [
        record
        for record in records(name)
        if not record.event
        and transport in (None, record.transport)
        and source in (None, record.source)
        and destination in (None, record.destination)
    ]


def stream(name: str, *, source: int | None = None, destination: int | None = None, transport: str = "TCP") -> bytes:
    """The bytes of one direction, joined as a TCP reader sees them: what left ``source`` or reached ``destination``.

    One of the two ports is given: the listening port. The other end's port is chosen by its system.
    """
    wanted = payloads(name, transport=transport, source=source, destination=destination)
    return b"".join(record.payload for record in wanted)
