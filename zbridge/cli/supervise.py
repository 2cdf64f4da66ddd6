"""``zbridge run DIR``, or several files: starts the supervisor."""

from __future__ import annotations

import asyncio
import gc
import os
from pathlib import Path

from msgspec import structs

from zbridge.app import until_signal
from zbridge.cli import set_up_log
from zbridge.cli.logs import log_settings
from zbridge.errors import ConfigError
from zbridge.host.fork_client import ForkClient, fork_server_command
from zbridge.host.replacement import SupervisorState, restore
from zbridge.host.settings import HostFile, load_host
from zbridge.host.supervisor import Supervisor
from zbridge.log import Log

log = Log("zbridge.cli")


def supervise(paths: tuple[Path, ...], *, watch: bool, verbose: bool) -> None:
    """Run the gateways of all robot files until SIGTERM or SIGINT; raise ConfigError if they cannot be started."""
    set_up_log()
    if missing := [path for path in paths if not path.exists()]:
        raise ConfigError(f"{missing[0]}: No such file or directory")
    _run(_with_host_file(SupervisorState(tuple(map(str, paths)), watch, verbose)))


def resume(descriptor: int) -> None:
    """Continue as a supervisor, in place of the code that left the state behind a descriptor; raise HandoverError."""
    set_up_log()
    state = restore(descriptor)
    os.close(descriptor)
    try:
        state = _with_host_file(state)
    except ConfigError as error:
        log.error("host_file_ignored", "{error}: the settings stay as they were", error=error)
    _run(state)


def _with_host_file(state: SupervisorState) -> SupervisorState:
    """Return the state with what ``host.toml`` says now; raise ConfigError. Sockets of another address are closed."""
    folders = [path for path in map(Path, state.sources) if path.is_dir()]
    found = load_host(folders[0]) if len(folders) == 1 else HostFile()  # several files or folders: the defaults
    listen = found.metrics.listen if found.metrics is not None else ""
    if listen != state.listen:
        for descriptor in state.sockets:
            os.close(descriptor)
        state = structs.replace(state, sockets=())
    return structs.replace(
        state,
        host=found.host,
        log_format=found.log.format or "",
        log_level=found.log.level or "",
        listen=listen,
        blackbox=found.blackbox,
    )


def _run(state: SupervisorState) -> None:
    set_up_log(settings=log_settings(state.log_format, state.log_level))
    supervisor = Supervisor(state, ForkClient(fork_server_command()))
    gc.freeze()
    asyncio.run(until_signal(supervisor.run()))
