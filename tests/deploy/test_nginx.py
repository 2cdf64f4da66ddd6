"""The configuration for nginx, before a real console: pages, sockets and logins pass, with the addresses of clients."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import ssl
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect

from tests.certificates import Authority
from tests.client import World
from tests.ports import HOST, free_port
from tests.views.console.programs import PASSWORD
from tests.views.console.serving import served
from zbridge.views.console.users import User, hash_password, save_users

CONFIGURATION = Path(__file__).parents[2] / "deploy" / "nginx" / "zbridge-console.conf"
NGINX = shutil.which("nginx") or shutil.which("/usr/sbin/nginx")
NAME = "localhost"

pytestmark = pytest.mark.skipif(NGINX is None, reason="nginx is not installed")


def configured(folder: Path, port: int, console: str) -> Path:
    """Write the configuration as it is shipped, with other ports, files and names."""
    certificate = Authority(folder / "authority").issue(NAME)
    text = CONFIGURATION.read_text()
    for shipped, here in (
        ("listen 443 ssl", f"listen {HOST}:{port} ssl"),
        ("server_name console.lab", f"server_name {NAME}"),
        ("/etc/zbridge/web/certificate.pem", str(certificate / "certificate.pem")),
        ("/etc/zbridge/web/key.pem", str(certificate / "key.pem")),
        ("http://127.0.0.1:8080;", f"{console};"),
    ):
        assert shipped in text
        text = text.replace(shipped, here)
    whole = folder / "nginx.conf"
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{kind}_temp_path {folder}/{kind};\n" for kind in kinds)
    whole.write_text(
        f"daemon off;\nuser root;\npid {folder}/pid;\nerror_log {folder}/error.log;\nevents {{}}\n"
        f"http {{\naccess_log off;\n{temporary}{text}\n}}\n"
    )
    return whole


@contextlib.contextmanager
def nginx(file: Path) -> Iterator[None]:
    assert NGINX is not None
    process = subprocess.Popen([NGINX, "-c", str(file), "-p", str(file.parent)], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


class Visitor:
    """A browser's requests to the proxy."""

    def __init__(self, port: int, authority: Path) -> None:
        self.at = f"https://{NAME}:{port}"
        self.tls = ssl.create_default_context(cafile=str(authority))

    async def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, dict[str, str], Any]:
        def exchange() -> tuple[int, dict[str, str], Any]:
            content = json.dumps(body).encode() if body is not None else None
            request = urllib.request.Request(self.at + path, content, headers, method=method)
            try:
                with urllib.request.urlopen(request, timeout=10, context=self.tls) as answer:
                    return answer.status, dict(answer.headers), json.loads(answer.read() or b"null")
            except urllib.error.HTTPError as error:
                return error.code, dict(error.headers), error.read()

        return await asyncio.to_thread(exchange)


async def test_pages_sockets_and_logins_pass_the_proxy(tmp_path: Path) -> None:
    world, port, behind = World("r1"), free_port(), free_port()
    save_users(tmp_path / "users.toml", {"ann": User("operator", hash_password(PASSWORD))})
    settings = {"hosts": (f"{NAME}:{port}",), "proxied": True, "users": tmp_path / "users.toml"}
    settings["journal"] = tmp_path / "journal"
    async with served(world.fleet, world.bus.join("console"), tmp_path / "roster", port=behind, **settings) as at:
        assert at == f"https://{NAME}:{port}"
        file = configured(tmp_path, port, f"http://{HOST}:{behind}")
        visitor = Visitor(port, tmp_path / "authority" / "ca.pem")
        with nginx(file):
            async with asyncio.timeout(10):
                while True:
                    with contextlib.suppress(OSError):
                        assert (await visitor.ask("GET", "/api/me"))[0] == 401
                        break
                    await asyncio.sleep(0.1)
            login = {"user": "ann", "password": PASSWORD}
            assert (await visitor.ask("POST", "/api/login", login, Origin="https://evil.example"))[0] == 403
            status, headers, me = await visitor.ask("POST", "/api/login", login, Origin=visitor.at)
            assert (status, me["user"]) == (200, "ann")
            cookie = headers["set-cookie"].partition(";")[0]
            options: dict[str, Any] = {"origin": visitor.at, "proxy": None, "ssl": visitor.tls}
            address = f"wss://{NAME}:{port}"
            async with connect(f"{address}/socket", additional_headers={"Cookie": cookie}, **options) as page:
                assert json.loads(await page.recv())["me"]["user"] == "ann"
            async with connect(f"{address}/drive/r1", additional_headers={"Cookie": cookie}, **options) as drive:
                await drive.send(json.dumps({"do": "take"}))
                async with asyncio.timeout(10):
                    while json.loads(await drive.recv()).get("control", {}).get("state") != "held":
                        continue
            lines = [json.loads(line) for line in (tmp_path / "journal").read_text().splitlines()]
            assert {line["address"] for line in lines} == {HOST}
            large = {"user": "ann", "password": "x" * 20_000}
            assert (await visitor.ask("POST", "/api/login", large, Origin=visitor.at))[0] == 413
