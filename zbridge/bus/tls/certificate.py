"""Reads a certificate's common name and dates from its file.

Python's ``ssl`` reports them for a peer's certificate only, and only if it accepts that; so the few fields that are
needed are read here. Signatures are not checked here: ``ssl`` does that.
"""

from __future__ import annotations

import ssl
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from zbridge.errors import ConfigError

_UTC_TIME, _VERSION = 0x17, 0xA0
_COMMON_NAME = b"\x06\x03\x55\x04\x03"
"""The object identifier 2.5.4.3 (common name), DER-encoded."""
_MOST = 65_536
"""Most bytes of a file that is read as a certificate."""


class Certificate(msgspec.Struct, frozen=True):
    """The fields of a certificate that are needed. common_name: empty if there is none."""

    common_name: str
    begins: datetime
    ends: datetime

    @property
    def role(self) -> str:
        """The role in a common name ``role.name``; empty if it is not of this form."""
        return self.common_name.partition(".")[0] if self.name else ""

    @property
    def name(self) -> str:
        """The name in a common name ``role.name``; empty if it is not of this form."""
        return self.common_name.partition(".")[2]


def read_certificate(path: Path) -> Certificate:
    """Read the first certificate of a file in PEM form; raise ConfigError, which names the file."""
    try:
        with path.open("rb") as file:
            text = file.read(_MOST).decode("ascii", "replace")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    begin, end = text.find(ssl.PEM_HEADER), text.find(ssl.PEM_FOOTER)
    try:
        if begin < 0:
            raise ValueError("no PEM")
        return parse_certificate(ssl.PEM_cert_to_DER_cert(text[begin : end + len(ssl.PEM_FOOTER)]))
    except (ValueError, IndexError) as error:
        raise ConfigError(f"{path}: not a certificate in PEM form") from error


def parse_certificate(der: bytes) -> Certificate:
    """Read a certificate in DER form; raise ValueError or IndexError."""
    fields = _items(_items(_items(der)[0][1])[0][1])
    if fields[0][0] == _VERSION:
        fields = fields[1:]
    _, _, _, (_, validity), (_, subject) = fields[:5]  # number, algorithm, issuer, validity, subject
    begins, ends = (_time(*each) for each in _items(validity))
    return Certificate(_common_name(subject), begins, ends)


def _items(data: bytes) -> list[tuple[int, bytes]]:
    """Cut bytes into DER items: tag and content."""
    items, at = [], 0
    while at < len(data):
        tag, size = data[at], data[at + 1]
        at += 2
        if size & 0x80:
            more = size & 0x7F
            size = int.from_bytes(data[at : at + more], "big")
            at += more
        if at + size > len(data):
            raise ValueError("an item is longer than what holds it")
        items.append((tag, data[at : at + size]))
        at += size
    return items


def _common_name(name: bytes) -> str:
    for _, part in _items(name):
        for _, attribute in _items(part):
            if attribute.startswith(_COMMON_NAME):
                return _items(attribute)[1][1].decode("utf-8", "replace")
    return ""


def _time(tag: int, content: bytes) -> datetime:
    form = "%y%m%d%H%M%SZ" if tag == _UTC_TIME else "%Y%m%d%H%M%SZ"
    return datetime.strptime(content.decode("ascii"), form).replace(tzinfo=UTC)
