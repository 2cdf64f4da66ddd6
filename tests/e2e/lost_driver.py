"""A robot whose driver is lost: how long after the last motion that it was told does the robot get its stop?

    python -m tests.e2e.lost_driver                              # killed, frozen, cut 100 times; other ways 10 times
    python -m tests.e2e.lost_driver --way cut --deadman 0.5 --repetitions 20

The driver is a program on the bus that holds the lease, in a process of its own. Every command has a value of its own.
A driver is cut off by unplugging the network namespace that it runs in.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import random
import select
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgpack
import zenoh

from tests.e2e.conftest import until
from tests.e2e.loss import (
    LATE_S,
    SCALE,
    NotHereError,
    Result,
    Scene,
    Way,
    be_measurement,
    commander,
    configuration,
    cut_driver_off,
    freeze_driver,
    freeze_gateway,
    heading,
    kill_driver,
    let_driver_end,
    measured,
    measured_apart,
    mend_cable,
    query,
    thaw_driver,
)
from tests.proofs import Holder

DEADMAN_S = 0.2
LEASE_S = 1.0
FEW = 10
"""Repetitions of the ways that are measured for the documentation only."""


def be_driver(endpoint: str, deadman_s: float, rate_hz: float, first: int) -> None:
    """Acquire the lease and drive until stdin ends; then leave without a release."""
    with zenoh.open(configuration("client", [endpoint])) as session:
        alive = f"operator.driver.{session.zid()}"
        announced = session.liveliness().declare_token(f"fleet/r1/@alive/{alive}")
        wishes = {"who": f"driver.{first}", "deadman_s": deadman_s, "lease_s": LEASE_S, "alive": alive}
        lease: dict[str, Any] = {}
        while not lease.get("ok"):
            lease = query(session, "@rpc/control/acquire/driver", **wishes)
            if select.select([sys.stdin], [], [], 0.0 if lease.get("ok") else 0.02)[0]:
                return
        drive, held = commander(session, "drive"), Holder.of(lease)
        for number in itertools.count(first):
            command = msgpack.packb({"forward": number / SCALE})
            drive.put(command, attachment=held.attachment("drive", command))
            if select.select([sys.stdin], [], [], 1 / rate_hz)[0]:
                break
        announced.undeclare()


class DriverScene(Scene):
    """With a driver that is on the bus."""

    def __init__(self, stack: contextlib.ExitStack, *, cable: bool, deadman_s: float) -> None:
        super().__init__(stack, cable=cable)
        self.deadman_s = deadman_s
        self._firsts = (SCALE // 10 + number * 500 % (SCALE * 8 // 10) for number in itertools.count())

    def drive(self, rng: random.Random) -> int:
        begun = len(self.robot.frames)
        driver = ["-m", "tests.e2e.lost_driver", "--be", "driver"]
        wishes = map(str, (self.reach, self.deadman_s, rng.uniform(20, 50), next(self._firsts)))
        self.start_driver(sys.executable, *driver, *wishes)
        until(lambda: self.moved(begun) is not None, what="the robot moves")
        first = self.moved(begun)
        assert first is not None
        return first


def _take_over(scene: Scene) -> float:
    at = time.monotonic()
    lease = query(scene.session, "@rpc/control/takeover/supervisor", who="supervisor", lease_s=LEASE_S)
    if not lease.get("ok"):
        scene.faults.append(f"takeover refused: {lease}")
    return at


def _stop(scene: Scene) -> float:
    at = time.monotonic()
    scene.stop()
    return at


def _kill_router(scene: Scene) -> float:
    at = time.monotonic()
    scene.router.kill()
    return at


def _kill_gateway(scene: Scene) -> float:
    at = time.monotonic()
    scene.gateway.kill()
    return at


def _end_gateway(scene: Scene) -> float:
    at = time.monotonic()
    scene.gateway.terminate()
    return at


def _see_gateway_off(scene: Scene) -> None:
    code = scene.gateway.wait(timeout=5)
    if code != 0:
        scene.faults.append(f"the gateway ended with {code}")
    scene.restart_gateway()


WAYS: dict[str, Way[Scene]] = {
    "killed": Way(kill_driver, often=True),
    "frozen": Way(freeze_driver, thaw_driver, often=True),
    "cut": Way(cut_driver_off, mend_cable, often=True),
    "exited": Way(let_driver_end),
    "taken-over": Way(_take_over),
    "stopped": Way(_stop),
    "router-killed": Way(_kill_router, Scene.restart_router),
    "gateway-ended": Way(_end_gateway, _see_gateway_off),
    "gateway-killed": Way(_kill_gateway, Scene.restart_gateway, connection_ends=True),
    "gateway-frozen": Way(freeze_gateway, resumes=True),
}


def measure(way: str, *, repetitions: int, deadman_s: float = DEADMAN_S, seed: int = 1) -> Result:
    """Lose the driver in one way again and again; raise NotHereError where this machine does not allow it."""
    if way != "cut":
        return _measured(way, repetitions=repetitions, deadman_s=deadman_s, seed=seed)
    wishes = (way, repetitions, deadman_s, seed)
    (result,) = measured_apart("tests.e2e.lost_driver", *wishes, timeout_s=60 + 10 * repetitions)
    return result


def _measured(way: str, *, repetitions: int, deadman_s: float, seed: int) -> Result:
    resumes = WAYS[way].resumes
    result = Result(way, LATE_S if resumes else deadman_s + LATE_S, from_loss=resumes)
    with contextlib.ExitStack() as stack:
        scene = DriverScene(stack, cable=way == "cut", deadman_s=deadman_s)
        return measured(scene, WAYS[way], result, repetitions=repetitions, rng=random.Random(f"{way} {seed}"))


def results(ways: Iterable[str], *, repetitions: int, deadman_s: float, seed: int) -> Iterator[Result | str]:
    """Measure several ways; a text where one is not possible here."""
    for way in ways:
        count = repetitions if WAYS[way].often else min(repetitions, FEW)
        try:
            yield measure(way, repetitions=count, deadman_s=deadman_s, seed=seed)
        except NotHereError as error:
            yield f"{way:15} skipped: {error}"


def _be_measurement(way: str, repetitions: str, deadman_s: str, seed: str) -> None:
    wishes: dict[str, Any] = {"repetitions": int(repetitions), "deadman_s": float(deadman_s), "seed": int(seed)}
    be_measurement(lambda: [_measured(way, **wishes)])


_PARTS: dict[str, Callable[..., None]] = {
    "driver": lambda endpoint, *rest: be_driver(endpoint, float(rest[0]), float(rest[1]), int(rest[2])),
    "measurement": _be_measurement,
}


def main() -> None:
    if sys.argv[1:2] == ["--be"]:
        _PARTS[sys.argv[2]](*sys.argv[3:])
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=100)
    parser.add_argument("--deadman", type=float, default=DEADMAN_S)
    parser.add_argument("--way", choices=(*WAYS, "all"), default="all")
    parser.add_argument("--seed", type=int, default=os.getpid(), help="of the moments and rates")
    wanted = parser.parse_args()
    print(heading(), flush=True)
    ways = WAYS if wanted.way == "all" else (wanted.way,)
    failed = False
    for result in results(ways, repetitions=wanted.repetitions, deadman_s=wanted.deadman, seed=wanted.seed):
        print(result, flush=True)
        failed = failed or (isinstance(result, Result) and not result.clean)
    sys.exit(failed)


if __name__ == "__main__":
    main()
