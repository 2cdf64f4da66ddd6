"""``zbridge foxglove, console, ros2``: serve robots, or a recording, to viewers."""

from __future__ import annotations

import contextlib
import gc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from zbridge.app import until_signal
from zbridge.app.process_usage import process_metrics
from zbridge.bus import BusSettings
from zbridge.bus.tls.files import own_name, own_role
from zbridge.cli import run_loop
from zbridge.cli.options import chosen
from zbridge.client import joined
from zbridge.client.fleet import Fleet
from zbridge.control.latch_store import state_folder
from zbridge.errors import ConfigError, LinkError
from zbridge.protocol.address import Address
from zbridge.toml import convert, read_toml
from zbridge.views.console.roster import Roster

if TYPE_CHECKING:
    from zbridge.views.foxglove.server import ViewerServer
    from zbridge.views.ros2.server import View


def run_foxglove(bus: BusSettings, realm: str, file: Path | None, given: dict[str, Any]) -> None:
    """Serve until SIGTERM or SIGINT; raise ConfigError. given: those of FoxgloveOptions, and others."""
    try:
        from zbridge.views.foxglove import server
        from zbridge.views.foxglove.settings import FoxgloveOptions, plan
    except ImportError as error:
        raise ConfigError(f"{error}: install the extra: pip install 'zbridge[foxglove]'") from error
    gc.freeze()  # objects made at start-up live as long as the process; the collector skips them
    given["who"] = given["who"] or own_name(bus.tls) or "foxglove"
    options = chosen(FoxgloveOptions, given)
    if options.drive and (role := own_role(bus.tls)) in ("viewer", "recorder"):
        raise ConfigError(f"--drive: a {role} may not drive: expected the certificate of an operator")
    planned, metrics = plan(options), process_metrics()

    def ready(viewers: ViewerServer) -> None:
        scheme = "wss" if planned.tls is not None else "ws"
        print(f"Foxglove connects to {scheme}://{str(viewers.address).removeprefix('tcp://')}", flush=True)  # noqa: T201

    if file is None:
        run_loop(until_signal(server.serve_live(planned, bus, realm, metrics, ready)))
    else:
        run_loop(until_signal(server.serve_file(planned, file, metrics, ready)))


def run_console(bus: BusSettings, realm: str, given: dict[str, Any]) -> None:
    """Serve pages until SIGTERM or SIGINT; raise ZbridgeError. given: the options of the command, by their names."""
    try:
        from zbridge.views.console import server
        from zbridge.views.console.http_server import listener
    except ImportError as error:
        raise ConfigError(f"{error}: install the extra: pip install 'zbridge[console]'") from error
    try:
        at = Address.parse(f"tcp://{given['listen']}")
    except LinkError as error:
        raise ConfigError(f"--listen {given['listen']!r}: expected host:port") from error
    settings = server.ConsoleSettings(
        listen=at,
        hosts=tuple(given["host"]),
        certificate=given["tls_certificate"],
        key=given["tls_key"],
        users=given["users"],
        journal=given["journal"] or (state_folder() / f"{realm}.console.jsonl" if given["users"] is not None else None),
        proxied=given["proxied"],
        own_role=own_role(bus.tls),
    )
    known = Roster(given["roster"] or state_folder() / f"{realm}.roster")
    known.load()
    gc.freeze()  # objects made at start-up live as long as the process; the collector skips them

    def ready(address: str) -> None:
        print(f"console at {address}", flush=True)  # noqa: T201

    async def work() -> None:
        with contextlib.closing(listener(at)) as listening:
            async with joined(bus, realm) as session:
                fleet = Fleet(session, realm, own_name(bus.tls))
                await server.serve(fleet, session, settings, listening, known, ready)

    run_loop(until_signal(work()))


def run_ros2(bus: BusSettings | None, default: BusSettings, file: Path | None, given: dict[str, object]) -> None:
    """Show robots until SIGTERM or SIGINT; raise ConfigError or BusError.

    bus: as given by options, else the file's, else ``default``. given: fields of Ros2Settings that win over the file's.
    """
    from zbridge.views.ros2 import server
    from zbridge.views.ros2.settings import Ros2Settings, plan

    try:
        written = convert(read_toml(file), Ros2Settings) if file is not None else Ros2Settings()
        planned = plan(msgspec.structs.replace(written, **given))
    except ConfigError as error:
        named = file is not None and str(file) not in str(error)
        raise ConfigError(f"{file}: {error}" if named else str(error)) from error

    def ready(view: View) -> None:
        gc.freeze()  # the types of ROS live as long as the process: the collector would take 18 ms to look at them
        where = ", ".join(planned.router.connect)
        print(f"ROS 2 {planned.distro}, domain {planned.domain}, at {where}", flush=True)  # noqa: T201

    run_loop(until_signal(server.serve(planned, bus or written.bus or default, process_metrics(), ready)))
