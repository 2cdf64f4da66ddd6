"""Scenarios of a seed and a profile. Six of ten faults wait for a state, the others for a time.

A third of the scenarios goes without the redundant stops: no idle stops, no liveliness tokens, robots without a
failsafe. Then robots cut packets by their length, since one that loses the stops of the first second gets no more.
"""

from __future__ import annotations

import random
from typing import Any

from tests.simulated.faults import REACHED
from tests.simulated.generate_restarts import restarts
from tests.simulated.situations import arrange
from tests.simulated.steps import WHEELS

PROFILES = ("link", "bus", "ownership", "hq", "restart", "latch", "tcpudp", "alf", "wc2ec", "mixed", "situations")
SECONDS = (25.0, 60.0)
_STATES = tuple(REACHED)
_WITH_PROGRAMS = ("mixed", "link", "latch", "restart", "tcpudp", "alf", "wc2ec")
_DRIVEN = ("moving", "moving", "mode read", "drive received", "stopping", "stop unwritten")
"""The states in which a fault of the robot or its link hurts."""


def scenario(seed: int, profile: str | None = None) -> dict[str, Any]:
    """Make the scenario of a seed; profile None: three situations, then one of another profile.

    One seed after the other meets each situation, so that a minute has them all, twice.
    """
    rng = random.Random(f"scenario {seed} {profile}")
    turn = seed
    if profile is None:
        turn = seed - seed // 4
        profile = rng.choice(PROFILES[:-1]) if seed % 4 == 3 else PROFILES[-1]
    stripped = rng.random() < 1 / 3
    protocol = profile if profile in ("alf", "wc2ec") else rng.choice(("tcpudp", "tcpudp", "tcpudp", "alf", "wc2ec"))
    if profile == "tcpudp":
        protocol = "tcpudp"
    made: dict[str, Any] = {
        "seed": f"{seed} {profile}",
        "profile": profile,
        "seconds": round(rng.uniform(*SECONDS), 1),
        "robot": _robot(rng, protocol, stripped=stripped),
        "control": {"idle_stop_s": 0.0} if stripped else {},
        "gateways": [{"name": "gw1", "host": "gw1", "router": "router1"}],
        "drivers": _drivers(rng, stripped=stripped),
        "programs": [],
        "network": {"delay_s": rng.choice((0.0005, 0.002, 0.02)), "jitter_s": rng.choice((0.0005, 0.005))},
    }
    share = {"ownership": 1.0, "mixed": 0.5, "latch": 0.5, "restart": 0.3}.get(profile, 0.0)
    if share == 1.0 or (share and rng.random() < share):
        made["gateways"].append({"name": "gw2", "host": "gw2", "router": rng.choice(("router1", "router2"))})
    if profile == "hq" or (profile in _WITH_PROGRAMS and rng.random() < 0.4):
        _add_programs(rng, made)
    if rng.random() < 0.2 or profile == "bus":
        made["network"]["reorders"] = rng.random() < 0.3
    if profile == "situations":
        arrange(rng, made, turn)
        return made
    steps = _acts(rng, made) + _faults(rng, made, profile)
    if profile == "restart":
        made["robot"]["options"]["splits_s"] = rng.choice((0.0, 0.02, 0.3))
        steps += restarts(rng, made)
    made["steps"] = sorted(steps, key=lambda step: step["t"])
    return made


def _robot(rng: random.Random, protocol: str, *, stripped: bool) -> dict[str, Any]:
    options: dict[str, Any] = {}
    device: dict[str, Any] = {}
    if not stripped and rng.random() < 0.4:
        options["self_stop_s"] = {"tcpudp": 1.0, "alf": 2.0}.get(protocol)
    if protocol == "tcpudp":
        options["version"] = rng.choice(("1.1", "1.2", "1.3", "1.4"))
        options["udp"] = rng.random() < 0.35
        options["lossless"] = stripped or rng.random() < 0.2
        if stripped:
            options["udp"] = False
    elif protocol == "alf":
        options["dialect"] = device["dialect"] = rng.choice(("text", "binary"))
    else:
        device = WHEELS
    return {"protocol": protocol, "options": options, "device": device}


def _drivers(rng: random.Random, *, stripped: bool) -> list[dict[str, Any]]:
    drivers = []
    for number in range(2):
        raw = stripped or rng.random() < 0.25
        options = {"client": False, "dated": rng.random() < 0.6} if raw else {}
        router = rng.choice(("router1", "router1", "router2"))
        drivers.append({"name": f"op{number + 1}", "host": f"pc{number + 1}", "router": router, "options": options})
    return drivers


def _add_programs(rng: random.Random, made: dict[str, Any]) -> None:
    protocols = [rng.choice(("tcpudp", "alf", "wc2ec")), rng.choice(("tcpudp", "tcpudp", "alf"))][: rng.choice((1, 2))]
    gateway = made["gateways"][0]
    if rng.random() < 0.4:
        gateway = {"name": "hq1", "host": "hq1", "router": rng.choice(("router1", "router2")), "device": False}
        made["gateways"].append(gateway)
    gateway["hq"] = protocols
    for number, protocol in enumerate(protocols):
        options = {"udp": rng.random() < 0.4} if protocol == "tcpudp" else {}
        made["programs"].append(
            {
                "name": f"stick{number + 1}",
                "host": f"desk{number + 1}",
                "protocol": protocol,
                "gateway_host": gateway["host"],
                "listener": number,
                "options": options,
            }
        )


def _acts(rng: random.Random, made: dict[str, Any]) -> list[dict[str, Any]]:
    """What people and programs do."""
    steps, t = [], 2.0
    autonomous = made["robot"]["protocol"] == "tcpudp"
    others = [each["name"] for each in made["programs"]]
    while t < made["seconds"]:
        t += rng.uniform(0.3, 5.0)
        who = rng.choice([*(each["name"] for each in made["drivers"]), *others, *others])
        step: dict[str, Any] = {"t": round(t, 2), "who": who, "do": "drive", "for": round(rng.uniform(0.5, 6.0), 2)}
        if who in others:
            if rng.random() < 0.25:
                step["do"] = rng.choice(("mode", "leave"))
                step["mode"] = rng.choice(("autonomous", "manual", "none"))
        else:
            step["deadman_s"] = rng.choice((0.3, 0.5, 1.0))
            step["hz"] = rng.choice((3.0, 5.0, 10.0, 10.0, 20.0))
            step["takeover"] = rng.random() < 0.25
            step["wiggles"] = rng.random() < 0.3
            step["neutral"] = rng.random() < 0.7
            step["releases"] = rng.random() < 0.7
            if autonomous and rng.random() < 0.25:
                step |= {"mode": "autonomous", "silent": True, "then": rng.choice((None, "none", "manual"))}
            if rng.random() < 0.15:
                step |= {"for": 0.05, "neutral": False, "releases": False}  # one command, and silence
            if rng.random() < 0.25:
                step = {"t": step["t"], "who": who, "do": rng.choice(("stop", "stop", "latch", "unlatch", "unlatch"))}
                step["fleet"] = rng.random() < 0.3
        steps.append(step)
    return steps


def _faults(rng: random.Random, made: dict[str, Any], profile: str) -> list[dict[str, Any]]:
    kinds = KINDS[profile]
    steps = []
    for _ in range(rng.choice((1, 2, 3, 4, 6))):
        step: dict[str, Any] = {"t": round(rng.uniform(2.0, made["seconds"] - 2.0), 2)}
        kind = rng.choice(kinds)
        step |= {
            "fault": kind,
            "for": round(rng.choice((0.1, 0.3, 0.7, 1.5, 2.5, 5.0, 12.0)) * rng.uniform(0.7, 1.3), 2),
        }
        _aim(rng, made, step)
        hits_robot = "robot" in (step.get("target"), *step.get("between", ()))
        if hits_robot:
            step["for"] = round(rng.choice((0.7, 2.5, 4.0, 7.0)) * rng.uniform(0.7, 1.3), 2)
        if rng.random() < 0.6:
            step["when"] = rng.choice(_DRIVEN if hits_robot else _STATES)
            step["after"] = round(rng.choice((0.0, 0.0002, 0.001, 0.005, 0.05, 0.3)), 4)
        steps.append(step)
    return steps


KINDS = {
    "link": ("cut", "cut", "pause robot", "reset", "slow", "lose"),
    "bus": ("cut bus", "cut bus", "unlink", "router", "news", "duplicate", "slow bus", "pause driver", "forge"),
    "ownership": ("cut bus", "cut routers", "cut routers", "unlink", "kill", "end", "pause gateway", "news", "cut"),
    "hq": ("cut hq", "pause program", "pause gateway", "reset hq", "cut bus", "lose", "kill"),
    "restart": ("kill", "kill", "end", "end", "pause robot", "cut"),
    "latch": ("kill", "end", "cut bus", "unlink", "news", "pause gateway", "duplicate"),
}
_ROBOT = ("pause robot", "pause robot", "pause robot", "cut", "cut", "reset", "lose", "pause gateway")
KINDS["tcpudp"] = KINDS["alf"] = KINDS["wc2ec"] = _ROBOT
KINDS["hq"] += ("forge",)
KINDS["mixed"] = tuple({kind: None for kinds in tuple(KINDS.values()) for kind in kinds}) + ("jump", "suspend")


def _aim(rng: random.Random, made: dict[str, Any], step: dict[str, Any]) -> None:
    """Choose whom a fault hits."""
    kind, _, target = step["fault"].partition(" ")
    gateways = list(made["gateways"])
    gateway, driver = rng.choice(gateways), rng.choice(made["drivers"])
    member = rng.choice([*gateways, driver])
    step["fault"] = kind
    if target == "bus" or (kind == "slow" and target):
        step["between"] = [member["host"], member["router"]]
        step["both"] = rng.random() < 0.8
    elif target == "routers":
        step["between"] = ["router1", "router2"]
    elif target == "hq" and made["programs"]:
        program = rng.choice(made["programs"])
        step["between"] = [program["host"], program["gateway_host"]]
    elif kind in ("cut", "reset", "slow"):
        step["between"] = ["robot", gateways[0]["host"]]
        step["both"] = rng.random() < 0.7
    elif kind == "router":
        step["target"] = rng.choice(("router1", "router2"))
    elif target == "program" and made["programs"]:
        step["target"] = rng.choice(made["programs"])["name"]
    elif target in ("robot", ""):
        step["target"] = "robot" if target == "robot" else member["name"] if kind == "unlink" else gateway["name"]
    else:
        step["target"] = driver["name"] if target == "driver" else gateway["name"]
    if kind == "slow":
        step["by"] = rng.choice((0.05, 0.2, 0.35))
    if kind == "news":
        step["late"], step["lost"] = rng.choice((0.5, 3.0)), rng.choice((0.0, 0.0, 0.5))
