"""Each role tries each action in the console, on an open and on a secure bus, and finds what the page says."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

from websockets.exceptions import InvalidStatus

import zbridge
from tests.e2e.conftest import HOST, Bench, Gateway, device, until
from tests.e2e.rigs.secure import SecureBus
from tests.e2e.test_secure_gateway import ROLES, established, settings, tls
from tests.views.console.programs import PASSWORD, Programs
from zbridge.client import Fleet
from zbridge.views.console.rights import USER_ROLES, Action, rights_of
from zbridge.views.console.users import User, hash_password, new_token, save_users

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "console-api.md"
GHOST = "ghost"
HASHED = hash_password(PASSWORD)


class Scene(Programs):
    """A console with a user of each role, one robot, and somebody on the bus who may do everything."""

    def __init__(self, at: str, tokens: dict[str, str], boss: Fleet) -> None:
        super().__init__(at, tokens)
        self.boss = boss
        self._logins: dict[str, dict[str, str]] = {}

    async def request(self, user: str, **request: Any) -> bool:
        """Send a page's request; return whether it was carried out, not refused for the role."""
        headers = await self.headers(user)
        async with self.page(Cookie=headers["Cookie"]) as page:
            await page.recv()
            await page.send(json.dumps(request))
            async with asyncio.timeout(10):
                while True:
                    told = json.loads(await page.recv())
                    if "warning" in told:
                        assert re.search("may not|does not permit", told["warning"])
                        return False
                    if told.get("gone") == [GHOST] or any(each["good"] for each in told.get("notices", {}).values()):
                        return True

    async def takes(self, user: str, *, takeover: bool) -> bool:
        """Have a browser take control; return whether it got it."""
        headers = await self.headers(user)
        try:
            async with self.page("/drive/r1", Cookie=headers["Cookie"]) as drive:
                await drive.send(json.dumps({"do": "take", "takeover": takeover}))
                async with asyncio.timeout(10):
                    while True:
                        control = json.loads(await drive.recv()).get("control", {})
                        if control.get("state") == "held":
                            await drive.send(json.dumps({"do": "give"}))
                            return True
                        if re.search("may not|does not permit", control.get("notice") or ""):
                            return False
        except InvalidStatus:
            return False

    async def headers(self, user: str) -> dict[str, str]:
        if user not in self._logins:
            self._logins[user] = await self.browser(user)
        return self._logins[user]


async def _looks(scene: Scene, user: str) -> bool:
    return (await scene.ask("GET", "/api/robots", user=user)).status == 200


async def _stops(scene: Scene, user: str) -> bool:
    return (await scene.ask("POST", "/api/robots/r1/stop", user=user)).status == 200


async def _takes_over(scene: Scene, user: str) -> bool:
    async with scene.boss["r1"].control("sup1.other" if scene.boss.name else "other"):
        return await scene.takes(user, takeover=True)


async def _unlatches(scene: Scene, user: str) -> bool:
    await scene.boss["r1"].latch("wet floor")
    answer = await scene.ask("POST", "/api/unlatch", {"robot": "r1"}, user=user)
    if answer.status != 200:
        await scene.boss["r1"].unlatch()
    return answer.status == 200 and bool(answer.json["good"])


async def _unlatches_fleet(scene: Scene, user: str) -> bool:
    await scene.boss.latch(reason="fire")
    answer = await scene.ask("POST", "/api/unlatch", user=user)
    released = answer.status == 200 and "1 of 1 released" in answer.json["text"]
    if not released:
        await scene.boss.unlatch()
    return released


TRIES: dict[Action, Callable[[Scene, str], Awaitable[bool]]] = {
    Action.LOOK: _looks,
    Action.STOP: _stops,
    Action.DRIVE: lambda scene, user: scene.takes(user, takeover=False),
    Action.SWITCH: lambda scene, user: scene.request(user, do="switch", robot="r1", name="lidar", on=True),
    Action.TAKE_OVER: _takes_over,
    Action.UNLATCH: _unlatches,
    Action.UNLATCH_FLEET: _unlatches_fleet,
    Action.FORGET: lambda scene, user: scene.request(user, do="forget", robot=GHOST),
}


def users(folder: Path) -> tuple[Path, dict[str, str]]:
    """Make a user of each role, with a token."""
    tokens, known = dict[str, str](), dict[str, User]()
    for role in USER_ROLES:
        tokens[role], kept = new_token()
        known[role] = User(role, HASHED, {"lab": kept})
    save_users(folder / "users.toml", known)
    (folder / "roster").write_text(f"{GHOST}\n")
    return folder / "users.toml", tokens


async def console(bench: Bench, *more: str) -> str:
    file, _ = bench.folder / "users.toml", None
    options = (
        "--users",
        str(file),
        "--journal",
        str(bench.folder / "journal"),
        "--roster",
        str(bench.folder / "roster"),
    )
    process: Any = bench.zbridge("console", "--listen", f"{HOST}:0", *options, *more)
    return str((await asyncio.to_thread(process.stdout.readline)).split()[-1])


@contextlib.asynccontextmanager
async def open_scene(bench: Bench, folder: Path) -> AsyncIterator[Scene]:
    _, tokens = users(bench.folder)
    bench.gateway(device(bench.simulator()))
    at = await console(bench, "--connect", bench.endpoint)
    await asyncio.to_thread(until, lambda: bench.fleet.state() == "established", 20.0, "established")
    async with zbridge.connect(endpoints=[bench.endpoint]) as boss:
        yield Scene(at, tokens, boss)


@contextlib.asynccontextmanager
async def secure_scene(bench: Bench, folder: Path, own: str = "sup1") -> AsyncIterator[Scene]:
    """own: the name in the certificate of the console."""
    bus = SecureBus(folder / "bus", ROLES)
    bench.stack.callback(bus.stop)
    _, tokens = users(bench.folder)
    Gateway(bench.stack, folder / "r1.toml", bus.endpoint, device(bench.simulator()), tls(bus, "g1"))
    at = await console(bench, "--connect", bus.endpoint, "--tls", str(bus.folders[own]))
    async with zbridge.connect(settings=settings(bus, "sup1")) as boss:
        await established(boss)
        yield Scene(at, tokens, boss)


async def tried(scene: Scene) -> dict[str, set[Action]]:
    """Give what each role could do."""
    found: dict[str, set[Action]] = {}
    for role in USER_ROLES:
        found[role] = {action for action, attempt in TRIES.items() if await attempt(scene, role)}
        if Action.FORGET in found[role]:
            assert role == "supervisor", "the ghost is gone for those who come after"
    return found


def table(found: dict[str, set[Action]]) -> str:
    """Write the table of the documentation."""
    lines = [f"| | {' | '.join(USER_ROLES)} |", f"|---{'|---' * len(USER_ROLES)}|"]
    for action in TRIES:
        cells = ("yes" if action in found[role] else "" for role in USER_ROLES)
        lines.append(f"| {action.value.replace('_', ' ')} | {' | '.join(cells)} |")
    return re.sub(" +", " ", "\n".join(lines))


async def test_each_role_on_an_open_bus_does_what_the_page_says(bench: Bench, tmp_path: Path) -> None:
    async with open_scene(bench, tmp_path) as scene:
        found = await tried(scene)
    print(table(found))
    assert table(found) in PAGE.read_text()


async def test_each_role_on_a_secure_bus_does_the_same(bench: Bench, tmp_path: Path) -> None:
    async with secure_scene(bench, tmp_path) as scene:
        found = await tried(scene)
    assert table(found) in PAGE.read_text()


async def test_nobody_does_more_than_the_certificate_of_the_console_permits(bench: Bench, tmp_path: Path) -> None:
    async with secure_scene(bench, tmp_path, "op1") as scene:
        found = await tried(scene)
    assert found["supervisor"] == found["operator"] == rights_of("operator")
    assert found["viewer"] == rights_of("viewer")
