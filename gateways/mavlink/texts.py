"""STATUSTEXT: texts of any length as chunks of 50 bytes, and back. Sans-IO.

Source: "Translation" of the protocol page. Chunks of one text share an id, and count from 0; the last one has a zero.
The id 0 is a text in one chunk.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from gateways.mavlink.messages.telemetry import Statustext
from zbridge.protocol import Kept

CHUNK_BYTES = 50
MOST_CHUNKS = 16
"""Chunks of one text; what is longer is cut off."""
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
        chunk = clip(text)
        text = text[len(chunk.decode()) :]
        chunks.append(Statustext(severity, chunk.ljust(CHUNK_BYTES) if text else chunk, text_id, len(chunks)))
    if len(chunks[-1].text) == CHUNK_BYTES and len(chunks) < MOST_CHUNKS:  # nothing says yet that it is the last one
        chunks.append(Statustext(severity, b"", text_id, len(chunks)))
    return tuple(chunks)


class TextJoiner(Kept):
    """Joins the chunks of one sender's texts."""

    kept: ClassVar[dict[str, Any]] = {"_chunks": list[tuple[int, int, int, bytes]]}

    def __init__(self) -> None:
        self._chunks: list[tuple[int, int, int, bytes]] = []
        """Id, number, severity and bytes of each chunk whose text is not whole, as they came."""

    def __repr__(self) -> str:
        return f"<TextJoiner {len(self._chunks)} chunks wait>"

    def take(self, message: Statustext) -> tuple[JoinedText, ...]:
        """Return the texts that this chunk completes, and one that gives way to it."""
        if not message.text_id:
            return (JoinedText(message.severity, _decoded(message.text)),)
        self._chunks.append((message.text_id, message.chunk_seq, message.severity, message.text))
        waiting = list(dict.fromkeys(chunk[0] for chunk in self._chunks))
        done = [text_id for text_id in waiting if self._is_whole(text_id)]
        if not done and len(waiting) > MOST_TEXTS:
            done = waiting[:1]
        return tuple(self._join(text_id) for text_id in done)

    def _of(self, text_id: int) -> dict[int, tuple[int, bytes]]:
        return {number: (severity, chunk) for each, number, severity, chunk in self._chunks if each == text_id}

    def _is_whole(self, text_id: int) -> bool:
        """Return whether the last chunk and all before it have come, or as many as are joined."""
        chunks = self._of(text_id)
        last = min((number for number, (_, chunk) in chunks.items() if not _goes_on(chunk)), default=None)
        whole = last is not None and all(number in chunks for number in range(last))
        return whole or sum(each[0] == text_id for each in self._chunks) >= MOST_CHUNKS

    def _join(self, text_id: int) -> JoinedText:
        chunks = self._of(text_id)
        severity = next(severity for each, _, severity, _ in self._chunks if each == text_id)
        self._chunks = [chunk for chunk in self._chunks if chunk[0] != text_id]
        pieces, before = [], -1
        for number, (_, chunk) in sorted(chunks.items()):
            pieces.append((b"" if number == before + 1 else GAP.encode()) + chunk.partition(b"\0")[0])
            before = number
        return JoinedText(severity, _decoded(b"".join(pieces)))


def _goes_on(chunk: bytes) -> bool:
    return len(chunk) == CHUNK_BYTES and b"\0" not in chunk


def _decoded(text: bytes) -> str:
    return text.partition(b"\0")[0].decode("utf-8", "replace").rstrip()
