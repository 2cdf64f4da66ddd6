"""What situations are made of: who takes part, and steps of people and of faults."""

from __future__ import annotations

import random
from typing import Any

Made = dict[str, Any]
WHEELS = {"differential": {"left": ["left"], "right": ["right"], "wheel_radius_m": 0.05, "track_m": 0.3}}
"""The options of a robot's gateway that drives two wheels."""


def drive(t: float, who: str, **more: Any) -> Made:
    """Let somebody drive."""
    return {"t": t, "who": who, "do": "drive", "for": 4.0, "deadman_s": 0.5, "hz": 10.0, **more}


def fault(t: float, fault: str, **more: Any) -> Made:
    """Let something fail."""
    return {"t": t, "fault": fault, **more}


def tcpudp(rng: random.Random, made: Made) -> None:
    """Let the robot be one of TCP/UDP without datagrams, where it is another one."""
    if made["robot"]["protocol"] != "tcpudp":
        options = {"version": rng.choice(("1.1", "1.3", "1.4")), "lossless": bool(made["control"])}
        made["robot"] = {"protocol": "tcpudp", "options": options, "device": {}}


def second_gateway(made: Made) -> None:
    """Let two gateways take part, each with a router and a program of its own."""
    made["gateways"] = [
        {"name": "gw1", "host": "gw1", "router": "router1"},
        {"name": "gw2", "host": "gw2", "router": "router2"},
    ]
    for driver, router in zip(made["drivers"], ("router1", "router2"), strict=True):
        driver["router"] = router


def stick(rng: random.Random, made: Made, *, alone: bool) -> Made:
    """Let one HQ program take part; alone: its listener is a process of its own."""
    protocol = rng.choice(("tcpudp", "tcpudp", "alf", "wc2ec"))
    if made["robot"]["protocol"] == "alf":
        protocol = rng.choice(("tcpudp", "alf"))
    made["gateways"] = [{"name": "gw1", "host": "gw1", "router": "router1"}]
    gateway = made["gateways"][0]
    if alone:
        gateway = {"name": "hq1", "host": "hq1", "router": "router1", "device": False}
        made["gateways"].append(gateway)
    gateway["hq"] = [protocol]
    program = {"name": "stick1", "host": "desk1", "protocol": protocol, "gateway_host": gateway["host"]}
    made["programs"] = [{**program, "listener": 0, "options": {}}]
    return gateway


def split(rng: random.Random, made: Made, *, t: float, s: float) -> list[Made]:
    """Cut the bus between two gateways, so that both serve the robot, and heal it."""
    second_gateway(made)
    return [fault(t, "cut", between=["router1", "router2"], both=True, **{"for": s})]


def client(made: Made) -> None:
    """Let the first program be the Python client, which dates its commands and renews its lease."""
    made["drivers"][0] |= {"options": {}, "router": "router1"}
