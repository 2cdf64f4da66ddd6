"""One robot on the bus: its links, its telemetry, its commands and queries, and which gateway owns it.

Knows no HQ program and no protocol in particular. :class:`Device` puts the parts together; ``commands`` and
``queries`` are the way in, ``telemetry`` and ``presence`` the way out, ``connection`` the links, ``ownership`` keeps
two gateways from serving one robot.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zbridge.robot.device import Device
    from zbridge.robot.ownership import Ownership
    from zbridge.robot.settings import DevicePlan, DeviceSettings

__all__ = ["Device", "DevicePlan", "DeviceSettings", "Ownership"]

_MODULES = {"Device": "device", "DevicePlan": "settings", "DeviceSettings": "settings", "Ownership": "ownership"}


def __getattr__(name: str) -> Any:
    """Load the module of a public name when it is asked for: reading a configuration needs the settings alone."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
