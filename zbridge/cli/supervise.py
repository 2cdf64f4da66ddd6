"""``zbridge run DIR``, or several files: starts the supervisor."""

from __future__ import annotations

import asyncio
import gc
import os
from pathlib import Path

from zbridge.app import until_signal
from zbridge.cli import set_up_log
from zbridge.cli.logs import log_settings
from zbridge.errors import ConfigError
from zbridge.host.fork_client import ForkClient, fork_server_command
from zbridge.host.replacement import SupervisorState, restore
from zbridge.host.settings import HostFile, load_host
from zbridge.host.supervisor import Supervisor


def supervise(paths: tuple[Path, ...], *, watch: bool, verbose: bool) -> None:
    """Run the gateways of all robot files until SIGTERM or SIGINT; raise ConfigError if they cannot be started."""
    set_up_log()
    if missing := [path for path in paths if not path.exists()]:
        raise ConfigError(f"{missing[0]}: No such file or directory")
    folders = [path for path in paths if path.is_dir()]
    found = load_host(folders[0]) if len(folders) == 1 else HostFile()  # several files or folders: the defaults
    log_format, log_level = found.log.format or "", found.log.level or ""
    listen = found.metrics.listen if found.metrics is not None else ""
    _run(SupervisorState(tuple(map(str, paths)), watch, verbose, found.host, log_format, log_level, listen))


def resume(descriptor: int) -> None:
    """Continue as a supervisor, in place of the code that left the state behind a descriptor; raise HandoverError."""
    set_up_log()
    state = restore(descriptor)
    os.close(descriptor)
    _run(state)


def _run(state: SupervisorState) -> None:
    set_up_log(settings=log_settings(state.log_format, state.log_level))
    supervisor = Supervisor(state, ForkClient(fork_server_command()))
    gc.freeze()
    asyncio.run(until_signal(supervisor.run()))
