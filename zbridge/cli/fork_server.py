"""``python -m zbridge.cli.fork_server FD``: the fork server of ``zbridge run DIR``. FD: its end of the channel."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

from zbridge.cli import give_up, run_gateway, set_up_log
from zbridge.cli.logs import log_settings
from zbridge.control.faults import FaultCode
from zbridge.errors import ConfigError, ZbridgeError
from zbridge.host.child import Reporter
from zbridge.host.fd_channel import FdChannel, Fork
from zbridge.host.fork_server import Birth, serve
from zbridge.host.settings import HostFile


def main() -> None:
    """Serve the supervisor that started this process."""
    serve(FdChannel.inherited(int(sys.argv[1])), run)


def run(birth: Birth) -> int:
    """Be a gateway; return the exit code."""
    request = birth.request
    settings = log_settings(request.log_format, request.log_level)
    set_up_log(verbose=request.verbose, robot=request.robot, labelled=True, settings=settings)
    try:
        run_gateway(
            Path(request.file),
            content=birth.read(),
            verbose=request.verbose,
            take_over=birth.take_over if birth.take_over >= 0 else None,
            reporter=Reporter(FdChannel.inherited(birth.channel), hands_over=True),
            host=HostFile(log=settings, blackbox=request.blackbox),
            died=_death(request),
        )
    except ZbridgeError as error:
        try:
            give_up(2, error)
        except SystemExit:
            return 2 if isinstance(error, ConfigError) else 1
    finally:
        logging.shutdown()  # the process ends without Python's own end
    return 0


def _death(request: Fork) -> tuple[FaultCode, str] | None:
    """Return how the process before this one died; None: it ended in order, or there was none."""
    code = FaultCode.GATEWAY_HUNG if request.hung else FaultCode.GATEWAY_DIED
    return (code, request.died) if request.died else None


if __name__ == "__main__":
    main()
