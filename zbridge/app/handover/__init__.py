"""A restart that no robot notices: a gateway hands its connections and its state to a successor, and goes.

``outgoing`` is the gateway that goes, ``incoming`` the one that comes; ``channel`` is the Unix socket between them,
``messages`` what they say, ``restarts`` what a gateway hands over and who may ask, ``successor`` how a successor is
started. ``docs/architecture.md``, "A restart", has the sequence.
"""

from zbridge.app.handover.claim import ClaimPart
from zbridge.app.handover.incoming import Incoming
from zbridge.app.handover.restarts import Restarts
from zbridge.app.handover.successor import Spawn, Successor

__all__ = ["ClaimPart", "Incoming", "Restarts", "Spawn", "Successor"]
