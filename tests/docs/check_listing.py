"""Checks a TOML file of a page as the product reads it: ``--whole FILE``, or ``--part FILE`` of a robot's file."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

from zbridge.app import plan
from zbridge.errors import ConfigError
from zbridge.host.settings import HostFile
from zbridge.protocol.plugin import find_protocol, protocol_names
from zbridge.security.router_settings import RouterSettings
from zbridge.toml import convert
from zbridge.views.ros2.settings import Ros2Settings

OTHERS = {"build-system", "users"}
"""First tables of files that are not ours, or that a command writes."""


def check(raw: dict[str, Any], name: str, *, whole: bool) -> None:
    """Raise ConfigError if the product would refuse these tables. name: of the file."""
    if OTHERS & set(raw):
        return
    if "host" in raw or name == "host.toml":
        convert(raw, HostFile)
    elif name == "ros2.toml":
        convert(raw, Ros2Settings)
    elif {"roles", "limits", "listen"} & set(raw):
        convert(raw, RouterSettings)
    elif whole:
        plan(raw)
    else:
        check_part(raw)


def check_part(raw: dict[str, Any]) -> None:
    """Check tables beside the smallest file of a robot: of the protocol they name, else of any that takes them."""
    named = raw.get("device", {}).get("protocol")
    errors = []
    for name in [named] if named else protocol_names():
        device = tomllib.loads(find_protocol(name).template)["device"]
        whole = {"robot": {"name": "r1"}, **raw, "device": device | raw.get("device", {})}
        try:
            plan(whole)
        except ConfigError as error:
            errors.append(error)
        else:
            return
    raise errors[0]


if __name__ == "__main__":
    file = Path(sys.argv[2])
    check(tomllib.loads(file.read_text()), file.name, whole=sys.argv[1] == "--whole")
