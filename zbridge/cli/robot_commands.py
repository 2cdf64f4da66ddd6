"""Declares what is done with robots of the bus.

``zbridge ls, top, health, echo, drive, stop, unlatch, restart, foxglove, ros2``.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from zbridge.app import until_signal
from zbridge.cli import give_up, run_command, set_up_log
from zbridge.cli.options import Connect, Json, Realm, TlsFolder, check_name
from zbridge.client import bus_settings

app = typer.Typer()

Recorded = Annotated[
    Path | None, typer.Argument(help="a recording (MCAP) to play, instead of live robots", show_default=False)
]
ShownRobots = Annotated[list[str], typer.Option("--robot", help="show this robot only; once for each; all by default")]
Origins = Annotated[
    list[str], typer.Option("--origin", help="Origin of another web page that may connect; once for each")
]
FullSpeeds = Annotated[list[str], typer.Option(help="m/s at full scale, NUMBER or ROBOT=NUMBER; 1 by default")]
FullTurns = Annotated[list[str], typer.Option(help="rad/s at full scale, NUMBER or ROBOT=NUMBER; 1 by default")]
DriverName = Annotated[
    str, typer.Option(help="prefix of the drivers' names; by default the name in the certificate, else foxglove")
]


@app.command()
def foxglove(
    file: Recorded = None,
    listen: Annotated[str, typer.Option(help="host:port for Foxglove; port 0: any free one")] = "127.0.0.1:8765",
    robots: ShownRobots = [],
    drive: Annotated[bool, typer.Option("--drive", help="let viewers with the token or a listed Origin drive")] = False,
    token: Annotated[Path | None, typer.Option(help="file with the token that viewers must give (?token=)")] = None,
    origins: Origins = [],
    allow: Annotated[list[str], typer.Option(help="network that viewers may connect from; once for each")] = [],
    tls_certificate: Annotated[Path | None, typer.Option(help="certificate (PEM), for wss://")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="its key (PEM)")] = None,
    insecure: Annotated[bool, typer.Option("--insecure", help="serve other machines without TLS")] = False,
    speed_full_mps: FullSpeeds = [],
    turn_full_radps: FullTurns = [],
    who: DriverName = "",
    viewers: Annotated[int, typer.Option(help="maximum number of viewers", min=1, max=1000)] = 32,
    metrics: Annotated[str, typer.Option(help="host:port at which Prometheus reads the metrics")] = "",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log what is refused")] = False,
) -> None:
    """Serve robots live, or a recording, to Foxglove until SIGTERM or SIGINT."""
    from zbridge.cli.viewers import run_foxglove

    set_up_log(verbose=verbose)
    run_foxglove(bus_settings(connect, tls), realm, file, locals())


@app.command()
def ls(
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    sessions: Annotated[bool, typer.Option("--sessions", help="list the sessions with robots and HQ programs")] = False,
    json: Json = False,
) -> None:
    """List the robots on the bus, or the sessions of their gateways and listeners."""
    from zbridge.cli import bus

    show = bus.list_sessions if sessions else bus.list_robots
    run_command(show(bus_settings(connect, tls), realm, as_json=json))


@app.command()
def top(
    once: Annotated[bool, typer.Option("--once", help="print the table once, and end")] = False,
    json: Annotated[bool, typer.Option("--json", help="with --once: one JSON object a line")] = False,
    sort: Annotated[str, typer.Option(help="column to sort by: robot, state, cpu, ...")] = "robot",
    text: Annotated[str, typer.Option("--filter", help="show robots that contain each of these words")] = "",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Watch all robots: states, rates, drivers, refusals, processor, memory; stop them. Needs zbridge[top]."""
    from zbridge.cli.top import print_once, run_top

    settings = bus_settings(connect, tls)
    if once:
        run_command(print_once(settings, realm, sort, text, as_json=json))
    elif json:
        give_up(2, "--json: only with --once")
    else:
        run_top(settings, realm, sort, text)


@app.command()
def health(
    robot: Annotated[str, typer.Argument(help="the robot's name; without it: all robots", show_default=False)] = "",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Annotated[bool, typer.Option("--json", help="one JSON object")] = False,
) -> None:
    """Print how the robots are, for monitoring.

    Exit code 0: ok, 1: warning, 2: critical.
    """
    from zbridge.cli.bus import report_health

    if robot:
        check_name("ROBOT", robot)
    work = report_health(bus_settings(connect, tls), realm, robot or None, as_json=json)
    run_command(work, level=logging.CRITICAL)


@app.command()
def echo(
    key: Annotated[str, typer.Argument(help="key expression, for example fleet/r1/pose or 'fleet/**'")],
    connect: Connect = [],
    tls: TlsFolder = None,
    json: Annotated[bool, typer.Option("--json", help="one JSON object a line, arrays in full")] = False,
    count: Annotated[int, typer.Option(help="end after this many messages; 0: no limit", min=0)] = 0,
    seconds: Annotated[float, typer.Option(help="end after this time; 0: no limit", min=0.0, max=1e9)] = 0.0,
    hz: Annotated[bool, typer.Option("--hz", help="print how often messages come, once a second for each key")] = False,
    realm: Annotated[
        str, typer.Option(help="first chunk of all keys; that of KEY by default", show_default=False)
    ] = "",
) -> None:
    """Print the messages on a key, decoded, until SIGTERM or SIGINT, --count or --seconds.

    If nothing comes for two seconds, a hint on stderr says why. Exit code 1: the time passed with fewer messages than
    --count, or with none.
    """
    from zbridge.cli.echo import Echo, echo

    options = Echo(key=key, as_json=json, count=count, seconds=seconds, hz=hz)
    work = echo(bus_settings(connect, tls), options, realm=realm or None)
    run_command(until_signal(work))


@app.command()
def drive(
    robot: Annotated[str, typer.Argument(help="the robot's name", show_default=False)],
    speed: Annotated[float, typer.Option(help="fraction of full scale", min=0.1, max=1.0)] = 0.3,
    who: Annotated[
        str, typer.Option(help="shown to others as the driver; by default the name in the certificate, else user@host")
    ] = "",
    takeover: Annotated[bool, typer.Option("--takeover", help="take the robot from whoever drives it")] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Drive a robot by keyboard: it moves only while a key is held down; space stops it."""
    from zbridge.cli.drive import drive_robot

    check_name("ROBOT", robot)
    work = drive_robot(bus_settings(connect, tls), realm, robot, speed, who=who or None, takeover=takeover)
    run_command(until_signal(work))


@app.command()
def stop(
    robot: Annotated[str, typer.Argument(help="the robot's name", show_default=False)] = "",
    everything: Annotated[bool, typer.Option("--all", help="every robot of the realm")] = False,
    latch: Annotated[bool, typer.Option("--latch", help="let nobody drive before zbridge unlatch")] = False,
    reason: Annotated[str, typer.Option(help="shown to everyone who tries to drive")] = "",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Json = False,
) -> None:
    """Stop a robot, or all of them; open to everyone who can write the key.

    Exit code 1: not every gateway confirmed it.
    """
    from zbridge.cli.gateway_commands import stop

    _check_one_or_all(robot, everything=everything)
    settings, one = bus_settings(connect, tls), robot or None
    run_command(stop(settings, realm, one, latch=latch, reason=reason or None, as_json=json))


@app.command()
def unlatch(
    robot: Annotated[str, typer.Argument(help="the robot's name", show_default=False)] = "",
    everything: Annotated[bool, typer.Option("--all", help="the stops of the whole fleet")] = False,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Json = False,
) -> None:
    """Release the latched stops of a robot, or those of the whole fleet; robots move only when somebody drives.

    Exit code 1: not every gateway confirmed it.
    """
    from zbridge.cli.gateway_commands import unlatch

    _check_one_or_all(robot, everything=everything)
    run_command(unlatch(bus_settings(connect, tls), realm, robot or None, as_json=json))


@app.command()
def restart(
    robot: Annotated[str, typer.Argument(help="the robot's name", show_default=False)] = "",
    everything: Annotated[bool, typer.Option("--all", help="every robot of the realm")] = False,
    who: Annotated[
        str,
        typer.Option(help="name under which the router knows you; by default that in the certificate, else user@host"),
    ] = "",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
    json: Json = False,
) -> None:
    """Restart a robot's gateway, or all of them: robots and HQ programs stay connected; what moves is stopped.

    Exit code 1: refused, or no answer; the gateway continues.
    """
    from zbridge.cli.gateway_commands import restart as ask

    _check_one_or_all(robot, everything=everything)
    run_command(ask(bus_settings(connect, tls), realm, robot or None, who=who or None, as_json=json))


@app.command()
def ros2(
    file: Annotated[
        Path | None, typer.Argument(help="settings (TOML): speeds, sizes, option defaults", show_default=False)
    ] = None,
    domain: Annotated[int | None, typer.Option(help="ROS_DOMAIN_ID; 0 by default", show_default=False)] = None,
    robots: ShownRobots = [],
    drive: Annotated[bool, typer.Option("--drive", help="let cmd_vel publishers drive, and services switch")] = False,
    distro: Annotated[
        str, typer.Option(help="humble, iron, jazzy, kilted or lyrical; jazzy by default", show_default=False)
    ] = "",
    ros: Annotated[
        list[str], typer.Option(help="ROS's router; tcp/localhost:7447 by default", show_default=False)
    ] = [],
    metrics: Annotated[str, typer.Option(help="host:port at which Prometheus reads the metrics")] = "",
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Annotated[str, typer.Option(help="first chunk of all keys; fleet by default", show_default=False)] = "",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="log what is refused")] = False,
) -> None:
    """Show robots to ROS 2 over its middleware rmw_zenoh, until SIGTERM or SIGINT; needs zbridge[ros2]."""
    from zbridge.cli.viewers import run_ros2

    set_up_log(verbose=verbose)
    options: dict[str, object] = {
        "domain": domain,
        "robots": tuple(robots) or None,
        "drive": drive or None,
        "distro": distro or None,
        "ros": tuple(ros) or None,
        "metrics": metrics or None,
        "realm": realm or None,
    }
    given = {name: value for name, value in options.items() if value is not None}
    run_ros2(bus_settings(connect, tls) if connect or tls else None, bus_settings(), file, given)


def _check_one_or_all(robot: str, *, everything: bool) -> None:
    """Give up unless either one robot is named or all are meant."""
    if bool(robot) == everything:
        give_up(2, "name one ROBOT, or give --all")
    if robot:
        check_name("ROBOT", robot)
