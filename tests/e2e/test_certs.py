"""Certificates of ``zbridge certs`` on a real Zenoh router: who gets in, and who does not."""

from __future__ import annotations

import asyncio
import contextlib
import json
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest
import zenoh

from tests.ports import free_port
from zbridge.bus import BusSettings, open_bus
from zbridge.errors import BusError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Pose
from zbridge.metrics import Metrics
from zbridge.security.certs import authority
from zbridge.security.certs.authority import CertificateRequest
from zbridge.security.certs.bundle import Packing, bundle
from zbridge.security.files import Folder, NameFiles
from zbridge.security.roles import Member

KEY = "fleet/r1/pose"


class Lab(msgspec.Struct, frozen=True):
    """An authority with a router, a gateway and a viewer; the port of its router."""

    folder: Folder
    port: int

    def settings(self, name: str, host: str = "127.0.0.1") -> BusSettings:
        """Pack a name, and read the ``[bus]`` table of the bundle."""
        output = self.folder.path.parent / f"{self.folder.path.name}-{name}-{host}"
        bundle(self.folder, name, Packing(output, (f"tls/{host}:{self.port}",)), datetime.now(UTC))
        return msgspec.convert(tomllib.loads((output / "bus.toml").read_text())["bus"], BusSettings)


def new_lab(path: Path, port: int) -> Lab:
    now, folder = datetime.now(UTC), Folder(path)
    authority.init(folder, now)
    for name, member, hosts in (
        ("hub", Member("router"), ("localhost", "127.0.0.1")),
        ("g1", Member("gateway", ("r1",)), ()),
        ("ann", Member("viewer"), ()),
    ):
        authority.issue(folder, CertificateRequest(name, member, hosts), now)
    return Lab(folder, port)


@contextlib.contextmanager
def routing(files: NameFiles, port: int) -> Iterator[zenoh.Session]:
    """Run a router with mutual TLS in this process."""
    tls = {
        "root_ca_certificate": str(files.ca),
        "enable_mtls": True,
        "listen_certificate": str(files.certificate),
        "listen_private_key": str(files.key),
    }
    values = {
        "mode": "router",
        "listen/endpoints": [f"tls/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        **{f"transport/link/tls/{key}": value for key, value in tls.items()},
    }
    config = zenoh.Config()
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return new_lab(tmp_path / "certs", free_port())


async def refused(settings: BusSettings) -> bool:
    """Tell whether the bus cannot be opened."""
    try:
        bus = await open_bus(settings, Metrics())
    except BusError:
        return True
    await bus.close()
    return False


async def arrives(sender: BusSettings, receiver: BusSettings) -> bool:
    """Tell whether a pose of one session reaches another one, through the router."""
    got = asyncio.Event()
    receiving = await open_bus(receiver, Metrics())
    sending = await open_bus(sender, Metrics())
    try:
        receiving.subscribe(KEY, lambda sample: got.set())
        publisher = sending.publisher(KEY, topics.POSE)
        for _ in range(100):
            publisher.put(payloads.encode(Pose(1.0, 2.0, 0.5)))
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(got.wait(), 0.1)
                break
        return got.is_set()
    finally:
        await sending.close()
        await receiving.close()


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
async def test_data_comes_from_a_gateway_to_a_viewer_through_a_router(lab: Lab, host: str) -> None:
    with routing(lab.folder.of("hub"), lab.port):
        assert await arrives(lab.settings("g1", host), lab.settings("ann", host))


async def test_a_renewed_certificate_and_the_one_before_are_taken(lab: Lab) -> None:
    before = lab.settings("g1")
    authority.renew(lab.folder, "g1", datetime.now(UTC))
    authority.renew(lab.folder, "hub", datetime.now(UTC))
    with routing(lab.folder.of("hub"), lab.port):
        assert await arrives(before, lab.settings("g1", "localhost"))


async def test_a_certificate_of_another_authority_is_refused(lab: Lab, tmp_path: Path) -> None:
    other = new_lab(tmp_path / "other", lab.port)
    stranger = other.settings("ann")
    knowing = msgspec.structs.replace(stranger, tls=msgspec.structs.replace(stranger.tls, ca=str(lab.folder.ca)))
    with routing(lab.folder.of("hub"), lab.port):
        assert not await refused(lab.settings("ann"))
        assert await refused(stranger)  # does not trust the router
        assert await refused(knowing)  # the router does not trust it


async def test_an_expired_certificate_is_refused(lab: Lab) -> None:
    settings = lab.settings("ann")
    authority.renew(lab.folder, "ann", datetime.now(UTC) - timedelta(days=2), days=1)
    expired = msgspec.structs.replace(
        settings, tls=msgspec.structs.replace(settings.tls, certificate=str(lab.folder.of("ann").certificate))
    )
    with routing(lab.folder.of("hub"), lab.port):
        assert not await refused(settings)
        assert await refused(expired)


async def test_a_viewer_cannot_pose_as_a_router(lab: Lab) -> None:
    with routing(lab.folder.of("ann"), lab.port):
        assert await refused(lab.settings("g1"))


async def test_a_router_is_refused_under_a_host_that_its_certificate_does_not_name(lab: Lab) -> None:
    now = datetime.now(UTC)
    authority.issue(lab.folder, CertificateRequest("far", Member("router"), ("hub.lab",)), now)
    with routing(lab.folder.of("far"), lab.port):
        assert await refused(lab.settings("g1"))
