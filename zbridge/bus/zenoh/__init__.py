"""The bus over Zenoh: the only package that imports it.

Zenoh calls back on threads of its own, and a slow callback stalls the whole session. Callbacks only sort what comes in
and put it into the inbox of the event loop (``incoming``). Calls that may block (states, answers, streams in ``block``
mode) are made by writer threads, never by the event loop (``publishers``). ``opening`` opens a Zenoh session or reports
why it cannot, ``session`` uses and closes it; ``declared`` undeclares what was declared on it. ``router`` opens a
router, and watches its neighbours and Zenoh's log.
"""

from __future__ import annotations

import os

# One thread that receives instead of several that wake one another for each message; read when zenoh is imported.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1), acc: (handover: rx))")

from zbridge.bus.zenoh.opening import canonical, zenoh_config
from zbridge.bus.zenoh.router import open_router, read_log
from zbridge.bus.zenoh.session import ZenohBus, open_zenoh

__all__ = ["ZenohBus", "canonical", "open_router", "open_zenoh", "read_log", "zenoh_config"]
