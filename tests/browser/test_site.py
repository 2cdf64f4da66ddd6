"""The documentation site in a browser, over HTTP and without a network: pictures load, and search finds pages."""

from __future__ import annotations

import functools
import http.server
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from tests.docs.site import built

pytestmark = pytest.mark.asyncio(loop_scope="session")


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    serve = functools.partial(Quiet, directory=str(built(tmp_path_factory.getbasetemp().parent)))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


async def test_search_finds_pages_pictures_load_and_nothing_is_fetched_from_elsewhere(
    shared: Any, address: str
) -> None:
    context = await shared.new_context()
    page = await context.new_page()
    fetched: list[str] = []
    failed: list[str] = []
    page.on("request", lambda request: fetched.append(request.url))
    page.on("requestfailed", lambda request: failed.append(request.url))
    page.on("response", lambda answer: failed.append(answer.url) if answer.status >= 400 else None)
    await page.goto(f"{address}/explanation/who-may-drive/")
    picture = page.locator("img[src*=lease]")
    assert await picture.evaluate("image => image.naturalWidth") > 500
    await page.keyboard.press("/")
    await page.keyboard.type("idle_stop_s", delay=20)
    found = page.locator(".md-search-result__link[href*='reference/configuration']").first
    await found.wait_for()
    assert [url for url in fetched if not url.startswith((address, "data:", "blob:"))] == []
    assert failed == []
