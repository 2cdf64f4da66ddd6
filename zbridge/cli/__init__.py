"""The command line.

Commands: ``zbridge run, check, init, simulate, probe, demo, router, foxglove, ls, top, doctor, health, echo,
drive, stop, unlatch, restart, certs, record, info, export, mark, replay, ros2, new-protocol``.

Knows no protocol. Only this package imports typer, and this module does not: ``zbridge run`` loads neither typer nor
rich. ``app`` declares the commands; ``certs``, ``doctor``, ``new_protocol``, ``robot_commands`` and
``recording_commands`` declare groups of them. ``bus``, ``check``, ``demo`` (with ``demo_bus``), ``diagnosis``,
``drive``, ``echo``, ``gateway_commands``, ``probe``, ``recording``, ``router``, ``simulate``, ``supervise``, ``top``
and ``viewers`` implement them; ``terminal`` prints lines and tables, ``logs`` (with ``log_lines`` and ``log_folding``)
the log. ``keyboard`` converts keys to drives;
``fork_server`` forks the gateways of ``zbridge run DIR``. Exit codes: ``commands.md``.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import io
import logging
import os
import signal
import socket
import sys
from collections.abc import Coroutine, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from zbridge.app import Gateway, load, until_signal
from zbridge.app.handover import Spawn
from zbridge.bus.tls.files import TLS_VARIABLE
from zbridge.cli.logs import last_words
from zbridge.cli.logs import set_up_log as set_up_log
from zbridge.errors import ConfigError, ZbridgeError, describe
from zbridge.host.addresses import hold_addresses
from zbridge.host.settings import HostFile, require_different_robots, require_one_bus, with_host
from zbridge.host.together import Together
from zbridge.log import Log
from zbridge.metrics.exposition import written
from zbridge.security.member import check_member
from zbridge.toml import prefixed, read_file

if TYPE_CHECKING:  # loaded only under a supervisor
    from zbridge.app.config import GatewayPlan
    from zbridge.control.faults import FaultCode
    from zbridge.host.child import Reporter

log = Log("zbridge.cli")


def main() -> None:
    """Run the command line; print an error that its user can make as one line on stderr."""
    _open_standard_streams()
    try:
        try:
            _run(sys.argv[1:])
        finally:
            sys.stdout.flush()
    except ConfigError as error:
        give_up(2, error)
    except ZbridgeError as error:
        give_up(1, error)
    except OSError as error:
        _discard_output()
        if isinstance(error, BrokenPipeError):  # whoever reads has seen enough
            sys.exit(1)
        give_up(1, describe(error))


def _run(words: Sequence[str]) -> None:
    match words:
        case ["run", file] if not file.startswith("-") and not Path(file).is_dir():
            run_gateway(Path(file))
        case ["run", file, "--take-over", descriptor] if not file.startswith("-") and descriptor.isdecimal():
            run_gateway(Path(file), take_over=int(descriptor))
        case ["run", *_, "--resume", descriptor] if descriptor.isdecimal():
            from zbridge.cli.supervise import resume

            resume(int(descriptor))
        case _:
            from zbridge.cli.app import app

            app()


def _open_standard_streams() -> None:
    """Open what was closed, like ``zbridge ls 2>&-``, as the null device, and print any character on any terminal.

    Zenoh and uvloop abort the process if one of the three descriptors is another file.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode)  # noqa: SIM115 - it gets the lowest descriptor, which is the closed one
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _discard_output() -> None:
    """Keep Python from writing at its end what could not be written before."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def run_only(protocol: str) -> None:
    """Run ``python -m gateways.<protocol> FILE``: a gateway of that protocol only."""
    try:
        if len(sys.argv) != 2:
            raise ConfigError(f"usage: python -m gateways.{protocol} FILE")
        run_gateway(Path(sys.argv[1]), only=protocol)
    except ConfigError as error:
        give_up(2, error)


def run_gateway(
    file: Path,
    *,
    only: str | None = None,
    verbose: bool = False,
    tls: Path | None = None,
    take_over: int | None = None,
    reporter: Reporter | None = None,
    content: bytes | None = None,
    host: HostFile = HostFile(),  # noqa: B008 - frozen
    died: tuple[FaultCode, str] | None = None,
) -> None:
    """Run the gateway of a configuration until SIGTERM or SIGINT, or until a successor has taken it over.

    content: of the file, if it was read already. tls: a folder, for a file without ``bus.tls``. take_over: the
    descriptor of the channel to the gateway that hands over to this process. reporter: reports to the supervisor, if
    there is one, which then also starts successors. host: for a file that says nothing of log or black
    box. died: how the process before this one died.
    """
    if reporter is None:
        set_up_log(verbose=verbose)
    plan = load(file, tls=tls, content=content)
    plan = with_host(plan, host)
    settings, robot = plan.config.log.over(host.log), plan.config.robot.name
    set_up_log(verbose=verbose, robot=robot, labelled=reporter is not None, settings=settings)
    hand_on_tls(tls)
    with prefixed(f"{file}: "):
        _check(plan, only)
    gc.freeze()  # objects made at start-up live as long as the process: exclude them from garbage collection
    predecessor = socket.socket(fileno=take_over) if take_over is not None else None
    successor = reporter if reporter is not None else Spawn(file, verbose=verbose)
    gateway = Gateway(plan, observer=reporter, predecessor=predecessor, successor=successor, died=died)

    async def serve() -> None:
        async with hold_addresses(plan):
            await gateway.run()

    async def work() -> None:
        if reporter is not None:
            reporter.describe, reporter.missing = gateway.restarts.deposit, gateway.missing
            reporter.metrics = lambda: written(gateway.metrics.read())
            reporter.begin()
        await until_signal(serve(), {signal.SIGUSR2: gateway.restarts.restart})

    with prefixed(f"{file}: "):
        run_loop(work())
    if gateway.restarts.gone.is_set() and isinstance(successor, Spawn):
        successor.notify_systemd()
    _exit(left=gateway.left)


def _check(plan: GatewayPlan, only: str | None) -> None:
    parts = {"device": plan.device} if plan.device else {f"hq[{n}]": part for n, part in enumerate(plan.listeners)}
    for key, part in parts.items():
        if only is not None and part.protocol.name != only:
            raise ConfigError(f"{key}.protocol = {part.protocol.name!r}: expected {only!r}")
    check_member(plan)


def _exit(*, left: bool) -> None:
    """End the process if leaving the bus failed: one of its threads hangs, and would keep the process alive."""
    if not left:
        logging.shutdown()
        os._exit(0)


def hand_on_tls(folder: Path | None) -> None:
    """Make child processes read certificates from the same folder."""
    if folder is not None:
        os.environ[TLS_VARIABLE] = str(folder.absolute())


def run_together(files: Sequence[Path], host: HostFile, *, verbose: bool = False) -> None:
    """Run the gateways of several configurations in this process until SIGTERM or SIGINT.

    A faulty file is reported, and the others run. They have one log: as ``host`` says, else as the files agree.
    """
    set_up_log(verbose=verbose, settings=host.log)
    plans, faults = [], []
    for file in files:
        try:
            plans.append((file, with_host(load(file, content=read_file(file, host.host.file_bytes)), host)))
        except ConfigError as error:
            faults.append(error)
            log.error("file_not_run", "{reason}", reason=error, file=file)
    if not plans:
        raise faults[0]
    if len(wishes := {plan.config.log for _, plan in plans}) == 1:
        set_up_log(verbose=verbose, settings=host.log.over(*wishes))
    require_different_robots(plans)
    require_one_bus(plans)
    gc.freeze()
    together = Together(
        {plan.config.robot.name: plan for _, plan in plans},
        host.host,
        listen=host.metrics.address if host.metrics is not None else None,
    )
    run_loop(until_signal(together.run()))
    _exit(left=together.left)


def run_loop(work: Coroutine[Any, Any, Any]) -> Any:
    """Run a coroutine on uvloop where the platform has it."""
    try:
        import uvloop
    except ImportError:
        return asyncio.run(work)
    return uvloop.run(work)


def run_command(work: Coroutine[Any, Any, bool | int | None], *, level: int = logging.ERROR) -> None:
    """Set up logging, and run a coroutine; end the process with the code that it returns, False being 1."""
    set_up_log(level=level)
    result = run_loop(work)
    code = int(not result) if isinstance(result, bool) else result
    if code:
        sys.exit(code)


def give_up(code: int, text: object) -> NoReturn:
    """End the process with one line on stderr."""
    print(last_words(code, text), file=sys.stderr)  # noqa: T201
    sys.exit(code)
