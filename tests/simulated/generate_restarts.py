"""Restarts of a scenario, and faults at their steps: before a message is sent, after, and when it was received."""

from __future__ import annotations

import random
from typing import Any

from tests.simulated.faults import HANDOVER

_STEPS = tuple(HANDOVER)
_BEGINS = ("moving", "stopping", "mode read", "mode unwritten", "stop unwritten", "drive received", "granted",
    "granted, not replied", "asking", "released")  # fmt: skip
"""The states in which a restart that begins hurts."""


def restarts(rng: random.Random, made: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the restarts of a scenario, and what fails at their steps."""
    steps: list[dict[str, Any]] = []
    for _ in range(rng.choice((1, 2, 2, 3, 4))):
        gateway = rng.choice(made["gateways"])
        at = round(rng.uniform(2.0, made["seconds"] - 4.0), 2)
        step: dict[str, Any] = {"t": at, "fault": "restart", "target": gateway["name"]}
        if rng.random() < 0.35 and gateway.get("device", True):
            step = {"t": at, "who": made["drivers"][0]["name"], "do": "restart"}
        if "fault" in step and rng.random() < 0.6:
            step |= {"when": rng.choice(_BEGINS), "after": round(rng.choice((0.0, 0.001, 0.05)), 4)}
        steps.append(step)
        if rng.random() < 0.55:
            steps += [_fault(rng, made, gateway, at)]
        if rng.random() < 0.4:  # somebody stops or latches meanwhile
            verb = rng.choice(("stop", "latch", "latch", "unlatch", "drive"))
            act = {"t": at, "who": rng.choice(made["drivers"])["name"], "do": verb, "for": 2.0, "deadman_s": 0.5}
            steps.append({**act, "when": rng.choice(_STEPS), "after": round(rng.choice((0.0, 0.0005, 0.003)), 4)})
    return steps


def _fault(rng: random.Random, made: dict[str, Any], gateway: dict[str, Any], at: float) -> dict[str, Any]:
    name, kind = gateway["name"], rng.choice(("kill", "kill", "pause", "pause", "cut", "end", "cut bus"))
    step: dict[str, Any] = {
        "t": at,
        "fault": kind,
        "for": round(rng.choice((0.1, 0.7, 2.5, 5.0, 12.0)) * rng.uniform(0.7, 1.3), 2),
        "when": rng.choice(_STEPS),
        "after": round(rng.choice((0.0, 0.0, 0.0005, 0.002, 0.3)), 4),
    }
    if kind == "cut":
        step |= {"between": ["robot", gateway["host"]], "both": rng.random() < 0.7}
    elif kind == "cut bus":
        step |= {"fault": "cut", "between": [gateway["host"], gateway["router"]], "both": rng.random() < 0.8}
    else:
        step["target"] = name + (rng.choice(("", "+", "-")) if kind != "end" else "")
    return step
