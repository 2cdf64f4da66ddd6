"""Situations in which two gateways serve one robot, or a gateway restarts."""

from __future__ import annotations

import random
from collections.abc import Callable

from tests.simulated.steps import Made, client, drive, fault, second_gateway, split, tcpudp


def _rival_gone(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and meet; one of them is killed, and stays away."""
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    healed_at = 3.5 + steps[0]["for"]
    kill = fault(healed_at + rng.uniform(1.5, 4.0), "kill", target=rng.choice(("gw1", "gw2"))) | {"for": 30.0}
    made["steps"] = [*steps, kill, drive(healed_at + 15.0, "op1")]


def _owner_without_robot(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and meet; then the way between the robot and one of them is cut for long."""
    tcpudp(rng, made)
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    t = 3.5 + steps[0]["for"] + rng.uniform(5.0, 6.0)
    cut = fault(t, "cut", between=["robot", rng.choice(("gw1", "gw1", "gw2"))]) | {"for": rng.uniform(10.0, 14.0)}
    made["steps"] = [*steps, cut, *(drive(t + rng.uniform(8.0, 9.0), who) for who in ("op1", "op2"))]


def _both_drive_and_meet(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and each drives it when they meet; the one that stays drives on."""
    tcpudp(rng, made)
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    t = 3.5 + steps[0]["for"] - 1.0
    made["steps"] = [*steps, *(drive(t, who) | {"for": 6.0} for who in ("op1", "op2"))]


def _latched_while_restarting(rng: random.Random, made: Made) -> None:
    """Somebody latches a robot whose gateway is handing everything over; somebody else asks for the robot then."""
    for each in made["drivers"]:
        each |= {"options": {}, "router": "router1"}
    made["network"] = {"delay_s": 0.0005, "jitter_s": 0.0005}
    steps: list[Made] = []
    for number in range(5):
        t = 4.0 + 5.0 * number
        steps.append(fault(t, "restart", target="gw1"))
        latch = {"t": t, "who": "op1", "do": "latch", "fleet": rng.random() < 0.3}
        when = rng.choice(("Hello unsent", "Hello sent", "Hello got"))
        steps.append(latch | {"when": when, "after": round(rng.uniform(0.0, 0.001), 5)})
        steps.append(drive(t + 1.5, "op2", takeover=True) | {"for": 1.0})
        steps += [{"t": t + 3.5 + 0.5 * fleet, "who": "op1", "do": "unlatch", "fleet": bool(fleet)} for fleet in (0, 1)]
    made["steps"] = steps


def _yielded_without_bus(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and meet; then one of them loses its bus, while the robot is driven."""
    tcpudp(rng, made)
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    t = 3.5 + steps[0]["for"] + rng.uniform(5.0, 6.0)
    steps += [drive(t - 1.0, who) | {"for": 8.0} for who in ("op1", "op2")]
    made["steps"] = [*steps, fault(t, "unlink", target=rng.choice(("gw1", "gw2"))) | {"for": rng.uniform(3.0, 8.0)}]


def _latched_and_owner_gone(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and meet; it is latched, and the one that serves it is killed."""
    tcpudp(rng, made)
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    t = 3.5 + steps[0]["for"] + 5.0
    latches = [{"t": t, "who": who, "do": "latch"} for who in ("op1", "op2")]
    made["steps"] = [*steps, *latches, fault(t + rng.uniform(2.0, 3.0), "kill", target="owner") | {"for": 30.0}]
    made["steps"] += [drive(t + after, who) for after in (6.0, 9.0) for who in ("op1", "op2")]


def _waits_and_learns(rng: random.Random, made: Made) -> None:
    """A robot drives itself when its gateway is killed, and the one that waits, which was asked of it, serves it."""
    tcpudp(rng, made)
    made["robot"]["options"].pop("self_stop_s", None)
    second_gateway(made)
    client(made)
    choice = drive(4.0, "op1", mode="autonomous", silent=True, then=None) | {"for": 9.0}
    kill = fault(3.9, "kill", target="owner", when="mode read", after=round(rng.uniform(1.0, 2.5), 3))
    made["steps"] = [choice, kill | {"for": 12.0}]


def _silent_to_the_owner(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and meet; then the robot sends the owner nothing more, and still hears it."""
    tcpudp(rng, made)
    made["robot"]["options"]["udp"] = False
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    t = 3.5 + steps[0]["for"] + rng.uniform(5.0, 6.0)
    mute = fault(t, "mute", target="owner") | {"for": rng.uniform(12.0, 16.0)}
    made["steps"] = [*steps, mute, *(drive(t + rng.uniform(8.0, 9.0), who) for who in ("op1", "op2"))]


def _two_latches(rng: random.Random, made: Made) -> None:
    """Two people latch a robot of two gateways; one releases a stop at one of them while they are cut off."""
    steps = split(rng, made, t=5.0, s=rng.uniform(10.0, 12.0))
    for each in made["drivers"]:
        each["options"] = {}
    healed_at = 5.0 + steps[0]["for"]
    steps += [{"t": t, "who": "op1", "do": "latch"} for t in (4.0, 12.5)]
    steps.append({"t": 13.5, "who": "op2", "do": "unlatch"})
    made["steps"] = [*steps, *(drive(healed_at + 2.5, who) | {"for": 2.0} for who in ("op1", "op2"))]


def _undone_restart(rng: random.Random, made: Made) -> None:
    """A successor dies when it has everything; another gateway waits for the robot."""
    second_gateway(made)
    made["steps"] = []
    for number, gateway in enumerate(("gw1", "gw2")):
        t = 9.0 + 12 * number
        when = rng.choice(("Up sent", "Up got", "Go unsent"))
        made["steps"] += [fault(t, "restart", target=gateway), fault(t, "kill", target=f"{gateway}+", when=when)]
        made["steps"] += [drive(t + 2.0, who, takeover=True) | {"for": 2.0} for who in ("op1", "op2")]


OF_TWO_GATEWAYS: tuple[Callable[[random.Random, Made], None], ...] = (
    _rival_gone,
    _owner_without_robot,
    _both_drive_and_meet,
    _latched_while_restarting,
    _yielded_without_bus,
    _latched_and_owner_gone,
    _waits_and_learns,
    _silent_to_the_owner,
    _two_latches,
    _undone_restart,
)
