"""Why a router was not reached, tried for real: each case is named by the client, by ``zbridge ls`` and by ``run``."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
import socket
from collections.abc import Awaitable, Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh

import zbridge
from tests.e2e.conftest import HOST, WAIT_S, configuration, device, end, start, until
from tests.e2e.test_certs import routing
from tests.machine import Patience
from tests.ports import free_port
from zbridge.app import Gateway, load
from zbridge.bus import BusSettings
from zbridge.cli.bus import list_robots
from zbridge.errors import BusError, ConfigError
from zbridge.security.certs import authority
from zbridge.security.certs.authority import CertificateRequest
from zbridge.security.files import Folder
from zbridge.security.member import check_member
from zbridge.security.roles import Member

DAY = timedelta(days=1)
ENDS_S = 8
"""After how long a certificate ends that ends while it is used."""
GATEWAY = Member("gateway", ("r1",))


class Lab:
    """A router with mutual TLS, one of plain TCP, and the folders of members that are wrong in one way each."""

    def __init__(self, path: Path) -> None:
        self.path, self.folder = path, Folder(path / "certs")
        self.port, self.plain, self.false, self.silent, self.nobody = (free_port() for _ in range(5))
        self.now = datetime.now(UTC)
        authority.init(self.folder, self.now)
        authority.issue(self.folder, CertificateRequest("hub", Member("router"), (HOST,)), self.now)
        for name in ("ann", "old", "young", "short"):
            self.issue(name)
        authority.renew(self.folder, "old", self.now - 2 * DAY, days=1)
        authority.renew(self.folder, "young", self.now + 2 * DAY)
        self.other = Folder(path / "other")
        authority.init(self.other, self.now)
        authority.issue(self.other, CertificateRequest("ann", GATEWAY), self.now)
        self.mixed("knowing", self.other, ca=self.folder.ca)
        self.mixed("mismatched", self.folder, key=self.folder.of("old").key)

    def issue(self, name: str) -> None:
        authority.issue(self.folder, CertificateRequest(name, GATEWAY), self.now)

    def here(self, common_name: str) -> bool:
        """Tell whether a member is connected, as the router says."""
        log = (self.path / "log").read_text()
        return f"{common_name} connected" in log.rpartition(f"{common_name} left")[2]

    def mixed(self, name: str, folder: Folder, **files: Path) -> None:
        """Copy the files of ann, some of them replaced."""
        there = self.path / name
        shutil.copytree(folder.of("ann").folder, there)
        for kind, file in files.items():
            shutil.copy(file, there / f"{kind}.pem")

    @contextlib.contextmanager
    def routing(self) -> Iterator[None]:
        log = self.path / "log"
        options = ("--tls", str(self.folder.of("hub").folder), "--roles", str(self.folder.roles))
        with log.open("wb") as output:
            router = start("router", "--listen", f"tls/{HOST}:{self.port}", *options, stdout=output, stderr=output)
        try:
            until(lambda: b"router at" in log.read_bytes(), what="router")
            self.issue("zed")  # the router has read roles.toml
            with (
                zenoh.open(configuration("router", f"tcp/{HOST}:{self.plain}")),
                routing(self.folder.of("ann"), self.false),
                socket.create_server((HOST, self.silent)),
            ):
                yield
        finally:
            end(router)


AT_A_TIME, TRIES = 5, 3


class Case(NamedTuple):
    """What is wrong. where: an endpoint. folder: of a lab; None: no certificate at all."""

    name: str
    where: Callable[[Lab], str]
    folder: Callable[[Lab], Path] | None
    said: str


Try = Callable[[Lab, Case], Awaitable[bool | str]]


def router(lab: Lab) -> str:
    return f"tls/{HOST}:{lab.port}"


def member(name: str) -> Callable[[Lab], Path]:
    return lambda lab: lab.folder.of(name).folder


CASES = [
    Case("no certificate", router, None, "wants a certificate, and we showed none"),
    Case("ours is of another authority", router, lambda lab: lab.path / "knowing", "another authority"),
    Case("the router's is of another", router, lambda lab: lab.other.of("ann").folder, "is of another authority than"),
    Case("expired", router, member("old"), "the certificate of gateway.old expired on "),
    Case("not yet valid", router, member("young"), "the certificate of gateway.young is not valid before "),
    Case("another host", lambda lab: f"tls/localhost:{lab.port}", member("ann"), "does not name the host localhost"),
    Case("no router's", lambda lab: f"tls/{HOST}:{lab.false}", member("ann"), "is not one of a server"),
    Case("silence", lambda lab: f"tls/{HOST}:{lab.silent}", member("ann"), "does not answer in TLS"),
    Case("another's key", router, lambda lab: lab.path / "mismatched", "key.pem: not the key of the certificate "),
    Case("plain TCP there", lambda lab: f"tls/{HOST}:{lab.plain}", member("ann"), "speaks no TLS: plain TCP"),
    Case("TLS there", lambda lab: f"tcp/{HOST}:{lab.port}", None, "speaks TLS: connect to tls/"),
    Case("nobody there", lambda lab: f"tls/{HOST}:{lab.nobody}", member("ann"), "nobody listens at"),
    Case("no such host", lambda lab: "tls/zbridge.invalid:7447", member("ann"), "no host has the name zbridge.invalid"),
    Case("unknown name", router, member("zed"), "the router does not know gateway.zed in realm fleet"),
]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    lab = Lab(tmp_path_factory.mktemp("lab"))
    with lab.routing():
        yield lab


@pytest.mark.long
async def test_each_case_is_named_by_the_client_by_ls_and_by_run(lab: Lab, caplog: pytest.LogCaptureFixture) -> None:
    some = asyncio.Semaphore(AT_A_TIME)
    assert await asyncio.gather(*(again(told, lab, case, some) for case in CASES)) == [True] * len(CASES)
    assert await asyncio.gather(*(again(listed, lab, case, some) for case in CASES)) == [True] * len(CASES)
    assert await asyncio.gather(*(logged(lab, case, caplog) for case in CASES)) == [True] * len(CASES)


async def again(try_it: Try, lab: Lab, case: Case, some: asyncio.Semaphore) -> bool | str:
    """Try a case again where nothing was found: on a busy machine a handshake may take longer than it is given."""
    async with some:
        for _ in range(TRIES):
            found = await try_it(lab, case)
            if found is True:
                break
        return found


async def told(lab: Lab, case: Case) -> bool | str:
    """Tell whether the client's error says it."""
    tls = case.folder(lab) if case.folder is not None else None
    with pytest.raises(BusError) as raised:
        async with zbridge.connect(case.where(lab), tls=tls):
            pass
    return case.said in str(raised.value) or str(raised.value)


async def listed(lab: Lab, case: Case) -> bool | str:
    """Tell whether ``zbridge ls`` says it, in one line."""
    tls = ("--tls", str(case.folder(lab))) if case.folder is not None else ()
    process = start("ls", "--connect", case.where(lab), *tls)
    try:
        said: str = (await asyncio.to_thread(process.communicate, timeout=60))[0]
    finally:
        end(process, signal.SIGKILL)
    assert (process.returncode, said.count("\n")) == (1, 1), said
    return case.said in said or said


async def logged(lab: Lab, case: Case, caplog: pytest.LogCaptureFixture) -> bool | str:
    """Tell whether a gateway says it: in its log, or as what is wrong with its files."""
    file = lab.path / f"{case.name}.toml"
    file.write_text(f'[robot]\nname = "r1"\n{device(1)}[bus]\nmulticast = false\nconnect = ["{case.where(lab)}"]\n')
    plan = load(file, {}, tls=case.folder(lab) if case.folder is not None else None)
    try:
        check_member(plan)
    except ConfigError as error:
        return case.said in str(error) or str(error)
    running = asyncio.create_task(Gateway(plan).run())
    patience = Patience(4 * WAIT_S)  # the third attempt asks the router
    while case.said not in caplog.text and not patience.over:  # noqa: ASYNC110 - a log, no event
        await asyncio.sleep(0.05)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return case.said in caplog.text or caplog.text


@pytest.mark.parametrize(("port", "hint"), [("port", ": 127.0.0.1:{port} speaks TLS: "), ("plain", "\n")])
async def test_who_sees_no_robot_is_told_of_a_router_that_speaks_tls(
    lab: Lab, capsys: pytest.CaptureFixture[str], port: str, hint: str
) -> None:
    where = BusSettings(mode="peer", connect=(f"tcp/{HOST}:{getattr(lab, port)}",), multicast=False)
    await list_robots(where, "fleet", as_json=False)
    assert f"no robots on fleet/{hint.format(port=lab.port)}" in capsys.readouterr().err


async def test_with_a_folder_alone_a_member_is_connected_and_one_without_the_robot_is_told(lab: Lab) -> None:
    (lab.folder.of("ann").folder / "bus.toml").write_text(f'[bus]\nconnect = ["{router(lab)}"]\n')
    async with zbridge.connect(tls=lab.folder.of("ann").folder) as fleet:
        assert await fleet.robots() == {}
    file = lab.path / "r2.toml"
    file.write_text(f'[robot]\nname = "r2"\n{device(free_port())}')
    checked = start("check", str(file), "--tls", str(lab.folder.of("ann").folder))
    assert (
        "not checked: whether the router knows gateway.ann and lets it serve r2" in checked.communicate(timeout=30)[0]
    )
    with (lab.path / "r2.log").open("wb") as log:
        running = start("run", str(file), "--tls", str(lab.folder.of("ann").folder), stdout=log, stderr=log)
    until(lambda: "gateway.ann is for r1 and not for r2" in (lab.path / "r2.log").read_text(), what="refusal")
    end(running)
    assert running.returncode == 0


async def test_a_gateway_whose_certificate_expires_leaves_and_is_back_with_a_renewed_one(
    lab: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    authority.renew(lab.folder, "short", datetime.now(UTC) - DAY + timedelta(seconds=ENDS_S), days=1)
    file = lab.path / "short.toml"
    file.write_text(f'[robot]\nname = "r1"\n{device(1)}[bus]\nconnect = ["{router(lab)}"]\n')
    plan = load(file, {}, tls=lab.folder.of("short").folder)
    running = asyncio.create_task(Gateway(plan).run())

    async def logs(*texts: str) -> None:
        patience = Patience(3 * WAIT_S)
        while not all(text in caplog.text for text in texts):
            assert not patience.over, caplog.text
            await asyncio.sleep(0.05)

    await logs("the certificate of gateway.short ends on ")
    await logs("expired on ", "; the bus is left", "no bus: the certificate of gateway.short expired")
    authority.renew(lab.folder, "short", datetime.now(UTC))
    patience = Patience(3 * WAIT_S)
    while not lab.here("gateway.short"):
        assert not patience.over
        await asyncio.sleep(0.05)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
