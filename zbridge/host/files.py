"""The robot files that a supervisor follows: directories and single files, and what has changed in them.

A faulty file changes nothing: the robot that runs by what stood in it before continues. A file that differs from the
poll before, or cannot be read, is polled once more before it counts: an editor may be writing it.

Files are read and checked on a thread of their own, never on the event loop: a slow disk, or a large file, must not
keep the supervisor from stopping the robot of a gateway that died.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from zbridge.app.config import load
from zbridge.errors import ConfigError, describe
from zbridge.fleet.printable import shown
from zbridge.host.addresses import Addresses, resolve
from zbridge.host.settings import robot_files
from zbridge.log import Log
from zbridge.protocol.address import DeviceAddress
from zbridge.toml import FILE_BYTES, read_file

log = Log("zbridge.host")

CHECK_AGAIN_S = 30.0
"""Seconds until a faulty file that is the same is checked again: a certificate that it names may be there now."""


class RobotFile(msgspec.Struct, frozen=True):
    """One file as it was read. fault: why nothing can run by it.

    identity: realm and name of the robot; None of a faulty file. connect: the robot's addresses; forms: the same,
    resolved. shares: whether other files may have them too.
    """

    path: Path
    content: bytes
    identity: tuple[str, str] | None = None
    fault: str | None = None
    connect: tuple[DeviceAddress, ...] = ()
    forms: frozenset[str] = frozenset()
    shares: bool = False

    @property
    def robot(self) -> str:
        """The robot's name on the bus; of a faulty file the file's name."""
        return self.identity[1] if self.identity is not None else self.path.stem


class Changes(msgspec.Struct, frozen=True):
    """What to do after a poll: files whose robots start, restart and end, and those that are faulty."""

    came: tuple[RobotFile, ...] = ()
    changed: tuple[RobotFile, ...] = ()
    gone: tuple[Path, ...] = ()
    moved: tuple[tuple[Path, RobotFile], ...] = ()
    """A file that has another name and is the same otherwise: the path before, and the file."""
    faulty: tuple[RobotFile, ...] = ()


def paths_of(sources: Iterable[Path]) -> list[Path]:
    """List the robot files of directories and the single files, each once; raise ConfigError for no directory."""
    found: dict[Path, None] = {}
    for source in sources:
        found.update(dict.fromkeys(robot_files(source) if source.is_dir() else [source]))
    return list(found)


def read(path: Path, most_bytes: int = FILE_BYTES) -> RobotFile:
    """Read and check one file; what is wrong is its fault."""
    try:
        content = read_file(path, most_bytes)
    except ConfigError as error:
        return RobotFile(path, b"", fault=shown(str(error)))
    return check(path, content)


def check(path: Path, content: bytes) -> RobotFile:
    """Check what was read of a file; what is wrong is its fault."""
    if not str(path).isprintable():  # so are bytes that are not UTF-8; processes send each other the name
        return RobotFile(path, content, fault=f"{shown(str(path))}: expected a name of printable characters in UTF-8")
    try:
        plan = load(path, content=content)
    except ConfigError as error:
        return RobotFile(path, content, fault=shown(str(error)))
    except Exception as error:  # whatever a check meets, the other files are followed
        log.exception("file_not_checked", "{file}: not checked", file=path)
        return RobotFile(path, content, fault=f"{path}: {describe(error)}")
    robot, device = plan.config.robot, plan.device
    connect, shares = (device.addresses, device.shares) if device is not None else ((), False)
    return RobotFile(path, content, (robot.realm, robot.name), connect=connect, shares=shares)


def located(files: Iterable[RobotFile]) -> list[RobotFile]:
    """Resolve the addresses of files that came or changed, all at once: host names may take RESOLVE_S."""
    files = list(files)
    found = resolve(address for file in files if not file.forms for address in file.connect)
    forms = (file.forms or frozenset[str]().union(*(found[each] for each in file.connect)) for file in files)
    return [msgspec.structs.replace(file, forms=each) for file, each in zip(files, forms, strict=True)]


def compare(running: Mapping[Path, RobotFile], seen: Iterable[RobotFile]) -> Changes:
    """Compare what runs with what was read now.

    Of two files with one robot name, or with one address of a robot, the one that came later is faulty.
    """
    now = {file.path: file for file in seen}
    gone = {path for path in running if path not in now}
    sound = {path: file for path, file in now.items() if file.fault is None}
    moved = [
        (old, file)
        for path, file in sound.items()
        if path not in running
        for old in gone
        if running[old].content == file.content and running[old].identity == file.identity
    ]
    gone -= {old for old, _ in moved}
    settled = {file.path for _, file in moved}
    names = {file.identity: path for path, file in running.items() if path in now}
    names |= {file.identity: file.path for _, file in moved}
    addresses = Addresses()
    for file in (*(file for path, file in running.items() if path in now), *(file for _, file in moved)):
        addresses.note(file.path, file.forms, file.shares)
    came, changed = list[RobotFile](), list[RobotFile]()
    faulty = [file for file in now.values() if file.fault is not None]
    for path, file in sound.items():
        before = running.get(path)
        if path in settled or (before is not None and before.content == file.content):
            continue
        try:
            if (other := names.get(file.identity, path)) != path:
                raise ConfigError(f"{path}: robot.name = {file.robot!r}: expected another name than that of {other}")
            addresses.add(path, file.forms, file.shares)
        except ConfigError as error:
            faulty.append(msgspec.structs.replace(file, identity=None, fault=str(error)))
        else:
            names[file.identity] = path
            (came if before is None else changed).append(file)
    return Changes(tuple(came), tuple(changed), tuple(sorted(gone)), tuple(moved), tuple(faulty))


def read_all(sources: tuple[Path, ...], most_bytes: int = FILE_BYTES) -> list[RobotFile]:
    """Read all robot files; raise ConfigError if two name one robot or one address, or no file is sound."""
    files = located(read(path, most_bytes) for path in paths_of(sources))
    if not files:
        raise ConfigError(f"{', '.join(map(str, sources))}: no robot file (*.toml)")
    sound = [file for file in files if file.fault is None]
    if not sound:
        raise ConfigError(files[0].fault or "")
    for file in compare({}, sound).faulty:
        raise ConfigError(file.fault or "")
    return files


class Follower:
    """Polls the files; a change counts when two polls show the same.

    reported: the faults that were reported already. most_bytes: of a file.
    """

    def __init__(
        self,
        sources: tuple[Path, ...],
        reported: Mapping[Path, str | None] | None = None,
        most_bytes: int = FILE_BYTES,
    ) -> None:
        self._sources = sources
        self._most_bytes = most_bytes
        self._shown: dict[Path, bytes] = {}
        self._faulty: dict[Path, tuple[float, RobotFile]] = {}
        """Files whose check failed, and when."""
        self._reported = dict(reported or {})

    def poll(self, running: Mapping[Path, RobotFile], *, twice: bool = True) -> Changes:
        """Read what may have changed; raise ConfigError if a directory cannot be read.

        twice: leave out what differs from the poll before. A fault is reported once for each content of a file.
        """
        if not twice:
            self._faulty.clear()
        seen = [self._again(path, running.get(path)) for path in paths_of(self._sources)]
        shown = {file.path: file.content for file in seen}
        self._faulty = {path: found for path, found in self._faulty.items() if path in shown}
        steady = [file for file in seen if not twice or self._shown.get(file.path) == file.content]
        waiting = {path: running[path] for path in shown if path in running and path not in {f.path for f in steady}}
        if twice:
            waiting |= {path: file for path, file in running.items() if path in self._shown and path not in shown}
        self._shown = shown
        changes = compare(running, [*located(steady), *waiting.values()])
        new = tuple(file for file in changes.faulty if self._reported.get(file.path) != file.fault)
        self._reported = {file.path: file.fault for file in changes.faulty}
        return msgspec.structs.replace(changes, faulty=new)

    def _again(self, path: Path, running: RobotFile | None) -> RobotFile:
        """Read a file; one that is as it runs is not checked again, a faulty one only every :data:`CHECK_AGAIN_S`."""
        try:
            content = read_file(path, self._most_bytes)
        except ConfigError as error:
            return RobotFile(path, b"", fault=shown(str(error)))
        if running is not None and content == running.content:
            return running
        now, (checked_at, before) = time.monotonic(), self._faulty.get(path, (-math.inf, None))
        if before is not None and before.content == content and now < checked_at + CHECK_AGAIN_S:
            return before
        file = check(path, content)
        self._faulty.pop(path, None)
        if file.fault is not None:
            self._faulty[path] = (now, file)
        return file
