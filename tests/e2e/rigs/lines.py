"""JSON objects, one a line, for who reads them from a pipe. Imports nothing but the standard library."""

from __future__ import annotations

import json
import threading
from typing import Any, TextIO


class Lines:
    """Writes objects to a stream; many threads may call it at the same time, and no line is torn.

    ``print`` writes a text and its line end one after the other: another thread's text may come between them.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()

    def __call__(self, **fields: Any) -> None:
        """Write one line and flush."""
        line = json.dumps(fields) + "\n"
        with self._lock:
            self._stream.write(line)
            self._stream.flush()
