"""Carries out ``zbridge record, info, export, mark, replay``."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

import msgspec

import zbridge
from zbridge.app import until_signal
from zbridge.bus import BusSettings, read_key_expr
from zbridge.bus.tls.files import own_name, own_role
from zbridge.bus.tls.membership import Right, require_right
from zbridge.cli.incidents import keep_minutes
from zbridge.cli.terminal import Column, Table, console, errors
from zbridge.client import joined
from zbridge.client.driver import default_who
from zbridge.errors import ConfigError, LinkError, ZbridgeError
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import KeySpace, is_name
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.tasks import occurs, together
from zbridge.toml import prefixed
from zbridge.views.recording.capture import BusCapture, RecordPlan, publish_mark
from zbridge.views.recording.contents import Pictures, describe_configuration
from zbridge.views.recording.export import export_arrays, export_tables, first_ns
from zbridge.views.recording.intake import Intake
from zbridge.views.recording.player import Player
from zbridge.views.recording.recorder import Recorder
from zbridge.views.recording.replay import Replay, ReplayPlan, plan_listeners, plan_names, survey
from zbridge.views.recording.selection import read_seconds, read_selection, read_split
from zbridge.views.recording.summary import KeySummary, Summary, summarize
from zbridge.views.recording.tape import Tape, TapeSettings
from zbridge.views.recording.wire_robot import WireLink

_LOSSES = 20
"""Most keys with losses that are printed."""
_KEY_COLUMNS = (
    *(Column("key"), Column("messages", 1, number=True), Column("Hz", 2, number=True)),
    *(Column("longest pause s", 3, number=True), Column("gaps", 4, number=True), Column("bytes", 5, number=True)),
    Column("schema", 6),
)
_LEAST_BUFFER = 2**20


class RecordOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The options of ``zbridge record`` as they were written."""

    output: Path
    robots: Sequence[str]
    keys: str
    only: str
    wire: bool
    split: str
    keep: int
    duration: str
    compression: str
    config: Sequence[Path]
    buffer: str
    realm: str


def _tape_settings(options: RecordOptions) -> TapeSettings:
    split_bytes, split_s = read_split(options.split) if options.split else (None, None)
    if options.keep and not options.split:
        raise ConfigError("keep: needs --split")
    if options.compression not in ("zstd", "lz4", "none"):
        raise ConfigError(f"compression = {options.compression!r}: expected one of 'zstd', 'lz4', 'none'")
    settings = TapeSettings(options.output, options.compression, split_bytes, split_s, options.keep or None)  # type: ignore[arg-type]
    taken = settings.file(1)
    if taken.exists():
        raise ConfigError(f"{taken} exists: give another name")
    return settings


def _metadata(options: RecordOptions) -> dict[str, dict[str, str]]:
    made = {
        "version": zbridge.__version__,
        "realm": options.realm,
        "robots": ", ".join(options.robots) or options.keys or "all",
        "wire": str(options.wire).lower(),
        "only": options.only,
        "began": datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    configurations = {f"configuration/{path.name}": describe_configuration(path) for path in options.config}
    return {"zbridge": made, **configurations}


async def run_record(settings: BusSettings, options: RecordOptions) -> bool:
    """Record until a signal, the end of the duration, or of the disk; False if the recording failed."""
    if options.only not in ("", "fleet", "foxglove"):
        raise ConfigError(f"only = {options.only!r}: expected 'fleet' or 'foxglove'")
    if not is_name(options.realm):
        raise ConfigError(f"realm = {options.realm!r}: expected letters, digits, '_', '.' and '-' only")
    keys = read_key_expr("keys", options.keys) if options.keys else None
    duration_s = read_seconds("duration", options.duration) if options.duration else None
    tape = Tape(_tape_settings(options))
    buffer, _ = read_split(options.buffer)
    if buffer is None or buffer < _LEAST_BUFFER:
        raise ConfigError(f"buffer = {options.buffer!r}: expected a size of 1MiB or more")
    intake, full, loop = Intake(buffer), asyncio.Event(), asyncio.get_running_loop()
    recorder = Recorder(
        tape,
        intake,
        _metadata(options),
        fleet=options.only != "foxglove",
        pictures=Pictures() if options.only != "fleet" else None,
        failed=lambda: loop.call_soon_threadsafe(full.set),
    )
    plan = RecordPlan(options.realm, tuple(options.robots), keys, options.wire)
    async with joined(settings, options.realm) as bus:
        recorder.start()
        recording = BusCapture(bus, plan, intake)
        recording.open()
        errors.print(shown(f"recording {', '.join(plan.key_exprs)} to {tape.files[0]}"))
        begun = time.monotonic()
        try:
            await until_signal(occurs(full, duration_s))
        finally:
            recording.close()
            await asyncio.to_thread(recorder.close)
            _report_end(recorder, tape, time.monotonic() - begun)
    return recorder.error is None


def _report_end(recorder: Recorder, tape: Tape, seconds: float) -> None:
    if recorder.error is not None:
        errors.print(shown(recorder.error))
    files = ", ".join(map(str, tape.files[-3:]))
    came = f"; {recorder.messages} came from the bus" if recorder.messages != tape.messages else ""
    errors.print(shown(f"{tape.messages} messages in {seconds:.1f} s, {tape.bytes_written} bytes: {files}{came}"))
    losses = recorder.losses()
    for reason, by_key in losses.items():
        errors.print(shown(f"lost, {reason}: {sum(by_key.values())}"))
        for key, count in sorted(by_key.items(), key=lambda item: -item[1])[:_LOSSES]:
            errors.print(shown(f"  {key} {count}"))
    if not losses:
        errors.print("nothing lost")


async def put_mark(settings: BusSettings, realm: str, text: str, who: str | None, *, keep: bool = False) -> bool:
    """Put a mark on the bus; raise BusRefused for a role that may not: the router would silently drop it.

    keep: let black boxes keep the minutes before; then return whether there is one.
    """
    name, role = own_name(settings.tls), own_role(settings.tls)
    async with joined(settings, realm) as bus:
        await require_right(bus.ask, realm, name or default_who(), Right.MARK, role=role or "")
        await publish_mark(bus, realm, text, who or name or default_who())
        return not keep or await keep_minutes(bus, realm, name or who or default_who(), text)


def show_info(path: Path, *, as_json: bool) -> None:
    """Print what a recording holds."""
    summary = summarize(path)
    if not summary.messages and summary.fault == "not an MCAP file":
        raise ConfigError(f"{path}: {summary.fault}")
    if not as_json:
        _print_info(summary)
        return
    fields = msgspec.to_builtins(summary)
    for entry, key in zip(fields["keys"], summary.keys, strict=True):
        entry["rate_hz"] = key.rate_hz
    console.print(to_json({**fields, "robots": summary.robots, "duration_s": summary.duration_s}))


def _print_info(summary: Summary) -> None:
    began = _day(summary.begin_ns)
    console.print(shown(f"{summary.path}: {summary.size} bytes, {summary.messages} messages"))
    console.print(shown(f"from {began}, {summary.duration_s:.3f} s"))
    console.print(shown("complete" if summary.fault is None else f"incomplete: {summary.fault}"))
    console.print(shown(f"robots: {', '.join(summary.robots) or 'none'}"))
    for name, pairs in summary.metadata:
        console.print(shown(f"{name}: " + ", ".join(f"{key} {value}" for key, value in pairs.items() if value)))
    Table(_KEY_COLUMNS, map(_key_row, summary.keys)).print()


def _key_row(key: KeySummary) -> tuple[object, ...]:
    rate, pause = f"{key.rate_hz:.2f}", f"{key.gap_s:.3f}"
    return (key.topic, key.count, rate, pause, key.gaps or "", key.bytes, key.schema or key.encoding)


def _day(stamp_ns: int) -> str:
    try:
        return datetime.fromtimestamp(stamp_ns / 1e9).astimezone().isoformat(timespec="milliseconds")
    except (ValueError, OverflowError, OSError):
        return f"{stamp_ns} ns"


def run_export(path: Path, output: Path | None, keys: str, since: str, until: str, *, arrays: bool) -> None:
    """Write a recording as tables or arrays."""
    selection = read_selection(first_ns(path), since, until, keys or None)
    output = output or path.with_suffix(".npz" if arrays else "")
    if output == path or (arrays and output.exists()):
        raise ConfigError(f"{output} exists: give another name with -o")
    try:
        done = (export_arrays if arrays else export_tables)(path, output, selection)
    except OSError as error:
        raise ZbridgeError(f"{error.filename or output}: {error.strerror or error}") from error
    errors.print(
        shown(f"{done.messages} messages to {output}, {done.files} files, {done.skipped} that cannot be represented")
    )
    if done.fault is not None:
        errors.print(shown(f"the recording is incomplete: {done.fault}"))


class ReplayOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The options of ``zbridge replay`` as they were written."""

    file: Path
    realm: str
    robots: Sequence[str]
    speed: float
    loop: bool
    since: str
    until: str
    pause: bool
    hq: Sequence[str]


def _plan(options: ReplayOptions) -> ReplayPlan:
    seen, begin_ns = survey(options.file), first_ns(options.file)
    names = plan_names(seen.robots, options.robots)
    if options.hq and len(names) > 1:
        raise ConfigError(f"hq: serves one robot, and the replay has {', '.join(names)}: choose one by --robot")
    return ReplayPlan(
        path=options.file,
        realm=options.realm,
        names=names,
        selection=read_selection(begin_ns, options.since, options.until),
        speed=options.speed,
        loop=options.loop,
        paused=options.pause,
        listeners=plan_listeners(options.hq),
        statuses=seen.statuses,
    )


async def run_replay(settings: BusSettings, options: ReplayOptions) -> None:
    """Replay onto the bus until the end of the file or a signal."""
    plan = _plan(options)
    async with joined(settings, options.realm) as bus:
        replay = Replay(bus, plan, lambda text: errors.print(shown(text)))
        with _keys(replay.player) if plan.paused else contextlib.nullcontext():
            errors.print(shown(", ".join(f"{recorded} as {name}" for recorded, name in plan.names.items())))
            await until_signal(replay.run())
    others = f", {replay.left_out} left out (other robots, commands, queries, raw frames, pictures)"
    errors.print(shown(f"{replay.played} messages played{others if replay.left_out else ''}"))
    if replay.fault is not None:
        errors.print(shown(f"the recording is incomplete: {replay.fault}"))


@contextlib.contextmanager
def _keys(player: Player) -> Iterator[None]:
    """Make Enter pause and resume the player."""
    loop, stdin = asyncio.get_running_loop(), sys.stdin.fileno()

    def pressed() -> None:
        if not os.read(stdin, 1024):
            loop.remove_reader(stdin)
            return
        if player.paused:
            player.resume()
        else:
            player.pause()
        errors.print("paused: press Enter to resume" if player.paused else "playing: press Enter to pause")

    try:
        loop.add_reader(stdin, pressed)
    except OSError as error:
        raise ConfigError(f"pause: stdin cannot be read: {error.strerror}") from error
    errors.print("paused: press Enter to resume")
    try:
        yield
    finally:
        loop.remove_reader(stdin)


async def run_wire(path: Path, protocol: str, listen: list[str], robots: list[str], speed: float, realm: str) -> None:
    """Act as the legacy robot until all is played, or a signal."""
    with prefixed("listen = ", LinkError):
        addresses = [Address.parse(text) for text in listen]
    found = find_protocol(protocol)
    if len(addresses) > found.links:
        raise ConfigError(f"listen: a {found.name} robot has at most {found.links} links")
    seen = survey(path)
    known = seen.robots
    if len(robots) > 1 or (len(known) > 1 and not robots) or (robots and robots[0] not in known):
        raise ConfigError(f"robot: the recording has {', '.join(known)}: name one by --robot")
    keys = KeySpace(realm, robots[0] if robots else known[0])
    names = _links(found, len(addresses), seen.links.get(keys.robot, []))
    links = [WireLink(path, keys, name, speed, lambda text: errors.print(shown(text))) for name in names]
    ready = [lambda at, name=link.link: print(f"{name} listens at {at}", flush=True) for link in links]  # noqa: T201
    await until_signal(together(*(link.run(at, tell) for link, at, tell in zip(links, addresses, ready, strict=True))))
    for link in links:
        less = f"; in {link.unanswered} conversations the gateway sent less than recorded" if link.unanswered else ""
        errors.print(shown(f"{link.link}: {link.frames} frames{less}"))


def _links(protocol: Protocol, count: int, recorded: Sequence[str]) -> tuple[str, ...]:
    """Return the names of this many links of a robot; raise ConfigError if the recording has others."""
    names = {
        number: protocol.robot(protocol.options(), number, Metrics()).link_names
        for number in range(1, protocol.links + 1)
    }
    missing = set(names[count]) - set(recorded)
    if not missing:
        return names[count]
    there = ", ".join(recorded) or "none: record it with --wire"
    fitting = next((each for each in names.values() if set(each) <= set(recorded)), None)
    if fitting is not None:
        often = f"give {len(fitting)} --listen, in this order" if len(fitting) > 1 else "give one --listen"
        raise ConfigError(f"listen: the recorded robot has the links {', '.join(fitting)}: {often}")
    raise ConfigError(f"as-robot: no raw frames of link {', '.join(sorted(missing))}; the recording has {there}")
