"""A process with one session that watches for silence: ``python -m tests.transport.frozen LOOP PORT``.

It prints ``established``, and why the session ended when it has.
"""

import asyncio
import sys

import uvloop

from tests.protocol.test_session import LIMITS, Toy
from zbridge.protocol.address import Address
from zbridge.transport.conversation import Conversation, ConversationHooks
from zbridge.transport.tcp import connect

SILENCE_S = 0.4
LOOPS = {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}


class Watching(Toy):
    """Ends when its peer says nothing for SILENCE_S."""

    heard_at = float("inf")

    def receive(self, data: bytes, now: float) -> list[bytes]:
        self.heard_at = now
        return super().receive(data, now)

    def establish(self, version: str, features: tuple[str, ...]) -> None:
        super().establish(version, features)
        print("established", flush=True)

    def timers(self) -> float:
        return self.heard_at + SILENCE_S

    def on_timer(self, now: float) -> None:
        self.fail(f"no report for {SILENCE_S:g} s")


async def main(port: int) -> None:
    """Be connected until the session ends."""
    session = Watching(LIMITS, name="robot")
    conversation = Conversation(session, asyncio.get_running_loop(), ConversationHooks())
    await connect(Address("127.0.0.1", port), conversation)
    await conversation.ended
    print(session.reason, flush=True)


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=LOOPS[sys.argv[1]]) as runner:
        runner.run(main(int(sys.argv[2])))
