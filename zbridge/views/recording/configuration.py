"""What a recording says of a gateway's configuration: the file as it was written, without secrets."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from zbridge.toml import read_toml

_SECRET = re.compile(r"pass|secret|token|key|credential|private|auth", re.IGNORECASE)
_IN_ADDRESS = re.compile(r"(?<=//)[^/@\s]*@")
_IN_QUERY = re.compile(rf"(?<=[?&;])([^=&#\s]*(?:{_SECRET.pattern})[^=&#\s]*=)[^&;#\s]*", re.IGNORECASE)
HIDDEN = "***"


def describe_configuration(path: Path) -> dict[str, str]:
    """Return the metadata of a configuration file; raise ConfigError. ``${VAR}`` is not replaced."""
    return {"file": path.name, "configuration": json.dumps(without_secrets(read_toml(path)), default=str)}


def without_secrets(value: Any, name: str = "") -> Any:
    """Return a configuration without what may be secret: values of telling names, the ``tls`` table, logins."""
    if name == "tls" or (_SECRET.search(name) and not isinstance(value, dict)):
        return HIDDEN
    if isinstance(value, dict):
        return {str(key): without_secrets(item, str(key)) for key, item in value.items()}
    if isinstance(value, list):
        return [without_secrets(item) for item in value]
    if isinstance(value, str):
        return _IN_QUERY.sub(rf"\g<1>{HIDDEN}", _IN_ADDRESS.sub(f"{HIDDEN}@", value))
    return value
