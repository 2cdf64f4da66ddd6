"""``zbridge new-protocol``: declares the command, and says what to do next with what it wrote.

The templates are the files of a package for a robot called newrobot; ``package`` makes them those of another one.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from zbridge.cli.new_protocol.package import check_folder, check_protocol_name, write_package

app = typer.Typer()

NEXT = """\
cd {folder}
pip install -e '.[test]'
python -m pytest
python -m zbridge.simulation.check {name}
zbridge simulate {name} &
zbridge init {name} --name r1 > r1.toml
zbridge run r1.toml &
zbridge drive r1
"""


@app.command(name="new-protocol")
def new_protocol(
    name: Annotated[
        str, typer.Argument(help="the protocol's name: lower-case letters, digits and '_'", show_default=False)
    ],
    style: Annotated[
        Literal["lines", "packets"],
        typer.Option(
            help="lines: the robot answers lines of text; packets: it sends binary packets with a checksum by itself"
        ),
    ] = "lines",
    folder: Annotated[
        Path | None, typer.Option("--dir", help="a new or empty directory; zbridge-NAME by default")
    ] = None,
) -> None:
    """Write a package that adds a protocol for a new robot: it works at once, and says in each file what to change.

    The robot is an invented one with two sides of wheels. The package has a simulated robot and tests, and passes the
    conformance kit.
    """
    folder = folder if folder is not None else Path(f"zbridge-{name}")
    check_protocol_name(name)
    check_folder(folder)
    files = write_package(name, style, folder)
    typer.echo(f"{folder}: {len(files)} files written; each says in its first lines what to change. Next:\n")
    typer.echo(NEXT.format(folder=shlex.quote(str(folder)), name=name), nl=False)
