"""Stores the latched stops of one robot on disk: a gateway that starts reads them before it serves its robot.

It also stores whether the robot was ever ordered to move by itself (:attr:`Latches.autonomous`).

A gateway that owns its robot writes ``<realm>@<robot>.latches``. One that waits for another gateway writes what that
one says to ``<realm>@<robot>.standby.latches``: both may run on one machine, and neither may overwrite what the other
knows. A file that cannot be read means latched: nobody knows what stood in it.
Source: "Latched stops" in ``lease.md``.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import msgspec

from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.control.latch import Latches, LatchRecord
from zbridge.fleet.messages import Latch
from zbridge.fleet.topics import KeySpace
from zbridge.log import Log

log = Log("zbridge.control.latch")

MOST_BYTES = 64 * 1024
"""A larger file was not written by a gateway."""
FLUSH_S = 1.0
"""Longest wait for a disk."""
_OWN, _STANDBY = "latches", "standby.latches"
_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(LatchRecord).decode


def state_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the folder for what must survive a restart: systemd's, else the user's."""
    if given := environment.get("STATE_DIRECTORY", "").partition(":")[0]:
        return Path(given)
    if home := environment.get("XDG_STATE_HOME"):
        return Path(home) / "zbridge"
    return Path(environment.get("HOME") or "/") / ".local" / "state" / "zbridge"


class LatchStore:
    """The files of one robot. open_faults: show on ``status`` that nothing can be kept."""

    def __init__(self, keys: KeySpace, open_faults: OpenFaults, folder: Path | None = None) -> None:
        folder = folder if folder is not None else state_folder()
        self._own, self._standby = (folder / f"{keys.realm}@{keys.robot}.{kind}" for kind in (_OWN, _STANDBY))
        self._open_faults = open_faults
        self.known = Latches()
        """What could be read, and what the gateway that owns the robot said since; after :meth:`load`."""
        self._written: dict[Path, LatchRecord] = {}
        """What is on disk, or on its way there."""
        self._waiting: dict[Path, LatchRecord] = {}
        self._writing: asyncio.Task[None] | None = None

    def __repr__(self) -> str:
        return f"<LatchStore {self._own}>"

    def load(self) -> Latches:
        """Read what is in force; from a file that cannot be read a latch without an end but its own release."""
        self.known = Latches()
        record = self._read(self._own)
        latches = Latches(record)
        if record is not None:
            self._written[self._own] = record
        standby = self._read(self._standby)
        if standby is not None:
            self._written[self._standby] = standby
            latches.merge(standby)
        return latches

    def save(self, latches: Latches) -> asyncio.Future[None] | None:
        """Write what is in force, on a thread; the newest counts. Call it again to try again.

        Returns what ends when everything is written, or could not be; None if nothing is to be written.
        """
        self._put(self._own, latches.record)
        self.known = Latches(latches.record)
        if self._standby in self._written:  # it is in the own file now
            self._put(self._standby, LatchRecord())
        return self._writing

    def mirror(self, record: LatchRecord) -> None:
        """Write what the gateway that owns the robot says, on a thread."""
        self.known.merge(record)
        self._put(self._standby, msgspec.structs.replace(record, autonomous=self.known.autonomous))

    async def flush(self) -> None:
        """Wait until everything is written, or could not be, for at most :data:`FLUSH_S`."""
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=FLUSH_S)

    # Reading

    def _read(self, path: Path) -> LatchRecord | None:
        """Read one file; None if there is none."""
        try:
            with path.open("rb") as file:
                data = file.read(MOST_BYTES + 1)
            if len(data) > MOST_BYTES:
                raise ValueError(f"more than {MOST_BYTES} bytes")
            record = _decode(data)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, msgspec.MsgspecError) as error:
            reason = f"{path} cannot be read: {error}"
            log.error("latch_file_unreadable", "{reason}: the robot is latched", reason=reason, file=path)
            return LatchRecord((Latch(os.urandom(16), "gateway", reason),))
        self.known.merge(record)
        return record

    # Writing

    def _put(self, path: Path, record: LatchRecord) -> None:
        if self._written.get(path, LatchRecord()) == record:
            return
        self._written[path] = self._waiting[path] = record
        if self._writing is None:
            self._writing = asyncio.ensure_future(self._write_all())

    async def _write_all(self) -> None:
        try:
            while self._waiting:
                path = next(iter(self._waiting))
                record = self._waiting.pop(path)
                try:
                    await asyncio.to_thread(_write, path, _encode(record))
                except OSError as error:
                    self._fail(path, error)
                else:
                    self._open_faults.set(FaultCode.LATCH_FILE, None)
        finally:
            self._writing = None

    def _fail(self, path: Path, error: OSError) -> None:
        self._written.pop(path, None)  # so that it is tried again
        text = f"latched stops do not survive a restart: {path}: {error.strerror or error}"
        if text not in self._open_faults.texts:
            log.error("latch_not_written", "{reason}", reason=text, file=path)
        self._open_faults.set(FaultCode.LATCH_FILE, text)


def _write(path: Path, data: bytes) -> None:
    """Replace a file such that it is whole at any moment, after a loss of power too; raise OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # mode 0600
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
