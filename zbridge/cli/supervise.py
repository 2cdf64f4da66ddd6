"""``zbridge run DIR``, or several files: starts the supervisor."""

from __future__ import annotations

import asyncio
import gc
from pathlib import Path

from zbridge.app import until_signal
from zbridge.app.host import HostSettings, load_host
from zbridge.app.supervisor.forks import fork_server_command
from zbridge.app.supervisor.supervisor import Supervisor
from zbridge.cli import set_up_log
from zbridge.errors import ConfigError


def supervise(paths: tuple[Path, ...], *, watch: bool, verbose: bool) -> None:
    """Run the gateways of all robot files until SIGTERM or SIGINT; raise ConfigError if they cannot be started."""
    set_up_log(verbose=False)
    if missing := [path for path in paths if not path.exists()]:
        raise ConfigError(f"{missing[0]}: No such file or directory")
    supervisor = Supervisor(paths, _host(paths), fork_server_command(), watch=watch, verbose=verbose)
    gc.freeze()
    asyncio.run(until_signal(supervisor.run()))


def _host(paths: tuple[Path, ...]) -> HostSettings:
    """Read ``host.toml`` of the directory; the defaults where files were named, or several directories."""
    folders = [path for path in paths if path.is_dir()]
    return load_host(folders[0]) if len(folders) == 1 else HostSettings()
