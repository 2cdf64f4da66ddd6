"""A robot protocol from another package: lines of text, and no HQ programs of its own.

The robot says ``at X Y HEADING`` ten times a second, and takes ``go FORWARD TURN``.
"""

import asyncio
import contextlib
import math
from collections.abc import Iterable
from typing import Any

import msgspec

from zbridge.errors import NotReady, ProtocolError, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Pose
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Codec, Outcome, Protocol, RobotSide, Simulation, Telemetry, Translate
from zbridge.protocol.session import Limits, Role, Session

TEMPLATE = """\
[device]
protocol = "toy"
connect = ["tcp://127.0.0.1:4000"]
"""


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """It has none."""


class At(msgspec.Struct, frozen=True):
    """Where it is."""

    x: float
    y: float
    heading: float


def line_end(data: bytes, start: int) -> int:
    end = data.find(b"\n", start)
    return len(data) + 1 if end < 0 else end + 1


def write(message: At) -> bytes:
    return b"at %f %f %f\n" % (message.x, message.y, message.heading)


def read(frame: bytes) -> At:
    try:
        word, x, y, heading = frame.split()
        if word != b"at":
            raise ValueError(word)
        return At(float(x), float(y), float(heading))
    except ValueError as error:
        raise ProtocolError(f"{frame!r}: {error}") from error


class ToySession(Session[At]):
    role = Role.HQ
    frame_end = staticmethod(line_end)
    silent_s, lost_s = 0.5, 3.0

    def encode(self, message: At) -> bytes:
        return write(message)

    def decode(self, frame: bytes) -> At:
        return read(frame)

    def opened(self, now: float) -> None:
        self.establish("7.0", ("wheels",))

    def accept(self, message: At, now: float) -> bool:
        return True


class ToyRobot(RobotSide):
    link_names = ("robot",)

    def __init__(self, options: Options, links: int, metrics: Metrics) -> None:
        self._session: ToySession | None = None

    def session(self, link: str, peer: str) -> ToySession:
        self._session = ToySession(Limits(frame_bytes=100, handshake_s=5.0))
        return self._session

    @property
    def driving(self) -> ToySession | None:
        return self._session

    def translator(self, kind: type) -> Translate:
        return self.pose

    def pose(self, message: At, stamp_ns: int) -> Iterable[Telemetry]:
        return ((topics.POSE, Pose(message.x, message.y, message.heading, stamp_ns=stamp_ns)),)

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if not isinstance(command, Drive):
            raise Unsupported("it only drives")
        self._go(command.forward, command.turn, now)
        left_out = [name for name in ("left", "light") if getattr(command, name)]
        return Outcome(left_out="; ".join(left_out) or None)

    def stop(self, now: float, until: float) -> None:
        self._go(0.0, 0.0, now, until=until, urgent=True)

    def _go(self, forward: float, turn: float, now: float, **more: Any) -> None:
        if self._session is None:
            raise NotReady("no connection")
        frame = b"go %f %f\n" % (forward, turn)
        self._session.outbox.set("motion", (frame,), now, period_s=0.1, **more)

    def ask(self, topic: Topic) -> None:
        raise Unsupported("it cannot be asked")


async def simulate(simulation: Simulation) -> None:
    """Be a robot on a plane."""
    place, speed = [0.0, 0.0, 0.0], [0.0, 0.0]

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        listening = asyncio.create_task(listen(reader))
        with contextlib.suppress(ConnectionError):
            while not listening.done():
                x, y, heading = place
                ahead, heading = speed[0] / 10, heading + speed[1] / 10
                place[:] = x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading
                writer.write(b"at %f %f %f\n" % tuple(place))
                await writer.drain()
                await asyncio.sleep(0.1)
        writer.close()

    async def listen(reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            speed[:] = map(float, line.split()[1:])

    (address,) = simulation.addresses
    async with await asyncio.start_server(serve, address.host, address.port) as server:
        simulation.ready((Address(*server.sockets[0].getsockname()[:2]),))
        await server.serve_forever()


PROTOCOL = Protocol(
    name="toy",
    summary="a toy: lines of text",
    options=Options,
    links=1,
    robot=ToyRobot,
    simulate=simulate,
    template=TEMPLATE,
    codecs=(Codec("lines", write, read, line_end, (At,)),),
)
