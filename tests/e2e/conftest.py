"""Real processes, real sockets, real Zenoh, all on loopback; every process is ended by its id."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgpack
import pytest
import zenoh

from tests.e2e.rigs.robots import Robot
from tests.machine import Patience, Withheld, contended_s
from tests.ports import HOST, free_port
from tests.proofs import Holder, packed

T = TypeVar("T")
WAIT_S = 10.0


def until(condition: Callable[[], T], timeout_s: float = WAIT_S, what: str = "condition") -> T:
    """Wait until ``condition()`` is true and give its value. A busy machine puts the timeout off."""
    patience = Patience(timeout_s)
    while True:
        over = patience.over
        value = condition()
        if value:
            return value
        if over:
            raise AssertionError(f"{what} not within {timeout_s} s")
        time.sleep(0.01)


# The bus


def configuration(mode: str, *endpoints: str) -> zenoh.Config:
    """Configure a session without multicast: a router that listens, or a client that connects."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{'listen' if mode == 'router' else 'connect'}/endpoints", json.dumps(endpoints))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def ask(session: zenoh.Session, key: str, payload: bytes = b"", timeout_s: float = 3.0, **fields: Any) -> list[Any]:
    """Plain get: the decoded replies, errors too."""
    payload = payload or (packed(fields) if fields else b"")
    replies = session.get(key, payload=payload or None, timeout=timeout_s)
    return [msgpack.unpackb((reply.ok or reply.err).payload.to_bytes()) for reply in replies]


ASKS_OTHERS = "querying the fleet's latched stops"
"""Why a gateway that has just started grants no lease for a moment, as clients are told."""


class Lease:
    """The lease of one robot by plain Zenoh and MessagePack, renewed on a thread until it is closed or has ended."""

    def __init__(self, session: zenoh.Session, robot: str, how: str, wishes: dict[str, Any]) -> None:
        self._session, self._key = session, f"fleet/{robot}/@rpc/control/"
        self.answer: dict[str, Any] = {}
        for _ in range(15):
            self.answer = self.ask(f"{how}/{wishes['who']}", packed(wishes))
            if self.answer and self.answer.get("reason") != ASKS_OTHERS and self.answer.get("code") != "closing":
                break
            time.sleep(0.1)
        assert self.answer.get("ok"), self.answer
        self.lost = False
        self.held = Holder.of(self.answer, robot)
        self._closed = threading.Event()
        threading.Thread(target=self._renew, daemon=True).start()

    def ask(self, name: str, payload: bytes) -> dict[str, Any]:
        try:
            answers = ask(self._session, self._key + name, payload)
        except ValueError:  # Zenoh's own words: who should have answered has just left the bus
            return {}
        return answers[0] if answers else {}

    def _renew(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session was closed
            while not self._closed.wait(self.answer["expires_in_s"] / 3):
                if not self.ask("renew", self.held.question("renew")).get("ok"):
                    self.lost = True
                    return

    def close(self) -> None:
        """Renew it no longer."""
        self._closed.set()


class Fleet:
    """A Zenoh session of the test, what it saw, and the robots it holds."""

    def __init__(self, session: zenoh.Session, keys: str = "fleet/**") -> None:
        self.session = session
        self.seen: dict[str, list[dict[str, Any]]] = {}
        self._leases: dict[str, Lease] = {}
        self.subscriber: Any = session.declare_subscriber(keys, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        fields = msgpack.unpackb(sample.payload.to_bytes())
        self.seen.setdefault(str(sample.key_expr), []).append({**fields, "at": time.monotonic()})

    def last(self, path: str) -> dict[str, Any]:
        return (self.seen.get(f"fleet/{path}") or [{}])[-1]

    def get(self, key: str, **fields: Any) -> list[Any]:
        return ask(self.session, key, **fields)

    def hold(self, robot: str = "r1", who: str = "test", *, how: str = "acquire", **wishes: Any) -> None:
        """Acquire a robot and keep its lease; from now on every command for it is the holder's."""
        if robot in self._leases:
            self._leases.pop(robot).close()
        self._leases[robot] = Lease(self.session, robot, how, {"who": who, **wishes})

    def release(self, robot: str = "r1") -> None:
        """Give a robot back."""
        lease = self._leases.pop(robot)
        lease.close()
        assert lease.ask("release", lease.held.question("release")).get("ok")

    def token(self, robot: str = "r1") -> bytes:
        """The secret of a robot's lease."""
        return self._leases[robot].held.token

    def lost(self, robot: str = "r1") -> bool:
        """Whether the lease of a robot was refused its renewal."""
        return self._leases[robot].lost

    def get_within(self, key: str, timeout_s: float) -> list[Any]:
        """Plain get that may take its time."""
        return ask(self.session, key, timeout_s=timeout_s)

    def put(self, path: str, payload: bytes = b"", **fields: Any) -> None:
        payload = payload or packed(fields)
        robot, _, command = path.partition("/@cmd/")
        lease = self._leases.get(robot)
        attachment = lease.held.attachment(command, payload) if lease is not None else None
        congestion = zenoh.CongestionControl.BLOCK
        self.session.put(f"fleet/{path}", payload, attachment=attachment, congestion_control=congestion)

    def close(self) -> None:
        """Renew nothing any more."""
        while self._leases:
            self._leases.popitem()[1].close()

    def tokens(self, key: str = "fleet/*/@alive/gateway") -> list[str]:
        return [str(reply.ok.key_expr) for reply in self.session.liveliness().get(key, timeout=2) if reply.ok]

    def state(self, robot: str = "r1") -> str | None:
        return self.last(f"{robot}/status").get("state")

    def reason(self, robot: str = "r1") -> str:
        return self.last(f"{robot}/status").get("reason") or ""

    def refusal(self, robot: str = "r1", **wanted: Any) -> dict[str, Any] | None:
        """Find what ``control`` shows as refused with these fields."""
        entries = self.last(f"{robot}/control").get("refusals", [])
        return next((entry for entry in entries if wanted.items() <= entry.items()), None)


@contextlib.contextmanager
def repeated(act: Callable[[], None], every_s: float = 0.05) -> Iterator[None]:
    """Do something again and again, as a stick does that is pushed."""
    ended = threading.Event()

    def go_on() -> None:
        while not ended.wait(every_s):
            act()

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


# Processes


def start(*arguments: str, **popen: Any) -> subprocess.Popen[str]:
    """Start a command of zbridge."""
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, **popen}
    main = os.environ.get("ZBRIDGE_TEST_MAIN")
    command = [sys.executable, *([main] if main else ["-m", "zbridge"]), *arguments]
    return subprocess.Popen(command, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}, **output)


def end(process: subprocess.Popen[str], number: int = signal.SIGTERM, within_s: float = 5.0) -> str:
    """End a process by its id, within so many seconds unless the machine is busy; give what it printed."""
    if process.poll() is None:
        process.send_signal(number)
    patience = Patience(within_s)
    while True:
        try:
            return process.communicate(timeout=0.2)[0]
        except subprocess.TimeoutExpired:
            if patience.over:
                process.kill()


class Gateway:
    """A process of ``zbridge run``; its log goes to a file, for a pipe that nobody reads would stop it.

    ``parts``: of its configuration, besides robot and bus. It is killed with the stack.
    """

    def __init__(
        self, stack: contextlib.ExitStack, file: Path, endpoint: str, *parts: str, robot: str = "r1", bus: str = ""
    ) -> None:
        bus = f'[bus]\nconnect = ["{endpoint}"]\nmulticast = false\n{bus}\n'
        file.write_text(f'[robot]\nname = "{robot}"\n' + "".join(parts) + bus)
        self._log = file.with_suffix(".log")
        with self._log.open("ab") as log:
            self.process = start("run", str(file), stdout=log, stderr=log)
        stack.callback(end, self.process, signal.SIGKILL)

    @property
    def log(self) -> str:
        """What it has logged."""
        return self._log.read_text()

    def listens(self, count: int) -> bool:
        """Whether so many listeners are open; a process that has ended says why."""
        if self.process.poll() is not None:
            raise AssertionError(f"the gateway ended: {self.log}")
        return self.log.count("HQ programs connect at") >= count

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def end(self) -> str:
        """End it; an exit that is not clean is an error. Give what it has logged."""
        end(self.process)
        assert self.process.returncode == 0, self.log
        assert "Traceback" not in self.log, self.log
        return self.log


def device(port: int, protocol: str = "tcpudp", options: str = "", *more: int) -> str:
    """Write ``[device]``."""
    connect = json.dumps([f"tcp://{HOST}:{one}" for one in (port, *more)])
    return f'[device]\nprotocol = "{protocol}"\nconnect = {connect}\n[device.options]\n{options}\n'


def listener(name: str, protocol: str, port: int, more: str = "") -> str:
    """Write one ``[[hq]]``."""
    return f'[[hq]]\nname = "{name}"\nprotocol = "{protocol}"\nlisten = "tcp://{HOST}:{port}"\n{more}\n'


class Bench:
    """Everything a test starts."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder = folder
        self.endpoint = f"tcp/{HOST}:{free_port()}"
        self.stack = stack
        self.simulators: dict[int, subprocess.Popen[str]] = {}
        """By port."""
        self._processes: list[int] = []
        self._withheld = Withheld()
        self.fleet = Fleet(self.stack.enter_context(self.router()))
        self.stack.callback(lambda: self.fleet.close())

    def router(self) -> zenoh.Session:
        return zenoh.open(configuration("router", self.endpoint))

    @contextlib.contextmanager
    def bus_away(self) -> Iterator[None]:
        """Take the router away, and bring it back."""
        self.fleet.session.close()
        yield
        self.fleet = Fleet(self.stack.enter_context(self.router()))

    def zbridge(self, *arguments: str) -> subprocess.Popen[str]:
        process = start(*arguments)
        self._processes.append(process.pid)
        self.stack.callback(end, process, signal.SIGKILL)
        return process

    @property
    def withheld_s(self) -> float:
        """The processor time that was withheld so far from this process and those it started: what excuses a delay."""
        return self._withheld.seconds(self._processes)

    def ended_within(self, process: subprocess.Popen[str], seconds: float) -> None:
        """Wait for the orderly end of a process.

        A busy machine excuses as long as anything waited for a processor: a process that has ended cannot be asked.
        """
        contended, began = contended_s(), time.monotonic()
        until(lambda: process.poll() is not None, what="the end of the process")
        took_s = time.monotonic() - began
        assert took_s < seconds + contended_s() - contended, f"it took {took_s:.2f} s"
        assert process.returncode == 0

    def simulator(self, protocol: str = "tcpudp", *more: str, port: int = 0) -> int:
        """Start a simulated robot; give its port."""
        port = port or free_port()
        process = self.simulators[port] = self.zbridge("simulate", protocol, "--listen", f"tcp://{HOST}:{port}", *more)
        assert process.stdout is not None
        assert "listening" in process.stdout.readline()
        return port

    def gateway(self, *parts: str, robot: str = "r1", name: str = "", endpoint: str = "", bus: str = "") -> Gateway:
        """Start a process for a robot with these parts of a configuration."""
        file = self.folder / f"{name or robot}.toml"
        process = Gateway(self.stack, file, endpoint or self.endpoint, *parts, robot=robot, bus=bus)
        self._processes.append(process.process.pid)
        return process

    def serve(self, port: int, *more: str, robot: str = "r1") -> Gateway:
        """Start the gateway of a TCP/UDP robot and wait until the robot is established."""
        process = self.gateway(device(port), *more, robot=robot)
        until(lambda: self.fleet.state(robot) == "established", what="established")
        return process


_SHOWN = 6000
"""Characters of a log that are shown with a failure: its last ones."""


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with contextlib.ExitStack() as stack:
        yield Bench(tmp_path, stack)


@pytest.fixture
def robot() -> Iterator[Robot]:
    with contextlib.closing(Robot()) as scripted:
        yield scripted


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show with a failure what the processes of its folder have logged."""
    report = yield
    folder = getattr(item, "funcargs", {}).get("tmp_path")
    if report.failed and folder is not None:
        for log in sorted(folder.rglob("*.log")):
            report.sections.append((log.name, log.read_text(errors="replace")[-_SHOWN:]))
    return report
