"""The commands that look at the bus: robots, messages, and the stop for everyone."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from zbridge.bus import Bus, BusSettings, Sample, open_bus
from zbridge.errors import BusError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, FleetMessage, Status, Stop
from zbridge.fleet.topics import KeySpace, split_key
from zbridge.metrics import Metrics

CONFIRM_S = 2.0
"""Seconds within which a stop must be confirmed."""
_SHOWN = 8

console = Console(highlight=False, soft_wrap=True)
errors = Console(stderr=True, highlight=False, soft_wrap=True)


@contextlib.asynccontextmanager
async def joined(settings: BusSettings) -> AsyncIterator[Bus]:
    """Be on the bus while the context lasts."""
    bus = await open_bus(settings, Metrics(), wait_for_peers=True)
    try:
        yield bus
    finally:
        await bus.close()


async def list_robots(settings: BusSettings, realm: str, *, as_json: bool) -> None:
    """Print every robot that has a gateway or a status."""
    async with joined(settings) as bus:
        tokens = await bus.alive(f"{realm}/*/@alive/gateway")
        answers = await bus.ask(f"{realm}/*/status")
    robots: dict[str, Status | None] = {split[1]: None for key in tokens if (split := split_key(key))}
    for answer in answers:
        split = split_key(answer.key)
        if split is not None and answer.error is None:
            with contextlib.suppress(PayloadError):
                robots[split[1]] = payloads.decode(Status, answer.payload)
    if as_json:
        for name, status in sorted(robots.items()):
            fields = msgspec.to_builtins(status) if status is not None else {"state": None}
            console.print(json.dumps({"robot": name, **fields}), markup=False)
    elif robots:
        console.print(_robot_table(robots))
    else:
        errors.print(f"no robots on {realm}/")


def _robot_table(robots: dict[str, Status | None]) -> Table:
    table = Table("robot", "state", "protocol", "version", "features", "reason", box=None)
    for name, status in sorted(robots.items()):
        if status is None:
            table.add_row(name, "?", "", "", "", "the gateway has published no status yet")
        else:
            table.add_row(
                name,
                status.state,
                status.protocol or "",
                status.version or "",
                " ".join(status.features),
                status.reason or "",
            )
    return table


async def echo(settings: BusSettings, key: str, *, as_json: bool, count: int) -> None:
    """Print the messages that come on ``key``; the last value of a state first."""
    seen, done = 0, asyncio.Event()

    def show(sample: Sample) -> None:
        nonlocal seen
        if count and seen >= count:
            return
        seen += 1
        console.print(_line(sample, as_json=as_json), markup=False)
        if seen == count:
            done.set()

    async with joined(settings) as bus:
        bus.subscribe(key, show, history=True)
        await done.wait()


def _line(sample: Sample, *, as_json: bool) -> str:
    try:
        fields = _fields(sample)
    except PayloadError as error:
        fields = {"error": str(error)}
    if as_json:
        return json.dumps({"key": sample.key, **_plain(fields, shorten=False)})
    return f"{sample.key} " + " ".join(f"{name}={_short(value)}" for name, value in fields.items())


def _fields(sample: Sample) -> dict[str, Any]:
    split = split_key(sample.key)
    topic = topics.find(split[2]) if split else None
    if topic is None:
        return payloads.unpack(sample.payload)
    message: FleetMessage = payloads.decode(topic.message, sample.payload)
    fields = msgspec.structs.asdict(message)
    return {name: value for name, value in fields.items() if value is not None and value is not msgspec.UNSET}


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, bytes):
        return f"{value[:_SHOWN].hex(' ')}{'...' if len(value) > _SHOWN else ''} ({len(value)} bytes)"
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(_plain(value, shorten=True), ensure_ascii=False)


def _plain(value: Any, *, shorten: bool) -> Any:
    """Make anything JSON can hold: arrays as lists, bytes as hex, what is no number as null."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, dict):
        return {name: _plain(item, shorten=shorten) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), shorten=shorten)
    if isinstance(value, list | tuple):
        return [_plain(item, shorten=shorten) for item in value]
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


async def stop(settings: BusSettings, realm: str, robot: str | None) -> bool:
    """Stop one robot or all; tell whether every one of them confirmed it."""
    async with joined(settings) as bus:
        if robot is None:
            tokens = await bus.alive(f"{realm}/*/@alive/gateway")
            names = sorted({split[1] for key in tokens if (split := split_key(key))})
            if not names:
                errors.print(f"no gateways on {realm}/")
                return False
        else:
            names = [robot]
        confirmed = await asyncio.gather(*(_stop_one(bus, KeySpace(realm, name)) for name in names))
    return all(confirmed)


async def _stop_one(bus: Bus, keys: KeySpace) -> bool:
    """Send the stop again and again until ``control`` shows it."""
    publisher = bus.publisher(keys.key(topics.CMD_STOP.path), topics.CMD_STOP)
    payload = payloads.encode(Stop())
    deadline = asyncio.get_running_loop().time() + CONFIRM_S
    while asyncio.get_running_loop().time() < deadline:
        publisher.put(payload)
        await asyncio.sleep(0.05)
        with contextlib.suppress(BusError, PayloadError):
            for answer in await bus.ask(keys.key(topics.CONTROL.path), timeout_s=0.3):
                if answer.error is None and payloads.decode(Control, answer.payload).state == "stopped":
                    return await _reached(bus, keys, payloads.decode(Control, answer.payload))
    errors.print(f"{keys.robot}: stop sent, but no gateway confirmed it within {CONFIRM_S:g} s")
    return False


async def _reached(bus: Bus, keys: KeySpace, control: Control) -> bool:
    """Say whether the stop that a gateway took could reach its robot."""
    for refusal in control.refusals:
        if refusal.command == "stop":
            errors.print(f"{keys.robot}: cannot be stopped: {refusal.reason}")
            return False
    for answer in await bus.ask(keys.key(topics.STATUS.path), timeout_s=0.3):
        status = payloads.decode(Status, answer.payload)
        if status.state != "established":
            why = status.reason or "no reason known"
            errors.print(f"{keys.robot}: stop taken, but the robot is {status.state}: {why}")
            return False
    console.print(f"{keys.robot}: stopped")
    return True
