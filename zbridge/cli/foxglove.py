"""``zbridge foxglove``: serves robots, or a recording, to Foxglove."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import TYPE_CHECKING

from zbridge.app import until_signal
from zbridge.bus import BusSettings
from zbridge.bus.tls.member import own_name, own_role
from zbridge.cli import run_loop
from zbridge.errors import ConfigError
from zbridge.metrics import Metrics

if TYPE_CHECKING:
    from zbridge.views.foxglove.front import Front
    from zbridge.views.foxglove.settings import Options


def run_foxglove(bus: BusSettings, realm: str, file: Path | None, given: dict[str, object]) -> None:
    """Serve until SIGTERM or SIGINT; raise ConfigError. given: fields of Options, as they were given."""
    try:
        from zbridge.views.foxglove import server
        from zbridge.views.foxglove.settings import Options, plan
    except ImportError as error:
        raise ConfigError(f"{error}: expected what `pip install 'zbridge[foxglove]'` installs") from error
    gc.freeze()  # objects made at start-up live as long as the process; the collector skips them
    given["who"] = given["who"] or own_name(bus.tls) or "foxglove"
    options: Options = Options(**given)  # type: ignore[arg-type]
    if options.drive and (role := own_role(bus.tls)) in ("viewer", "recorder"):
        raise ConfigError(f"--drive: a {role} may not drive: expected the certificate of an operator")
    planned, metrics = plan(options), Metrics()

    def ready(front: Front) -> None:
        scheme = "wss" if planned.tls is not None else "ws"
        print(f"Foxglove connects to {scheme}://{str(front.address).removeprefix('tcp://')}", flush=True)  # noqa: T201

    if file is None:
        run_loop(until_signal(server.serve_live(planned, bus, realm, metrics, ready)))
    else:
        run_loop(until_signal(server.serve_file(planned, file, metrics, ready)))
