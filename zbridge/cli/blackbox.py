"""Declares ``zbridge blackbox ls, show, export, rm``; ``incidents`` carries them out."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from zbridge.cli import give_up, run_command
from zbridge.cli.options import Connect, Json, Realm, TlsFolder
from zbridge.client import bus_settings

app = typer.Typer(help="The minutes before an incident, which gateways with [blackbox] keep.")

Name = Annotated[str, typer.Argument(help="an incident, as ls prints it", show_default=False)]
Folder = Annotated[
    Path | None,
    typer.Option(
        "--dir", help="read the files of this host, in the folder of all black boxes, not over the bus", exists=True
    ),
]


@app.command("ls")
def list_all(
    folder: Folder = None,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Json = False,
) -> None:
    """List the incidents of the fleet, or of this host with --dir."""
    from zbridge.cli import incidents

    if folder is not None:
        incidents.list_here(folder, as_json=json)
        return
    run_command(incidents.list_fleet(bus_settings(connect, tls), realm, as_json=json))


@app.command()
def show(
    name: Name,
    folder: Folder = None,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Print why something was kept, and the state of that moment; with --dir also the last lines of the log.

    Over the bus it needs the role supervisor. Exit code 1: no such incident.
    """
    from zbridge.cli import incidents

    if folder is not None:
        incidents.show_here(folder, name, as_json=json)
        return
    run_command(incidents.show_fetched(bus_settings(connect, tls), realm, name, as_json=json))


@app.command()
def export(
    name: Name,
    output: Annotated[Path, typer.Option("-o", "--output", help="the recording to write (MCAP)", show_default=False)],
    only: Annotated[str, typer.Option(help="fleet: without Foxglove messages")] = "",
    folder: Folder = None,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Write an incident as a recording, for Foxglove and zbridge replay.

    Over the bus its gateway sends the files; this needs the role supervisor. Exit code 1: no such incident.
    """
    from zbridge.cli import incidents

    if only not in ("", "fleet"):
        give_up(2, f"only = {only!r}: expected 'fleet'")
    pictures = not only
    if folder is not None:
        incidents.export_here(folder, name, output, pictures=pictures)
        return
    work = incidents.export_fetched(bus_settings(connect, tls), realm, name, output, pictures=pictures)
    run_command(work, level=logging.WARNING)


@app.command()
def rm(
    names: Annotated[list[str], typer.Argument(help="incidents, as ls prints them", show_default=False)],
    folder: Annotated[
        Path, typer.Option("--dir", help="the folder of all black boxes of this host", exists=True, show_default=False)
    ],
) -> None:
    """Delete incidents of this host.

    Exit code 1: no such incident.
    """
    from zbridge.cli import incidents

    incidents.remove_here(folder, names)
