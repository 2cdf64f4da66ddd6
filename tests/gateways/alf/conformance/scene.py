"""What the conversations with both judges share: the messages by name in either dialect, and the end of a judge."""

import asyncio
import re
import struct
from typing import Any

import pytest

from gateways.alf.conformance.parser import Dialect
from tests.conformance.scene import Scene, Script, scripts
from tests.gateways.alf import golden

DIALECTS: tuple[Dialect, ...] = ("text", "binary")
MESSAGES: dict[str, dict[Dialect, bytes]] = {
    **{
        name: {dialect.value: data for dialect, data in frames.items()}  # type: ignore[misc]
        for name, frames in (
            *(("INIT", golden.INIT), ("GOOD", golden.NEUTRAL), ("FORWARD", golden.DRIVE)),
            *(("INFO", golden.INFO), ("END", golden.END)),
        )
    },
    "SCAN": {
        "text": b"1|7|5000|0|-1|20|5600|3|1|4;",
        "binary": bytes.fromhex("01 07000000 88130000") + struct.pack("<5qII", 0, -1, 20, 5600, 3, 1, 4),
    },
}


def conversations(text: str, **options: dict[str, Any]) -> pytest.MarkDecorator:
    """Parametrise a test over the options of a judge and the steps of a conversation with it, one row each.

    A row is ``sentence [options]: step / step``; an indented line continues the row before.
    """
    table: dict[str, Script] = {}
    for row in re.split(r"\n(?! )", text.strip()):
        sentence, steps = " ".join(row.split()).split(": ", 1)
        names = re.findall(r"\w+", sentence.partition("[")[2])
        chosen = {key: value for name in names for key, value in options[name].items()}
        table[sentence] = (chosen, steps.split(" / "))
    return scripts(table)


class AlfScene(Scene):
    """A judge of this protocol and its peer."""

    def raw(self, text: str) -> bytes:
        """Bytes of hex and of names of messages in the dialect of the judge."""
        dialect = self.judge.dialect if self.judge else "text"
        return b"".join(MESSAGES[word][dialect] if word in MESSAGES else bytes.fromhex(word) for word in text.split())

    async def say(self, text: str) -> None:
        """Send a text as it stands."""
        await self.peer.send_bytes(text.encode("latin-1"))

    async def begin_end(self, _: str) -> None:
        self.ending = asyncio.create_task(self.judge.end())
        await asyncio.sleep(0)

    async def end_ended(self, _: str) -> None:
        await self.ending

    async def cancel(self, _: str) -> None:
        self.task.cancel()

    async def rest(self, text: str) -> None:
        """This is all that is still to be read."""
        assert await self.peer.read_to_the_end() == self.raw(text)

    async def noted(self, count: str) -> None:
        assert len(self.judge.violations) == int(count), self.judge.violations
        assert self.judge.alive
