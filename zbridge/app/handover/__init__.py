"""A restart that no robot notices: a gateway hands its connections and its state to a successor, and goes.

``outgoing`` is the gateway that goes, ``incoming`` the one that comes; ``channel`` is the Unix socket between them and
its messages, ``restarts`` what a gateway hands over and who may ask, ``processes`` how a successor is started and
ended. ``docs/architecture.md``, "A restart", has the sequence.
"""

from zbridge.app.handover.incoming import Incoming
from zbridge.app.handover.processes import Spawn, Successor
from zbridge.app.handover.restarts import ClaimPart, Restarts

__all__ = ["ClaimPart", "Incoming", "Restarts", "Spawn", "Successor"]
