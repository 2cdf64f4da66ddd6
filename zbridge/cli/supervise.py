"""``zbridge run DIR``, or several files: starts the supervisor."""

from __future__ import annotations

import asyncio
import gc
import os
from pathlib import Path

from zbridge.app import until_signal
from zbridge.cli import set_up_log
from zbridge.errors import ConfigError
from zbridge.host.fork_client import ForkClient, fork_server_command, module_command
from zbridge.host.replacement import restore
from zbridge.host.settings import HostSettings, load_host
from zbridge.host.supervisor import Supervisor


def supervise(paths: tuple[Path, ...], *, watch: bool, verbose: bool) -> None:
    """Run the gateways of all robot files until SIGTERM or SIGINT; raise ConfigError if they cannot be started."""
    set_up_log(verbose=False)
    if missing := [path for path in paths if not path.exists()]:
        raise ConfigError(f"{missing[0]}: No such file or directory")
    itself = _itself(paths, watch=watch, verbose=verbose)
    supervisor = Supervisor(paths, _host(paths), _forks(), watch=watch, verbose=verbose, itself=itself)
    _run(supervisor)


def resume(descriptor: int, *, only_check: bool) -> None:
    """Continue as a supervisor, in place of the code that left the state behind ``descriptor``.

    only_check: end at once, with an error where the state cannot be taken. Raises HandoverError.
    """
    set_up_log(verbose=False)
    state = restore(descriptor)
    paths = tuple(map(Path, state.sources))
    supervisor = Supervisor(
        paths,
        HostSettings(stagger_s=state.stagger_s, file_bytes=state.file_bytes),
        _forks(),
        watch=state.watch,
        verbose=state.verbose,
        itself=_itself(paths, watch=state.watch, verbose=state.verbose),
        resumed=state,
    )
    if not only_check:
        os.close(descriptor)
        _run(supervisor)


def _run(supervisor: Supervisor) -> None:
    gc.freeze()
    asyncio.run(until_signal(supervisor.run()))


def _forks() -> ForkClient:
    return ForkClient(fork_server_command())


def _itself(paths: tuple[Path, ...], *, watch: bool, verbose: bool) -> list[str]:
    """Return the command that runs the installed code in place of this one; its options show in process lists."""
    options = ["--watch"] * watch + ["--verbose"] * verbose
    return [*module_command("zbridge"), "run", *options, *map(str, paths)]


def _host(paths: tuple[Path, ...]) -> HostSettings:
    """Read ``host.toml`` of the directory; the defaults where files were named, or several directories."""
    folders = [path for path in paths if path.is_dir()]
    return load_host(folders[0]) if len(folders) == 1 else HostSettings()
