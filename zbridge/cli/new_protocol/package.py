"""Writes the package of a new protocol from templates: files of a package that works, for a robot called newrobot.

A file is a template with the suffix ``.in``, so that neither tests nor linters of this repository take it for a module.
Templates in ``common`` belong to every style, the others to one.
"""

from __future__ import annotations

import keyword
import re
import sys
from importlib.util import find_spec
from pathlib import Path

from zbridge.errors import ConfigError
from zbridge.protocol.plugin import protocol_names

TEMPLATES = Path(__file__).parent / "templates"
COMMON, SUFFIX = "common", ".in"
_NAME = re.compile(r"[a-z]([a-z0-9_]*[a-z0-9])?")  # also of a distribution, which ends with a letter or a digit
_PLACEHOLDER = re.compile("newrobot|NewRobot")


def check_protocol_name(name: str) -> None:
    """Raise ConfigError for a name that the package of a new protocol cannot have."""
    what = f"NAME = {name!r}"
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{what}: expected lower-case letters, digits and '_', a letter first and no '_' last")
    if keyword.iskeyword(name):
        raise ConfigError(f"{what}: it is a keyword of Python")
    if name in protocol_names():
        raise ConfigError(f"{what}: a protocol of this name is installed")
    if name == "tests":
        raise ConfigError(f"{what}: the tests have this directory")
    if name in sys.stdlib_module_names or find_spec(name) is not None:
        raise ConfigError(f"{what}: a module of this name is installed, or in the current directory")


def check_folder(folder: Path) -> None:
    """Raise ConfigError unless a folder is new or empty."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise ConfigError(f"--dir {folder}: {existing} is no directory")
    if existing == folder and any(folder.iterdir()):
        raise ConfigError(f"--dir {folder}: the directory is not empty")


def write_package(name: str, style: str, folder: Path) -> list[Path]:
    """Write the package of a protocol of this name; return its files. style: the directory of its templates."""
    files = []
    for source in (TEMPLATES / COMMON, TEMPLATES / style):
        for template in sorted(source.rglob(f"*{SUFFIX}")):
            file = folder / _renamed(template.relative_to(source).as_posix().removesuffix(SUFFIX), name)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(_renamed(template.read_text("utf-8"), name), "utf-8")
            files.append(file)
    return files


def _renamed(text: str, name: str) -> str:
    camel = "".join(part.capitalize() for part in name.split("_"))
    return _PLACEHOLDER.sub(lambda found: name if found[0] == "newrobot" else camel, text)
