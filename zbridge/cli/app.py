"""Connect robots that speak legacy protocols to a Zenoh bus, list them, drive them and stop them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from zbridge.app import addressed, listener_template, robot_template, secured
from zbridge.bus.tls.files import folder_tls
from zbridge.cli import (
    blackbox,
    certs,
    console,
    doctor,
    give_up,
    hand_on_tls,
    new_protocol,
    recording_commands,
    robot_commands,
    run_command,
    run_gateway,
    run_together,
    set_up_log,
)
from zbridge.cli.options import Connect, FileTls, Json, Realm, TlsFolder, check_name
from zbridge.client import bus_settings
from zbridge.errors import LinkError
from zbridge.host.settings import HostFile, load_host, robot_files
from zbridge.protocol.plugin import find_protocol, protocol_names
from zbridge.toml import prefixed
from zbridge.version import __version__

app = typer.Typer(
    help=__doc__,
    epilog="Exit codes: 0 done, 1 failed, 2 wrong arguments or configuration, 130 interrupted; commands say their own.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(certs.app, name="certs")
app.add_typer(console.app, name="console")
app.add_typer(blackbox.app, name="blackbox")
app.add_typer(robot_commands.app)
app.add_typer(doctor.app)
app.add_typer(recording_commands.app)
app.add_typer(new_protocol.app)

Files = Annotated[
    list[Path], typer.Argument(help="a gateway's configuration (TOML), several, or a directory", show_default=False)
]
ProtocolName = Annotated[
    str,
    typer.Argument(
        help="one of: " + ", ".join(protocol_names()),
        show_default=False,
        autocompletion=protocol_names,
    ),
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="log every frame")]
SimulatedAt = Annotated[
    list[str],
    typer.Option(
        help="address to listen at, tcp://host:port; port 0: any free one; once for each link. "
        "By default where `zbridge init` expects a robot"
    ),
]
OnSerial = Annotated[
    bool,
    typer.Option("--serial", help="put the robot on a serial line, a pair of pseudo terminals, and print its address"),
]
ServedBy = Annotated[
    str,
    typer.Option(
        help="simulate an HQ program instead, as fragile as a legacy one, and connect it to this address. A protocol "
        "that has none: connect its robot side to the robot at this address, tcp://host:port or "
        "serial:///path?baud=N, and print what it sends. This bypasses the gateway: only for a robot that no gateway "
        "serves"
    ),
]
Drives = Annotated[
    str, typer.Option(help="with --hq: drive FORWARD or FORWARD,TURN, fractions of full scale: 0.3 or 0.3,-0.2")
]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"zbridge {__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", help="print the version and exit", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    """Take the options that stand before the command."""


@app.command()
def run(
    files: Files,
    together: Annotated[
        bool, typer.Option("--together", help="several robots in one process, as host.toml of a directory may say")
    ] = False,
    watch: Annotated[bool, typer.Option("--watch", help="apply added, changed and removed files")] = False,
    tls: FileTls = None,
    verbose: Verbose = False,
    take_over: Annotated[int, typer.Option("--take-over", help="descriptor from the predecessor", hidden=True)] = -1,
) -> None:
    """Run a gateway in the foreground until SIGTERM or SIGINT; for a directory or several files, one process per file.

    SIGUSR2 restarts a gateway without dropping its connections. For a directory, several files or --watch, a supervisor
    restarts gateways that die or hang, and stops their robots; at SIGHUP it reads the files and the installed code
    again. One FILE without --watch is not monitored.
    """
    found = load_host(files[0]) if len(files) == 1 and files[0].is_dir() else HostFile()
    if together or found.host.together:
        if watch:
            give_up(2, "--watch: not with --together, which does not follow files")
        hand_on_tls(tls)
        run_together(_robot_files(files), found, verbose=verbose)
    elif len(files) == 1 and not files[0].is_dir() and not watch:
        run_gateway(files[0], verbose=verbose, tls=tls, take_over=take_over if take_over >= 0 else None)
    else:
        from zbridge.cli.supervise import supervise

        hand_on_tls(tls)
        supervise(tuple(files), watch=watch, verbose=verbose)


def _robot_files(paths: list[Path]) -> list[Path]:
    files = [file for path in paths for file in (robot_files(path) if path.is_dir() else [path])]
    if not files:
        give_up(2, f"{paths[0]}: no robot files (*.toml)")
    return files


@app.command()
def check(
    file: Annotated[
        Path,
        typer.Argument(help="a gateway's configuration (TOML), or a directory: all its files", show_default=False),
    ],
    tls: FileTls = None,
    json: Json = False,
) -> None:
    """Check a configuration, or all of a directory, and print what they would run; also its certificate.

    An error names the faulty key, or the gateway of this machine that has the robot's address.

    Exit code 2: one is faulty.
    """
    from zbridge.cli.check import check as check_files

    if not check_files(file, tls, as_json=json):
        raise typer.Exit(2)


@app.command()
def init(
    protocol: ProtocolName,
    name: Annotated[str, typer.Option(help="the robot's name on the bus")] = "r1",
    hq: Annotated[bool, typer.Option("--hq", help="for a process that only serves HQ programs")] = False,
    connect: Annotated[
        list[str],
        typer.Option(metavar="ADDRESS", help="the robot's address, tcp://host:port; once for each link"),
    ] = [],
    secure: Annotated[bool, typer.Option("--secure", help="for a secure bus: with the files of a certificate")] = False,
) -> None:
    """Print a commented configuration to start from."""
    check_name("--name", name)
    found = find_protocol(protocol)
    if hq and found.hq is None:
        give_up(2, f"{protocol} serves no HQ programs")
    if hq and connect:
        give_up(2, "--connect: not with --hq: a listener finds its robot on the bus, by --name")
    if len(connect) > found.links:
        give_up(2, f"--connect: a {protocol} robot has at most {found.links} link{'s' if found.links > 1 else ''}")
    with prefixed("--connect ", LinkError):
        for address in connect:
            found.device_address(address)
    template = listener_template(found) if hq else robot_template(found)
    template = secured(template) if secure else template
    template = addressed(template, connect) if connect else template
    typer.echo(template.replace("{name}", name), nl=False)


@app.command()
def simulate(
    protocol: ProtocolName,
    listen: SimulatedAt = [],
    serial: OnSerial = False,
    hq: ServedBy = "",
    drive: Drives = "",
    seed: Annotated[int, typer.Option(help="seed of the simulated world")] = 1,
    version: Annotated[str, typer.Option(help="version of the protocol; the newest common one by default")] = "",
    dialect: Annotated[str, typer.Option(help="dialect of the protocol, where it has several")] = "",
    udp: Annotated[bool, typer.Option("--udp", help="offer datagrams")] = False,
    fragile: Annotated[bool, typer.Option("--fragile", help="be as fragile as a legacy robot")] = False,
    camera: Annotated[str, typer.Option(help="stream pictures too: HOST:PORT, for example 127.0.0.1:8000")] = "",
    verbose: Verbose = False,
) -> None:
    """Simulate a robot, or an HQ program, until SIGTERM or SIGINT."""
    from zbridge.cli.simulate import SimulateOptions
    from zbridge.cli.simulate import simulate as begin

    set_up_log(verbose=verbose)
    options = SimulateOptions(
        listen=tuple(listen),
        serial=serial,
        hq=hq,
        drive=drive,
        seed=seed,
        version=version or None,
        dialect=dialect or None,
        udp=udp,
        fragile=fragile,
        camera=camera,
    )
    begin(find_protocol(protocol), options)


@app.command()
def probe(
    protocol: ProtocolName,
    address: Annotated[str, typer.Argument(help="tcp://host:port or serial:///path?baud=N", show_default=False)],
    yes: Annotated[
        bool, typer.Option("--yes", help="connect to the device although that may use up its only connection")
    ] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Json = False,
) -> None:
    """Print what a device is: as its gateway reports on the bus, or, with --yes, after a handshake with it.

    Exit code 1: no handshake; 2: not contacted without --yes.
    """
    from zbridge.cli.probe import probe as ask

    found = find_protocol(protocol)
    with prefixed("ADDRESS ", LinkError):
        at = found.device_address(address)
    run_command(ask(bus_settings(connect, tls), found, at, realm=realm, sure=yes, as_json=json))


@app.command()
def demo(
    seconds: Annotated[
        float, typer.Option(help="end after this many seconds; 0: run until interrupted", min=0.0)
    ] = 0.0,
    secure: Annotated[
        bool,
        typer.Option("--secure", help="use mutual TLS with generated certificates; needs zbridge[certs]"),
    ] = False,
    console: Annotated[
        bool, typer.Option("--console", help="open the console in a browser; needs zbridge[console]")
    ] = False,
) -> None:
    """Show a simulated robot of each protocol, their gateways, a router and a live table; loopback only.

    With the extra zbridge[console] it serves the console too, and prints its address.

    Exit code 1: with --seconds, a robot sent no data.
    """
    from zbridge.cli.demo import run_demo

    run_command(run_demo(seconds, secure=secure, console=console), level=logging.WARNING)


@app.command()
def router(
    file: Annotated[Path | None, typer.Argument(help="a router's configuration (TOML)", show_default=False)] = None,
    listen: Annotated[list[str], typer.Option(help="where to listen: tls/0.0.0.0:7447")] = [],
    connect: Annotated[list[str], typer.Option(help="another router")] = [],
    tls: Annotated[
        Path | None,
        typer.Option(
            help="folder with ca.pem, certificate.pem and key.pem, as `zbridge certs bundle` makes it",
        ),
    ] = None,
    roles: Annotated[Path | None, typer.Option(help="roles.toml: who may use the bus")] = None,
    realm: Annotated[str, typer.Option(help="first chunk of all keys; fleet by default")] = "",
    insecure: Annotated[bool, typer.Option("--insecure", help="serve other machines without tls")] = False,
    print_config: Annotated[
        bool, typer.Option("--print-config", help="print the configuration for Zenoh's own router (JSON5)")
    ] = False,
    print_nftables: Annotated[
        bool, typer.Option("--print-nftables", help="print nftables rules that limit new connections per address")
    ] = False,
) -> None:
    """Run a Zenoh router in the foreground until SIGTERM or SIGINT; with tls, roles limit what members may do."""
    from zbridge.cli.router import run_router

    set_up_log()
    given: dict[str, object] = {
        "listen": listen,
        "connect": connect,
        "tls": folder_tls(tls) if tls is not None else None,
        "roles": str(roles) if roles is not None else None,
        "realm": realm,
        "insecure": insecure,
    }
    run_router(file, given, print_config=print_config, print_nftables=print_nftables)
