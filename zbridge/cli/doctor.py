"""``zbridge doctor``: declares the command, and prints what the examination finds."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from zbridge.cli import give_up, run_command
from zbridge.cli.options import Connect, Realm, TlsFolder
from zbridge.client import bus_settings
from zbridge.fleet.topics import is_name
from zbridge.protocol.address import Address

app = typer.Typer()

Target = Annotated[
    str,
    typer.Argument(
        help="a robot's name, a gateway's file, or a directory of them, on the gateway's host; without it: all robots",
        show_default=False,
    ),
]
FromHere = Annotated[
    list[str], typer.Option(help="open a connection to a listener from here: tcp://host:port; once for each")
]
Disks = Annotated[list[Path], typer.Option("--disk", help="a directory that recordings are written to; once for each")]
FailOn = Annotated[
    Literal["warning", "error"], typer.Option(help="exit code 1 if there is such a finding, or a worse one")
]


@app.command()
def doctor(
    target: Target = "",
    probe: Annotated[
        bool,
        typer.Option("--probe", help="contact the robot of a FILE that no gateway serves; may use it up"),
    ] = False,
    from_here: FromHere = [],
    disks: Disks = [],
    fail_on: FailOn = "error",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="show what is well, too")] = False,
    json: Annotated[bool, typer.Option("--json", help="one JSON object a line")] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Examine the path to a robot layer by layer; the last line says which layer fails, and what to do.

    Exit code 0: nothing found that --fail-on names; 1: something; 2: wrong arguments.
    """
    from zbridge.cli.diagnosis import Printer
    from zbridge.doctor.examination import Examination, Options, examine_bus
    from zbridge.doctor.findings import Verdict, conclusion, exit_code
    from zbridge.doctor.gateway_file import examine_file
    from zbridge.host.settings import robot_files

    path = Path(target)
    files = robot_files(path) if target and path.is_dir() else [path] if path.suffix == ".toml" else []
    if target and path.is_dir() and not files:
        give_up(2, f"{target}: no robot files (*.toml)")
    if target and not files and not is_name(target):
        give_up(2, f"TARGET = {target!r}: expected a robot's name, a file *.toml or a directory")
    _check(path, files, probe=probe, disks=disks, connect=connect, listeners=from_here)
    printer = Printer(as_json=json, verbose=verbose or bool(target), several=not target or len(files) > 1)
    examination, options = Examination(printer.show), Options(probe, tuple(disks), tuple(from_here))

    async def work() -> int:
        for file in files:
            await examine_file(examination, file, tls, options)
        if not files:
            await examine_bus(examination, bus_settings(connect, tls), realm, target or None, options)
        if not json:
            printer.conclude(conclusion(examination.findings))
        return exit_code(examination.findings, Verdict[fail_on.upper()])

    run_command(work(), level=logging.CRITICAL)


def _check(
    path: Path, files: list[Path], *, probe: bool, disks: list[Path], connect: list[str], listeners: list[str]
) -> None:
    """Give up for options that do not fit the target."""
    if files == [path] and not path.exists():
        give_up(2, f"{path}: no such file")
    for option, given in (("--probe", probe), ("--disk", disks)):
        if given and not files:
            give_up(2, f"{option}: only with a FILE, on its own host")
    if connect and files:
        give_up(2, "--connect: not with a FILE, which names its own routers")
    for disk in disks:
        if not disk.is_dir():
            give_up(2, f"--disk {disk}: no such directory")
    for address in listeners:
        Address.parse(address)
