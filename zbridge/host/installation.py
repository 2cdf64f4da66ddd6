"""Tells whether the installed code is another one than that of a running process."""

from __future__ import annotations

import hashlib
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from zbridge.protocol.plugin import GROUP

HOME = Path(__file__).parents[1]
"""The folder of zbridge's code."""
SETTLED_S = 2.0
"""Seconds for which nothing must have changed: an installer writes file after file."""


class Stamp:
    """What is installed now. Two stamps are equal if no file of the code differs in size and time of change."""

    def __init__(self) -> None:
        digest, newest_ns = hashlib.blake2b(digest_size=16), 0
        for path in _files():
            try:
                state = path.stat()
            except OSError:  # an installer replaces it at this moment
                newest_ns = time.time_ns()
                continue
            digest.update(f"{path}\0{state.st_size}\0{state.st_mtime_ns}\0".encode())
            newest_ns = max(newest_ns, state.st_mtime_ns, state.st_ctime_ns)
        self.digest = digest.digest()
        self.settled = abs(time.time_ns() - newest_ns) > SETTLED_S * 1e9
        """Whether nothing changed for :data:`SETTLED_S`."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Stamp) and self.digest == other.digest

    @classmethod
    def of(cls, digest: bytes) -> Stamp:
        """Make the stamp of an installation that was looked at before."""
        stamp = cls.__new__(cls)
        stamp.digest, stamp.settled = digest, True
        return stamp

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"<Stamp {self.digest.hex()[:8]}>"


def _files() -> list[Path]:
    """List the code of zbridge and of the protocols, and the names of what is installed beside it."""
    roots = {HOME, *_protocol_packages()}
    sources = [path for root in roots for path in root.rglob("*.py")]
    return sorted({*sources, *(path for folder in sys.path for path in Path(folder).glob("*.dist-info"))})


def _protocol_packages() -> set[Path]:
    """Find the folders of the protocols' packages; loads none of them."""
    from importlib.metadata import entry_points

    specs = [find_spec(point.module.partition(".")[0]) for point in entry_points(group=GROUP)]
    return {Path(spec.origin).parent for spec in specs if spec is not None and spec.has_location and spec.origin}
