"""``zbridge ros2``: shows robots to ROS 2, and lets it drive them."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import TYPE_CHECKING

from zbridge.app import until_signal
from zbridge.bus import BusSettings
from zbridge.cli import run_loop
from zbridge.errors import ConfigError
from zbridge.metrics import Metrics
from zbridge.toml import convert, read_toml

if TYPE_CHECKING:
    from zbridge.views.ros2.server import View


def run_ros2(bus: BusSettings | None, default: BusSettings, file: Path | None, given: dict[str, object]) -> None:
    """Show robots until SIGTERM or SIGINT; raise ConfigError or BusError.

    bus: as given by options, else the file's, else ``default``. given: fields of Options, as they were given.
    """
    from zbridge.views.ros2 import server
    from zbridge.views.ros2.settings import File, Options, plan

    try:
        written = convert(read_toml(file), File) if file is not None else File()
        planned = plan(Options(**given), written)  # type: ignore[arg-type]
    except ConfigError as error:
        named = file is not None and str(file) not in str(error)
        raise ConfigError(f"{file}: {error}" if named else str(error)) from error

    def ready(view: View) -> None:
        gc.freeze()  # the types of ROS live as long as the process: the collector would take 18 ms to look at them
        where = ", ".join(planned.ros.connect)
        print(f"ROS 2 {planned.distro}, domain {planned.domain}, at {where}", flush=True)  # noqa: T201

    run_loop(until_signal(server.serve(planned, bus or written.bus or default, Metrics(), ready)))
