"""Doctor on the gateway's own host: what only that machine knows reaches the verdict."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.fake_bus import FakeBus
from tests.ports import free_port
from zbridge.bus.tls.files import folder_settings
from zbridge.cli import doctor as command
from zbridge.doctor import gateway_file, here
from zbridge.doctor.bus import examine_certificate
from zbridge.doctor.examination import Examination, Options
from zbridge.doctor.findings import Finding, Layer, Verdict
from zbridge.doctor.gateway_file import examine_file
from zbridge.errors import LinkError
from zbridge.fleet.processes import SessionEntry
from zbridge.host.addresses import AddressHolder

FILE = '[robot]\nname = "r1"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:{port}"]\n'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "r1.toml"
    path.write_text(FILE.format(port=free_port()))
    return path


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def hold(*pids: int) -> None:
        known = [AddressHolder("fleet/r1", pid, False) for pid in pids]
        monkeypatch.setattr(here, "holders", lambda form: known)
        monkeypatch.setattr(gateway_file, "serving", lambda plan: known[0] if known else None)

    return hold


async def examined(file: Path, tls: Path | None = None, **options: bool) -> list[Finding]:
    examination = Examination()
    await examine_file(examination, file, tls, Options(**options))  # type: ignore[arg-type]
    return examination.findings


def codes(findings: list[Finding], layer: Layer) -> set[str]:
    return {each.code for each in findings if each.layer is layer and each.verdict is not Verdict.OK}


async def test_a_process_that_has_the_robot_and_is_not_on_the_bus_is_not_told_to_be_started(
    file: Path, bus: FakeBus, held: Callable[..., None]
) -> None:
    held(4711)
    findings = await examined(file)
    (gateway,) = [each for each in findings if each.layer is Layer.GATEWAY]
    assert (gateway.code, gateway.text.startswith("process 4711 of this machine has the robot")) == (
        "not_on_the_bus",
        True,
    )
    assert gateway.remedy is not None
    assert "zbridge run" not in gateway.remedy


async def test_a_second_gateway_of_the_same_robot_is_a_warning_that_names_both(
    file: Path, bus: FakeBus, held: Callable[..., None]
) -> None:
    held(4711, 4712)
    (finding,) = [each for each in await examined(file) if each.layer is Layer.ADDRESS]
    assert (finding.verdict, finding.code) == (Verdict.WARNING, "two_gateways")
    assert "processes 4711, 4712" in finding.text


@pytest.mark.parametrize(
    ("failure", "verdict", "code", "says"),
    [
        (None, Verdict.NOTE, "probed", "answers (tcpudp 1.3); the probe used its connection"),
        ("no common version: the peer speaks '9'", Verdict.ERROR, "wrong_version", "(no common version: the peer"),
        (LinkError("tcp://a:1: Connection refused"), Verdict.ERROR, "no_handshake", "tcp://a:1: Connection refused"),
    ],
)
async def test_what_a_probe_found_is_the_verdict(
    file: Path,
    bus: FakeBus,
    monkeypatch: pytest.MonkeyPatch,
    failure: str | LinkError | None,
    verdict: Verdict,
    code: str,
    says: str,
) -> None:
    from zbridge.doctor import probe

    async def shake_hands(protocol: object, address: object, options: object) -> probe.Probed:
        if isinstance(failure, LinkError):
            raise failure
        entry = SessionEntry("robot", "tcp://a:1", "hq", "closed", failure, None if failure else "1.3")
        return probe.Probed(entry, None, failure is None)

    monkeypatch.setattr(probe, "shake_hands", shake_hands)
    findings = await examined(file, probe=True)
    (found,) = [each for each in findings if each.layer is Layer.ROBOT and each.verdict is not Verdict.SKIPPED]
    assert (found.verdict, found.code) == (verdict, code)
    assert says in found.text
    assert (Layer.GATEWAY in {each.layer for each in findings}) == (failure is not None), (
        "nobody serves it, as expected"
    )


async def test_a_robot_that_is_served_is_not_probed(file: Path, bus: FakeBus, held: Callable[..., None]) -> None:
    held(4711)
    findings = await examined(file, probe=True)
    assert "not probed: process 4711 of this machine serves the robot" in {each.text for each in findings}


async def test_a_file_without_tls_is_read_with_a_viewers_certificate(
    file: Path, bus: FakeBus, held: Callable[..., None], tmp_path: Path
) -> None:
    held()
    folder = Authority(tmp_path / "lab").issue("viewer.v1")
    (folder / "bus.toml").write_text('[bus]\nconnect = ["tls/127.0.0.1:1"]\n')
    assert codes(await examined(file, folder), Layer.CERTIFICATE) == {"not_checked"}


def test_a_key_that_others_can_read_is_an_error_that_names_the_command(tmp_path: Path) -> None:
    folder = Authority(tmp_path / "lab").issue("viewer.v1")
    settings = folder_settings(folder, ("tls/127.0.0.1:1",))
    (folder / "key.pem").chmod(0o644)
    (finding,) = examine_certificate(settings)
    assert (finding.verdict, finding.code, finding.remedy) == (
        Verdict.ERROR,
        "key_readable",
        f"chmod 600 {folder / 'key.pem'}",
    )
    (folder / "key.pem").chmod(0o600)
    assert [each.code for each in examine_certificate(settings)] == ["ends_soon"]


def test_an_authority_that_strict_programs_refuse_is_a_warning_that_names_the_commands(tmp_path: Path) -> None:
    folder = Authority(tmp_path / "lab", strict=False).issue("viewer.v1", days=90)
    (finding,) = examine_certificate(folder_settings(folder, ("tls/127.0.0.1:1",)))
    assert (finding.verdict, finding.code) == (Verdict.WARNING, "not_strict")
    assert finding.remedy == "`zbridge certs init --force`, then `zbridge certs renew --all`"


def test_the_kernels_table_shows_a_port_that_is_open_and_not_one_that_was_closed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        open_ports = here.listening_ports()
        assert open_ports is not None
        assert open_ports[port] == {"127.0.0.1"}
    closed = here.listening_ports()
    assert closed is not None
    assert port not in closed
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
        assert (here.listening_ports("udp") or {})[port] == {"127.0.0.1"}
        bound.connect(("127.0.0.1", 9))
        assert port not in (here.listening_ports("udp") or {})


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"target": "nowhere.toml"}, "nowhere.toml: no such file"),
        ({"target": "a b"}, "TARGET = 'a b': expected a robot's name"),
        ({"target": "r1", "probe": True}, "--probe: only with a FILE"),
        ({"target": "r1", "disks": [Path("/")]}, "--disk: only with a FILE"),
        ({"target": "FILE", "disks": [Path("/nowhere")]}, "--disk /nowhere: no such directory"),
        ({"target": "FILE", "connect": ["tcp/127.0.0.1:1"]}, "--connect: not with a FILE"),
    ],
)
def test_options_that_do_not_fit_the_target_are_refused(
    file: Path, arguments: dict[str, object], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if arguments["target"] == "FILE":
        arguments = {**arguments, "target": str(file)}
    with pytest.raises(SystemExit) as ended:
        command.doctor(**arguments)  # type: ignore[arg-type]
    assert ended.value.code == 2
    assert says in capsys.readouterr().err
