"""A supervisor as a part of a scene, whose gateways hang, and die at a step of a restart, when they are told to.

``python -m tests.e2e.rigs.supervised FOLDER``: ``zbridge run FOLDER``; its fork server is this module too. A gateway
that is sent SIGUSR1 blocks its event loop for good. Orders to die are written to the folder beside it
(:mod:`tests.e2e.rigs.steps`).
"""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.e2e.conftest import WAIT_S, end, until
from tests.e2e.rigs import steps
from tests.e2e.rigs.processes import ROOT, module
from zbridge.app import until_signal
from zbridge.cli import set_up_log
from zbridge.cli.fork_server import run
from zbridge.host.fd_channel import FdChannel
from zbridge.host.fork_client import ForkClient
from zbridge.host.fork_server import Birth, serve
from zbridge.host.replacement import SupervisorState
from zbridge.host.supervisor import Supervisor

FORKS = "forks"


class Supervised:
    """A running supervisor: ``zbridge run FOLDER``, or that of this module (``hangs``). Its log goes to a file.

    enter: the command that runs it in another network namespace.
    """

    def __init__(
        self,
        stack: contextlib.ExitStack,
        folder: Path,
        *more: str,
        hangs: bool = False,
        environment: dict[str, str] | None = None,
        enter: Sequence[str] = (),
    ) -> None:
        self.folder = folder
        self.orders = orders_of(folder)
        self._log = folder.with_suffix(".log")
        command = (
            module("tests.e2e.rigs.supervised", folder)
            if hangs
            else [sys.executable, "-m", "zbridge", "run", str(folder), *more]
        )
        with self._log.open("ab") as log:
            command = [*enter, *command]
            self.process = subprocess.Popen(command, stdout=log, stderr=log, text=True, cwd=ROOT, env=environment)
        stack.callback(end, self.process)

    @property
    def log(self) -> str:
        """What the supervisor and its gateways have logged."""
        return self.log_since(0)

    def log_since(self, at: int) -> str:
        """What they have logged since the log had so many bytes (:attr:`logged`)."""
        with self._log.open("rb") as file:
            file.seek(at)
            return file.read().decode(errors="replace")

    @property
    def logged(self) -> int:
        """How many bytes they have logged."""
        return self._log.stat().st_size

    def gateway(self, robot: str, not_pid: int = 0) -> int:
        """Wait for the gateway process of a robot, another one than ``not_pid``; give its process id."""
        return until(lambda: self._gateway(robot, not_pid), WAIT_S, f"a process for {robot}")

    def _gateway(self, robot: str, not_pid: int) -> int:
        for pid in children(self.process.pid):
            with contextlib.suppress(OSError):
                if pid != not_pid and Path(f"/proc/{pid}/comm").read_text().strip() == f"zb {robot}"[:15]:
                    return pid
        return 0

    def reload(self) -> None:
        """Let the supervisor look at its files."""
        self.process.send_signal(signal.SIGHUP)


def children(pid: int) -> list[int]:
    """List the children of a process."""
    with contextlib.suppress(OSError):
        return [*map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())]
    return []


def orders_of(folder: Path) -> Path:
    """Give the folder for orders to the gateways of a folder."""
    return folder.with_suffix(".orders")


def hang(birth: Birth) -> int:
    """Be a gateway that can be hung, and ended at a step of a restart."""
    signal.signal(signal.SIGUSR1, lambda *_: time.sleep(3600))
    steps.be(birth.request.robot)
    return run(birth)


def main() -> None:
    if sys.argv[1] == FORKS:
        steps.watch(Path(sys.argv[2]))
        serve(FdChannel.inherited(int(sys.argv[3])), hang)
        return
    set_up_log(verbose=False)
    folder = Path(sys.argv[1])
    orders_of(folder).mkdir(exist_ok=True)
    forks = module("tests.e2e.rigs.supervised", FORKS, orders_of(folder))
    supervisor = Supervisor(SupervisorState((str(folder),)), ForkClient(forks))
    asyncio.run(until_signal(supervisor.run()))


if __name__ == "__main__":
    os.environ.pop("NOTIFY_SOCKET", None)
    main()
