"""zbridge: legacy robots and operator programs on one Zenoh bus, one gateway process per device.

This package is the core. It knows no robot: each protocol is a package of its own, found through the
entry-point group ``zbridge.protocols``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from zbridge.version import __version__ as __version__

if TYPE_CHECKING:
    from zbridge.client import blocking as blocking
    from zbridge.client import connect as connect


def __getattr__(name: str) -> Any:
    """Load the client when a program asks for it: a gateway has no use for it."""
    match name:
        case "connect":
            return import_module("zbridge.client").connect
        case "blocking":
            return import_module("zbridge.client.blocking")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
