"""The black box of a gateway: what it keeps on its own, and what it answers on the bus."""

from __future__ import annotations

import asyncio
import errno
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from tests.blackbox.scene import EPOCH_NS
from tests.fake_bus import FakeBus, FakeQuery
from tests.machine import Patience
from zbridge.app.black_box import WAITING, BoxServer, box_folder, open_black_box
from zbridge.app.config import plan
from zbridge.blackbox import BlackBox, BlackBoxSettings, BoxFolder, IncidentInfo
from zbridge.blackbox.incidents import IncidentCause
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.errors import Code, Refused, ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet.incidents import IncidentPart, Incidents, ReadIncident
from zbridge.fleet.messages import Text
from zbridge.fleet.topics import KeySpace

KEYS = KeySpace("fleet", "r1")
DEVICE = {"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:1"]}
BOX = "fleet/r1/@rpc/blackbox"


class Gateway:
    """What of a gateway the black box needs."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.folder = BoxFolder(folder / "blackbox", "fleet", "r1")
        self.open_faults = OpenFaults()
        self.plan = plan({"robot": {"name": "r1"}, "device": DEVICE, "blackbox": settings})
        self.opened = open_black_box(self.plan, KEYS, self.open_faults, folder, alone=True)

    @property
    def codes(self) -> list[str]:
        return [fault.code for fault in self.open_faults.faults]

    def causes(self) -> list[tuple[str, str]]:
        (info,) = self.folder.infos()
        return [(cause.code, cause.text) for cause in info.causes]


@pytest.fixture
async def gateway(tmp_path: Path) -> Gateway:
    return Gateway(tmp_path)


async def until(condition: Any) -> None:
    patience = Patience(10.0)
    while not condition():
        assert not patience.over
        await asyncio.sleep(0.002)


def left_by(folder: BoxFolder, pid: int) -> None:
    """Leave what a process leaves that was killed."""
    folder.make()
    (folder.live / str(pid)).write_text("")


# The folder


def test_the_files_are_where_the_configuration_says_or_beside_latched_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert box_folder(BlackBoxSettings(dir="/box"), tmp_path) == Path("/box")
    assert box_folder(BlackBoxSettings(), tmp_path) == tmp_path / "blackbox"
    assert box_folder(BlackBoxSettings()) == Path("/state/zbridge/blackbox")


async def test_without_the_table_there_is_no_black_box(tmp_path: Path) -> None:
    without = plan({"robot": {"name": "r1"}, "device": DEVICE})
    with open_black_box(without, KEYS, OpenFaults(), tmp_path, alone=True) as box:
        assert box is None
    assert os.listdir(tmp_path) == []


# What it keeps


async def test_an_incident_among_the_faults_keeps_the_minutes_before_it(gateway: Gateway) -> None:
    with gateway.opened as box:
        assert box is not None
        gateway.open_faults.happened(FaultCode.DEADMAN, "too early")
        box.begin()
        box.put("fleet/r1/pose", b"\x80")
        gateway.open_faults.happened(FaultCode.ROBOT_LOST, "closed")
        gateway.open_faults.set(FaultCode.AUDIT_LOG, "disk full")
    gateway.open_faults.happened(FaultCode.DEADMAN, "too late")
    assert gateway.causes() == [("robot_lost", "closed")]
    (info,) = gateway.folder.infos()
    assert len(gateway.folder.parts(info.name)) == 2


async def test_the_freeze_frame_has_versions_and_the_configuration_without_secrets(tmp_path: Path) -> None:
    gateway = Gateway(tmp_path, keep=3)
    with gateway.opened as box:
        assert box is not None
        box.begin()
        gateway.open_faults.happened(FaultCode.DEADMAN, "no command")
    (info,) = gateway.folder.infos()
    assert set(info.frame["versions"]) == {"zbridge", "python", "protocol"}
    assert info.frame["configuration"] == gateway.plan.written
    assert info.frame["configuration"]["blackbox"] == {"keep": 3}


@pytest.mark.parametrize("error", [ValueError("a bug"), ZbridgeError("no bus"), KeyboardInterrupt()])
async def test_an_unexpected_error_by_which_the_gateway_ends_is_an_incident(
    gateway: Gateway, error: BaseException
) -> None:
    def run() -> None:
        with gateway.opened as box:
            assert box is not None
            box.begin()
            raise error

    with pytest.raises(type(error)):
        run()
    codes = [info.causes[0].code for info in gateway.folder.infos()]
    assert codes == (["gateway_died"] if isinstance(error, ValueError) else [])


async def test_the_next_process_continues_an_incident_that_is_open(gateway: Gateway) -> None:
    with gateway.opened as box:
        assert box is not None
        box.begin()
        gateway.open_faults.happened(FaultCode.DEADMAN, "no command")
    assert [info.ended_ns for info in gateway.folder.infos()] == [None]


async def test_a_process_before_this_one_that_died_is_a_fault_and_an_incident(gateway: Gateway) -> None:
    left_by(gateway.folder, 4711)
    with gateway.opened as box:
        assert box is not None
        box.begin()
        box.disk.wake()
        await until(lambda: gateway.codes)
    assert gateway.codes == ["gateway_died"]
    assert gateway.causes()[0][1].startswith("process 4711 did not shut down cleanly")


@pytest.mark.parametrize("code", [FaultCode.GATEWAY_DIED, FaultCode.GATEWAY_HUNG])
async def test_what_the_supervisor_said_of_its_end_counts_alone(gateway: Gateway, code: FaultCode) -> None:
    left_by(gateway.folder, 4711)
    with gateway.opened as box:
        assert box is not None
        box.begin()
        gateway.open_faults.happened(code, "no heartbeat")
    await asyncio.sleep(0)
    assert gateway.codes == [code]
    assert gateway.causes() == [(code, "no heartbeat")]


@pytest.mark.parametrize(
    ("code", "died"),
    [(FaultCode.GATEWAY_DIED, True), (FaultCode.GATEWAY_HUNG, True), (FaultCode.DEADMAN, False)],
)
async def test_only_the_end_of_the_process_before_concerns_its_minutes(
    gateway: Gateway, monkeypatch: pytest.MonkeyPatch, code: FaultCode, died: bool
) -> None:
    kept = []
    monkeypatch.setattr(BlackBox, "keep", lambda box, code, text, *, died=False: kept.append((code, text, died)))
    with gateway.opened:
        gateway.open_faults.happened(code, "why")
    assert kept == [(code, "why", died)]


async def test_a_folder_that_cannot_be_written_is_a_fault_and_the_gateway_serves(gateway: Gateway) -> None:
    gateway.folder.path.parent.mkdir()
    gateway.folder.path.write_text("a file")
    with gateway.opened as box:
        assert box is not None
        box.begin()
        box.put("fleet/r1/pose", b"\x80")
    await asyncio.sleep(0)
    assert gateway.codes == ["black_box"]
    (text,) = gateway.open_faults.texts
    assert text == f"the black box is not written: {gateway.folder.path}: Not a directory"


# What it answers


class Served:
    """A server on a fake bus, with one incident."""

    def __init__(self, path: Path) -> None:
        self.now = 0.0
        self.bus = FakeBus()
        self.box = BlackBox(KEYS, path, BlackBoxSettings(), {})
        self.kept: list[tuple[str, str]] = []
        self.box.keep = self._keep  # type: ignore[method-assign]
        self.folder = self.box.folder
        self.folder.make()
        (self.folder.incidents / "one").mkdir()
        self.folder.write_info(IncidentInfo("one", "fleet", "r1", 1, (IncidentCause("deadman", "why", EPOCH_NS),)))
        (self.folder.incidents / "one" / "0000000001.zbb").write_bytes(b"content")
        self.server = BoxServer(self.bus, KEYS, self.box, lambda: self.now)

    def ask(self, path: str, payload: bytes = b"\x80") -> FakeQuery:
        key = f"{BOX}/{path}"
        above = key.rpartition("/")[0]
        (handler,) = (handler for at, handler, _ in self.bus.network.queryables if at in (key, f"{above}/*"))
        query = FakeQuery(key, payload)
        handler(query)
        return query

    def _keep(self, code: str, text: str, *, died: bool = False) -> bool:
        self.kept.append((code, text))
        return True

    async def answer(self, path: str, payload: bytes = b"\x80") -> bytes | Code:
        """Return what is answered, or the code of the refusal."""
        query = self.ask(path, payload)
        await until(lambda: query.replies)
        (reply,) = query.replies
        return reply.error.code if isinstance(reply.error, Refused) else reply.payload


@pytest.fixture
async def served(tmp_path: Path) -> Served:
    return Served(tmp_path)


def question(incident: str, file: str = "", offset: int = 0) -> bytes:
    return payloads.encode(ReadIncident(incident, file, offset))


async def test_incidents_are_listed_and_read_over_the_bus(served: Served) -> None:
    listed = await served.answer("incidents")
    assert isinstance(listed, bytes)
    assert [entry.name for entry in payloads.decode(Incidents, listed).incidents] == ["one"]
    part = await served.answer("read/ann", question("one", "0000000001.zbb", 3))
    assert isinstance(part, bytes)
    assert payloads.decode(IncidentPart, part).data == b"tent"


@pytest.mark.parametrize(
    ("payload", "code"),
    [
        (question("none"), Code.UNSUPPORTED),
        (question("../incidents/one"), Code.UNSUPPORTED),
        (question("one", "../../etc/passwd"), Code.UNSUPPORTED),
        (b"", Code.MALFORMED),
        (b"\xc1", Code.MALFORMED),
        (b"\x80", Code.MALFORMED),
        (question("one", "x" * 65), Code.MALFORMED),
        (question("one", offset=-1), Code.MALFORMED),
    ],
)
async def test_a_question_for_what_is_not_there_is_refused(served: Served, payload: bytes, code: Code) -> None:
    assert await served.answer("read/ann", payload) == code


async def test_a_disk_that_cannot_be_read_is_a_refusal(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path) -> list[Path]:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(served.folder, "parts", fail)
    assert await served.answer("read/ann", question("one")) == Code.NOT_READY
    assert await served.answer("incidents") == Code.NOT_READY


async def test_questions_that_wait_for_the_disk_are_bounded(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    moves, parts = threading.Event(), served.folder.parts

    def hang(name: str) -> list[Path]:
        assert moves.wait(10.0)
        return parts(name)

    monkeypatch.setattr(served.folder, "parts", hang)
    queries = [served.ask("read/ann", question("one")) for _ in range(WAITING + 5)]
    refused = [query for query in queries if query.replies]
    assert len(refused) == 5
    assert {query.replies[0].error.code for query in refused} == {Code.NOT_READY}
    moves.set()
    await until(lambda: all(query.replies for query in queries))
    assert isinstance(await served.answer("read/ann", question("one")), bytes)


async def test_a_mark_keeps_the_minutes_before_and_says_who_asked(served: Served) -> None:
    for name, mark in (("ann", Text("odd noise")), ("%C3%A4", Text("x")), ("ann", Text("y", sender="Bob"))):
        assert isinstance(await served.answer(f"keep/{name}", payloads.encode(mark)), bytes)
    assert served.kept == [("mark", "odd noise (ann)"), ("mark", "x (ä)"), ("mark", "y (ann)")]


@pytest.mark.parametrize(("name", "payload"), [("*", payloads.encode(Text("x"))), ("ann", b"\xc1"), ("ann", b"\x80")])
async def test_a_mark_of_nobody_or_without_a_text_is_refused(served: Served, name: str, payload: bytes) -> None:
    assert await served.answer(f"keep/{name}", payload) == Code.MALFORMED
    assert served.kept == []


async def test_after_its_end_nothing_is_answered(served: Served) -> None:
    served.server.close()
    served.server.close()
    assert served.bus.network.queryables == []
