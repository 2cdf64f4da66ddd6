"""What ``console-api.md`` shows to programs, run as it stands there against a console with users."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.e2e.conftest import HOST, Bench, start, until

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "console-api.md").read_text()
SECTION = PAGE.partition("## For programs")[2].partition("\n## ")[0]


def example(language: str, word: str) -> str:
    """Give the example of this language that begins with this word."""
    found = re.search(rf"```{language}[^\n]*\n({word} .*?)```", SECTION, re.DOTALL)
    assert found is not None
    return found[1]


def user(bench: Bench, *words: str) -> str:
    done = start("console", "user", *words, "--file", str(bench.folder / "users.toml"))
    printed, _ = done.communicate(timeout=30)
    assert done.returncode == 0, printed
    return str(printed).strip()


@pytest.mark.long
def test_curl_and_python_see_the_fleet_and_stop_it(bench: Bench) -> None:
    user(bench, "add", "lab", "--role", "viewer", "--no-password")
    token = user(bench, "token", "lab")
    (bench.folder / "token.txt").write_text(f"{token}\n")
    bench.serve(bench.simulator())
    files = {"--users": "users.toml", "--journal": "journal", "--roster": "roster"}
    options = [word for option, name in files.items() for word in (option, str(bench.folder / name))]
    console = bench.zbridge("console", "--listen", f"{HOST}:0", *options, "--connect", bench.endpoint)
    assert console.stdout is not None
    at = console.stdout.readline().split()[-1]
    environment = {**os.environ, "TOKEN": token, "CONSOLE": at, "PYTHONUNBUFFERED": "1"}

    def sees() -> bool:
        ask = f'curl -sf -H "Authorization: Bearer $TOKEN" {at}/api/robots'
        done = subprocess.run(["bash", "-c", ask], env=environment, capture_output=True, check=True)
        return bool(json.loads(done.stdout)["robots"])

    until(sees, what="the robot")
    script = example("sh", "curl").replace("http://127.0.0.1:8080", at).replace("curl ", "curl -sf ")
    script = script.replace("\ncurl", "\necho\ncurl")
    done = subprocess.run(["bash", "-ec", script], cwd=bench.folder, capture_output=True, text=True, check=True)
    robots, status, stop, stop_all = map(json.loads, done.stdout.split("\n"))
    assert [row["name"] for row in robots["robots"]] == ["r1"]
    assert status["state"] == "established"
    assert stop == {"text": "r1 stopped (its gateway sent it)", "good": True}
    assert stop_all == {"text": "1 of 1 stopped (their gateways sent it)", "good": True}
    command = [sys.executable, "-c", example("python", "import")]
    following = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    try:
        assert following.stdout is not None
        assert following.stdout.readline().split() == ["r1", "LATCHED", "LATCHED"]
    finally:
        following.kill()
        following.communicate()
