"""Keys and messages of the bus, from their declarations."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from types import ModuleType

import msgspec

from docs.generate.declared import documented, fields, summary, table
from zbridge.fleet import incidents, lease_messages, messages, processes, topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import QOS, Delivery, Topic

COMMON = FleetMessage.__struct_fields__


def declared() -> Iterator[tuple[str, Topic, str]]:
    """Give each topic with its path, where ``<name>`` stands for the last part of a family, and its meaning."""
    told = documented(ast.parse(inspect.getsource(topics)).body)
    for name, value in vars(topics).items():
        if isinstance(value, Topic):
            yield value.path, value, told.get(name, "")
        elif name.isupper() and callable(value) and isinstance(family := value("name"), Topic):
            yield family.path.removesuffix("name") + "<name>", family, told.get(name, "")


def link(message: str) -> str:
    return f"[{message}](messages.md#{message.lower()})"


def keys(delivery: Delivery) -> str:
    """Write the keys of one class of delivery."""
    rows = []
    for path, topic, meaning in declared():
        if topic.delivery is delivery:
            most = f"{topic.most_bytes:_}".replace("_", " ") if topic.most_bytes else "-"
            rows.append((f"`{path}`", link(topic.message.__name__), meaning, most))
    heading = ("key below `fleet/r1/`", "message", "contents", "most bytes")
    cut = slice(None) if delivery in (Delivery.COMMAND, Delivery.QUERY) else slice(3)
    return table(heading[cut], (row[cut] for row in rows))


def qualities() -> str:
    """Write how the bus treats each class."""
    rows = (
        (
            delivery.value,
            qos.priority.value,
            qos.congestion.value,
            "yes" if qos.express else "no",
            "yes" if qos.keeps_last else "no",
        )
        for delivery, qos in QOS.items()
    )
    return table(("class", "priority", "when the network is full", "express", "a `get` returns the last"), rows)


def struct(kind: type) -> str:
    """Write one message, or a part of one."""
    inherited = set(COMMON) - set(kind.__annotations__) if issubclass(kind, FleetMessage) else set()
    rows = [each for each in fields(kind) if each.name not in inherited]
    text = f"### {kind.__name__}\n\n{summary(kind)}\n"
    if rows:
        cells = ((f"`{each.name}`", each.type, each.default, each.meaning) for each in rows)
        text += f"\n{table(('field', 'type', 'default', 'meaning'), cells)}\n"
    return text


def structs(module: ModuleType) -> str:
    """Write all messages that a module declares."""
    kinds = [
        kind
        for kind in vars(module).values()
        if isinstance(kind, type)
        and issubclass(kind, msgspec.Struct)
        and kind.__module__ == module.__name__
        and kind is not FleetMessage
    ]
    return "\n".join(map(struct, kinds))


def sections() -> dict[str, str]:
    """Return every generated part of the two pages by its name."""
    return {
        **{f"keys {delivery.value}": keys(delivery) for delivery in Delivery},
        "delivery": qualities(),
        "messages": structs(messages),
        "lease messages": structs(lease_messages),
        "incident messages": structs(incidents),
        "processes": structs(processes),
    }
