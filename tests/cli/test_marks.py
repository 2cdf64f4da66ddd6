"""``zbridge mark`` and ``restart`` on a secure bus: who may not is told, for the router drops it without a word."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.fake_bus import FakeBus
from zbridge.bus import Bus, BusSettings, Tls
from zbridge.cli.gateway_commands import restart
from zbridge.cli.recording import put_mark
from zbridge.errors import BusRefused
from zbridge.fleet import payload as payloads
from zbridge.fleet.processes import Membership

TAKES = "that takes the role {} in roles.toml of the router"


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    bus = FakeBus("router")

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus.join("program")

    monkeypatch.setattr("zbridge.client.open_bus", open_bus)
    return bus


def as_member(folder: Path, common_name: str) -> BusSettings:
    certificate = Authority(folder / "lab").issue(common_name) / "certificate.pem"
    return BusSettings(connect=["tls/127.0.0.1:1"], tls=Tls("ca.pem", str(certificate)))


def knows(bus: FakeBus, name: str, role: str) -> None:
    member = payloads.encode(Membership(name=name, role=role))
    bus.answer(f"fleet/@bus/whoami/{name}", lambda question: question.answer(member))


@pytest.mark.parametrize("known", [False, True])
async def test_a_viewer_may_not_mark(bus: FakeBus, tmp_path: Path, known: bool) -> None:
    if known:
        knows(bus, "vi", "viewer")
    told = f"^viewer.vi may not write a mark: {TAKES.format('operator or supervisor or hq')}$"
    with pytest.raises(BusRefused, match=told):
        await put_mark(as_member(tmp_path, "viewer.vi"), "fleet", "text", None)
    assert bus.network.history == []


async def test_what_the_router_says_counts_and_not_the_certificate(bus: FakeBus, tmp_path: Path) -> None:
    knows(bus, "vi", "operator")
    await put_mark(as_member(tmp_path, "viewer.vi"), "fleet", "text", None)
    assert [sample.key for sample in bus.network.history] == ["fleet/@mark"]


async def test_an_operator_may_not_restart_and_no_gateway_is_asked(
    bus: FakeBus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = []
    bus.answer("fleet/r1/@rpc/restart/*", asked.append)
    assert not await restart(as_member(tmp_path, "operator.op1"), "fleet", "r1")
    told = TAKES.format("supervisor")
    assert capsys.readouterr().err == f"r1: operator.op1 may not restart its gateway: {told}\n"
    assert asked == []


async def test_a_restart_without_an_answer_tells_of_rules_only_where_there_may_be_some(
    bus: FakeBus, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert not await restart(as_member(tmp_path, "supervisor.sue"), "fleet", "r1")
    assert capsys.readouterr().err == "r1: no answer: no gateway, or the router's rules forbid it\n"
    assert not await restart(BusSettings(connect=["tcp/127.0.0.1:1"]), "fleet", "r1")
    assert capsys.readouterr().err == "r1: no gateway answered\n"
