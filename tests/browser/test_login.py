"""Users log in, see what their role may do, and are out when they log out."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from tests.browser.conftest import Browser, soon
from tests.client import World
from tests.views.console.programs import PASSWORD
from tests.views.console.serving import served
from zbridge.fleet import topics
from zbridge.fleet.messages import Status
from zbridge.views.console.users import User, hash_password, save_users

pytestmark = pytest.mark.asyncio(loop_scope="session")
COMMANDS = ("stop", "drive", "light")


class Desk:
    """A console with users before a robot, and a browser."""

    def __init__(self, world: World, browser: Browser, users: Path) -> None:
        self.world, self.browser, self.users = world, browser, users

    async def log_in(self, user: str, password: str = PASSWORD, path: str = "/#/robot/r1") -> Any:
        page = await self.browser.open(path)
        await page.get_by_label("User").fill(user)
        await page.get_by_label("Password").fill(password)
        await page.get_by_role("button", name="Log in").click()
        return page


@pytest_asyncio.fixture(loop_scope="session")
async def desk(tmp_path: Path, shared: Any) -> AsyncIterator[Desk]:
    world, users, hashed = World("r1"), tmp_path / "users.toml", hash_password(PASSWORD)
    save_users(users, {role: User(role, hashed) for role in ("viewer", "operator", "supervisor")})  # type: ignore[arg-type]

    async def publish() -> None:
        while True:
            world.gateway.publish(topics.STATUS, Status("established", commands=COMMANDS))
            await asyncio.sleep(0.5)

    publishing = asyncio.create_task(publish())
    async with served(world.fleet, world.bus.join("console"), tmp_path / "roster", users=users) as at:
        yield Desk(world, Browser(shared, at), users)
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)


async def test_a_user_logs_in_sees_what_the_role_may_do_and_logs_out(desk: Desk) -> None:
    page = await desk.log_in("viewer", "wrong password")
    await page.get_by_role("alert").get_by_text("no such user, or another password").wait_for()
    await page.get_by_label("Password").fill(PASSWORD)
    await page.keyboard.press("Enter")
    await page.get_by_text("viewer (viewer)").wait_for()
    await page.locator(".picture").wait_for()
    for name in ("Take control", "On"):
        assert await page.get_by_role("button", name=name).count() == 0
    await page.get_by_role("button", name="STOP ALL").click()
    await page.get_by_text("1 of 1 stopped (their gateways sent it)").wait_for()
    assert await page.get_by_role("button", name="Release").count() == 0
    await page.reload()
    await page.get_by_text("viewer (viewer)").wait_for()
    await page.get_by_role("button", name="Log out").click()
    await page.get_by_label("Password").wait_for()
    await page.reload()
    await page.get_by_label("Password").wait_for()


async def test_an_operator_drives_under_their_name_and_releases_one_robot(desk: Desk) -> None:
    page = await desk.log_in("operator")
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("Ready.").wait_for()
    assert desk.world.gateway.control.holder == "console.operator"
    await page.keyboard.down("w")
    await soon(lambda: desk.world.gateway.driven and desk.world.gateway.driven[-1].moving)  # type: ignore[attr-defined]
    await desk.world.fleet["r1"].latch("wet floor")
    await page.get_by_role("button", name="Release r1").click()
    await page.get_by_text("r1: 1 latched stops released").wait_for()
    assert desk.world.gateway.control.state != "latched"


async def test_a_user_who_is_removed_is_shown_the_login(desk: Desk) -> None:
    page = await desk.log_in("operator")
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("Ready.").wait_for()
    save_users(desk.users, {})
    await page.get_by_label("Password").wait_for()
    await soon(lambda: desk.world.gateway.control.state == "free")


async def test_a_stop_that_the_end_of_the_login_swallowed_is_said_with_the_login(desk: Desk) -> None:
    page = await desk.log_in("viewer", path="/")
    await page.locator(".tall .row").first.wait_for()
    await page.evaluate(
        """async () => {
          const { csrf } = await (await fetch('/api/me')).json();
          await fetch('/api/logout', { method: 'POST', headers: { 'x-zbridge-csrf': csrf } });
          dispatchEvent(new KeyboardEvent('keydown', { key: 'Escape' }));
        }"""
    )
    await page.get_by_label("Password").wait_for()
    await page.get_by_text("STOP ALL was NOT confirmed").wait_for()
    assert not desk.world.machine.stops
