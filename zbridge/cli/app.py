"""Connect robots that speak legacy protocols to a Zenoh bus, list them, drive them and stop them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from zbridge.app import listener_template, load, robot_template, until_signal
from zbridge.app.member import check_member, not_checked
from zbridge.bus.tls.files import TLS_VARIABLE, ends_soon, out_of_date, utc_now
from zbridge.cli import certs, give_up, run_gateway, run_loop, set_up_log
from zbridge.client import bus_settings
from zbridge.errors import ConfigError
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import is_name
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import HqSimulation, Protocol, Simulation, find_protocol, protocol_names

app = typer.Typer(
    help=__doc__,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.add_typer(certs.app, name="certs")

File = Annotated[Path, typer.Argument(help="a gateway's configuration (TOML)", show_default=False)]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="log every frame")]
Realm = Annotated[str, typer.Option(help="first chunk of all keys")]
Connect = Annotated[
    list[str],
    typer.Option(
        help="Zenoh endpoint, for example tcp/192.168.0.2:7447; without it: multicast and the router on this machine",
        envvar="ZBRIDGE_CONNECT",
        show_default=False,
    ),
]
TlsFolder = Annotated[
    Path | None,
    typer.Option(
        "--tls",
        help="for a secure bus: a folder as `zbridge certs bundle` makes it; its endpoints are used without --connect",
        envvar=TLS_VARIABLE,
        show_default=False,
    ),
]
FileTls = Annotated[
    Path | None,
    typer.Option(
        "--tls",
        help=f"for a FILE without bus.tls: a folder as `zbridge certs bundle` makes it; or {TLS_VARIABLE}",
        show_default=False,
    ),
]


@app.command()
def run(file: File, tls: FileTls = None, verbose: Verbose = False) -> None:
    """Run a gateway in the foreground until SIGTERM or SIGINT."""
    run_gateway(file, verbose=verbose, tls=tls)


@app.command()
def check(file: File, tls: FileTls = None) -> None:
    """Check a configuration and print what it would run."""
    plan = load(file, tls=tls)
    robot, parts = plan.config.robot, []
    try:
        certificate = check_member(plan)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error
    if plan.device is not None:
        parts.append(f"{plan.device.protocol.name} at {', '.join(map(str, plan.device.addresses))}")
    parts += [f"{listener.protocol.name} HQ programs at {listener.address}" for listener in plan.listeners]
    parts.append(f"bus as {plan.config.bus.effective_mode}")
    if certificate is not None:
        if problem := out_of_date(certificate, utc_now()):
            raise ConfigError(f"{file}: {problem}")
        parts.append(f"certificate of {certificate.common_name} until {certificate.ends:%Y-%m-%d}")
    typer.echo(shown(f"{file}: ok: {robot.realm}/{robot.name}, {', '.join(parts)}"))
    if certificate is not None:
        if warning := ends_soon(certificate, utc_now()):
            typer.echo(shown(f"{file}: warning: {warning}"), err=True)
        typer.echo(shown(f"{file}: {not_checked(plan, certificate)}"))


@app.command()
def init(
    protocol: Annotated[str, typer.Argument(help="one of: " + ", ".join(protocol_names()), show_default=False)],
    name: Annotated[str, typer.Option(help="the robot's name on the bus")] = "r1",
    hq: Annotated[bool, typer.Option("--hq", help="for a process that only serves HQ programs")] = False,
) -> None:
    """Print a commented configuration to start from."""
    found = find_protocol(protocol)
    if hq and found.hq is None:
        give_up(2, f"{protocol} serves no HQ programs")
    template = listener_template(found) if hq else robot_template(found)
    typer.echo(template.replace("{name}", name), nl=False)


@app.command()
def simulate(
    protocol: Annotated[str, typer.Argument(help="one of: " + ", ".join(protocol_names()), show_default=False)],
    listen: Annotated[
        list[str],
        typer.Option(help="address to listen at, tcp://host:port; port 0: any free one; once for each link"),
    ] = [],
    hq: Annotated[
        str, typer.Option(help="be an HQ program instead, as fragile as deployed ones, and connect to this address")
    ] = "",
    seed: Annotated[int, typer.Option(help="the same seed makes the same world")] = 1,
    version: Annotated[str, typer.Option(help="version of the protocol; the newest common one by default")] = "",
    dialect: Annotated[str, typer.Option(help="dialect of the protocol, where it has several")] = "",
    udp: Annotated[bool, typer.Option("--udp", help="offer datagrams")] = False,
    fragile: Annotated[bool, typer.Option("--fragile", help="be as fragile as deployed robots")] = False,
    verbose: Verbose = False,
) -> None:
    """Simulate a robot, or an HQ program, until SIGTERM or SIGINT."""
    set_up_log(verbose=verbose)
    simulated = find_protocol(protocol)
    if bool(listen) == bool(hq):
        give_up(2, "give either --listen, to be a robot, or --hq, to be an HQ program")
    if hq:
        simulate_hq(simulated, HqSimulation(Address.parse(hq), version or None, dialect or None, udp))
        return
    simulation = Simulation(
        tuple(map(Address.parse, listen)),
        seed,
        version or None,
        dialect or None,
        udp,
        fragile,
        lambda addresses: print(f"listening on {' '.join(map(str, addresses))}", flush=True),  # noqa: T201
    )
    run_loop(until_signal(simulated.simulate(simulation)))


def simulate_hq(simulated: Protocol, simulation: HqSimulation) -> None:
    """Simulate an HQ program until SIGTERM or SIGINT, or until it dies or its connection ends."""
    if simulated.simulate_hq is None:
        give_up(2, f"there is no simulated HQ program of {simulated.name}")
    try:
        run_loop(until_signal(simulated.simulate_hq(simulation)))
    except OSError as error:
        give_up(1, f"{simulation.address}: {error.strerror or error}")


@app.command()
def probe(
    protocol: Annotated[str, typer.Argument(help="one of: " + ", ".join(protocol_names()), show_default=False)],
    address: Annotated[str, typer.Argument(help="tcp://host:port or serial:///path?baud=N", show_default=False)],
    yes: Annotated[
        bool, typer.Option("--yes", help="connect to the device although that may use up its only connection")
    ] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Print what a device is: from its gateway on the bus, else, with --yes, by a handshake with it."""
    from zbridge.cli.probe import probe as ask

    set_up_log(verbose=False, level=logging.ERROR)
    found = find_protocol(protocol)
    at = found.device_address(address)
    code = run_loop(ask(bus_settings(connect, tls), found, at, realm=realm, sure=yes))
    if code:
        raise typer.Exit(code)


@app.command()
def demo(
    seconds: Annotated[float, typer.Option(help="end after this many seconds; 0: run until interrupted")] = 0.0,
    secure: Annotated[
        bool, typer.Option("--secure", help="on mutual TLS, with roles made on the fly; needs zbridge[certs]")
    ] = False,
) -> None:
    """Show a simulated robot of each protocol, their gateways, a router and a live table; loopback only."""
    from zbridge.cli.demo import run_demo

    set_up_log(verbose=False, level=logging.WARNING)
    run_loop(run_demo(seconds, secure=secure))


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
    """Run a Zenoh router in the foreground until SIGTERM or SIGINT: with tls, each member may do what its role may."""
    from zbridge.cli.router import folder_tls, run_router

    set_up_log(verbose=False)
    given: dict[str, object] = {
        "listen": listen,
        "connect": connect,
        "tls": folder_tls(tls) if tls is not None else None,
        "roles": str(roles) if roles is not None else None,
        "realm": realm,
        "insecure": insecure,
    }
    run_router(file, given, print_config=print_config, print_nftables=print_nftables)


@app.command()
def ros2(
    file: Annotated[
        Path | None, typer.Argument(help="settings (TOML): speeds, sizes, what the options say", show_default=False)
    ] = None,
    domain: Annotated[int | None, typer.Option(help="ROS_DOMAIN_ID; 0 by default", show_default=False)] = None,
    robot: Annotated[list[str], typer.Option(help="show this robot only; once for each; all by default")] = [],
    drive: Annotated[bool, typer.Option("--drive", help="let publishers on cmd_vel drive, and calls switch")] = False,
    distro: Annotated[
        str, typer.Option(help="humble, iron, jazzy, kilted or lyrical; jazzy by default", show_default=False)
    ] = "",
    ros: Annotated[
        list[str], typer.Option(help="ROS's router; tcp/localhost:7447 by default", show_default=False)
    ] = [],
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Annotated[str, typer.Option(help="first chunk of all keys; fleet by default", show_default=False)] = "",
    verbose: Verbose = False,
) -> None:
    """Show robots to ROS 2 over its middleware rmw_zenoh, until SIGTERM or SIGINT; needs zbridge[ros2]."""
    from zbridge.cli.ros2 import run_ros2

    set_up_log(verbose=verbose)
    given: dict[str, object] = {
        "domain": domain,
        "robots": robot,
        "drive": drive,
        "distro": distro or None,
        "ros": ros,
        "realm": realm or None,
    }
    run_ros2(bus_settings(connect, tls) if connect or tls else None, bus_settings(), file, given)


@app.command()
def ls(
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    sessions: Annotated[bool, typer.Option("--sessions", help="list the sessions with robots and HQ programs")] = False,
    json: Annotated[bool, typer.Option("--json", help="one JSON object a line")] = False,
) -> None:
    """List the robots on the bus, or the sessions of their gateways and listeners."""
    from zbridge.cli import bus

    set_up_log(verbose=False, level=logging.ERROR)
    show = bus.list_sessions if sessions else bus.list_robots
    run_loop(show(bus_settings(connect, tls), realm, as_json=json))


@app.command()
def echo(
    key: Annotated[str, typer.Argument(help="key expression, for example fleet/r1/pose or 'fleet/**'")],
    connect: Connect = [],
    tls: TlsFolder = None,
    json: Annotated[bool, typer.Option("--json", help="one JSON object a line, arrays in full")] = False,
    count: Annotated[int, typer.Option(help="end after this many messages; 0: run until interrupted")] = 0,
) -> None:
    """Print the messages on a key, decoded."""
    from zbridge.cli import bus

    set_up_log(verbose=False, level=logging.ERROR)
    run_loop(until_signal(bus.echo(bus_settings(connect, tls), key, as_json=json, count=count)))


@app.command()
def drive(
    robot: Annotated[str, typer.Argument(help="the robot's name", show_default=False)],
    speed: Annotated[float, typer.Option(help="fraction of full scale", min=0.1, max=1.0)] = 0.3,
    who: Annotated[str, typer.Option(help="shown to others as the driver; user@host by default")] = "",
    takeover: Annotated[bool, typer.Option("--takeover", help="take the robot from whoever drives it")] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Drive a robot by keyboard: it moves only while a key is held down; space stops it."""
    from zbridge.cli.drive import drive_robot

    set_up_log(verbose=False, level=logging.ERROR)
    check_name("ROBOT", robot)
    work = drive_robot(bus_settings(connect, tls), realm, robot, speed, who=who or None, takeover=takeover)
    run_loop(until_signal(work))


@app.command()
def stop(
    robot: Annotated[str, typer.Argument(help="the robot's name", show_default=False)] = "",
    everything: Annotated[bool, typer.Option("--all", help="every robot of the realm")] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Stop a robot, or all of them; open to everyone who can write the key."""
    from zbridge.cli import bus

    set_up_log(verbose=False, level=logging.ERROR)
    if bool(robot) == everything:
        give_up(2, "name one ROBOT, or give --all")
    if robot:
        check_name("ROBOT", robot)
    if not run_loop(bus.stop(bus_settings(connect, tls), realm, robot or None)):
        raise typer.Exit(1)


def check_name(argument: str, name: str) -> None:
    """End the process with exit code 2 if ``name`` cannot be a robot's name."""
    if not is_name(name):
        give_up(2, f"{argument} = {name!r}: expected letters, digits, '_', '.' and '-' only")
