"""Configurations: what is accepted, and that every error names file, key, value and what was expected."""

import math
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest

from zbridge.app import config
from zbridge.app.config import GatewayPlan, load, plan
from zbridge.app.templates import listener_template, robot_template
from zbridge.bus import Tls
from zbridge.control.settings import ControlSettings
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


def serving(*listeners: dict[str, Any]) -> dict[str, Any]:
    """A process that only serves HQ programs."""
    return {"robot": {"name": "r1"}, "hq": list(listeners)}


def hq(**fields: Any) -> dict[str, Any]:
    return {"protocol": "tcpudp", "listen": "tcp://127.0.0.1:11002", **fields}


def loaded(folder: Path, text: str, **environment: str) -> GatewayPlan:
    file = folder / "robot.toml"
    file.write_text(text, encoding="utf-8")
    return load(file, environment)


def test_a_minimal_file_takes_all_defaults(tmp_path: Path) -> None:
    made = loaded(tmp_path, MINIMAL)
    assert (made.config.robot.name, made.config.robot.realm) == ("r1", "fleet")
    assert (made.device.addresses, made.device.protocol.name) == ((Address("127.0.0.1", 11001),), "tcpudp")
    assert (made.device.options, made.metrics, made.camera) == (made.device.protocol.options(), None, None)
    control, bus = made.config.control, made.config.bus
    assert (control.lease_s, control.deadman_s, control.rate_hz, control.slew_per_s) == (3.0, 2.0, None, None)
    assert (control.audit, control.audit_bytes, control.audit_files) == (None, 1_000_000, 5)
    assert (bus.effective_mode, bus.multicast, bus.stream) == ("peer", True, "drop")


SECURE = MINIMAL + '[bus]\nconnect = ["tls/hub.lab:7447"]\n'
FILES = 'tls = { ca = "ca.pem", certificate = "own/c.pem", key = "/etc/k.pem" }\n'


def test_files_of_tls_are_relative_to_the_file(tmp_path: Path) -> None:
    tls = loaded(tmp_path, SECURE + FILES).config.bus.tls
    assert tls == Tls(str(tmp_path / "ca.pem"), str(tmp_path / "own" / "c.pem"), "/etc/k.pem")


BUNDLED = 'connect = ["tls/other.lab:7447"]\n'
BUSES: list[tuple[str, bool, str]] = [
    ("", True, "tls/other.lab:7447"),
    ("", False, "tls/other.lab:7447"),
    ('[bus]\nconnect = ["tls/hub.lab:7447"]\n', True, "tls/hub.lab:7447"),
    ('[bus]\nconnect = ["tls/hub.lab:7447"]\n', False, "tls/hub.lab:7447"),
]


@pytest.mark.parametrize(("bus", "option", "endpoint"), BUSES)
def test_a_folder_makes_a_file_without_tls_secure(tmp_path: Path, bus: str, option: bool, endpoint: str) -> None:
    file, folder = tmp_path / "r1.toml", tmp_path / "bundle"
    file.write_text(MINIMAL + bus)
    folder.mkdir()
    (folder / "bus.toml").write_text("[bus]\n" + BUNDLED)
    settings = load(file, {} if option else {"ZBRIDGE_TLS": str(folder)}, tls=folder if option else None).config.bus
    assert (settings.connect, settings.effective_mode) == ((endpoint,), "client")
    assert settings.tls == Tls(*(str(folder / f"{name}.pem") for name in ("ca", "certificate", "key")))


FOLDERS: list[tuple[str, str | None, str]] = [
    ("", None, "no such folder; expected one as `zbridge certs bundle` makes it"),
    ("", "", "no bus.toml there; give --connect tls/HOST:7447"),
    ("", "[bus]\n", "bus.toml: expected a [bus] table with connect = "),
    ("", "hello", "bus.toml: expected a [bus] table with connect = "),
    ('[bus]\nmode = "peer"\n', BUNDLED, "bus.mode = 'peer': expected 'client', or none"),
    ("[bus]\n" + BUNDLED + FILES, BUNDLED, "expected only for a file without bus.tls"),
]


@pytest.mark.parametrize(("bus", "bundled", "told"), FOLDERS)
def test_a_folder_that_does_not_fit_is_told(tmp_path: Path, bus: str, bundled: str | None, told: str) -> None:
    file, folder = tmp_path / "r1.toml", tmp_path / "bundle"
    file.write_text(MINIMAL + bus)
    if bundled is not None:
        folder.mkdir()
    if bundled:
        (folder / "bus.toml").write_text(bundled if bundled != BUNDLED else "[bus]\n" + BUNDLED)
    with pytest.raises(ConfigError) as raised:
        load(file, {}, tls=folder)
    assert told in str(raised.value)
    assert str(raised.value).startswith(f"{file}: ")


REQUIRED = {"mavlink": {"system_id": 1}}
"""Options of listeners that have no default."""


@pytest.mark.parametrize("name", protocol_names())
def test_the_templates_of_every_protocol_are_configurations_with_all_defaults(tmp_path: Path, name: str) -> None:
    protocol = find_protocol(name)
    made = loaded(tmp_path, robot_template(protocol).replace("{name}", "r7"))
    assert (made.config.robot.name, made.device.options) == ("r7", protocol.options())
    if protocol.hq is None:
        return
    made = loaded(tmp_path, listener_template(protocol).replace("{name}", "r7"))
    (listener,) = made.listeners
    assert (made.config.robot.name, made.device, listener.options) == (
        "r7",
        None,
        protocol.hq_options(**REQUIRED.get(name, {})),
    )
    settings = listener.settings
    assert settings == HqSettings(protocol=name, listen=settings.listen, options=settings.options)


EVERY_KEY = """
[device.options]
gap_s = 0.05
force = ["joystick", 50]
[bus]
connect = ["tls/10.0.0.1:7447"]
multicast = false
stream = "block"
tls = { ca = "/etc/ca.pem", certificate = "/etc/c.pem", key = "/etc/k.pem" }
[control]
lease_s = 10.0
deadman_s = 0.5
rate_hz = 50.0
slew_per_s = 0.5
audit = "/var/log/zbridge/audit.jsonl"
audit_bytes = 5000
audit_files = 2
audit_days = 7.0
idle_stop_s = 0.5
[metrics]
listen = "127.0.0.1:9100"
[camera]
url = "http://[fd00::7]/stream.mjpg?w=640"
rate_hz = 5.0
stall_s = 2.5
relay = "0.0.0.0:8000"
clients = 4
allow = ["192.168.1.0/24", "fd00::/8"]
[[hq]]
protocol = "tcpudp"
listen = "tcp://[::1]:0"
name = "ground.1"
clients = 3
handshake_s = 1.5
idle_s = 60.0
rate_hz = 200.0
allow = ["10.0.0.0/8", "192.168.1.7", "fd00::/8"]
options = { versions = ["1.1"], quiet_s = 0 }
"""


def test_every_key_is_read(tmp_path: Path) -> None:
    made, given = loaded(tmp_path, MINIMAL + EVERY_KEY), tomllib.loads(EVERY_KEY)
    for read, table in (
        (made.config.bus, given["bus"]),
        (made.config.control, given["control"]),
        (made.config.hq[0], given["hq"][0]),
        (made.device.options, given["device"]["options"]),
    ):
        values = msgspec.json.decode(msgspec.json.encode(read))
        assert {name: value for name, value in values.items() if name in table} == table
    assert made.metrics == Address("127.0.0.1", 9100)
    camera, table = made.camera, given["camera"]
    assert (str(camera.source), camera.source.target) == ("http://[fd00::7]:80/stream.mjpg", "/stream.mjpg?w=640")
    assert (camera.relay, [str(network) for network in camera.allow]) == (Address("0.0.0.0", 8000), table["allow"])
    assert msgspec.json.decode(msgspec.json.encode(camera.settings)) == table
    (listener,) = made.listeners
    assert listener.address == Address("::1", 0)
    assert [str(network) for network in listener.allow] == ["10.0.0.0/8", "192.168.1.7/32", "fd00::/8"]
    assert (listener.options.versions, listener.options.quiet_s) == (("1.1",), 0.0)


def test_a_process_may_only_serve_hq_programs() -> None:
    made = plan(serving(hq(protocol="alf", listen="tcp://${HOST}:10020")), {"HOST": "robot.test"})
    (listener,) = made.listeners
    assert (made.device, listener.protocol.name, listener.allow) == (None, "alf", ())
    assert (listener.address, listener.options) == (Address("robot.test", 10020), listener.protocol.hq_options())


def test_many_listeners_may_have_one_protocol_no_name_and_any_port() -> None:
    named = [hq(listen="tcp://127.0.0.1:0", name=name) for name in "ab"]
    listeners = plan(serving(hq(), hq(listen="tcp://127.0.0.1:11003"), *named), {}).listeners
    assert [listener.settings.name for listener in listeners] == [None, None, "a", "b"]


def test_the_mode_of_the_bus_is_client_when_only_connect_is_given() -> None:
    connect = {"connect": ["tcp/a:1"]}
    for bus, mode in (
        ({}, "peer"),
        (connect, "client"),
        ({**connect, "listen": ["tcp/b:2"]}, "peer"),
        ({**connect, "mode": "peer"}, "peer"),
    ):
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
    with pytest.raises(ConfigError, match="letters"):  # a value is not substituted again
        plan(minimal(robot={"name": "${A}"}), {"A": "${B}", "B": "x"})


def secure(**bus: Any) -> dict[str, Any]:
    return minimal(bus={"connect": ["tls/hub.lab:7447"], "tls": {"ca": "a", "certificate": "b", "key": "c"}, **bus})


TLS = {"certificate": "/none.pem", "key": "/key.pem"}


URL = "http://192.168.0.10:8000/stream.mjpg"
INF, NAN = math.inf, math.nan
NOT_NAMES = ("a/b", "", "@r", "*")

ERRORS: list[tuple[dict[str, Any], str]] = [
    # What is missing, unknown, or of another type, at every depth
    ({}, "robot: missing"),
    ({"robot": {"name": "r1"}}, "device: missing, it is required without [[hq]]"),
    (serving(hq(), {"protocol": "alf"}), "hq[1].listen: missing, it is required"),
    (minimal(bus={"tls": {}}), "bus.tls.ca: missing"),
    # On a secure bus every program is a client of a router
    (secure(mode="peer"), "bus.mode = 'peer': expected 'client', or none: with tls"),
    (secure(mode="router"), "bus.mode = 'router': expected 'client', or none: with tls"),
    (secure(listen=["tls/0.0.0.0:7447"]), "bus.listen = ['tls/0.0.0.0:7447']: expected none: with tls"),
    (secure(connect=[]), "bus.connect: missing, expected tls/host:port"),
    (secure(connect=["tls/a:1", "tcp/a:1"]), "bus.connect = 'tcp/a:1': expected tls/host:port: with tls nothing"),
    (minimal(colour="red"), "colour = 'red': unknown key"),
    (minimal(robot={"nam": "r1"}), "expected one of name, realm"),
    (serving(hq(colour="red")), "hq[0].colour = 'red': unknown key; expected one of protocol, listen, name, options"),
    (serving(hq(options={"version": "1.1"})), "hq[0].options.version = '1.1': unknown key; expected one of versions, "),
    (minimal(control={"audit_file": "x"}), "control.audit_file = 'x': unknown key"),
    (minimal(robot=1), "robot = 1: expected `object`"),
    (device(options=5), "device.options = 5: expected `object`"),
    (device(connect=["tcp://a:1", 5]), "device.connect[1] = 5: expected `str`"),
    (device(connect=[]), "device.connect = []: expected `array` of length >= 1"),
    (device(options={"map_origin": [1.0]}), "device.options.map_origin = [1.0]: expected `array` of length 2"),
    ({"robot": {"name": "r1"}, "hq": hq()}, "hq = {'protocol': 'tcpudp', "),
    (serving(hq(allow=["10.0.0.0/8", 5])), "hq[0].allow[1] = 5: expected `str`"),
    # One of several
    (serving(hq(protocol="nope")), "hq[0].protocol = 'nope': expected one of alf, mavlink, ros2, tcpudp, wc2ec"),
    (minimal(bus={"mode": "mesh"}), "bus.mode = 'mesh': expected one of 'client', 'peer', 'router'"),
    (device(options={"force": ["wings"]}), "device.options.force[0] = 'wings': expected one of"),
    (device(options={"force": [300]}), "device.options.force[0] = 300: expected `int` <= 255"),
    # Names
    *[(minimal(robot={"name": name}), f"robot.name = {name!r}: expected letters") for name in NOT_NAMES],
    *[(serving(hq(name=name)), f"hq[0].name = {name!r}: expected letters, digits, '_',") for name in NOT_NAMES],
    (minimal(robot={"name": "r1", "realm": "*"}), "robot.realm = '*': expected letters"),
    (serving(hq(name="a"), hq(name="a")), "hq[0].name = 'a': expected a name of its own"),
    # Addresses and networks
    (serving(hq(), hq()), "hq[0].listen = 'tcp://127.0.0.1:11002': expected an address of its own"),
    (serving(hq(), hq(listen="127.0.0.1:11002")), "hq[1].listen = '127.0.0.1:11002': expected tcp://host:port"),
    (serving(hq(listen="serial:///dev/s?baud=9600")), "hq[0].listen = 'serial:///dev/s?baud=9600': expected tcp://"),
    (device(connect=["udp://a:1"]), "device.connect = 'udp://a:1': expected tcp://host:port"),
    (device(connect=["serial:///dev/s"]), "device.connect = 'serial:///dev/s': expected serial:///path?baud=N"),
    (device(connect=["tcp://a:1", "tcp://a:2"]), "a tcpudp robot has at most 1 link"),
    (minimal(bus={"connect": ["127.0.0.1:7447"]}), "bus.connect[0] = '127.0.0.1:7447': "),
    (minimal(metrics={"listen": "9100"}), "metrics.listen = '9100': expected host:port"),
    (serving(hq(allow=["10.0.0.0/8", "home"])), "hq[0].allow[1] = 'home': expected a network like '192.168.1.0/24': "),
    (serving(hq(allow=["10.0.0.1/8"])), "hq[0].allow[0] = '10.0.0.1/8': expected a network like '192.168.1.0/24': "),
    (serving(hq(listen="tls://127.0.0.1")), "hq[0].listen = 'tls://127.0.0.1': expected tls://host:port"),
    (serving(hq(listen="tls://a:1")), "hq[0].tls: missing, it is required with listen = 'tls://a:1'"),
    (serving(hq(listen="tls://a:1", tls={"key": "k"})), "hq[0].tls.certificate: missing"),
    (
        serving(hq(tls=TLS)),
        "hq[0].listen = 'tcp://127.0.0.1:11002': expected tls://host:port, because there is a table tls",
    ),
    (serving(hq(listen="tls://a:1", tls=TLS)), "hq[0].tls: certificate '/none.pem' with key '/key.pem': No such file"),
    (serving(hq(), hq(listen="tls://127.0.0.1:11002", tls=TLS)), "hq[1].tls: certificate '/none.pem'"),
    # The camera
    ({**serving(hq()), "camera": {"url": URL}}, "camera: expected only with a table device"),
    (minimal(camera={}), "camera.url: missing, it is required"),
    (minimal(camera={"url": URL, "rate": 5}), "camera.rate = 5: unknown key; expected one of url, rate_hz, stall_s,"),
    *[
        (minimal(camera={"url": url}), f"camera.url = {url!r}: expected http://host:port/path")
        for url in (
            "",
            "192.168.0.10:8000",
            "https://robot/",
            "http:///x",
            "http://r:0/",
            "http://u:p@r/",
            "http://r/#a",
        )
    ],
    (minimal(camera={"url": "http://r/a\r\nX: y"}), "camera.url = 'http://r/a\\r\\nX: y': expected http://host"),
    (minimal(camera={"url": "http://r/a b"}), "camera.url = 'http://r/a b': expected http://host:port/path"),
    (minimal(camera={"url": "http://r:99999/"}), "camera.url = 'http://r:99999/': Port out of range 0-65535; expected"),
    (minimal(camera={"url": URL, "relay": "8000"}), "camera.relay = '8000': expected host:port"),
    (minimal(camera={"url": URL, "relay": "a:1", "allow": ["home"]}), "camera.allow[0] = 'home': expected a network"),
    (minimal(camera={"url": URL, "allow": ["::/0"]}), "camera.allow = ['::/0']: expected only with camera.relay"),
    # The environment
    (serving(hq(listen="tcp://${NONE}:1")), "hq[0].listen = 'tcp://${NONE}:1': expected the environment variable NONE"),
    (device(connect=["${NONE}"]), "device.connect[0] = '${NONE}': expected the environment variable NONE"),
    # Bounds
    *[
        (raw, f"{key}.{name} = {value!r}: expected `{kind}")
        for name, kind, values in (
            ("clients", "int", (0, 10_001, 1.5)),
            ("handshake_s", "float", (0, 3601, NAN)),
            ("idle_s", "float", (0, INF)),
            ("lease_s", "float", (0, 3601, NAN)),
            ("deadman_s", "float", (0, 3601, NAN, INF)),
            ("rate_hz", "float", (0, NAN)),
            ("slew_per_s", "float", (-1.0, NAN, "fast")),
            ("audit", "str", ("", True)),
            ("audit_bytes", "int", (999, 1e6 + 0.5)),
            ("audit_files", "int", (0,)),
        )
        for value in values
        for key, kind_of, raw in (
            ("hq[0]", HqSettings, serving(hq(**{name: value}))),
            ("control", ControlSettings, minimal(control={name: value})),
        )
        if name in kind_of.__struct_fields__
    ],
    *[
        (device(options={name: value}), f"device.options.{name} = {value}: expected `float` ")
        for name in ("speed_full", "turn_full", "length_unit_m", "map_cell_m", "heading_offset")
        for value in (INF, -INF, NAN)
    ],
    (device(options={"gap_s": -1}), "device.options.gap_s = -1: expected `float` >= 0"),
    (device(options={"map_origin": [0.0, NAN]}), "device.options.map_origin[1] = nan: expected `float` "),
    # Options that a protocol checks by itself
    (serving(hq(options={"versions": ["one"]})), "hq[0].options.versions[0] = 'one': "),
    (serving(hq(protocol="mavlink")), "hq[0].options.system_id: missing, it is required"),
    (serving(hq(protocol="wc2ec", options={"dialect": "draft"})), "devices: must be listed for the draft"),
]


@pytest.mark.parametrize(("raw", "text"), ERRORS, ids=[text for _, text in ERRORS])
def test_an_error_names_key_value_and_what_was_expected(raw: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan(raw, {})
    assert text in str(caught.value)


def test_an_error_in_a_file_names_the_file_and_the_place(tmp_path: Path) -> None:
    for content, error in (
        (None, r"robot\.toml: No such file"),
        (MINIMAL.replace('"r1"', '"a/b"').encode(), r"robot\.toml: robot\.name = 'a/b'"),
        (b"\nname = \n", r"robot\.toml: not TOML: .*line 2"),
        (b"\xff\xfe", "not TOML"),
    ):
        file = tmp_path / "robot.toml"
        if content is not None:
            file.write_bytes(content)
        with pytest.raises(ConfigError, match=error):
            load(file)


def test_a_protocol_without_an_hq_side_serves_no_hq_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    own = msgspec.structs.replace(find_protocol("alf"), hq=None)
    monkeypatch.setattr(config, "find_protocol", lambda name: own)
    with pytest.raises(ConfigError, match=r"hq\[0\]\.protocol = 'alf': serves no HQ programs"):
        plan(serving(hq(protocol="alf")), {})
