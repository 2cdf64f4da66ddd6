"""A restart that no robot notices: a gateway hands its connections and its state to a successor, and goes.

``outgoing`` is the gateway that goes, ``incoming`` the one that comes; ``channel`` is the Unix socket between them,
``messages`` what they say, ``successor`` how a successor is started. ``docs/architecture.md``, "A restart", has the
sequence.
"""

from zbridge.app.handover.incoming import Incoming
from zbridge.app.handover.outgoing import Outgoing, Part
from zbridge.app.handover.successor import Spawn, Successor

__all__ = ["Incoming", "Outgoing", "Part", "Spawn", "Successor"]
