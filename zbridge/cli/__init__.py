"""The command line: ``zbridge run, check, init, simulate, probe, demo, router, ros2, ls, echo, drive, stop, certs``.

Knows no protocol. Only this package imports typer and rich, and this module does not: ``zbridge run`` loads neither.
``app`` declares the commands, ``certs`` those of ``zbridge certs``; ``bus``, ``demo`` (with ``secure_demo`` and
``processes``), ``drive``, ``probe``, ``ros2`` and ``router`` carry theirs out, ``keyboard`` turns keys into drives.
Exit codes: 0 done, 1 failed, 2 wrong arguments or configuration.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, NoReturn

from zbridge.app import Gateway, load, until_signal
from zbridge.app.member import check_member
from zbridge.errors import ConfigError, ZbridgeError
from zbridge.fleet.printable import shown


def main() -> None:
    """Run the command line; print a ZbridgeError as one line on stderr."""
    try:
        match sys.argv[1:]:
            case ["run", file] if not file.startswith("-"):
                run_gateway(Path(file))
            case _:
                from zbridge.cli.app import app

                app()
    except ConfigError as error:
        give_up(2, error)
    except ZbridgeError as error:
        give_up(1, error)


def run_only(protocol: str) -> None:
    """Run ``python -m gateways.<protocol> FILE``: a gateway of that protocol only."""
    try:
        if len(sys.argv) != 2:
            raise ConfigError(f"usage: python -m gateways.{protocol} FILE")
        run_gateway(Path(sys.argv[1]), only=protocol)
    except ConfigError as error:
        give_up(2, error)


def run_gateway(file: Path, *, only: str | None = None, verbose: bool = False, tls: Path | None = None) -> None:
    """Run the gateway of a configuration until SIGTERM or SIGINT. tls: a folder, for a file without ``bus.tls``."""
    set_up_log(verbose=verbose)
    plan = load(file, tls=tls)
    parts = {"device": plan.device} if plan.device else {f"hq[{n}]": part for n, part in enumerate(plan.listeners)}
    for key, part in parts.items():
        if only is not None and part.protocol.name != only:
            raise ConfigError(f"{file}: {key}.protocol = {part.protocol.name!r}: expected {only!r}")
    try:
        check_member(plan)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error
    gc.freeze()  # objects made at start-up live as long as the process; the collector skips them
    gateway = Gateway(plan)
    try:
        run_loop(until_signal(gateway.run()))
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from error
    if not gateway.left:  # a thread of the bus hangs and would keep the process alive
        logging.shutdown()
        os._exit(0)


def run_loop(work: Coroutine[Any, Any, Any]) -> Any:
    """Run a coroutine on uvloop where the platform has it."""
    try:
        import uvloop
    except ImportError:
        return asyncio.run(work)
    return uvloop.run(work)


def set_up_log(*, verbose: bool, level: int = logging.INFO) -> None:
    """Log to stderr from ``level`` on; ``verbose`` logs every frame."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.DEBUG if verbose else level, handlers=[handler])


class LineFormatter(logging.Formatter):
    """Writes a record as one line that is safe to print, whatever peers sent; a traceback on lines below it."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - the library's names
        return shown(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802
        return "\n".join(map(shown, super().formatException(ei).split("\n")))


def give_up(code: int, text: object) -> NoReturn:
    """End the process with one line on stderr."""
    print(f"zbridge: {shown(text)}", file=sys.stderr)  # noqa: T201
    sys.exit(code)
