"""A restart that no robot notices: a gateway hands its connections and its state to a successor, and exits.

``sequence`` implements both ends, the predecessor and the successor; ``channel`` is the Unix socket between them and
its messages, ``restarts`` what a gateway hands over and who may request it, ``processes`` how a successor is started
and ended. ``restarts.md`` has the sequence.
"""

from zbridge.app.handover.processes import Spawn, Successor
from zbridge.app.handover.restarts import ClaimPart, Restarts
from zbridge.app.handover.sequence import ColdStart, Incoming

__all__ = ["ClaimPart", "ColdStart", "Incoming", "Restarts", "Spawn", "Successor"]
