"""``zbridge simulate``: runs a simulated robot, on TCP or on a serial line, or an HQ program."""

from __future__ import annotations

import sys
import tomllib

import msgspec

from zbridge.app import until_signal
from zbridge.cli import give_up, run_loop
from zbridge.errors import ConfigError, LinkError
from zbridge.protocol.address import Address, SerialAddress, parse_device_address
from zbridge.protocol.plugin import HqSimulation, Protocol, Simulation
from zbridge.simulation.fragile import print_line
from zbridge.tasks import together
from zbridge.toml import prefixed

BAUD = 115_200
"""Of a serial line, where the template of the protocol names no serial address."""


class SimulateOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The options of the command, as they are typed."""

    listen: tuple[str, ...] = ()
    serial: bool = False
    hq: str = ""
    drive: str = ""
    seed: int = 1
    version: str | None = None
    dialect: str | None = None
    udp: bool = False
    fragile: bool = False
    camera: str = ""


def simulate(protocol: Protocol, options: SimulateOptions) -> None:
    """Simulate what the options ask for until SIGTERM or SIGINT; end the process if they exclude each other."""
    refusal = excluded(options) or (unfit_for_serial(protocol) if options.serial else None)
    if refusal is not None:
        give_up(2, refusal)
    if not options.hq:
        run_loop(until_signal(simulate_robot(protocol, simulation_of(protocol, options), options)))
    elif protocol.simulate_hq is None and not protocol.keyed:
        run_plugin_hq(protocol, options)
    else:
        with prefixed("--hq ", LinkError):
            address = protocol.port(options.hq)
        drive = read_drive(options.drive)
        simulate_hq(protocol, HqSimulation(address, options.version, options.dialect, options.udp, drive))


def excluded(options: SimulateOptions) -> str | None:
    """Return which options exclude each other; None if they do not."""
    if options.serial:
        for name, given in (("listen", options.listen), ("hq", options.hq), ("udp", options.udp)):
            if given:
                return f"--serial: not with --{name}"
    if options.listen and options.hq:
        return "give either --listen (a robot) or --hq (an HQ program)"
    if options.camera and options.hq:
        return "--camera: not with --hq"
    if options.drive and not options.hq:
        return "--drive: only with --hq"
    return None


def unfit_for_serial(protocol: Protocol) -> str | None:
    """Return why a robot of this protocol cannot be simulated on a serial line; None if it can."""
    if protocol.keyed:
        return f"--serial: robots of {protocol.name} are connected by Zenoh"
    if protocol.links > 1:
        return f"--serial: robots of {protocol.name} have up to {protocol.links} links, a serial line is one"
    return None


def simulation_of(protocol: Protocol, options: SimulateOptions) -> Simulation:
    """Make the start options of a simulated robot; raise LinkError, ConfigError for a faulty address."""
    listen = [] if options.serial else options.listen or default_addresses(protocol)
    with prefixed("--listen ", LinkError):
        addresses = tuple(map(protocol.port, listen))
    return Simulation(
        addresses,
        options.seed,
        options.version,
        options.dialect,
        options.udp,
        options.fragile,
        lambda bound: print_line(f"listening on {' '.join(map(str, bound))}"),
    )


def default_addresses(protocol: Protocol) -> list[str]:
    """Return where the protocol's template expects a robot; raise ConfigError if it names no address of that kind."""
    addresses = _template_addresses(protocol, "tcp://") or _template_addresses(protocol, "udp://")
    if not addresses:
        raise ConfigError(f"listen: missing, the template of {protocol.name} names no address tcp://host:port")
    return addresses


def default_baud(protocol: Protocol) -> int:
    """Return the baud rate of the serial address in the protocol's template, :data:`BAUD` without one."""
    for text in _template_addresses(protocol, "serial://"):
        address = parse_device_address(text)
        if isinstance(address, SerialAddress):
            return address.baud
    return BAUD


def _template_addresses(protocol: Protocol, scheme: str) -> list[str]:
    device = tomllib.loads(protocol.template).get("device", {})
    return [text for text in device.get("connect", []) if text.startswith(scheme)]


def read_drive(text: str) -> tuple[float, float] | None:
    """Read ``FORWARD`` or ``FORWARD,TURN``; None for an empty text. Raises ConfigError."""
    if not text:
        return None
    try:
        forward, turn = (*map(float, text.split(",")), 0.0)[:2]
        if text.count(",") < 2 and abs(forward) <= 1.0 and abs(turn) <= 1.0:
            return forward, turn
    except ValueError:
        pass
    raise ConfigError(f"drive = {text!r}: expected FORWARD or FORWARD,TURN, each -1 to 1")


async def simulate_robot(protocol: Protocol, simulation: Simulation, options: SimulateOptions) -> None:
    """Simulate a robot, and its camera if an address is given, until cancelled."""
    work = [_serve_robot(protocol, simulation, serial=options.serial)]
    if options.camera:
        work.append(_serve_camera(options.camera))
    await together(*work)


async def _serve_robot(protocol: Protocol, simulation: Simulation, *, serial: bool) -> None:
    if not serial:
        await protocol.simulate(simulation)
        return
    from zbridge.simulation.serial_line import simulate_on_serial_line

    baud = default_baud(protocol)
    await simulate_on_serial_line(
        protocol.simulate, simulation, baud, lambda address: print_line(f"listening on {address}")
    )


async def _serve_camera(text: str) -> None:
    from zbridge.simulation.camera import serve_camera

    with prefixed("--camera ", LinkError):
        address = Address.parse(f"tcp://{text}")
    await serve_camera(address, lambda url: print_line(f"camera at {url}"))


def simulate_hq(protocol: Protocol, simulation: HqSimulation) -> None:
    """Simulate an HQ program until SIGTERM or SIGINT, or until it dies or its connection ends."""
    if protocol.simulate_hq is None:
        give_up(2, f"there is no simulated HQ program of {protocol.name}")
    try:
        run_loop(until_signal(protocol.simulate_hq(simulation)))
    except OSError as error:
        give_up(1, f"{simulation.address}: {error.strerror or error}")


def run_plugin_hq(protocol: Protocol, options: SimulateOptions) -> None:
    """Connect the protocol's own robot side until SIGTERM or SIGINT; end the process with 1 if the session ends."""
    for name, given in (("version", options.version), ("dialect", options.dialect), ("udp", options.udp)):
        if given:
            give_up(2, f"--{name}: not with --hq, as there is no simulated HQ program of {protocol.name}")
    with prefixed("--hq ", LinkError):
        address = protocol.device_address(options.hq)
    drive = read_drive(options.drive)
    from zbridge.simulation.plugin_hq import PluginHq

    async def work() -> bool:
        await PluginHq(protocol, address, drive).run()
        return True

    if run_loop(until_signal(work())):
        sys.exit(1)
