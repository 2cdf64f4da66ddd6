"""``zbridge demo``: a simulated robot of each protocol, their gateways, a router, a table. Loopback only.

Here the bus is open to this machine, and its router embedded; ``demo_bus`` makes a bus with roles.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import secrets
import sys
import tempfile
import tomllib
import webbrowser
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import IO

import msgspec
from rich.console import Console
from rich.live import Live
from rich.text import Text

from zbridge.app import until_signal
from zbridge.bus import BusSettings, Sample, open_bus
from zbridge.cli.demo_bus import REALM, START_S, DemoBus, end, free_port, process, secure_bus
from zbridge.cli.terminal import Column, Table
from zbridge.client import LOCAL_ROUTER, Fleet, Robot
from zbridge.errors import BusError, ConfigError, LeaseLost, NeutralFirst, NotReady, PayloadError, Refused, ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Pose, Status
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import split_key
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Protocol, find_protocol, protocol_names
from zbridge.toml import as_toml

REFRESH_S = 0.5
FIGURE: tuple[dict[str, float], ...] = ({"forward": 0.6}, {"turn": 0.5})
FIGURE_S = 2.0
"""Seconds of each motion: the robots drive straight on, then turn, and so on."""
PRIORITY = -1
"""Below the default of 0: any other program that acquires a robot gets it."""
_RATES = ("pose", "scan", "map", "sensor")
_COLUMNS = (
    *(Column("robot"), Column("state", 1), Column("version", 3), Column("driver", 2)),
    *(Column(title, number=True) for title in (*(f"{name}/s" for name in _RATES), "x m", "y m", "turn")),
)
_PIPED = 500
"""Characters of a line that is piped: none is cut."""
_NO_DATA = (topics.STATUS.path, topics.CONTROL.path)


class Row(msgspec.Struct):
    """What the table shows of one robot."""

    status: Status | None = None
    control: Control | None = None
    pose: Pose | None = None
    received: bool = False
    counts: Counter[str] = msgspec.field(default_factory=Counter)


class LiveTable:
    """Collects what the robots publish and draws the table."""

    def __init__(self, robots: list[str]) -> None:
        self.rows = {robot: Row() for robot in robots}

    def take(self, sample: Sample) -> None:
        split = split_key(sample.key)
        row = self.rows.get(split[1]) if split else None
        if split is None or row is None:
            return
        row.counts[split[2].partition("/")[0]] += 1
        row.received = row.received or split[2] not in _NO_DATA
        with contextlib.suppress(PayloadError):
            if split[2] == topics.STATUS.path:
                row.status = payloads.decode(Status, sample.payload)
            elif split[2] == topics.CONTROL.path:
                row.control = payloads.decode(Control, sample.payload)
            elif split[2] == topics.POSE.path:
                row.pose = payloads.decode(Pose, sample.payload)

    def table(self, seconds: float, room: int) -> Text:
        """Draw the table, ``room`` characters wide at most; the counts since the last drawing become rates."""
        rows = []
        for robot, row in self.rows.items():
            state = row.status.state if row.status else "no gateway yet"
            version = (row.status.version or "") if row.status else ""
            driver = (row.control.holder or row.control.state) if row.control else ""
            rates = [f"{row.counts[name] / seconds:.1f}" for name in _RATES]
            pose = row.pose
            where = [f"{pose.x:.2f}", f"{pose.y:.2f}", f"{math.degrees(pose.heading):.0f}°"] if pose else ["", "", ""]
            rows.append((robot, state, version, driver, *rates, *where))
            row.counts.clear()
        table = Table(_COLUMNS, rows).text(room)
        table.no_wrap, table.overflow = True, "crop"
        return table


async def run_demo(seconds: float, *, secure: bool = False, console: bool = False) -> None:
    """Show the demo for ``seconds`` (0: until interrupted); raise ZbridgeError if a robot sent no data.

    secure: on mutual TLS, with roles; raises ConfigError if no certificates can be made. console: open the console in a
    browser; raises ConfigError if its extra is not installed.
    """
    if console and not _has_console():
        raise ConfigError("--console: install the extra: pip install 'zbridge[console]'")
    robots = {f"{name}1": name for name in protocol_names() if _is_whole(name)}
    print(f"starting {', '.join(robots)}", flush=True)  # noqa: T201 - the first words of the rest take seconds
    watch = LiveTable(list(robots))
    async with contextlib.AsyncExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="zbridge-demo-")))
        log = stack.enter_context((folder / "log").open("w+b"))
        bus = await stack.enter_async_context(secure_bus(folder, log, list(robots)) if secure else _open_to_all())
        listeners = {robot: f"tcp://127.0.0.1:{free_port()}" for robot in robots}
        processes, failed = [], list[str]()
        for robot, protocol in robots.items():
            starting = _robot(folder, log, robot, protocol, listeners[robot], bus.table(robot))
            try:
                processes.append(await stack.enter_async_context(starting))
            except ZbridgeError as error:
                failed.append(_left_out(error))
                del watch.rows[robot]
        for key_expr in ("*", "sensor/*"):
            bus.viewer.subscribe(f"{REALM}/*/{key_expr}", watch.take)
        how = _how_to_use(bus, {name: (find_protocol(robots[name]), listeners[name]) for name in watch.rows})
        if _has_console():
            serving = _console(folder, log, bus.joins, secure=secure, opens=console)
            how.append(f"the fleet in a browser, with STOP ALL: {await stack.enter_async_context(serving)}")
        await until_signal(_show(bus.operator, watch, seconds, how))
        await end([gateway for _, gateway in processes])  # all at once: each needs about a second to stop its robot
        await end([simulator for simulator, _ in processes])
        failed += [f"no data from {robot}" for robot, row in watch.rows.items() if not row.received]
        if seconds and failed:
            _print_end(folder / "log")
            raise ZbridgeError(f"{'; '.join(failed)}; the end of the processes' log is above")


def _print_end(log: Path) -> None:
    for line in log.read_text(errors="replace")[-2000:].splitlines():
        print(shown(line), file=sys.stderr)  # noqa: T201


def _has_console() -> bool:
    return all(find_spec(module) is not None for module in ("starlette", "uvicorn", "websockets"))


def _console_users(folder: Path) -> tuple[tuple[str, ...], str]:
    """Make a user of the console; return the options that name the file, and how to log in."""
    from zbridge.views.console.users import User, hash_password, save_users

    file, password = folder / "users.toml", secrets.token_urlsafe(9)
    save_users(file, {"demo": User("supervisor", hash_password(password))})
    return ("--users", str(file), "--journal", str(folder / "journal")), f" (user demo, password {password})"


@contextlib.asynccontextmanager
async def _console(
    folder: Path, log: IO[bytes], joins: tuple[str, ...], *, secure: bool, opens: bool
) -> AsyncIterator[str]:
    """Run the console while the context lasts; yield its address and how to log in, or why it has no address.

    joins: the options by which it joins the bus. opens: whether to open it in a browser.
    """
    users, login = _console_users(folder) if secure else ((), "")
    options = ("--listen", "127.0.0.1:0", "--roster", str(folder / "roster"), *joins, *users)
    async with process(log, "console", *options, read=True) as console:
        assert console.stdout is not None
        line = b""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(START_S):
                line = await console.stdout.readline()
        at = line.decode().rpartition(" ")[2].strip()
        if opens and at:
            webbrowser.open(at)
        yield at + login if at else "it did not start"


def _left_out(error: ZbridgeError) -> str:
    """Print why the demo continues without a protocol; return it."""
    print(shown(f"zbridge: {error}; the demo continues without it"), file=sys.stderr)  # noqa: T201
    return str(error)


def _is_whole(name: str) -> bool:
    """Return whether a protocol can be loaded, and what its robots need is installed; print what is missing."""
    try:
        missing = [module for module in find_protocol(name).requires if find_spec(module) is None]
        if not missing:
            return True
        how = f"for a protocol of zbridge: pip install 'zbridge[{name}]'"
        _left_out(ConfigError(f"{name}: not installed: {', '.join(missing)}; {how}"))
    except ConfigError as error:
        _left_out(error)
    return False


def _how_to_use(bus: DemoBus, robots: Mapping[str, tuple[Protocol, str]]) -> list[str]:
    """Return what to try. robots: each with its protocol, and the address of its listener for HQ programs."""
    return [
        f"router at {bus.endpoint}; try, in another terminal:",
        *(f"  {line}" for line in bus.commands),
        "HQ programs connect to the robots here; to simulate one:",
        *(f"  {name}: {_how_to_connect(*each)}" for name, each in robots.items()),
    ]


def _how_to_connect(protocol: Protocol, listener: str) -> str:
    """Return how an HQ program connects to the robot; not every protocol has one, or a simulated one."""
    if protocol.hq is None:
        return "serves no HQ programs"
    return f"zbridge simulate {protocol.name} --hq {listener}" if protocol.simulate_hq is not None else listener


def _listener(protocol: Protocol, address: str) -> str:
    """Write ``[[hq]]``, with the options that ``zbridge init`` writes: some have no default."""
    options = tomllib.loads(protocol.hq_template).get("hq", {}).get("options", {})
    return f'[[hq]]\nprotocol = "{protocol.name}"\nlisten = "{address}"\noptions = {as_toml(options)}\n'


@contextlib.asynccontextmanager
async def _open_to_all() -> AsyncIterator[DemoBus]:
    """Open the embedded router, at Zenoh's usual port if that is free."""
    for endpoint in (LOCAL_ROUTER, f"tcp/127.0.0.1:{free_port()}"):
        try:
            bus = await open_bus(BusSettings(mode="router", listen=(endpoint,), multicast=False), Metrics())
            break
        except BusError:
            continue
    else:
        raise BusError("no port for the embedded router")
    table = f'[bus]\nmode = "client"\nconnect = ["{endpoint}"]\nmulticast = false\n'
    try:
        commands = (f"zbridge ls --sessions --connect {endpoint}",)
        yield DemoBus(endpoint, bus, Fleet(bus, REALM), lambda robot: table, commands, ("--connect", endpoint))
    finally:
        await bus.close()


@contextlib.asynccontextmanager
async def _robot(
    folder: Path, log: IO[bytes], robot: str, protocol: str, listener: str, bus: str
) -> AsyncIterator[tuple[asyncio.subprocess.Process, asyncio.subprocess.Process]]:
    """Run a simulator and its gateway with a listener; yield both processes. bus: the ``[bus]`` table."""
    found = find_protocol(protocol)
    listen, options = found.links * ("--listen", "tcp://127.0.0.1:0"), found.simulated
    async with process(log, "simulate", protocol, *listen, read=True) as simulator:
        assert simulator.stdout is not None
        line = b""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(START_S):
                line = await simulator.stdout.readline()
        addresses = [word for word in line.decode().split() if word.startswith("tcp://")]
        if not addresses:
            raise ZbridgeError(f"the {protocol} simulator did not start")
        file = folder / f"{robot}.toml"
        serving = _listener(found, listener) if found.hq is not None else ""
        file.write_text(
            f'[robot]\nname = "{robot}"\n'
            f'[device]\nprotocol = "{protocol}"\nconnect = {as_toml(addresses)}\noptions = {as_toml(options)}\n'
            f"{serving}{bus}"
        )
        async with process(log, "run", str(file), state=folder) as gateway:
            yield simulator, gateway


async def _show(fleet: Fleet, watch: LiveTable, seconds: float, how: list[str]) -> None:
    """Print how to take part, draw the table, and drive each robot until somebody else does."""
    for line in how:
        print(line, flush=True)  # noqa: T201
    loop = asyncio.get_running_loop()
    started = loop.time()
    wandering = [asyncio.create_task(wander(fleet[robot])) for robot in watch.rows]
    try:
        console = Console(width=None if sys.stdout.isatty() else _PIPED)
        with Live(console=console, auto_refresh=False) as live:
            while not seconds or loop.time() - started < seconds:
                await asyncio.sleep(REFRESH_S)
                live.update(watch.table(REFRESH_S, console.width), refresh=True)
    finally:
        for task in wandering:
            task.cancel()
        await asyncio.gather(*wandering, return_exceptions=True)


async def wander(robot: Robot) -> None:
    """Drive straight on, turn, and so on, until somebody else takes the robot, or stops it.

    If this program was paused meanwhile, the robot was stopped, and the program starts over: with a neutral, or with a
    new lease if the pause was longer than the lease. It waits for a robot that accepts no commands now.
    """
    with contextlib.suppress(Refused, BusError):
        while True:
            try:
                async with robot.control("demo", priority=PRIORITY, wait_s=START_S) as drive:
                    for motion in itertools.cycle(FIGURE):
                        try:
                            await drive.during(FIGURE_S, **motion)
                        except NeutralFirst:
                            with contextlib.suppress(NotReady):
                                await drive.neutral()
                        except NotReady:
                            await asyncio.sleep(REFRESH_S)
            except LeaseLost as loss:
                if not loss.expired:
                    raise
