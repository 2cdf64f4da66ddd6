"""What all simulators share, with a toy robot of lines on real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator

from zbridge.errors import NotReady, ProtocolError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation
from zbridge.protocol.session import Limits, Role, Session
from zbridge.simulation.simulator import Simulator
from zbridge.transport.conversation import Conversation
from zbridge.wire.lines import Lines

SOON_S = 5.0


class Talk(Session[str]):
    """A line is a message."""

    role = Role.ROBOT
    frame_end = staticmethod(Lines.end)

    def __init__(self) -> None:
        super().__init__(Limits(frame_bytes=100, handshake_s=5.0))

    def opened(self, now: float) -> None:
        self.establish("", ())

    def encode(self, message: str) -> bytes:
        return message.encode() + b"\n"

    def decode(self, frame: bytes) -> str:
        return frame[:-1].decode()

    def accept(self, message: str, now: float) -> bool:
        raise ProtocolError("no handshake")


class Toy(Simulator[str]):
    """Greets, echoes, and tells every tenth step on each link; has two places."""

    def __init__(self) -> None:
        super().__init__(logging.getLogger("test"), links=("drive", "laser"))
        self.places = 2

    def session(self, peer: str, link: str) -> Talk | None:
        self.places -= 1
        return Talk() if self.places >= 0 else None

    def greet(self, client: Conversation, link: str) -> None:
        self.send(client, f"hello {link}")

    def take(self, client: Conversation, message: str) -> None:
        self.send(client, f"echo {message}", "secret", "never sent")

    def check(self, session: Session[str], message: str) -> None:
        if message == "secret":
            raise NotReady("a secret")

    def step(self, steps: int) -> None:
        if steps % 10 == 0:
            self.tell("first", link="drive")
            self.tell("second", link="laser")


@contextlib.asynccontextmanager
async def living() -> AsyncIterator[tuple[Address, ...]]:
    ready: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    simulation = Simulation(tuple(Address("127.0.0.1", 0) for _ in range(2)), ready=ready.set_result)
    task = asyncio.create_task(Toy().run(simulation))
    try:
        async with asyncio.timeout(SOON_S):
            yield await ready
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def connect(address: Address) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection(address.host, address.port)


async def test_each_link_greets_first_is_told_its_own_and_answers_up_to_what_may_not_be_sent() -> None:
    async with living() as (first, second):
        for address, lines in ((first, [b"hello drive\n", b"first\n"]), (second, [b"hello laser\n", b"second\n"])):
            reader, writer = await connect(address)
            assert [await reader.readline() for _ in lines] == lines
            writer.write(b"one\n")
            assert {await reader.readline() for _ in range(3)} == {lines[1], b"echo one\n"}
            writer.close()


async def test_who_finds_no_place_is_closed_and_the_end_closes_every_conversation() -> None:
    async with living() as (first, _):
        served = [await connect(first), await connect(first)]
        for reader, _ in served:
            assert await reader.readline() == b"hello drive\n"
        reader, writer = await connect(first)
        assert await reader.read() == b""
        writer.close()
    for reader, writer in served:
        assert (await reader.read()).strip(b"first\n") == b""
        writer.close()
