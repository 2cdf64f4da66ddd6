"""The robots that were ever on the bus, kept in a file: one whose gateway was killed is missing, and not forgotten."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from zbridge.errors import ConfigError
from zbridge.fleet.topics import is_name

ROBOTS = 10_000
"""Most robots of a roster."""
MOST_BYTES = 1_000_000
"""A larger file is no roster."""


class Roster:
    """The names, one a line in ``file``. fault: why the last change is not on disk."""

    def __init__(self, file: Path) -> None:
        self.names: set[str] = set()
        self.fault: str | None = None
        self._file = file
        self._changed = False

    def __repr__(self) -> str:
        return f"<Roster {self._file}, {len(self.names)} robots>"

    def load(self) -> None:
        """Read the file, if there is one; raise ConfigError if it is no roster."""
        try:
            with self._file.open("rb") as file:
                content = file.read(MOST_BYTES + 1)
            lines = content.decode().split("\n")
        except FileNotFoundError:
            return
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{self._file}: {error}") from error
        names = {line for line in lines if line}
        if len(content) > MOST_BYTES or len(names) > ROBOTS or not all(map(is_name, names)):
            raise ConfigError(f"{self._file}: expected names of robots, one a line, {ROBOTS} at most")
        self.names = names

    def add(self, names: Iterable[str]) -> None:
        """Remember robots; those beyond :data:`ROBOTS` are not."""
        new = set(names) - self.names
        self.names.update(sorted(new)[: ROBOTS - len(self.names)])
        self._changed = self._changed or bool(new & self.names)

    def forget(self, name: str) -> None:
        """Forget a robot, until it is on the bus again."""
        self._changed = self._changed or name in self.names
        self.names.discard(name)

    def save(self) -> None:
        """Write the file if something has changed. Blocks; may run on a thread."""
        if not self._changed:
            return
        self._changed, temporary = False, self._file.with_name(f"{self._file.name}.new")
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_text("".join(f"{name}\n" for name in sorted(self.names.copy())))
            os.replace(temporary, self._file)
            self.fault = None
        except OSError as error:
            self._changed, self.fault = True, f"{self._file}: {error.strerror or error}"
