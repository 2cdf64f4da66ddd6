"""Where a peer of a legacy protocol is: host and port, as configurations and logs write it. Opens nothing."""

from __future__ import annotations

from urllib.parse import urlsplit

import msgspec

from zbridge.errors import LinkError


class Address(msgspec.Struct, frozen=True):
    """Where a peer is: ``tcp://host:port``."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read ``tcp://host:port``; raise LinkError saying what was expected."""
        try:
            parts = urlsplit(text)
            host, port = parts.hostname, parts.port
            (host or "").encode("idna")
        except ValueError as error:
            raise LinkError(f"{text!r}: {error}; expected tcp://host:port") from error
        odd = parts.path or parts.query or parts.fragment or parts.username is not None
        if parts.scheme != "tcp" or not host or port is None or odd:
            raise LinkError(f"{text!r}: expected tcp://host:port")
        return cls(host, port)

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"tcp://{host}:{self.port}"
