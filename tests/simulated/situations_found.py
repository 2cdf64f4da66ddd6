"""Situations for breaks of the product that nothing noticed: they were chosen by who had not read the rules."""

from __future__ import annotations

import random
from collections.abc import Callable

from tests.simulated.steps import WHEELS, Made, client, drive, fault, stick, tcpudp


def _cut_when_granted(rng: random.Random, made: Made) -> None:
    """A program's link stalls just after it was granted the lease; it drives on, and all of it arrives at once."""
    client(made)
    after = rng.choice((0.0, 0.0, 0.0002, 0.05))
    cut = fault(2.5, "cut", between=["pc1", "router1"], when="granted", after=after)
    made["steps"] = [drive(3.0, "op1", hz=20.0) | {"for": 5.0}, cut | {"for": rng.uniform(0.8, 2.2)}]


def _suspended_while_held(rng: random.Random, made: Made) -> None:
    """A gateway's machine is suspended while the holder does not drive; the holder drives when it is awake."""
    client(made)
    t = rng.uniform(4.0, 5.0)
    quiet_s = t - 3.0 + rng.uniform(0.3, 1.5)
    suspend = fault(t, "suspend", target="gw1") | {"for": rng.uniform(0.3, 2.0)}
    made["steps"] = [drive(3.0, "op1", quiet=quiet_s) | {"for": quiet_s + 3.0}, suspend]


def _reset_while_held(rng: random.Random, made: Made) -> None:
    """The robot is lost while its holder does not drive; the holder drives when the robot is back."""
    client(made)
    quiet_s = rng.uniform(5.0, 9.0)
    reset = fault(rng.uniform(5.0, 6.0), "reset", between=["robot", "gw1"])
    made["steps"] = [drive(3.0, "op1", quiet=quiet_s) | {"for": quiet_s + 3.0}, reset]


def _missed_a_fleet_latch(rng: random.Random, made: Made) -> None:
    """All robots are latched while this one's gateway is away; somebody asks for the robot when it is back.

    Perhaps the latch was released meanwhile, and one of the other gateways has missed that.
    """
    client(made)
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


def _moves_an_arm(rng: random.Random, made: Made) -> None:
    """A program moves a motor that is none of the wheels, and says nothing more."""
    client(made)
    made["robot"] = {"protocol": "wc2ec", "options": {"arm": True}, "device": WHEELS}
    ends = rng.choice(("kill", "pause", "pause"))
    t = rng.uniform(4.0, 6.0)
    motor = {"motor": "arm", "way": rng.choice(("forward", "back", "back"))}
    made["steps"] = [drive(3.0, "op1", **motor, neutral=False) | {"for": t - 3.0 + (2.0 if ends else 0.0)}]
    if ends:
        made["steps"].append(fault(t, ends, target="op1") | {"for": 4.0})


def _late_start(rng: random.Random, made: Made) -> None:
    """A robot asks for datagrams late, while it is driven: it sleeps, and must get nothing but the stop after it."""
    client(made)
    options = {"version": rng.choice(("1.1", "1.3", "1.4")), "udp": True, "starts_s": rng.uniform(3.0, 5.0)}
    made["robot"] = {"protocol": "tcpudp", "options": options, "device": {}}
    made["steps"] = [drive(3.0, "op1") | {"for": 5.0}]


def _stop_into_a_cut(rng: random.Random, made: Made) -> None:
    """Somebody stops a robot that is stopped already, and nothing of this arrives, though ``control`` does."""
    made["drivers"][1] |= {"router": "router2"}
    what = rng.choice(("stop", "latch"))
    cut = fault(5.9, "cut", between=["pc2", "router2"], both=False) | {"for": rng.uniform(4.0, 6.0)}
    made["steps"] = [{"t": 4.0, "who": "op1", "do": "stop"}, cut, {"t": 6.0, "who": "op2", "do": what}]


def _stopped_before_mode_3(rng: random.Random, made: Made) -> None:
    """Somebody chooses mode 3 on a gateway whose disk is slow, and loses the lease before the mode is written."""
    tcpudp(rng, made)
    client(made)
    made["drivers"][1] |= {"router": "router1"}
    ends = rng.choice(("stop", "latch", "takeover", "kill"))
    meanwhile = {"t": 4.5, "when": "mode unwritten", "after": rng.uniform(0.0, 0.15)}
    if ends == "kill":
        meanwhile |= fault(4.5, "kill", target="op1") | {"for": 4.0}
    elif ends == "takeover":
        meanwhile |= {"who": "op2", "do": "drive", "for": 0.5, "silent": True, "takeover": True}
    else:
        meanwhile |= {"who": "op2", "do": ends}
    slow = fault(4.0, "threads", target="gw1", by=0.6) | {"for": 6.0}
    choice = drive(5.0, "op1", mode="autonomous", silent=True, then=None, holds=2.0)
    made["steps"] = [slow, choice, meanwhile, {"t": 9.0, "who": "op2", "do": "stop"}]


def _wiggled_over_a_short_cut(rng: random.Random, made: Made) -> None:
    """An HQ program of a short deadman wiggles its stick while its network is cut, for less than its lease lasts."""
    gateway, t = stick(rng, made, alone=rng.random() < 0.5), 5.0
    protocol = "alf" if made["robot"]["protocol"] == "alf" else rng.choice(("alf", "wc2ec"))
    gateway["hq"], made["programs"][0]["protocol"] = [protocol], protocol
    cut_s = rng.uniform(1.4, 2.6)
    cut = fault(t, "cut", between=["desk1", gateway["host"]], both=True) | {"for": cut_s}
    made["steps"] = [drive(3.5, "stick1") | {"for": 1.8}, cut]
    while t < 5.0 + cut_s - 1.2:
        t += rng.uniform(0.35, 0.6)
        made["steps"].append(drive(t, "stick1") | {"for": rng.uniform(0.1, 0.2)})
    made["steps"].append(drive(5.0 + cut_s - rng.uniform(0.1, 0.3), "stick1") | {"for": 2.5})


def _lost_while_stalled(rng: random.Random, made: Made) -> None:
    """The link to the robot stalls, and its connection is reset before it recovers; somebody drives again."""
    t = rng.uniform(4.0, 5.0)
    cut_s = rng.uniform(1.2, 3.0)
    cut = fault(t, "cut", between=["robot", "gw1"]) | {"for": cut_s}
    reset = fault(t + rng.uniform(0.6, cut_s), "reset", between=["robot", "gw1"])
    made["steps"] = [drive(3.0, "op1"), cut, reset, drive(t + cut_s + 4.0, "op2", takeover=True)]
    if made["robot"]["protocol"] == "tcpudp":
        made["robot"]["options"]["udp"] = False


def _latched_late(rng: random.Random, made: Made) -> None:
    """Somebody who latches is cut off before it is confirmed; what is repeated arrives after somebody released it."""
    for each, router in zip(made["drivers"], ("router1", "router2"), strict=True):
        each |= {"options": {}, "router": router}
    t, fleet = rng.uniform(4.0, 5.0), rng.random() < 0.2
    after = rng.uniform(0.0, 0.3) if fleet else 0.0
    cut = fault(3.5, "cut", between=["pc2", "router2"], when="stop unwritten", after=after)
    release = {"who": "op1", "do": "unlatch", "fleet": fleet}
    made["steps"] = [cut | {"for": rng.uniform(1.5, 2.7)}, {"t": t, "who": "op2", "do": "latch", "fleet": fleet}]
    made["steps"] += [release | {"t": t + 0.7}, drive(t + 6.0, "op1")]


def _cut_after_long(rng: random.Random, made: Made) -> None:
    """A program that has driven for long is cut off for less than its deadman; all that it sent arrives at once."""
    client(made)
    t = rng.uniform(24.0, 34.0)
    cut = fault(t, "cut", between=["pc1", "router1"]) | {"for": rng.uniform(0.9, 1.6)}
    made["steps"] = [drive(2.0, "op1", hz=20.0, deadman_s=2.0, wiggles=rng.random() < 0.3) | {"for": t + 2.0}, cut]


def _stop_while_away(rng: random.Random, made: Made) -> None:
    """Somebody stops a robot that its gateway cannot reach, and tries to."""
    client(made)
    made["drivers"][1] |= {"options": {}, "router": "router1"}
    cut = fault(3.0, "cut", between=["robot", "gw1"], both=True) | {"for": 30.5}
    reset = fault(3.1, "reset", between=["robot", "gw1"])
    stops = [{"t": 10.0 + 2.0 * number + rng.random(), "who": "op2", "do": "stop"} for number in range(12)]
    made["steps"] = [cut, reset, *stops]


def _light_after_a_stop(rng: random.Random, made: Made) -> None:
    """Somebody without a lease switches the light of a vehicle whose driver was stopped."""
    dialect = rng.choice(("text", "binary"))
    made["robot"] = {"protocol": "alf", "options": {"dialect": dialect}, "device": {"dialect": dialect}}
    ends = rng.choice(("stop", "latch", "kill", ""))
    t = rng.uniform(4.0, 5.0)
    made["steps"] = [drive(3.0, "op1", hz=20.0, neutral=False) | {"for": t - 3.0 + (2.0 if ends else 0.0)}]
    if ends == "kill":
        made["steps"].append(fault(t, "kill", target="op1") | {"for": 4.0})
    elif ends:
        made["steps"].append({"t": t, "who": "op2", "do": ends})
    made["steps"] += [{"t": t + after, "who": "op2", "do": "light"} for after in (0.7, 1.3, 1.9, 2.5, 3.0)]


def _garbled_stop(rng: random.Random, made: Made) -> None:
    """Somebody stops a driven robot with a text that is no UTF-8."""
    made["steps"] = [drive(3.0, "op1", hz=20.0) | {"for": 8.0}]
    made["steps"] += [{"t": rng.uniform(4.0, 7.0), "who": "op2", "do": "garbled stop"}]


def _backwards(rng: random.Random, made: Made) -> None:
    """A program drives backwards, sideways or turns, and is killed, or says nothing more while it holds the lease."""
    made["drivers"][0] |= {"options": {"client": False, "dated": rng.random() < 0.5}, "router": "router1"}
    ways = ("back", "left", "right", "turn left", "turn right")
    way = "back" if made["robot"]["protocol"] == "wc2ec" else rng.choice(ways)
    if made["robot"]["protocol"] == "alf":
        tcpudp(rng, made)
    t = rng.uniform(4.0, 5.0)
    ends = rng.choice(("kill", "pause", ""))
    made["steps"] = [
        drive(3.0, "op1", way=way, neutral=False, releases=False) | {"for": t - 3.0 + (2.0 if ends else 0.0)},
        drive(t + 2.5, "op2", way=way, takeover=True) | {"for": 1.0},
    ]
    if ends:
        made["steps"].append(fault(t, ends, target="op1") | {"for": 4.0})


def _late_and_silent(rng: random.Random, made: Made) -> None:
    """What a program that dates said last comes late, and it says nothing more: its deadman counts from its clock."""
    made["drivers"][0] |= {"options": {"client": False, "dated": True}, "router": "router1"}
    made["network"] = {"delay_s": 0.0005, "jitter_s": 0.0005}
    t = rng.uniform(4.0, 5.0)
    last = drive(3.0, "op1", hz=20.0, deadman_s=0.5, neutral=False, releases=False) | {"for": t - 3.0}
    made["steps"] = [last]
    made["steps"].append(fault(t - 0.3, "slow", between=["pc1", "router1"], by=rng.uniform(0.2, 0.3)) | {"for": 3.0})


def _frozen_program(rng: random.Random, made: Made) -> None:
    """An HQ program is frozen while it pushes; its machine still acknowledges."""
    gateway = stick(rng, made, alone=rng.random() < 0.5)
    if rng.random() < 0.5:
        gateway["hq"], made["programs"][0]["protocol"] = ["wc2ec"], "wc2ec"
    freeze = fault(rng.uniform(4.5, 6.0), "pause", target="stick1") | {"for": rng.uniform(2.0, 4.0)}
    made["steps"] = [drive(3.5, "stick1") | {"for": 6.0}, freeze]


def _controller_that_computes(rng: random.Random, made: Made) -> None:
    """An external controller sets velocities once, and computes (``hold``); it is frozen, cut off or disconnects."""
    gateway = stick(rng, made, alone=rng.random() < 0.5)
    gateway["hq"], gateway["hold"] = ["wc2ec"], True
    made["programs"][0] |= {"protocol": "wc2ec", "options": {"once": True}}
    t = rng.uniform(5.0, 6.0)
    ends = rng.choice(("cut", "cut", "leave", "pause"))
    made["steps"] = [drive(3.5, "stick1") | {"for": rng.uniform(3.0, 8.0)}]
    if ends == "cut":
        cut = fault(t, "cut", between=["desk1", gateway["host"]]) | {"for": rng.uniform(2.0, 5.0)}
        made["steps"].append(cut)
    elif ends == "leave":
        made["steps"].append({"t": t, "who": "stick1", "do": "leave"})
    else:
        made["steps"].append(fault(t, ends, target=gateway["name"]) | {"for": rng.uniform(0.3, 2.0)})


def _wheels_deflected_at_rest(rng: random.Random, made: Made) -> None:
    """An HQ program of ALF rests with its wheels deflected, which turns no robot of another protocol."""
    if made["robot"]["protocol"] == "alf":
        tcpudp(rng, made)
    gateway = stick(rng, made, alone=rng.random() < 0.5)
    gateway["hq"] = ["alf"]
    made["programs"][0] |= {"protocol": "alf", "options": {"deflected": rng.choice((-60, 45))}}
    made["steps"] = [drive(3.5, "stick1") | {"for": rng.uniform(0.5, 3.0)}]
    made["steps"].append(drive(9.0, "stick1") | {"for": rng.uniform(0.5, 3.0)})


def _killed_before_the_disk(rng: random.Random, made: Made) -> None:
    """A gateway whose disk is slow is killed about when its robot is told to drive itself, and starts again."""
    tcpudp(rng, made)
    made["robot"]["options"] |= {"lossless": True}
    made["robot"]["options"].pop("self_stop_s", None)
    client(made)
    slow = fault(3.5, "threads", target="gw1", by=0.4) | {"for": 3.0}
    choice = drive(4.0, "op1", mode="autonomous", silent=True, then=None) | {"for": 9.0}
    kill = fault(3.9, "kill", target="gw1", when="mode read", after=round(rng.uniform(0.005, 0.2), 3))
    made["steps"] = [slow, choice, kill | {"for": rng.uniform(0.2, 2.0)}]


def _one_wheel_is_let_go(rng: random.Random, made: Made) -> None:
    """A program pushes two motors, falls silent, and its link stalls; then it says neutral for one of them only."""
    made["robot"] = {"protocol": "wc2ec", "options": {}, "device": WHEELS}
    made["drivers"][0] |= {"options": {"client": False, "dated": rng.random() < 0.5}, "router": "router1"}
    made["steps"] = [drive(3.0, "op1", wheels=True) | {"for": rng.uniform(2.0, 2.5)}]
    made["steps"].append(fault(rng.uniform(4.9, 5.2), "cut", between=["robot", "gw1"]) | {"for": rng.uniform(0.7, 1.5)})


def _one_wheel_pushed(rng: random.Random, made: Made) -> None:
    """An external controller turns a robot on one wheel when somebody stops it, and continues."""
    made["robot"] = {"protocol": "wc2ec", "options": {}, "device": WHEELS}
    gateway = stick(rng, made, alone=rng.random() < 0.5)
    gateway["hq"] = ["wc2ec"]
    made["programs"][0] |= {"protocol": "wc2ec", "options": {"one": True}}
    stop = {"t": rng.uniform(5.0, 6.0), "who": "op1", "do": "stop"}
    made["steps"] = [drive(3.5, "stick1") | {"for": 6.0}, stop]


def _latched_before_the_disk(rng: random.Random, made: Made) -> None:
    """A gateway whose disk is slow is killed about when its robot is latched; somebody else asks for the robot."""
    for each in made["drivers"]:
        each |= {"options": {}, "router": "router1"}
    slow = fault(3.5, "threads", target="gw1", by=1.2) | {"for": 3.0}
    kill = fault(3.9, "kill", target="gw1", when="stop unwritten", after=round(rng.uniform(0.1, 0.4), 3))
    latch = {"t": 4.0, "who": "op2", "do": "latch"}
    made["steps"] = [slow, latch, kill | {"for": rng.uniform(0.2, 1.0)}]
    made["steps"] += [drive(t, "op1") | {"for": 1.0} for t in (6.5, 8.5, 10.5)]


def _killed_listener(rng: random.Random, made: Made) -> None:
    """The process of a listener is killed while its program drives, and stays away."""
    gateway = stick(rng, made, alone=True)
    made["steps"] = [drive(3.5, "stick1") | {"for": 6.0}]
    made["steps"].append(fault(rng.uniform(5.0, 6.0), "kill", target=gateway["name"]) | {"for": 5.0})


FOUND: tuple[Callable[[random.Random, Made], None], ...] = (
    _cut_when_granted,
    _cut_when_granted,
    _suspended_while_held,
    _reset_while_held,
    _missed_a_fleet_latch,
    _missed_a_fleet_latch,
    _moves_an_arm,
    _late_start,
    _stop_into_a_cut,
    _stopped_before_mode_3,
    _wiggled_over_a_short_cut,
    _lost_while_stalled,
    _latched_late,
    _cut_after_long,
    _stop_while_away,
    _light_after_a_stop,
    _garbled_stop,
    _backwards,
    _late_and_silent,
    _frozen_program,
    _controller_that_computes,
    _wheels_deflected_at_rest,
    _killed_before_the_disk,
    _one_wheel_is_let_go,
    _one_wheel_pushed,
    _latched_before_the_disk,
    _killed_listener,
)
