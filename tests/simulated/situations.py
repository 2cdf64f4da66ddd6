"""Situations that random steps seldom meet: what a rule needs to be put to the test, each with random times.

A situation sets who takes part, what they do and what fails, in a scenario that is otherwise random.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from tests.simulated.situations_found import FOUND
from tests.simulated.situations_gateways import OF_TWO_GATEWAYS
from tests.simulated.steps import Made
from tests.simulated.steps import drive as _drive
from tests.simulated.steps import fault as _fault
from tests.simulated.steps import second_gateway as _second_gateway
from tests.simulated.steps import split as _split
from tests.simulated.steps import stick as _stick


def arrange(rng: random.Random, made: Made, turn: int) -> None:
    """Turn a scenario into one of the situations, by turns."""
    made["steps"] = []
    situation = SITUATIONS[turn % len(SITUATIONS)]
    made["situation"] = situation.__name__.strip("_")
    situation(rng, made)
    for step in made["steps"]:
        step["t"] = round(step["t"], 2)
    made["steps"].sort(key=lambda step: step["t"])
    made["seconds"] = round(max(step["t"] for step in made["steps"]) + 8.0, 1)


def _silent_holder(rng: random.Random, made: Made) -> None:
    """A program holds the lease and says nothing, and another one takes over, or stops the robot."""
    made["drivers"][0]["options"] = {}
    step = _drive(3.0, "op1", silent=True, neutral=False) | {"for": 14.0}
    taken = _drive(rng.uniform(5.0, 7.0), "op2", takeover=True) | {"for": 2.0}
    made["steps"] = [step, taken if rng.random() < 0.6 else {"t": taken["t"], "who": "op2", "do": "stop"}]


def _stalled_link(rng: random.Random, made: Made) -> None:
    """The link to the robot stalls while the robot is driven, and the driver drives on."""
    t = rng.uniform(4.0, 5.0)
    cut = _fault(t, "cut", between=["robot", "gw1"], both=rng.random() < 0.7, **{"for": rng.uniform(0.7, 3.0)})
    made["steps"] = [_drive(3.0, "op1", hz=20.0, deadman_s=rng.choice((0.5, 1.0))) | {"for": 8.0}, cut]
    if made["robot"]["protocol"] == "tcpudp":
        made["robot"]["options"]["udp"] = False


def _reconnected(rng: random.Random, made: Made) -> None:
    """The connection to the robot is reset while the robot moves, and its driver is killed or says nothing more."""
    t = rng.uniform(4.0, 5.0)
    made["steps"] = [_drive(3.0, "op1", neutral=False) | {"for": t - 2.95}]
    made["steps"].append(_fault(t, "reset", between=["robot", "gw1"]))
    made["steps"].append(_drive(t + rng.uniform(0.6, 1.5), "op2", takeover=True))


def _reconnected_in_mode_3(rng: random.Random, made: Made) -> None:
    """The connection to a robot that drives itself is reset; its driver still holds the lease, and says nothing."""
    options = {"version": rng.choice(("1.1", "1.3", "1.4")), "lossless": bool(made["control"])}
    made["robot"] = {"protocol": "tcpudp", "options": options, "device": {}}
    made["drivers"][0]["options"] = {}  # the client that chooses modes
    made["steps"] = [_drive(3.0, "op1", mode="autonomous", silent=True) | {"for": 9.0}]
    after = rng.uniform(0.0, 3.0)
    made["steps"].append(_fault(2.9, "reset", between=["robot", "gw1"], when="mode read", after=round(after, 3)))


def _wiggled_over_a_cut(rng: random.Random, made: Made) -> None:
    """An HQ program pushes and releases its stick while its network is cut, and all of it arrives at once."""
    gateway, t = _stick(rng, made, alone=rng.random() < 0.5), 5.0
    steps = [_drive(3.5, "stick1") | {"for": 1.8}]
    cut_s = rng.uniform(2.2, 4.0)
    steps.append(_fault(t, "cut", between=["desk1", gateway["host"]], both=True, **{"for": cut_s}))
    t += 0.3
    while t < 5.0 + cut_s - 0.3:
        t += rng.uniform(0.7, 1.1)
        steps.append(_drive(t, "stick1") | {"for": rng.uniform(0.2, 0.5)})
    made["steps"] = steps


def _frozen_listener(rng: random.Random, made: Made) -> None:
    """A listener is frozen, or its machine suspended, while its program pushes, for less than its deadman."""
    gateway = _stick(rng, made, alone=True)
    kind = rng.choice(("pause", "suspend"))
    freeze = _fault(rng.uniform(5.0, 6.0), kind, target=gateway["name"], **{"for": rng.uniform(0.95, 1.25)})
    made["steps"] = [_drive(3.5, "stick1") | {"for": 6.0}, freeze]


def _frozen_shortly(rng: random.Random, made: Made) -> None:
    """A listener is frozen, too shortly to notice it, while its program pushes by datagrams and says neutral by TCP."""
    gateway, t = _stick(rng, made, alone=True), rng.uniform(5.0, 7.0)
    gateway["hq"] = ["tcpudp"]
    made["programs"][0] |= {"protocol": "tcpudp", "options": {"udp": True}}
    steps = [_drive(3.0, "stick1") | {"for": rng.uniform(0.5, 1.5)}]
    for _ in range(4):
        steps.append(_fault(t - 0.05, "pause", target=gateway["name"], **{"for": 0.45}))
        steps.append(_drive(t, "stick1") | {"for": rng.uniform(0.2, 0.35)})
        t += rng.uniform(2.0, 5.0)
    made["steps"] = steps


def _idle_or_gone(rng: random.Random, made: Made) -> None:
    """An HQ program drives, and then says neutral for long, or disconnects."""
    _stick(rng, made, alone=rng.random() < 0.5)
    drive = _drive(3.5, "stick1") | {"for": rng.uniform(1.0, 3.0)}
    made["steps"] = [drive]
    if rng.random() < 0.5:
        made["steps"].append({"t": drive["t"] + rng.uniform(0.5, 4.0), "who": "stick1", "do": "leave"})


def _two_owners(rng: random.Random, made: Made) -> None:
    """Both gateways serve the robot, one or both drive it, and they meet."""
    steps = _split(rng, made, t=3.5, s=rng.uniform(9.0, 11.0))
    healed_at = 3.5 + steps[0]["for"]
    for driver in rng.sample(("op1", "op2"), rng.choice((1, 2))):
        steps.append(_drive(healed_at - 1.5, driver) | {"for": 4.0})
    if rng.random() < 0.5:  # the one that stays is killed, and stays away
        steps.append(_fault(healed_at + 4.0, "kill", target="owner", **{"for": 30.0}))
        steps.append(_drive(healed_at + 14.0, "op1"))
    made["steps"] = steps


def _killed_in_mode_3(rng: random.Random, made: Made) -> None:
    """A gateway is killed while its robot drives itself; it starts again, or another one takes the robot over."""
    if made["robot"]["protocol"] != "tcpudp":
        options = {"version": rng.choice(("1.1", "1.3")), "lossless": bool(made["control"])}
        made["robot"] = {"protocol": "tcpudp", "options": options, "device": {}}
    made["drivers"][0]["options"] = {}  # the client that chooses modes
    if rng.random() < 0.6:
        _second_gateway(made)
    drive = _drive(4.0, "op1", mode="autonomous", silent=True, then=None) | {"for": 9.0}
    after = rng.choice((0.0, 0.001, 0.005, 0.02, 0.3, 1.5))
    kill = _fault(3.9, "kill", target="owner", when=rng.choice(("mode read", "mode unwritten")), after=after)
    made["steps"] = [drive, kill | {"for": rng.choice((0.2, 6.0))}]
    if rng.random() < 0.3:
        made["steps"] += [_fault(2.5, "cut", between=["router1", "router2"], both=True, **{"for": 8.0})]


def _called_off(rng: random.Random, made: Made) -> None:
    """Somebody chooses mode 3 and calls it off at once, by neutral or another mode; the gateway's disk is slow."""
    if made["robot"]["protocol"] != "tcpudp":
        made["robot"] = {"protocol": "tcpudp", "options": {"version": rng.choice(("1.1", "1.3", "1.4"))}, "device": {}}
    made["drivers"][0]["options"] = {}  # the client that chooses modes
    then = rng.choice((None, None, "manual"))
    drive = _drive(5.0, "op1", mode="autonomous", silent=True, then=then, hz=rng.choice((20.0, 50.0)), holds=1.0)
    slow = _fault(4.0, "threads", target="gw1", by=rng.choice((0.4, 0.4, 0.8)), **{"for": 6.0})
    made["steps"] = [slow, drive | {"for": 0.01}]


def _busy_program(rng: random.Random, made: Made) -> None:
    """A program drives, and chooses modes in another task, while its threads are slow: drives wait for their turn."""
    if made["robot"]["protocol"] != "tcpudp":
        made["robot"] = {"protocol": "tcpudp", "options": {"version": rng.choice(("1.1", "1.3", "1.4"))}, "device": {}}
    made["drivers"][0]["options"] = {}  # the client, which dates
    drive = _drive(3.0, "op1", modes=True, deadman_s=rng.choice((1.0, 1.5)), hz=10.0) | {"for": 6.0}
    made["steps"] = [drive, _fault(3.8, "threads", target="op1", by=1.2, **{"for": 4.0})]


def _pushed_while_away(rng: random.Random, made: Made) -> None:
    """An HQ program begins to push while no gateway serves the robot, and continues when one does."""
    _stick(rng, made, alone=True)
    t = rng.uniform(5.0, 7.0)
    kill = _fault(t, "kill", target="gw1", **{"for": rng.uniform(2.5, 4.0)})
    made["steps"] = [
        _drive(3.0, "stick1") | {"for": 1.0},
        kill,
        _drive(t + rng.uniform(1.0, 2.0), "stick1") | {"for": 9.0},
    ]


def _used_up(rng: random.Random, made: Made) -> None:
    """The robot's one usable connection ends: on the next one it says nothing, and loses half of what it is sent."""
    options = {"version": rng.choice(("1.1", "1.3", "1.4")), "udp": rng.random() < 0.5, "poor_again": True}
    made["robot"] = {"protocol": "tcpudp", "options": options, "device": {}}
    made["steps"] = [_fault(rng.uniform(9.0, 11.0), "reset", between=["robot", "gw1"])]
    made["steps"] += [_drive(t, rng.choice(("op1", "op2")), takeover=True) for t in (9.0, 14.0, 19.0, 24.0)]


def _failed_restarts(rng: random.Random, made: Made) -> None:
    """The restarts of both gateways fail; later both serve the robot, each drives it, and they meet."""
    made["steps"] = _split(rng, made, t=9.0, s=rng.uniform(9.0, 11.0))
    for number, gateway in enumerate(("gw1", "gw2")):
        t = 3.0 + 3 * number
        kill = _fault(
            t, "kill", target=f"{gateway}+", when=rng.choice(("HandoverState sent", "HandoverState got", "Up unsent"))
        )
        made["steps"] += [_fault(t, "restart", target=gateway), kill]
    healed_at = 9.0 + made["steps"][0]["for"]
    made["steps"] += [_drive(healed_at - 1.5, driver) | {"for": 8.0} for driver in ("op1", "op2")]


def _locked_up(rng: random.Random, made: Made) -> None:
    """A gateway's session locks up while its robot is driven or latched; it may be restarted, killed or cut then."""
    _stick(rng, made, alone=False)
    t = rng.uniform(4.0, 6.0)
    made["steps"] = [_drive(3.0, "op1"), _drive(3.0, "stick1"), _fault(t, "lock", target="gw1")]
    if rng.random() < 0.4:
        made["steps"].append({"t": 3.5, "who": "op2", "do": "latch"})
    meanwhile = rng.choice(("restart", "kill", "pause", "reset", "cut", ""))
    links = (
        {"between": ["gw1", "robot" if meanwhile == "reset" else "router1"]} if meanwhile in ("reset", "cut") else {}
    )
    if meanwhile:
        at = rng.choice((t + rng.uniform(1.0, 30.0), t + rng.uniform(24.0, 27.0)))
        made["steps"].append(_fault(at, meanwhile, target="gw1", **links, **{"for": rng.uniform(1.0, 8.0)}))
    made["steps"] += [_drive(t + s, "stick1") for s in (6.0, 20.0, 26.0)]
    made["steps"] += [_drive(t + s, "op1") for s in (30.0, 38.0)]


def _released_meanwhile(rng: random.Random, made: Made) -> None:
    """A latched stop is released while one gateway of the robot is away; later that one serves the robot."""
    _second_gateway(made)
    t = rng.uniform(8.0, 10.0)
    made["steps"] = [
        {"t": 3.5, "who": "op1", "do": "latch"},
        _fault(5.0, rng.choice(("kill", "end")), target="gw1", **{"for": rng.uniform(2.0, 8.0)}),
        {"t": t, "who": "op1", "do": "unlatch"},
        _fault(t + 8.0, rng.choice(("kill", "end")), target="gw2", **{"for": 8.0}),
        _drive(t + 14.0, "op1"),
    ]


def _killed_driver(rng: random.Random, made: Made) -> None:
    """The driver's process is killed while it drives, or its bus is lost, or it is frozen."""
    kind = rng.choice(("kill", "pause", "unlink"))
    fault = _fault(rng.uniform(4.0, 6.0), kind, target="op1", **{"for": rng.uniform(1.0, 4.0)})
    made["steps"] = [_drive(3.0, "op1", priority=rng.choice((0, 0, 1))) | {"for": 6.0}, fault]
    made["steps"].append(_drive(5.5, "op2", priority=rng.choice((0, 1, 2))))


def _forged_and_flooded(rng: random.Random, made: Made) -> None:
    """Somebody repeats what was overheard, while the holder's clock jumps or the bus delivers twice."""
    made["steps"] = [_drive(3.0, "op1") | {"for": 6.0}]
    made["steps"] += [_fault(rng.uniform(3.5, 8.0), "forge") for _ in range(3)]
    made["steps"].append(_fault(4.0, rng.choice(("duplicate", "jump")), target="gw1", **{"for": 3.0}))


SITUATIONS: tuple[Callable[[random.Random, Made], None], ...] = (
    _silent_holder,
    _stalled_link,
    _reconnected,
    _reconnected_in_mode_3,
    _wiggled_over_a_cut,
    _frozen_listener,
    _frozen_listener,
    _frozen_shortly,
    _idle_or_gone,
    _two_owners,
    _two_owners,
    _killed_in_mode_3,
    _killed_in_mode_3,
    _called_off,
    _called_off,
    _busy_program,
    _pushed_while_away,
    _used_up,
    _failed_restarts,
    _locked_up,
    _locked_up,
    _released_meanwhile,
    _killed_driver,
    _forged_and_flooded,
    *FOUND,
    *OF_TWO_GATEWAYS,
)
