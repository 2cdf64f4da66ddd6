"""Who may drive one robot: leases and proofs, stops and deadlines, limits on motion, the audit log.

Knows no link and no protocol. The authority is the gateway's machine, the lease client the holder's; both are without
clock, loop and bus. The gate sorts commands on the bus's threads; the enforcer carries out what the authority decides;
the lease server answers queries; the lease holder asks them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zbridge.control.audit_log import Audit, AuditFile
    from zbridge.control.authority import Authority
    from zbridge.control.context import RobotContext
    from zbridge.control.enforcer import Enforcer
    from zbridge.control.lease_client import LeaseClient
    from zbridge.control.lease_holder import LeaseHolder
    from zbridge.control.lease_server import LeaseServer
    from zbridge.control.motion_limits import MotionLimits
    from zbridge.control.proof import Signer, Verifier
    from zbridge.control.settings import ControlSettings
    from zbridge.control.standstill import Standstill

__all__ = [
    "Audit",
    "AuditFile",
    "Authority",
    "ControlSettings",
    "Enforcer",
    "LeaseClient",
    "LeaseHolder",
    "LeaseServer",
    "MotionLimits",
    "RobotContext",
    "Signer",
    "Standstill",
    "Verifier",
]

_MODULES = {
    "Audit": "audit_log",
    "AuditFile": "audit_log",
    "Authority": "authority",
    "ControlSettings": "settings",
    "Enforcer": "enforcer",
    "LeaseClient": "lease_client",
    "LeaseHolder": "lease_holder",
    "LeaseServer": "lease_server",
    "MotionLimits": "motion_limits",
    "RobotContext": "context",
    "Signer": "proof",
    "Standstill": "standstill",
    "Verifier": "proof",
}


def __getattr__(name: str) -> Any:
    """Load the module of a public name when it is asked for: a client needs proofs alone."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
