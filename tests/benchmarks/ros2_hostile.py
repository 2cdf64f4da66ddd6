"""Hostile input from ROS's side at a high rate: ``python -m tests.benchmarks.ros2_hostile [--seconds S] [--rounds N]``.

First against ``zbridge ros2 --drive`` before fragile robots of every protocol, then against the gateway of a ROS 2
robot. Each attack comes from a process of its own. Printed: what it sent a second, the memory of the process that was
attacked before and after, its share of a core, what it counted, and how long a robot took to come to rest meanwhile.
Exit code 1 where a robot moved that nobody drove, or did not obey.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tests.benchmarks.harness import cpu_s
from tests.e2e.conftest import repeated
from tests.e2e.measured import ros_robot
from tests.e2e.rigs.processes import Part
from tests.e2e.rigs.ros2_scene import FRAGILE, SCAN, TWIST, FragileInFleet, RosScene
from tests.views.ros2.judge import DEFAULT, Publisher, Ros

STRING, TRIGGER, SET_BOOL = "std_msgs/msg/String", "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
NODES = 1000
CDR = b"\x00\x01\x00\x00"
FULL_SPEED = CDR + struct.pack("<6d", 0.5, 0, 0, 0, 0, 0)
DRIVEN, FORWARD_MPS, SPEED = "alf", 0.25, 0.5
CALM_S = 2.0
"""Seconds after an attack until its memory is looked at: what waits in queues is worked off."""
_PAGE = os.sysconf("SC_PAGE_SIZE")


# Attacks: each returns how many samples, tokens or calls it sent until its time was over.


class Attacker:
    """A process on ROS's side. topic: what it attacks, ``/r1/cmd_vel`` or ``/scan``; type_name: the type of it."""

    def __init__(self, endpoint: str, seconds: float, topic: str, type_name: str) -> None:
        self.ros = Ros(endpoint, "stranger")
        self.topic, self.type_name = topic, type_name
        self.key, _ = self.ros.names(topic, type_name)
        self.rng = random.Random(1)
        self._ends_at = time.monotonic() + seconds
        self.sent = 0

    def puts(self, samples: Iterator[tuple[bytes, bytes | None]], key: str = "") -> None:
        """Put samples, payload and attachment, as fast as that goes."""
        publisher = self.ros.session.declare_publisher(key or self.key)
        prepared = [next(samples) for _ in range(4096)]
        while time.monotonic() < self._ends_at:
            for payload, attachment in prepared:
                publisher.put(payload, attachment=attachment)
            self.sent += len(prepared)

    def known(self) -> bytes:
        """Declare a publisher with its token; give its gid."""
        self._publisher = self.ros.publisher(self.topic, self.type_name)
        return self._publisher.gid

    def repeat(self, act: Callable[[], int]) -> None:
        """Do something that counts, again and again."""
        while time.monotonic() < self._ends_at:
            self.sent += act()


def beside(gid: bytes, number: int = 1, length: int = 16) -> bytes:
    """Write an attachment."""
    return struct.pack("<qqB", number, time.time_ns(), length) + gid


def strangers(attacker: Attacker) -> None:
    """Whole messages from publishers without a token."""
    rng, payload = attacker.rng, whole(attacker)
    attacker.puts((payload, beside(rng.randbytes(16))) for _ in iter(int, 1))


def lying(attacker: Attacker) -> None:
    """Whole messages with attachments that are missing, short, long, or say what cannot be."""
    rng, payload, gid = attacker.rng, whole(attacker), attacker.known()
    lies = [
        *(None, b"", gid, beside(gid)[:-1], beside(gid) + b"\0", bytes(10_000), rng.randbytes(33)),
        *(beside(gid, -1), beside(gid, 1, 15), beside(gid, 1, 255), beside(bytes(16))),
    ]
    attacker.puts((payload, rng.choice(lies)) for _ in iter(int, 1))


def garbage(attacker: Attacker) -> None:
    """A known publisher's messages of random bytes, cut ones, other encodings, and numbers that are none."""
    rng, good, gid = attacker.rng, whole(attacker), attacker.known()
    nan = good[:-48] + struct.pack("<6d", *[float("nan")] * 6)
    kinds: list[Callable[[], bytes]] = [
        lambda: rng.randbytes(rng.randrange(60)),
        lambda: CDR + rng.randbytes(rng.randrange(60)),
        lambda: good[: rng.randrange(len(good))],
        lambda: b"\x00\x0b\x00\x00" + good[4:],
        lambda: nan,
        lambda: CDR + b"\xff" * 48,
    ]
    attacker.puts((rng.choice(kinds)(), beside(gid)) for _ in iter(int, 1))


def large(attacker: Attacker) -> None:
    """A known publisher's messages of 1 MB."""
    gid, payload = attacker.known(), CDR + bytes(2**20)
    attacker.puts((payload, beside(gid)) for _ in iter(int, 1))


def full(attacker: Attacker) -> None:
    """A known publisher's scans, right in every way, of 100 000 points each."""
    scan = scan_of(attacker.ros, 100_000)
    gid = attacker.known()
    attacker.puts((scan, beside(gid)) for _ in iter(int, 1))


def types(attacker: Attacker) -> None:
    """A thousand nodes whose publishers have other types and hashes, and their messages under those keys."""
    ros, place = attacker.ros, attacker.ros.place
    for number in range(NODES):
        name = f"{place[0]}/{number + 10}"
        ros.declare(f"{name}/NN/%/%/n{number}")
    wrong = [ros.publisher(attacker.topic, STRING) for _ in range(NODES // 2)]
    _, named = ros.names(attacker.topic, attacker.type_name)
    other = named.replace("RIHS01_", "RIHS01_0")[: len(named)]
    for number in range(NODES // 2):
        token = f"{place[0]}/{number + 5000}/MP/{place[1]}/{other}/{DEFAULT}"
        ros.declare(token)
    attacker.puts(((whole(attacker), beside(wrong[0].gid)) for _ in iter(int, 1)), wrong[0].key)


def churn(attacker: Attacker) -> None:
    """Publishers, right in every way, that come and go."""

    def come_and_go() -> int:
        publishers = [attacker.ros.publisher(attacker.topic, attacker.type_name) for _ in range(50)]
        for publisher in publishers:
            publisher.close()
        return len(publishers)

    attacker.repeat(come_and_go)


def calls(attacker: Attacker) -> None:
    """Requests of services that are none."""
    rng, ros, robot = attacker.rng, attacker.ros, attacker.topic.rpartition("/")[0]
    keys = [ros.names(f"{robot}/{name}", kind)[0] for name, kind in (("stop", TRIGGER), ("set_light", SET_BOOL))]
    attachments = [None, b"", bytes(32), rng.randbytes(33), beside(bytes(16), -1)]

    def call() -> int:
        payload, attachment = rng.randbytes(rng.randrange(100)), rng.choice(attachments)
        ros.session.get(rng.choice(keys), lambda reply: None, payload=payload, attachment=attachment, timeout=1.0)
        return 1

    attacker.repeat(call)


def whole(attacker: Attacker) -> bytes:
    """Give a message that is right in every way: a Twist that moves, or a scan."""
    return FULL_SPEED if attacker.type_name == TWIST else scan_of(attacker.ros, 360)


def scan_of(ros: Ros, points: int) -> bytes:
    """Write a scan."""
    import numpy as np

    types = ros.store.types
    stamp = types["builtin_interfaces/msg/Time"](int(time.time()), 0)
    header = types["std_msgs/msg/Header"](stamp, "laser")
    ranges = np.ones(points, np.float32)
    scan = types[SCAN](header, -3.1, 3.1, 6.2 / points, 0.0, 0.1, 0.1, 10.0, ranges, np.zeros(0, np.float32))
    return bytes(ros.store.serialize_cdr(scan, SCAN))


ATTACKS: dict[str, Callable[[Attacker], None]] = {
    attack.__name__: attack for attack in (strangers, lying, garbage, large, full, types, churn, calls)
}
ON_THE_VIEW = ("strangers", "lying", "garbage", "large", "types", "calls", "churn")
ON_A_GATEWAY = ("strangers", "lying", "garbage", "large", "full", "types", "churn")


# What is attacked


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE / 1e6


def attacked(
    pid: int, endpoint: str, attack: str, seconds: float, topic: str, type_name: str, meanwhile: Callable[[], str]
) -> str:
    """Attack, do something in the middle of it, and say what came of it."""
    before, used, began = memory_mb(pid), cpu_s(pid), time.monotonic()
    with contextlib.ExitStack() as stack:
        command = ("-m", "tests.benchmarks.ros2_hostile", "--attack", attack, endpoint, str(seconds), topic, type_name)
        part = Part(stack, sys.executable, *command)
        assert part.line() == "begins"
        time.sleep(seconds / 4)
        said = meanwhile()
        told = json.loads(part.rest(seconds + 60.0)[-1])
    share = (cpu_s(pid) - used) / (time.monotonic() - began)
    time.sleep(CALM_S)
    rate = told["sent"] / told["seconds"]
    return f"{attack}: {rate:.0f}/s, {before:.1f} MB, then {memory_mb(pid):.1f}, {share:.0%} of a core; {said}"


def on_the_view(seconds: float, attacks: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Attack the view; give a line and the faults of each attack.

    A driver whose commands come too late is stopped, which is no fault: routers of Zenoh pass on little while they work
    off tokens.
    """
    with contextlib.ExitStack() as stack:
        scene = RosScene(stack, Path(stack.enter_context(tempfile.TemporaryDirectory())))
        robots = {protocol: FragileInFleet(scene, protocol) for protocol in FRAGILE}
        driven = robots[DRIVEN]
        for attack in attacks:
            begun = time.monotonic()
            with scene.publishing(DRIVEN) as publisher, repeated(lambda: publisher.twist(FORWARD_MPS)):
                driven.moves(SPEED)

                def leave(publisher: Publisher = publisher) -> str:
                    at = time.monotonic()
                    publisher.hide()
                    return f"at rest {max(0.0, driven.rests() - at):.3f} s after its driver's end"

                at = time.monotonic()
                line = attacked(scene.view.pid, scene.ros_at, attack, seconds, "/tcpudp/cmd_vel", TWIST, leave)
            speeds = [speed for changed, speed in driven.changes if changed > at]
            moved = [name for name, robot in robots.items() if name != DRIVEN and robot.changes[-1][0] > begun]
            faults = [f"{name} moved" for name in moved]
            faults += [f"{DRIVEN} was told {speeds}"] * any(speed not in (0.0, SPEED) for speed in speeds)
            yield f"{line}; {scene.told('tcpudp: cmd_vel', '').replace('nobody drives ', '')}", faults


def on_a_gateway(seconds: float, attacks: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Attack the gateway of a ROS 2 robot; give a line and the faults of each attack."""
    with contextlib.ExitStack() as stack:
        scene = ros_robot.Scene(Path(stack.enter_context(tempfile.TemporaryDirectory())), stack)
        pid, fleet = scene.gateway.process.pid, scene.bench.fleet

        def stop() -> str:
            with scene.driven():
                at = time.monotonic()
                fleet.put("r1/@cmd/stop")
                return f"at rest {scene.rest_since(at):.3f} s after a stop"

        for attack in attacks:
            before = len(scene.robot.commands)
            line = attacked(pid, scene.router_at, attack, seconds, "/scan", SCAN, stop)
            (table,) = fleet.get("fleet/r1/@rpc/sessions/gateway")
            counted = {name: table["sessions"][0]["counters"][name] for name in ("malformed", "dropped")}
            speeds = {command.forward for command in scene.robot.commands[before:]}
            faults = [f"the robot was told {speeds}"] * (speeds != {0.0, ros_robot.FORWARD})
            faults += [f"{fleet.state()}: {fleet.reason()}"] * (fleet.state() != "established")
            yield f"{line}; {counted}", faults


def main() -> int:
    """Attack, print, and say whether all was as it should be."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="of each attack")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--of", choices=["view", "gateway"], help="default: both")
    parser.add_argument("--attacks", default=",".join(ATTACKS), help="some of %(default)s")
    wanted = parser.parse_args()
    good = True
    for name, measure, attacks in (("view", on_the_view, ON_THE_VIEW), ("gateway", on_a_gateway, ON_A_GATEWAY)):
        if wanted.of not in (None, name):
            continue
        print(f"{name}:", flush=True)
        chosen = [attack for attack in attacks if attack in wanted.attacks.split(",")]
        for line, faults in measure(wanted.seconds, chosen * wanted.rounds):
            print(f"  {line}", *(f"    FAULT {fault}" for fault in faults), sep="\n", flush=True)
            good = good and not faults
    return 0 if good else 1


def _attack(name: str, endpoint: str, seconds: str, topic: str, type_name: str) -> None:
    attacker, began = Attacker(endpoint, float(seconds), topic, type_name), time.monotonic()
    print("begins", flush=True)
    ATTACKS[name](attacker)
    print(json.dumps({"sent": attacker.sent, "seconds": time.monotonic() - began}), flush=True)
    os._exit(0)  # a thousand tokens go at once


if __name__ == "__main__":
    if sys.argv[1:2] == ["--attack"]:
        _attack(*sys.argv[2:])
    else:
        sys.exit(main())
