"""Situations for breaks of the product that nothing noticed: they were chosen by who had not read the rules."""

from __future__ import annotations

import random
from collections.abc import Callable

from tests.simulated.steps import WHEELS, Made, drive, fault, split


def _client(made: Made) -> None:
    """Let the first program be the Python client, which dates its commands and renews its lease."""
    made["drivers"][0] |= {"options": {}, "router": "router1"}


def _cut_when_granted(rng: random.Random, made: Made) -> None:
    """A program's link stalls just after it was granted the lease; it drives on, and all of it arrives at once."""
    _client(made)
    after = rng.choice((0.0, 0.0, 0.0002, 0.05))
    cut = fault(2.5, "cut", between=["pc1", "router1"], when="granted", after=after)
    made["steps"] = [drive(3.0, "op1", hz=20.0) | {"for": 5.0}, cut | {"for": rng.uniform(0.8, 2.2)}]


def _suspended_while_held(rng: random.Random, made: Made) -> None:
    """A gateway's machine is suspended while the holder does not drive; the holder drives when it is awake."""
    _client(made)
    t = rng.uniform(4.0, 5.0)
    quiet_s = t - 3.0 + rng.uniform(0.3, 1.5)
    suspend = fault(t, "suspend", target="gw1") | {"for": rng.uniform(0.3, 2.0)}
    made["steps"] = [drive(3.0, "op1", quiet=quiet_s) | {"for": quiet_s + 3.0}, suspend]


def _reset_while_held(rng: random.Random, made: Made) -> None:
    """The robot is lost while its holder does not drive; the holder drives when the robot is back."""
    _client(made)
    quiet_s = rng.uniform(5.0, 9.0)
    reset = fault(rng.uniform(5.0, 6.0), "reset", between=["robot", "gw1"])
    made["steps"] = [drive(3.0, "op1", quiet=quiet_s) | {"for": quiet_s + 3.0}, reset]


def _missed_a_fleet_latch(rng: random.Random, made: Made) -> None:
    """All robots are latched while this one's gateway is away; somebody asks for the robot when it is back.

    Perhaps the latch was released meanwhile, and one of the other gateways has missed that.
    """
    _client(made)
    made["others"] = [
        {"name": f"other{number}", "host": f"other{number}", "router": "router1", "robot": f"r{number}"}
        for number in (2, 3)
    ]
    released = rng.random() < 0.5
    away_s = rng.uniform(11.0, 13.0) if released else rng.uniform(4.0, 6.0)
    steps = [fault(4.0, "unlink", target="gw1") | {"for": away_s}]
    steps.append({"t": rng.uniform(4.5, 5.5), "who": "op1", "do": "latch", "fleet": True})
    if released:
        steps.append(fault(7.0, "unlink", target="other2") | {"for": 4.0})
        steps.append({"t": rng.uniform(8.0, 9.0), "who": "op1", "do": "unlatch", "fleet": True})
    made["steps"] = [*steps, drive(4.0 + away_s - rng.uniform(0.0, 1.0), "op2", takeover=True)]


def _rival_gone(rng: random.Random, made: Made) -> None:
    """Two gateways serve the robot, and meet; one of them is killed, and stays away."""
    steps = split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    healed_at = 3.5 + steps[0]["for"]
    kill = fault(healed_at + rng.uniform(1.5, 4.0), "kill", target=rng.choice(("gw1", "gw2"))) | {"for": 30.0}
    made["steps"] = [*steps, kill, drive(healed_at + 15.0, "op1")]


def _moves_an_arm(rng: random.Random, made: Made) -> None:
    """A program moves a motor that is none of the wheels, and says nothing more."""
    _client(made)
    made["robot"] = {"protocol": "wc2ec", "options": {"arm": True}, "device": WHEELS}
    ends = rng.choice(("kill", "pause", ""))
    t = rng.uniform(4.0, 6.0)
    made["steps"] = [drive(3.0, "op1", motor="arm", neutral=False) | {"for": t - 3.0 + (2.0 if ends else 0.0)}]
    if ends:
        made["steps"].append(fault(t, ends, target="op1") | {"for": 4.0})


def _late_start(rng: random.Random, made: Made) -> None:
    """A robot asks for datagrams late, while it is driven: it sleeps, and must get nothing but the stop after it."""
    _client(made)
    options = {"version": rng.choice(("1.1", "1.3", "1.4")), "udp": True, "starts_s": rng.uniform(3.0, 5.0)}
    made["robot"] = {"protocol": "tcpudp", "options": options, "device": {}}
    made["steps"] = [drive(3.0, "op1") | {"for": 5.0}]


def _stop_into_a_cut(rng: random.Random, made: Made) -> None:
    """Somebody stops a robot that is stopped already, and nothing of this arrives, though ``control`` does."""
    made["drivers"][1] |= {"router": "router2"}
    what = rng.choice(("stop", "latch"))
    cut = fault(5.9, "cut", between=["pc2", "router2"], both=False) | {"for": rng.uniform(4.0, 6.0)}
    made["steps"] = [{"t": 4.0, "who": "op1", "do": "stop"}, cut, {"t": 6.0, "who": "op2", "do": what}]


FOUND: tuple[Callable[[random.Random, Made], None], ...] = (
    _cut_when_granted,
    _cut_when_granted,
    _suspended_while_held,
    _reset_while_held,
    _missed_a_fleet_latch,
    _missed_a_fleet_latch,
    _rival_gone,
    _moves_an_arm,
    _late_start,
    _stop_into_a_cut,
)
