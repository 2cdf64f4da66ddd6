"""STATUSTEXT: texts of any length as chunks of 50 bytes, and back. Sans-IO.

Source: "Translation" of the protocol page. Chunks of one text share an id, and count from 0; the last one has a zero.
The id 0 is a text in one chunk.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

from gateways.mavlink.messages.telemetry import Statustext
from zbridge.protocol import Kept

CHUNK_BYTES = 50
MOST_CHUNKS = 16
"""Chunks of one text; what is longer is cut off: the last one has a zero at its end, too."""
MOST_TEXTS = 4
"""Texts of which chunks may be missing; the oldest gives way, as it is."""
GAP = "..."


class JoinedText(NamedTuple):
    """A text whose chunks have come. severity: of its first chunk that came."""

    severity: int
    text: str


def clip(text: str, most_bytes: int = CHUNK_BYTES) -> bytes:
    """Return as much of a text as fits, as UTF-8 without half characters."""
    return text.encode("utf-8", "replace").replace(b"\0", b" ")[:most_bytes].decode("utf-8", "ignore").encode()


def chunks_of(text: str, severity: int, text_id: int) -> tuple[Statustext, ...]:
    """Write a text as chunks. text_id: 1 to 65535, of this text; it is used only if there are several chunks.

    A zero ends a text, so a chunk that must not cut a character is filled with spaces.
    """
    first = clip(text)
    if len(first) == len(text.encode("utf-8", "replace")):
        return (Statustext(severity, first),)
    chunks: list[Statustext] = []
    while text and len(chunks) < MOST_CHUNKS:
        last = len(chunks) == MOST_CHUNKS - 1
        chunk = clip(text, CHUNK_BYTES - last)
        text = text[len(chunk.decode()) :]
        chunks.append(
            Statustext(severity, chunk.ljust(CHUNK_BYTES) if text and not last else chunk, text_id, len(chunks))
        )
    if len(chunks[-1].text) == CHUNK_BYTES:  # nothing says yet that it is the last one
        chunks.append(Statustext(severity, b"", text_id, len(chunks)))
    return tuple(chunks)


class TextJoiner(Kept):
    """Joins the chunks of one sender's texts."""

    kept: ClassVar[dict[str, Any]] = {"_texts": dict[int, dict[int, tuple[int, bytes]]]}

    def __init__(self) -> None:
        self._texts: dict[int, dict[int, tuple[int, bytes]]] = {}
        """Severity and bytes of each chunk by its number, of each text that is not whole by its id, as they came."""

    def __repr__(self) -> str:
        return f"<TextJoiner {len(self._texts)} texts wait>"

    def take(self, message: Statustext) -> tuple[JoinedText, ...]:
        """Return the text that this chunk completes, or one that gives way to it."""
        if not message.text_id:
            return (JoinedText(message.severity, _decoded(message.text)),)
        chunks = self._texts.setdefault(message.text_id, {})
        chunks[message.chunk_seq] = message.severity, message.text
        last = min((number for number, (_, chunk) in chunks.items() if not _goes_on(chunk)), default=math.inf)
        if sum(number <= last for number in chunks) > last or len(chunks) >= MOST_CHUNKS:
            return (_join(self._texts.pop(message.text_id)),)
        if len(self._texts) > MOST_TEXTS:
            return (_join(self._texts.pop(next(iter(self._texts)))),)
        return ()


def _join(chunks: dict[int, tuple[int, bytes]]) -> JoinedText:
    pieces, due = [], 0
    for number, (_, chunk) in sorted(chunks.items()):
        pieces.append((b"" if number == due else GAP.encode()) + chunk.partition(b"\0")[0])
        due = number + 1
    severity, _ = next(iter(chunks.values()))
    return JoinedText(severity, _decoded(b"".join(pieces)))


def _goes_on(chunk: bytes) -> bool:
    return len(chunk) == CHUNK_BYTES and b"\0" not in chunk


def _decoded(text: bytes) -> str:
    return text.partition(b"\0")[0].decode("utf-8", "replace").rstrip()
