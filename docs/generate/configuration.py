"""The tables of every configuration file, with what ``zbridge init`` says of each setting."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
from msgspec import inspect

from docs.generate.declared import fields, meanings, summary, table
from zbridge.app.config import LogSettings, MetricsSettings, RobotSettings
from zbridge.app.templates import listener_template, robot_template
from zbridge.blackbox import BlackBoxSettings
from zbridge.bus import BusSettings, Tls
from zbridge.camera.settings import CameraSettings
from zbridge.control.settings import ControlSettings
from zbridge.host.settings import HostSettings
from zbridge.hq import HqSettings
from zbridge.hq.settings import ListenerTls
from zbridge.protocol.plugin import Protocol, find_protocol, protocol_names
from zbridge.robot.settings import DeviceSettings
from zbridge.security.router_settings import RouterSettings
from zbridge.views.ros2.settings import Ros2Settings

DEPLOY = Path(__file__).parents[2] / "deploy"
ELSEWHERE = {("device", "options"), ("hq", "options"), ("ros2.toml", "bus")}
"""Settings that a part of their own documents."""
OWN_WORDS = ("device", "hq")
"""Tables whose templates are of one protocol each: their docstrings speak of all."""
ONCE = (Tls, ListenerTls)
"""Tables that stand on the page once, by their own name."""
_SETTING = re.compile(r"^(?:# )?(?P<key>\w+) = .*?(?: +# (?P<text>.*))?$")
_TABLE = re.compile(r"^(?:# )?\[+(?P<name>[\w.]+)\]+")
_MORE = re.compile(r"^(?:# )? {8,}# (?P<text>.*)$")

Told = dict[tuple[str, str], str]
"""What a template says of a setting, by table and key."""


def commented(template: str, root: str = "") -> Told:
    """Read what a template says of each setting; a text may go on below its line. root: of tables in the file."""
    told: Told = {}
    place, key = root, ""
    for line in template.splitlines():
        if found := _TABLE.match(line):
            place = ".".join(filter(None, (root, found["name"])))
        elif found := _MORE.match(line):
            told[place, key] += f" {found['text']}"
        elif found := _SETTING.match(line):
            key = found["key"]
            told[place, key] = found["text"] or ""
    return told


def settings(name: str, struct: type[msgspec.Struct], told: Told, level: int = 3) -> str:
    """Write one table of a file, and the tables in it."""
    place, own = name.strip("[]"), meanings(struct)
    rows, below = [], []
    for each in fields(struct):
        if (place, each.name) in ELSEWHERE:
            continue
        texts = (own.get(each.name), told.get((place, each.name)))
        meaning = next(filter(None, texts if place in OWN_WORDS else reversed(texts)), "")
        inner = nested(struct, each.name)
        if inner is not None and inner not in ONCE:
            below.append(settings(f"[{place.removesuffix('.toml')}.{each.name}]", inner, told, level))
            meaning = meaning or summary(inner)
        rows.append((f"`{each.name}`", each.type, each.default, meaning.replace("{name}", "r1").rstrip(".,;")))
    text = f"{'#' * level} `{name}`\n\n{table(('setting', 'value', 'default', 'meaning'), rows)}\n"
    return "\n".join([text, *below])


def nested(struct: type[msgspec.Struct], name: str) -> type[msgspec.Struct] | None:
    """Return the struct that a setting consists of, alone, in a list or by names."""
    info = inspect.type_info(struct)
    assert isinstance(info, inspect.StructType)
    kind: inspect.Type = next(field.type for field in info.fields if field.encode_name == name)
    while not isinstance(kind, inspect.StructType):
        if isinstance(kind, inspect.UnionType):
            kind = next(each for each in kind.types if not isinstance(each, inspect.NoneType))
        elif isinstance(kind, inspect.VarTupleType):
            kind = kind.item_type
        elif isinstance(kind, inspect.DictType):
            kind = kind.value_type
        else:
            return None
    return kind.cls


def options(protocol: Protocol) -> str:
    """Write the options of one protocol, of a robot and of a listener."""
    text = settings("[device.options]", protocol.options, commented(robot_template(protocol)), 4)
    if protocol.hq is not None:
        text += "\n" + settings("[hq.options]", protocol.hq_options, commented(listener_template(protocol)), 4)
    return f"### Protocol {protocol.name}\n\n{protocol.summary}.\n\n{text}"


def robot_file() -> str:
    """Write the tables of a robot's file that all protocols have."""
    protocol = find_protocol("tcpudp")
    told = commented(listener_template(protocol)) | commented(robot_template(protocol))
    told |= {place: text for place, text in commented(listener_template(protocol)).items() if place[0] == "hq"}
    parts = (
        ("[robot]", RobotSettings), ("[device]", DeviceSettings), ("[[hq]]", HqSettings), ("[hq.tls]", ListenerTls),
        ("[camera]", CameraSettings), ("[bus]", BusSettings), ("[bus.tls]", Tls), ("[control]", ControlSettings),
        ("[metrics]", MetricsSettings), ("[log]", LogSettings), ("[blackbox]", BlackBoxSettings),
    )  # fmt: skip
    return "\n".join(settings(name, struct, told) for name, struct in parts)


def sections() -> dict[str, str]:
    """Return every generated part of the page by its name."""
    router = commented((DEPLOY / "zenoh" / "router.toml").read_text(), "router")
    router |= {("router.toml", key): text for (place, key), text in router.items() if place == "router"}
    host = commented((DEPLOY / "config" / "host.toml").read_text())
    return {
        "robot file": robot_file(),
        "options": "\n".join(options(find_protocol(name)) for name in protocol_names()),
        "host file": "\n".join(
            settings(name, struct, host)
            for name, struct in (
                ("[host]", HostSettings),
                ("[metrics]", MetricsSettings),
                ("[log]", LogSettings),
                ("[blackbox]", BlackBoxSettings),
            )
        ),
        "router file": settings("router.toml", RouterSettings, router).replace("`[router.", "`["),
        "ros2 file": settings("ros2.toml", Ros2Settings, {}).replace("`[ros2.", "`["),
    }
