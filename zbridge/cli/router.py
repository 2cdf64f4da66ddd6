"""``zbridge router``: a Zenoh router, or the configuration of one."""

from __future__ import annotations

import json
import os
from pathlib import Path

import msgspec

from zbridge.app import until_signal
from zbridge.bus import read_zenoh_log
from zbridge.cli import run_loop
from zbridge.errors import ConfigError
from zbridge.security.router import Router, log_zenoh_line
from zbridge.security.router_settings import RouterSettings, load_router, nested, nftables, plan_router, zenoh_values
from zbridge.toml import convert

RUNTIME = "(rx: (worker_threads: 2), acc: (worker_threads: 1))"
"""Threads of Zenoh's in a router: who knocks with garbage keeps the thread busy that accepts, not those that route."""
HEAD = """\
// The configuration of a Zenoh router, for `zenohd --config FILE`, as `zbridge router --print-config` prints it.
// Print it again after every change of roles.toml, and restart the router: Zenoh reads rules at its start only.
// zenohd does not answer `@bus/whoami`: members that it does not know are not told so.
"""


def settings_of(file: Path | None, given: dict[str, object]) -> RouterSettings:
    """Return the settings of a file with what was given as options instead; raise ConfigError.

    given: fields of RouterSettings; empty ones were not given.
    """
    settings = load_router(file) if file is not None else RouterSettings()
    changes = {key: value for key, value in given.items() if value}
    return convert(msgspec.to_builtins(settings) | msgspec.to_builtins(changes), RouterSettings)


def run_router(
    file: Path | None, given: dict[str, object], *, print_config: bool = False, print_nftables: bool = False
) -> None:
    """Run a router until SIGTERM or SIGINT, or print its configuration for Zenoh's own, or rules for its ports."""
    try:
        plan = plan_router(settings_of(file, given), files=not (print_config or print_nftables))
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}" if file is not None and str(file) not in str(error) else error) from error
    if print_config:
        print(HEAD + json.dumps(nested(zenoh_values(plan)), indent=2))  # noqa: T201
        return
    if print_nftables:
        print(nftables(plan.settings), end="")  # noqa: T201
        return
    os.environ.setdefault("ZENOH_RUNTIME", RUNTIME)
    read_zenoh_log(log_zenoh_line)
    run_loop(until_signal(Router(plan).run()))
