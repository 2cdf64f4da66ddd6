"""Configurations: what is accepted, and that every error names file, key, value and what was expected."""

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

from zbridge.app import config
from zbridge.app.config import Plan, load, plan
from zbridge.app.templates import listener_template, robot_template
from zbridge.errors import ConfigError
from zbridge.hq.settings import HqSettings
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import find_protocol, protocol_names

MINIMAL = """
[robot]
name = "r1"
[device]
protocol = "tcpudp"
connect = ["tcp://127.0.0.1:11001"]
"""


def minimal(**tables: Any) -> dict[str, Any]:
    return {"robot": {"name": "r1"}, "device": {"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:11001"]}, **tables}


def device(**fields: Any) -> dict[str, Any]:
    return minimal(device={"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:11001"], **fields})


def serving(*listeners: dict[str, Any], **tables: Any) -> dict[str, Any]:
    """A process that only serves HQ programs."""
    return {"robot": {"name": "r1"}, "hq": list(listeners), **tables}


def hq(**fields: Any) -> dict[str, Any]:
    return {"protocol": "tcpudp", "listen": "tcp://127.0.0.1:11002", **fields}


def loaded(folder: Path, text: str, **environment: str) -> Plan:
    file = folder / "robot.toml"
    file.write_text(text, encoding="utf-8")
    return load(file, environment)


def test_a_minimal_file_takes_all_defaults(tmp_path: Path) -> None:
    made = loaded(tmp_path, MINIMAL)
    assert (made.config.robot.name, made.config.robot.realm) == ("r1", "fleet")
    assert made.device.addresses == (Address("127.0.0.1", 11001),)
    assert made.device.protocol.name == "tcpudp"
    assert made.device.options == made.device.protocol.options()
    control = made.config.control
    assert (control.lease_s, control.deadman_s) == (3.0, 2.0)
    assert (control.rate_hz, control.slew_per_s) == (None, None)
    assert (control.audit, control.audit_bytes, control.audit_files) == (None, 1_000_000, 5)
    assert made.config.bus.effective_mode == "peer"
    assert made.config.bus.multicast
    assert made.config.bus.stream == "drop"
    assert made.metrics is None


@pytest.mark.parametrize("name", protocol_names())
def test_the_template_of_every_protocol_is_a_configuration(tmp_path: Path, name: str) -> None:
    made = loaded(tmp_path, robot_template(find_protocol(name)).replace("{name}", "r7"))
    assert made.config.robot.name == "r7"
    assert made.device.options == made.device.protocol.options()


@pytest.mark.parametrize("name", protocol_names())
def test_the_template_of_every_listener_is_a_configuration_with_all_defaults(tmp_path: Path, name: str) -> None:
    protocol = find_protocol(name)
    made = loaded(tmp_path, listener_template(protocol).replace("{name}", "r7"))
    (listener,) = made.listeners
    assert (made.config.robot.name, made.device) == ("r7", None)
    assert listener.options == protocol.hq_options()
    settings = listener.settings
    assert settings == HqSettings(protocol=name, listen=settings.listen, options=settings.options)


def test_every_table_is_read(tmp_path: Path) -> None:
    made = loaded(
        tmp_path,
        MINIMAL
        + """
[device.options]
gap_s = 0.05
force = ["joystick", 50]
[bus]
connect = ["tcp/10.0.0.1:7447"]
multicast = false
stream = "block"
tls = { ca = "ca.pem", certificate = "c.pem", key = "k.pem" }
[control]
lease_s = 10
deadman_s = 0.5
rate_hz = 50
slew_per_s = 0.5
audit = "/var/log/zbridge/audit.jsonl"
audit_bytes = 5000
audit_files = 2
[metrics]
listen = "127.0.0.1:9100"
""",
    )
    assert made.device.options.gap_s == 0.05
    assert made.device.options.force == ("joystick", 50)
    assert made.config.bus.connect == ("tcp/10.0.0.1:7447",)
    assert made.config.bus.tls is not None
    assert made.config.bus.tls.key == "k.pem"
    control = made.config.control
    assert (control.lease_s, control.deadman_s, control.rate_hz, control.slew_per_s) == (10.0, 0.5, 50.0, 0.5)
    assert (control.audit, control.audit_bytes, control.audit_files) == ("/var/log/zbridge/audit.jsonl", 5000, 2)
    assert made.metrics == Address("127.0.0.1", 9100)


def test_a_process_may_only_serve_hq_programs(tmp_path: Path) -> None:
    made = loaded(tmp_path, '[robot]\nname = "r1"\n[[hq]]\nprotocol = "alf"\nlisten = "tcp://127.0.0.1:11002"\n')
    assert made.device is None
    (listener,) = made.listeners
    assert (listener.protocol.name, listener.address) == ("alf", Address("127.0.0.1", 11002))
    assert (listener.options, listener.allow) == (listener.protocol.hq_options(), ())
    settings = listener.settings
    assert (settings.name, settings.clients, settings.rate_hz) == (None, 256, 1000.0)
    assert (settings.handshake_s, settings.idle_s) == (5.0, None)


def test_every_key_of_a_listener_is_read(tmp_path: Path) -> None:
    made = loaded(
        tmp_path,
        MINIMAL
        + """
[[hq]]
protocol = "tcpudp"
listen = "tcp://[::1]:0"
name = "ground.1"
clients = 3
handshake_s = 1.5
idle_s = 60
rate_hz = 200
allow = ["10.0.0.0/8", "192.168.1.7", "fd00::/8"]
options = { versions = ["1.1"], quiet_s = 0 }
[[hq]]
protocol = "wc2ec"
listen = "tcp://${HOST}:10020"
""",
        HOST="robot.test",
    )
    assert made.device is not None
    first, second = made.listeners
    assert first.address == Address("::1", 0)
    assert first.settings.name == "ground.1"
    assert (first.settings.clients, first.settings.handshake_s, first.settings.idle_s) == (3, 1.5, 60.0)
    assert first.settings.rate_hz == 200.0
    assert [str(network) for network in first.allow] == ["10.0.0.0/8", "192.168.1.7/32", "fd00::/8"]
    assert (first.options.versions, first.options.quiet_s) == (("1.1",), 0.0)
    assert (second.protocol.name, second.address) == ("wc2ec", Address("robot.test", 10020))


def test_listeners_without_a_name_may_be_many_of_one_protocol() -> None:
    given = (None, None, "a", "b")
    ports = [{"listen": f"tcp://127.0.0.1:{11002 + number}"} for number in range(4)]
    entries = [hq(**port, **({"name": name} if name else {})) for port, name in zip(ports, given, strict=True)]
    assert [listener.settings.name for listener in plan(serving(*entries), {}).listeners] == list(given)


def test_two_listeners_need_two_addresses_unless_they_take_any_port() -> None:
    with pytest.raises(ConfigError, match=r"hq\[0\].listen = 'tcp://127.0.0.1:11002': expected an address of its own"):
        plan(serving(hq(), hq()), {})
    assert len(plan(serving(hq(listen="tcp://127.0.0.1:0"), hq(listen="tcp://127.0.0.1:0")), {}).listeners) == 2


@pytest.mark.parametrize(("field", "value"), [("clients", 1), ("clients", 10_000), ("rate_hz", 1), ("rate_hz", 1e6)])
def test_the_bounds_of_a_listener_are_themselves_allowed(field: str, value: float) -> None:
    (listener,) = plan(serving(hq(**{field: value})), {}).listeners
    assert getattr(listener.settings, field) == value


@pytest.mark.parametrize(
    ("bus", "mode"),
    [
        ({}, "peer"),
        ({"connect": ["tcp/a:1"]}, "client"),
        ({"connect": ["tcp/a:1"], "listen": ["tcp/b:2"]}, "peer"),
        ({"listen": ["tcp/b:2"]}, "peer"),
        ({"connect": ["tcp/a:1"], "mode": "peer"}, "peer"),
        ({"mode": "router"}, "router"),
    ],
)
def test_the_mode_of_the_bus_is_client_when_only_connect_is_given(bus: dict[str, Any], mode: str) -> None:
    assert plan(minimal(bus=bus)).config.bus.effective_mode == mode


def test_variables_of_the_environment_are_put_into_strings_wherever_they_stand() -> None:
    raw = minimal(
        robot={"name": "r-${N}${N}"}, bus={"connect": ["tcp/${HOST}:7447"]}, control={"audit": "/log/${N}.jsonl"}
    )
    raw["device"]["connect"] = ["tcp://${HOST}:${PORT}"]
    made = plan(raw, {"N": "7", "HOST": "robot.test", "PORT": "11001"})
    assert made.config.robot.name == "r-77"
    assert made.device.addresses == (Address("robot.test", 11001),)
    assert made.config.bus.connect == ("tcp/robot.test:7447",)
    assert made.config.control.audit == "/log/7.jsonl"


def test_a_value_of_the_environment_is_not_substituted_again() -> None:
    with pytest.raises(ConfigError, match="letters"):
        plan(minimal(robot={"name": "${A}"}), {"A": "${B}", "B": "x"})


ERRORS: list[tuple[dict[str, Any], str]] = [
    ({}, "robot: missing"),
    ({"robot": {}, "device": {}}, "robot.name: missing"),
    ({"robot": {"name": "r1"}}, "device: missing, it is required where there is no [[hq]]"),
    (serving(), "device: missing, it is required where there is no [[hq]]"),
    ({"robot": {"name": "r1"}, "hq": hq()}, "hq = {'protocol': 'tcpudp', "),
    (serving({}), "hq[0].protocol: missing, it is required"),
    (serving(hq(), {"protocol": "alf"}), "hq[1].listen: missing, it is required"),
    (serving(hq(colour="red")), "hq[0].colour = 'red': unknown key; expected one of protocol, listen, name, options"),
    (serving(hq(protocol="nope")), "hq[0].protocol = 'nope': expected one of alf, tcpudp, wc2ec"),
    (serving(hq(protocol=1)), "hq[0].protocol = 1: expected `str`"),
    (serving(hq(), hq(listen="127.0.0.1:11002")), "hq[1].listen = '127.0.0.1:11002': expected tcp://host:port"),
    (serving(hq(listen="tcp://a:99999")), "hq[0].listen = 'tcp://a:99999': "),
    (serving(hq(listen="tcp://${NONE}:1")), "hq[0].listen = 'tcp://${NONE}:1': expected the environment variable NONE"),
    (serving(hq(listen=["tcp://a:1"])), "hq[0].listen = ['tcp://a:1']: expected `str`"),
    (serving(hq(name="a/b")), "hq[0].name = 'a/b': expected letters, digits, '_', '.' and '-' only"),
    (serving(hq(name="")), "hq[0].name = '': expected letters"),
    (serving(hq(name="a"), hq(name="a")), "hq[0].name = 'a': expected a name of its own"),
    (serving(hq(name=5)), "hq[0].name = 5: expected `str"),
    (serving(hq(clients=0)), "hq[0].clients = 0: expected `int` >= 1"),
    (serving(hq(clients=10_001)), "hq[0].clients = 10001: expected `int` <= 10000"),
    (serving(hq(clients=1.5)), "hq[0].clients = 1.5: expected `int`"),
    (serving(hq(handshake_s=0)), "hq[0].handshake_s = 0: expected `float` > 0"),
    (serving(hq(handshake_s=3601)), "hq[0].handshake_s = 3601: expected `float` <= 3600"),
    (serving(hq(handshake_s=math.nan)), "hq[0].handshake_s = nan: expected"),
    (serving(hq(idle_s=0)), "hq[0].idle_s = 0: expected `float` > 0"),
    (serving(hq(idle_s=math.inf)), "hq[0].idle_s = inf: expected"),
    (serving(hq(idle_s="long")), "hq[0].idle_s = 'long': expected `float"),
    (serving(hq(rate_hz=0.5)), "hq[0].rate_hz = 0.5: expected `float` >= 1"),
    (serving(hq(rate_hz=1e7)), "hq[0].rate_hz = 10000000.0: expected `float` <= 1000000"),
    (serving(hq(rate_hz=math.nan)), "hq[0].rate_hz = nan: expected"),
    (serving(hq(allow="10.0.0.0/8")), "hq[0].allow = '10.0.0.0/8': expected `array`"),
    (serving(hq(allow=["10.0.0.0/8", 5])), "hq[0].allow[1] = 5: expected `str`"),
    (serving(hq(allow=["10.0.0.0/8", "home"])), "hq[0].allow[1] = 'home': expected a network like '192.168.1.0/24': "),
    (serving(hq(allow=["10.0.0.1/8"])), "hq[0].allow[0] = '10.0.0.1/8': expected a network like '192.168.1.0/24': "),
    (serving(hq(options=5)), "hq[0].options = 5: expected `object`"),
    (serving(hq(options={"version": "1.1"})), "hq[0].options.version = '1.1': unknown key; expected one of versions, "),
    (serving(hq(), hq(options={"gap_s": -1})), "hq[1].options.gap_s = -1: expected `float` >= 0"),
    (serving(hq(options={"versions": []})), "hq[0].options.versions = []: expected `array` of length >= 1"),
    (serving(hq(options={"versions": ["one"]})), "hq[0].options.versions[0] = 'one': "),
    (serving(hq(protocol="wc2ec", options={"sectors": 0})), "hq[0].options.sectors = 0: expected `int` >= 1"),
    (serving(hq(protocol="wc2ec", options={"dialect": "draft"})), "devices: must be listed for the draft"),
    (serving(hq(protocol="alf", options={"serve": "nothing"})), "hq[0].options.serve = 'nothing': expected one of"),
    (minimal(robot={"name": 5}), "robot.name = 5: expected `str`"),
    (minimal(robot={"name": "a/b"}), "robot.name = 'a/b': expected letters"),
    (minimal(robot={"name": ""}), "robot.name = '': expected letters"),
    (minimal(robot={"name": "@r"}), "robot.name = '@r': expected letters"),
    (minimal(robot={"name": "r1", "realm": "*"}), "robot.realm = '*': expected letters"),
    (minimal(robot={"name": "r1", "colour": "red"}), "robot.colour = 'red': unknown key"),
    (minimal(robot=1), "robot = 1: expected `object`"),
    (minimal(robot={"nam": "r1"}), "expected one of name, realm"),
    (minimal(colour="red"), "colour = 'red': unknown key"),
    (minimal(robot={"name": "${NONE}"}), "robot.name = '${NONE}': expected the environment variable NONE"),
    (device(connect=["${NONE}"]), "device.connect[0] = '${NONE}': expected the environment variable NONE"),
    (device(protocol="nope"), "device.protocol = 'nope': expected one of"),
    (device(connect=[]), "device.connect = []: expected `array` of length >= 1"),
    (device(connect="tcp://a:1"), "device.connect = 'tcp://a:1': expected `array`"),
    (device(connect=["tcp://a:1", 5]), "device.connect[1] = 5: expected `str`"),
    (device(connect=["udp://a:1"]), "device.connect = 'udp://a:1': expected tcp://host:port"),
    (device(connect=["serial:///dev/s"]), "device.connect = 'serial:///dev/s': expected serial:///path?baud=N"),
    (serving(hq(listen="serial:///dev/s?baud=9600")), "hq[0].listen = 'serial:///dev/s?baud=9600': expected tcp://"),
    (
        minimal(metrics={"listen": "serial:///dev/s?baud=9600"}),
        "metrics.listen = 'serial:///dev/s?baud=9600': expected",
    ),
    (device(connect=["tcp://a:99999"]), "device.connect = 'tcp://a:99999': "),
    (device(connect=["tcp://a:1", "tcp://a:2"]), "a tcpudp robot has at most 1 link"),
    (device(options=5), "device.options = 5: expected `object`"),
    (device(options={"gap": 1}), "device.options.gap = 1: unknown key"),
    (device(options={"gap_s": -1}), "device.options.gap_s = -1: expected `float` >= 0"),
    (device(options={"speed_full": 0.0}), "device.options.speed_full = 0.0: expected `float` > 0"),
    (device(options={"combine": "all"}), "device.options.combine = 'all': expected one of 'both', 'exclusive'"),
    (device(options={"force": ["wings"]}), "device.options.force[0] = 'wings': expected one of"),
    (device(options={"force": [300]}), "device.options.force[0] = 300: expected `int` <= 255"),
    (device(options={"map_origin": [1.0]}), "device.options.map_origin = [1.0]: expected `array` of length 2"),
    (minimal(bus={"mode": "mesh"}), "bus.mode = 'mesh': expected one of 'client', 'peer', 'router'"),
    (minimal(bus={"stream": "lose"}), "bus.stream = 'lose': expected one of 'block', 'drop'"),
    (minimal(bus={"connect": [1]}), "bus.connect[0] = 1: expected `str`"),
    (minimal(bus={"connect": ["127.0.0.1:7447"]}), "bus.connect[0] = '127.0.0.1:7447': "),
    (minimal(bus={"tls": {"ca": 1}}), "bus.tls.ca = 1: expected `str`"),
    (minimal(bus={"tls": {}}), "bus.tls.ca: missing"),
    (minimal(control={"lease_s": 0}), "control.lease_s = 0: expected `float` > 0"),
    (minimal(control={"deadman_s": float("nan")}), "control.deadman_s = nan: expected"),
    (minimal(control={"deadman_s": float("inf")}), "control.deadman_s = inf: expected"),
    (minimal(control={"lease_s": 3601}), "control.lease_s = 3601: expected `float` <= 3600"),
    (minimal(control={"rate_hz": 0}), "control.rate_hz = 0: expected `float` > 0"),
    (minimal(control={"rate_hz": math.nan}), "control.rate_hz = nan: expected `float` > 0"),
    (minimal(control={"slew_per_s": -1.0}), "control.slew_per_s = -1.0: expected `float` > 0"),
    (minimal(control={"slew_per_s": math.nan}), "control.slew_per_s = nan: expected `float` > 0"),
    (minimal(control={"slew_per_s": "fast"}), "control.slew_per_s = 'fast': expected `float"),
    (minimal(control={"audit": ""}), "control.audit = '': expected `str` of length >= 1"),
    (minimal(control={"audit": True}), "control.audit = True: expected `str"),
    (minimal(control={"audit_bytes": 999}), "control.audit_bytes = 999: expected `int` >= 1000"),
    (minimal(control={"audit_bytes": 1e6 + 0.5}), "control.audit_bytes = 1000000.5: expected `int`"),
    (minimal(control={"audit_files": 0}), "control.audit_files = 0: expected `int` >= 1"),
    (minimal(control={"audit_file": "x"}), "control.audit_file = 'x': unknown key"),
    *[
        (device(options={name: value}), f"device.options.{name} = {value}: expected `float` ")
        for name in ("speed_full", "turn_full", "length_unit_m", "map_cell_m", "heading_offset")
        for value in (math.inf, -math.inf, math.nan)
    ],
    *[
        (device(options={"map_origin": [0.0, value]}), f"device.options.map_origin[1] = {value}: expected `float` ")
        for value in (math.inf, math.nan)
    ],
    (minimal(metrics={"listen": "9100"}), "metrics.listen = '9100': expected host:port"),
    (minimal(metrics={"listen": "tcp://a:1"}), "metrics.listen = 'tcp://a:1': expected host:port"),
    (minimal(metrics={}), "metrics.listen: missing"),
]


@pytest.mark.parametrize(("raw", "text"), ERRORS, ids=[text for _, text in ERRORS])
def test_an_error_names_key_value_and_what_was_expected(raw: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan(raw, {})
    assert text in str(caught.value)


def test_a_protocol_without_an_hq_side_serves_no_hq_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    own = msgspec.structs.replace(find_protocol("alf"), hq=None)
    monkeypatch.setattr(config, "find_protocol", lambda name: own)
    with pytest.raises(ConfigError, match=r"hq\[0\]\.protocol = 'alf': serves no HQ programs"):
        plan(serving(hq(protocol="alf")), {})


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (MINIMAL.replace('"r1"', '"a/b"').encode(), r"robot\.toml: robot\.name = 'a/b'"),
        (b"\nname = \n", r"robot\.toml: not TOML: .*line 2"),
        (b"\xff\xfe", "not TOML"),
        (None, r"robot\.toml: No such file"),
    ],
    ids=["a wrong value", "no TOML", "no text", "no file"],
)
def test_an_error_in_a_file_names_the_file_and_the_place(tmp_path: Path, content: bytes | None, error: str) -> None:
    file = tmp_path / "robot.toml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match=error):
        load(file)


def test_a_folder_is_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="directory"):
        load(tmp_path)
