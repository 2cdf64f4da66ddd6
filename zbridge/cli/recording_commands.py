"""Declares ``zbridge record, info, export, mark, replay``; ``recording`` carries them out."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from zbridge.cli import give_up, run_command
from zbridge.cli.options import Connect, Realm, TlsFolder, check_name, chosen
from zbridge.client import bus_settings

app = typer.Typer()

Recorded = Annotated[Path, typer.Argument(help="a recording (MCAP)", show_default=False)]
Since = Annotated[str, typer.Option("--from", help="begin here: 12.5, 1:30, or a time of day: 2026-11-22T05:00:00")]
Until = Annotated[str, typer.Option("--to", help="end here; written as --from")]
NewNames = Annotated[
    list[str],
    typer.Option(
        "--robot",
        help="the new name; of several robots RECORDED=NEW for each. By default all, as NAME-replay; "
        "with --as-robot: which robot of the recording",
    ),
]
HqListeners = Annotated[
    list[str],
    typer.Option(help="serve HQ programs: PROTOCOL:PORT, PROTOCOL:HOST:PORT or a file with [[hq]]"),
]
AsRobot = Annotated[
    str, typer.Option("--as-robot", help="act as the legacy robot, from its raw frames; the name of its protocol")
]
Listen = Annotated[list[str], typer.Option(help="where the legacy robot listens, tcp://host:port; once for each link")]
Configurations = Annotated[
    list[Path],
    typer.Option(help="a gateway's configuration, to be kept in the recording without its secrets"),
]


@app.command()
def record(
    robots: Annotated[list[str], typer.Argument(help="names of robots", show_default=False)] = [],
    output: Annotated[Path, typer.Option("-o", "--output", help="the file to write (MCAP)", show_default=False)] = ...,  # type: ignore[assignment]
    everything: Annotated[bool, typer.Option("--all", help="every robot of the realm")] = False,
    keys: Annotated[str, typer.Option(help="a key expression instead of robots")] = "",
    only: Annotated[str, typer.Option(help="record only fleet messages (fleet) or Foxglove messages (foxglove)")] = "",
    wire: Annotated[bool, typer.Option("--wire", help="raw legacy frames too")] = False,
    split: Annotated[str, typer.Option(help="begin another file after this size or time: 1GB, 10min")] = "",
    keep: Annotated[int, typer.Option(help="keep the last N files; with --split", min=0)] = 0,
    duration: Annotated[str, typer.Option(help="end after this time: 90s, 10min, 1h")] = "",
    compression: Annotated[str, typer.Option(help="zstd, lz4 or none")] = "zstd",
    config: Configurations = [],
    buffer: Annotated[str, typer.Option(help="size of the queue for a slow disk")] = "64MiB",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Record robots, or all of them, until SIGTERM or SIGINT: every key, commands and refusals too.

    Exit code 1: the recording failed, for example because the disk is full.
    """
    from zbridge.cli.recording import RecordOptions, run_record

    if sum(map(bool, (robots, everything, keys))) != 1:
        give_up(2, "name ROBOTs, or give --all or --keys")
    for robot in robots:
        check_name("ROBOT", robot)
    robots = list(dict.fromkeys(robots))
    options = chosen(RecordOptions, locals())
    run_command(run_record(bus_settings(connect, tls), options), level=logging.WARNING)


@app.command()
def info(
    file: Recorded,
    json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Print what a recording holds: robots, keys, counts, rates, gaps, and whether it was cut off."""
    from zbridge.cli.recording import show_info

    show_info(file, as_json=json)


@app.command()
def export(
    file: Recorded,
    csv: Annotated[bool, typer.Option("--csv", help="a table for each key")] = False,
    npz: Annotated[bool, typer.Option("--npz", help="scans and poses as numpy arrays")] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder of the tables, or file of the arrays")
    ] = None,
    keys: Annotated[str, typer.Option(help="only keys that this expression matches")] = "",
    since: Since = "",
    until: Until = "",
) -> None:
    """Write a recording as tables or as numpy arrays."""
    from zbridge.cli.recording import run_export

    if csv == npz:
        give_up(2, "give either --csv or --npz")
    run_export(file, output, keys, since, until, arrays=npz)


@app.command()
def mark(
    text: Annotated[str, typer.Argument(help="what happened", show_default=False)],
    who: Annotated[
        str, typer.Option(help="author of the mark; by default the name in the certificate, else user@host")
    ] = "",
    keep: Annotated[
        bool, typer.Option("--keep", help="let all black boxes keep the minutes before now, and the one after it")
    ] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Write an event into all running recordings of the realm.

    Exit code 1: with --keep, no gateway has a black box.
    """
    from zbridge.cli.recording import put_mark

    run_command(put_mark(bus_settings(connect, tls), realm, text, who or None, keep=keep))


@app.command()
def replay(
    file: Recorded,
    robots: NewNames = [],
    speed: Annotated[float, typer.Option(help="seconds of the recording per second", min=0.01, max=1000.0)] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="start over at the end")] = False,
    since: Since = "",
    until: Until = "",
    pause: Annotated[bool, typer.Option("--pause", help="start paused; Enter resumes, and pauses again")] = False,
    hq: HqListeners = [],
    as_robot: AsRobot = "",
    listen: Listen = [],
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Replay a recording onto the bus under another name, or to a gateway as the legacy robot itself."""
    from zbridge.cli.recording import ReplayOptions, run_replay, run_wire

    if bool(as_robot) != bool(listen):
        give_up(2, "--as-robot and --listen belong together")
    if as_robot:
        if hq or loop or pause or since or until:
            give_up(2, "--as-robot replays the whole recording once: not with --hq, --loop, --pause, --from, --to")
        run_command(run_wire(file, as_robot, listen, robots, speed, realm), level=logging.WARNING)
        return
    options = chosen(ReplayOptions, locals())
    run_command(run_replay(bus_settings(connect, tls), options), level=logging.WARNING)
