"""Measure what mutual TLS costs: the same gateway behind the same router, in plain TCP and with certificates.

    python -m tests.benchmarks.secure                   # latency and CPU, then 200 sessions whose router restarts
    python -m tests.benchmarks.secure --turns 3 --sessions 20

Run it on a machine that does nothing else. Positions at 1 000 Hz go from a robot through a gateway and ``zbridge
router`` to a consumer, all processes of their own. Both ways live all the time and take turns of two seconds; ratios
are those of one turn, the median of the turns counts. CPU is that of gateway and router together. Then sessions with
certificates of their own, each with a liveliness token and the wildcards of a gateway, lose their router: the time is
from the moment at which the new router listens to the one at which an observer sees all tokens again.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import zenoh

from tests.access import COLUMNS
from tests.benchmarks.harness import Process, cpu_s, process
from tests.benchmarks.paced import FULL, Lane, Plan, interval
from tests.benchmarks.peer import ROBOT
from tests.certificates import Authority
from tests.e2e.rigs.secure import FAR, SecureBus
from tests.ports import free_port
from zbridge.security.roles import Member, Roles, save_roles

RATE_HZ = 1000.0
TURNS, SESSIONS = 7, 200
WAIT_S = 60.0
MEMBERS = Roles({"hub": Member("router"), "g1": Member("gateway", (ROBOT,)), "eye": Member("viewer")})
_PACKAGE = "tests.benchmarks"


class Way:
    """One way from robot to consumer: plain, or with the certificates of an authority."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, authority: Authority | None) -> None:
        endpoint = f"{'tcp' if authority is None else 'tls'}/127.0.0.1:{free_port()}"
        folders = {name: authority.issue(MEMBERS.common_name(name)) for name in MEMBERS.names} if authority else {}
        folder.mkdir()
        save_roles(folder / "roles.toml", MEMBERS)
        secure = ("--tls", folders["hub"], "--roles", folder / "roles.toml") if folders else ()
        self.router = stack.enter_context(process("zbridge", "router", "--listen", endpoint, *secure))
        _wait_for_port(int(endpoint.rpartition(":")[2]))
        sink = stack.enter_context(
            process(f"{_PACKAGE}.paced_peers", "client", "position", endpoint, folders.get("eye", ""))
        )
        sink.hear()
        source = stack.enter_context(process(f"{_PACKAGE}.paced_peers", "robot", "position"))
        file = folder / "gateway.toml"
        file.write_text(_configuration(source.hear()["port"], endpoint, folders.get("g1")))
        gateway: Process = stack.enter_context(process("zbridge", "run", file))
        start_s = (sink.hear()["first_ns"] - gateway.started_ns) / 1e9
        source.say("hold")
        source.hear()
        self.lane = Lane(source, gateway, sink, start_s)
        self.cpus_us: list[float] = []

    def run(self, plan: Plan) -> None:
        """Take one turn."""
        count, before_s = plan.count(RATE_HZ), self._cpu_s()
        self.lane.run(count, RATE_HZ)
        self.cpus_us.append((self._cpu_s() - before_s) / count * 1e6)

    def _cpu_s(self) -> float:
        return cpu_s(self.router.pid) + cpu_s(self.lane.tested.pid)


def _configuration(port: int, endpoint: str, folder: Path | None) -> str:
    files = ", ".join(f'{name} = "{folder}/{file}.pem"' for name, file in _FILES.items())
    return f"""
[robot]
name = "{ROBOT}"
[device]
protocol = "tcpudp"
connect = ["tcp://127.0.0.1:{port}"]
[bus]
connect = ["{endpoint}"]
multicast = false
{f"tls = {{ {files} }}" if folder is not None else ""}
"""


_FILES = {"ca": "ca", "certificate": "certificate", "key": "key"}


def _wait_for_port(port: int) -> None:
    end = time.monotonic() + WAIT_S
    while time.monotonic() < end:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        time.sleep(0.05)
    raise SystemExit(f"no router at port {port}")


def latency(turns: int) -> None:
    """Compare both ways, turn by turn."""
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        ways = [Way(stack, folder / "plain", None), Way(stack, folder / "tls", Authority(folder / "authority"))]
        time.sleep(1.0)
        for turn in range(turns + 1):
            for way in ways if turn % 2 else ways[::-1]:
                way.run(FULL)
        for way in ways:  # the first turn warms up
            del way.lane.slices[0], way.cpus_us[0]
        print(f"positions at {RATE_HZ:g} Hz through a router, {turns} turns")
        for name, way in zip(("plain", "tls"), ways, strict=True):
            lost = sum(each.lost for each in way.lane.slices)
            p50_us, p99_us = (way.lane.middle(lambda each, n=n: getattr(each, n)) for n in ("p50_us", "p99_us"))
            print(f"  {name:<6} p50 {p50_us:4.0f}, p99 {p99_us:5.0f}, CPU {median(way.cpus_us):4.0f} us, lost {lost}")
        plain, tls = ways
        for what, ours, theirs, most in (
            ("p50", [e.p50_us for e in tls.lane.slices], [e.p50_us for e in plain.lane.slices], 1.15),
            ("CPU", tls.cpus_us, plain.cpus_us, 1.3),
        ):
            ratios = [one / other for one, other in zip(ours, theirs, strict=True)]
            low, high = interval(ratios)
            print(
                f"  {what} tls / plain {median(ratios):.2f} (95 %: {low:.2f} to {high:.2f}), at most {most}", flush=True
            )


@contextlib.contextmanager
def gateways(bus: SecureBus, names: list[str]) -> Iterator[None]:
    """Be as many gateways as there are names, each with a session of its own."""
    with contextlib.ExitStack() as stack:
        declared = []
        for name in names:
            session = stack.enter_context(bus.session(name))
            declared += [
                session.declare_subscriber(f"fleet/{name}/@cmd/**", lambda _: None),
                session.declare_queryable(f"fleet/{name}/@rpc/**", lambda query: query.drop()),
                session.liveliness().declare_token(f"fleet/{name}/@alive/gateway"),
            ]
        yield


def reconnections(count: int) -> None:
    """Restart the router of so many sessions."""
    names = [f"r{number}" for number in range(count)]
    base = {"main": Member("router"), COLUMNS["viewer"]: Member("viewer"), FAR: Member("router")}
    roles = Roles({**base, **{name: Member("gateway", (name,)) for name in names}})
    with tempfile.TemporaryDirectory() as folder:
        bus = SecureBus(Path(folder), roles)
        try:
            with gateways(bus, names), bus.session(FAR) as observer:
                begun = time.monotonic()
                seen_s = [_all_seen_s(observer, count, begun)]
                for _ in range(3):
                    bus.stop()
                    time.sleep(1.0)
                    bus.start(roles)
                    seen_s.append(_all_seen_s(observer, count, time.monotonic()))
        finally:
            bus.stop()
    print(f"{count} sessions, the router restarts: all are back after {', '.join(f'{s:.1f}' for s in seen_s[1:])} s")
    print("  at most 5 s")


def _all_seen_s(observer: zenoh.Session, count: int, begun: float) -> float:
    while time.monotonic() - begun < WAIT_S:
        alive = {str(reply.ok.key_expr) for reply in observer.liveliness().get("fleet/*/@alive/gateway") if reply.ok}
        if len(alive) == count:
            return time.monotonic() - begun
        time.sleep(0.05)
    raise SystemExit(f"only {len(alive)} of {count} sessions came back within {WAIT_S:g} s")


def main() -> None:
    """Run what the arguments say; this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--turns", type=int, default=TURNS)
    parser.add_argument("--sessions", type=int, default=SESSIONS)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    latency(arguments.turns)
    reconnections(arguments.sessions)


if __name__ == "__main__":
    main()
