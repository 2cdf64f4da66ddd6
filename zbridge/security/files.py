"""The files of a secure bus: their paths, and atomic writing; keys are readable by their owner only."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from zbridge.errors import ConfigError

SECRET, PUBLIC, PRIVATE_FOLDER = 0o600, 0o644, 0o700
_OTHERS = 0o077
"""The permissions of everybody but the owner."""


class NameFiles:
    """The files of one name; ``--tls`` accepts a folder with them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ca = folder / "ca.pem"
        """The certificate of the authority."""
        self.certificate = folder / "certificate.pem"
        self.key = folder / "key.pem"


class Folder:
    """The folder of an authority."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ca = path / "ca.pem"
        self.ca_key = path / "ca-key.pem"
        self.roles = path / "roles.toml"

    def of(self, name: str) -> NameFiles:
        """Return the files of a name. A name has no dots, so no name is one of the files above."""
        return NameFiles(self.path / name)


@contextlib.contextmanager
def changing(folder: Folder) -> Iterator[None]:
    """Lock the folder against changes by other programs; raise ConfigError if it is locked, or does not exist."""
    try:
        descriptor = os.open(folder.path, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise ConfigError(f"{folder.path}: {error.strerror}: expected the folder of `zbridge certs init`") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise ConfigError(f"{folder.path}: another program issues or revokes here now; try again") from error
    finally:
        os.close(descriptor)


def make_folder(path: Path) -> None:
    """Make a folder that only its owner may enter, if it does not exist; raise ConfigError."""
    with _named(path):
        path.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)


def write(path: Path, content: bytes, mode: int | None = None) -> None:
    """Replace a file as a whole; raise ConfigError. A secret is never readable by others, not even temporarily.

    mode: None: as the umask sets it.
    """
    new = path.with_name(f".{path.name}.new")
    with _named(path):
        new.unlink(missing_ok=True)
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666 if mode is None else mode)
        with os.fdopen(descriptor, "wb") as file:
            if mode is not None:
                os.fchmod(descriptor, mode)  # whatever the umask is
            file.write(content)
            file.flush()
            os.fsync(descriptor)
        new.replace(path)


def read(path: Path) -> bytes:
    """Read a file; raise ConfigError, which names it."""
    with _named(path):
        return path.read_bytes()


def read_secret(path: Path) -> bytes:
    """Read a key; raise ConfigError also if anybody but its owner may read or write the file."""
    with _named(path):
        mode = path.stat().st_mode & 0o777
    if mode & _OTHERS:
        raise ConfigError(
            f"{path}: others can read or write this key (mode {mode:04o}): expected 0600. If somebody did, it is lost."
        )
    return read(path)


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Raise an OSError as a ConfigError that names the file."""
    try:
        yield
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error


def refuse_to_overwrite(*paths: Path, advice: str) -> None:
    """Raise ConfigError with the first path that exists; ``advice`` says what to do."""
    for path in paths:
        if path.exists():
            raise ConfigError(f"{path}: exists already; {advice}")
