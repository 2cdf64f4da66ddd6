"""The log of real processes as programs read it: through jq, from a journal, of many gateways, and without secrets."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
import shutil
import signal
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.certificates import Authority
from tests.docs.pages import blocks
from tests.e2e.conftest import Bench, device, end, repeated, start, until
from tests.e2e.rigs.hq_programs import tcpudp_by_tcp
from tests.e2e.test_hq_tls import tunnel
from tests.ports import HOST, free_port
from tests.views.console.programs import PASSWORD, Programs
from zbridge.views.console.users import User, hash_password, new_token, save_users

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "logs.md"
JSON = '[log]\nformat = "json"\n'
ALONE = "[bus]\nmulticast = false\n"
JOURNAL = """
set -e
mount -t tmpfs none /run
mount -t tmpfs none /var/log
mkdir -p /run/systemd/journal /run/log/journal
/lib/systemd/systemd-journald 2>/dev/null &
trap "kill $!" EXIT
until [ -S /run/systemd/journal/stdout ]; do sleep 0.02; done
echo 'Started zbridge@r1.service.' | systemd-cat -t other
systemd-cat -t zbridge "$@" &
zbridge=$!
logged() { until journalctl -t zbridge -o cat | grep -q "$1"; do sleep 0.05; done; }
logged '"link_lost"'
exec 3<>/dev/tcp/127.0.0.1/$PORT
logged '"warning"'
kill -INT $zbridge
wait $zbridge
journalctl --sync
"""
"""A journal of its own, in a namespace of its own; then the commands of a page."""
CONSOLE = """
import zbridge.cli as cli, zbridge.cli.console as console
from zbridge.cli.logs import set_up_log
console.set_up_log = lambda: set_up_log(verbose=True)
cli.main()
"""
"""The console with a log at the level debug."""


def needs(*programs: str) -> None:
    """Skip a test where a program is missing."""
    if missing := [name for name in programs if shutil.which(name) is None and not Path(name).exists()]:
        pytest.skip(f"{', '.join(missing)}: not installed")


def commands(word: str) -> list[str]:
    """Give the blocks of the page that this file runs, and that hold a word."""
    own = f"tests/e2e/{Path(__file__).name}"
    found = [block.text for block in blocks(PAGE.read_text()) if (block.says("elsewhere") or "").startswith(own)]
    return [text for text in found if word in text]


def nobody(name: str, more: str = "") -> str:
    """Write the file of a robot where nobody listens."""
    return f'[robot]\nname = "{name}"\n{device(free_port())}{ALONE}{more}'


def parsed(line: str) -> dict[str, Any]:
    found = json.loads(line)
    assert isinstance(found, dict), line
    assert line.isascii()
    assert set(found) >= {"time", "level", "logger", "message"}
    return found


def test_the_log_of_a_gateway_goes_through_jq_as_the_page_says(tmp_path: Path) -> None:
    needs("jq")
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "r1.toml").write_text(nobody("r1"))
    (command,) = commands("link_lost")
    zbridge = f"bash -c 'echo $$ > pid; exec {sys.executable} -m zbridge run $0'"
    shell = command.replace("zbridge run", zbridge).replace("jq ", "jq -e ")
    with subprocess.Popen(
        ["bash", "-c", shell], cwd=tmp_path, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as ran:
        assert ran.stdout is not None
        try:
            line = ran.stdout.readline()
            os.kill(int((tmp_path / "pid").read_text()), signal.SIGINT)
            assert ran.wait(timeout=10) == 0
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(ran.pid, signal.SIGKILL)
    assert re.fullmatch(r"r1 \d+\.\d+\n", line)


class Host:
    """A supervisor of some robots, whose whole stderr is kept."""

    def __init__(self, folder: Path, **files: str) -> None:
        self.folder, self._log = folder / "robots", folder / "stderr"
        self.folder.mkdir()
        for name, text in files.items():
            (self.folder / f"{name}.toml").write_text(text)
        with self._log.open("wb") as log:
            self.process = start("run", str(self.folder), stdout=subprocess.DEVNULL, stderr=log)

    @property
    def lines(self) -> list[dict[str, Any]]:
        """What was logged so far, as whole lines."""
        return [parsed(line) for line in self._log.read_text().splitlines(keepends=True) if line.endswith("\n")]

    def first(self, **wanted: object) -> dict[str, Any]:
        """Wait for the first line with these values."""

        def found() -> dict[str, Any] | None:
            return next((line for line in self.lines if wanted.items() <= line.items()), None)

        line = until(found, what=f"a line with {wanted}")
        assert line is not None
        return line


@pytest.fixture
def host(tmp_path: Path) -> Iterator[Host]:
    quiet, faulty = nobody("r2", '[log]\nlevel = "error"\n'), "[robto]\n"
    made = Host(tmp_path, host=f"[host]\n{JSON}", r1=nobody("r1"), r2=quiet, r3=nobody("r3"), bad=faulty)
    yield made
    end(made.process, signal.SIGKILL)


def test_a_supervised_fleet_logs_json_alone_and_each_line_of_a_robot_names_it(host: Host) -> None:
    for robot in ("r1", "r3"):
        host.first(robot=robot, event="link_lost")
    pid = host.first(robot="r1", event="process_started")["fields"]["pid"]
    os.kill(pid, signal.SIGKILL)
    died = host.first(robot="r1", event="process_died")
    assert died["fields"] == {"pid": pid, "how": "was killed by SIGKILL"}
    assert (died["level"], died["message"]) == ("error", f"r1: process {pid} was killed by SIGKILL")
    until(lambda: [line.get("event") for line in host.lines if line.get("robot") == "r1"].count("process_started") > 1)
    host.process.send_signal(signal.SIGUSR2)
    host.first(event="supervisor_replaced")
    end(host.process)
    assert host.process.returncode == 0
    without = {line.get("event") for line in host.lines if "robot" not in line}
    assert without <= {"file_faulty", "supervisor_ready", "supervisor_replaced"}
    assert {line["event"] for line in host.lines if line.get("robot") == "r2"} == {"process_started"}, "its own level"
    assert host.first(event="file_faulty")["fields"]["file"].endswith("bad.toml")


def test_robots_of_one_process_are_told_apart(tmp_path: Path) -> None:
    shared = Host(tmp_path, host="[host]\ntogether = true\n", r1=nobody("r1", JSON), r2=nobody("r2", JSON))
    with contextlib.ExitStack() as stack:
        stack.callback(end, shared.process, signal.SIGKILL)
        for robot in ("r1", "r2"):
            assert shared.first(robot=robot, event="link_lost")["fields"]["link"] == f"{robot} robot"
        end(shared.process)
    assert all(line["robot"] in line["message"] for line in shared.lines if line["event"] == "link_lost")


def test_what_ends_a_process_is_json_too(tmp_path: Path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text(f'{nobody("r1")}[[hq]]\nprotocol = "tcpudp"\nlisten = "tcp://203.0.113.1:1"\n{JSON}')
    unreadable = tmp_path / "r2.toml"
    unreadable.write_text("[robto]\n")
    for path, code, said in ((file, 1, "203.0.113.1"), (unreadable, 2, "robto = {}: unknown key")):
        environment = {**os.environ, "ZBRIDGE_LOG_FORMAT": "json"} if path is unreadable else os.environ
        ran = subprocess.run(
            [sys.executable, "-m", "zbridge", "run", str(path)],
            capture_output=True,
            text=True,
            env=environment,
            timeout=30,
            check=False,
        )
        *before, last = map(parsed, ran.stderr.splitlines())
        assert (ran.returncode, last["event"], last["fields"]["code"]) == (code, "gave_up", code)
        assert said in last["message"]
        assert all(line["robot"] == "r1" for line in before)


# A journal


def test_the_journal_is_read_as_the_page_says(tmp_path: Path) -> None:
    needs("jq", "unshare", "systemd-cat", "journalctl", "/lib/systemd/systemd-journald")
    port, shown = free_port(), commands("journalctl")
    listener = f'[[hq]]\nprotocol = "tcpudp"\nlisten = "tcp://{HOST}:{port}"\nallow = ["10.0.0.0/8"]\n'
    (tmp_path / "r1.toml").write_text(nobody("r1", f'{listener}{JSON}level = "debug"\n'))
    assert len(shown) == 4
    # The unit's own lines are those of another name here: systemd is not running.
    named = [
        command.replace("-u zbridge@r1", "-t zbridge" if "-cR" not in command and "-nR" not in command else "")
        for command in shown
    ]
    script = JOURNAL + "".join(f"echo '== {number}'\n{command}" for number, command in enumerate(named))
    zbridge = [sys.executable, "-m", "zbridge", "run", "r1.toml"]
    namespace = ["unshare", "--mount", "--propagation", "private", "bash", "-o", "pipefail", "-c", script, "bash"]
    ran = subprocess.run(
        [*namespace, *zbridge],
        cwd=tmp_path,
        env={**os.environ, "PORT": str(port)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if "unshare: " in ran.stderr or "mount: " in ran.stderr:
        pytest.skip(f"no journal of its own: {ran.stderr.strip()[-200:]}")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    warnings, all_warnings, with_pids, (counts,) = (
        [json.loads(line) for line in part.splitlines()] for part in re.split(r"^== \d\n", ran.stdout, flags=re.M)[1:]
    )
    assert warnings == all_warnings
    assert {line["event"] for line in warnings} == {"hq_turned_away"}
    assert {line["robot"] for line in with_pids if "event" in line} == {"r1"}
    assert all(line["pid"].isdecimal() and line["at"].isdecimal() for line in with_pids)
    assert counts["link_lost"] == len([line for line in with_pids if line.get("event") == "link_lost"]) > 0


# Secrets


class Secrets:
    """What must be in no log, in any form in which it could be written."""

    def __init__(self) -> None:
        self._forms: dict[str, tuple[bytes, ...]] = {}

    def add(self, name: str, secret: bytes) -> None:
        """Note a secret. Parts of it count: what is shortened, or folded, is as bad."""
        assert len(secret) >= 8, name
        part = secret[: max(12, len(secret) // 2)]
        texts = (part.hex(), part.hex(" "), base64.b64encode(part).decode().rstrip("=")[:-2], repr(part)[2:-1])
        escaped = {json.dumps(text)[1:-1] for text in (*texts, part.decode("latin-1"))}
        self._forms[name] = (part, *(text.encode() for text in (*texts, *escaped)))

    def found_in(self, text: bytes) -> list[str]:
        return [name for name, forms in self._forms.items() if any(form in text for form in forms)]


@contextlib.contextmanager
def old_program(authority: Authority, port: int, secrets: Secrets) -> Iterator[None]:
    """Drive by an old HQ program over TLS."""
    desk = authority.issue("viewer.desk")
    context = ssl.create_default_context(cafile=str(authority.ca))
    context.load_cert_chain(desk / "certificate.pem", desk / "key.pem")
    secrets.add("program's key", (desk / "key.pem").read_bytes()[40:120])
    with tunnel(context, port) as program:
        move = tcpudp_by_tcp(program)
        with repeated(lambda: [move(number) for number in (0, 1)], 0.2):  # type: ignore[func-returns-value]
            yield


async def test_the_log_holds_no_secret_at_the_level_debug(bench: Bench, tmp_path: Path) -> None:
    secrets, authority, port = Secrets(), Authority(tmp_path / "authority"), free_port()
    own = authority.issue("gateway.g1")
    files = f'tls = {{ certificate = "{own}/certificate.pem", key = "{own}/key.pem", ca = "{authority.ca}" }}\n'
    hq = f'[[hq]]\nname = "desk"\nprotocol = "tcpudp"\nlisten = "tls://{HOST}:{port}"\n{files}'
    gateway = bench.gateway(
        device(bench.simulator()), f"{hq}options = {{ udp = false }}\n", '[log]\nformat = "json"\nlevel = "debug"\n'
    )
    until(lambda: bench.fleet.state() == "established", what="established")
    secrets.add("listener's key", (own / "key.pem").read_bytes()[40:120])
    with old_program(authority, port, secrets):
        until(lambda: (bench.fleet.last("r1/control").get("holder") or "").startswith("hq.desk."), what="the lease")
        until(lambda: "hq_drives" in gateway.log, what="its line")
    until(lambda: bench.fleet.last("r1/control").get("holder") is None, what="its end")
    bench.fleet.hold()
    for number in range(3):
        bench.fleet.put("r1/@cmd/drive", forward=0.1 * number)
    secrets.add("lease token", bench.fleet.token())
    shown = bench.fleet.token().hex().encode()
    log = await through_console(bench, secrets)
    text = gateway.end().encode() + log
    events = {parsed(line).get("event") for line in text.decode().splitlines()}
    assert events >= {"frame", "hq_drives", "hq_established", "authority_changed"}, "it was logged at all"
    assert secrets.found_in(text) == []
    assert secrets.found_in(text + shown) == ["lease token"], "the check can fail"


def console(bench: Bench, command: list[str]) -> subprocess.Popen[str]:
    environment = {**os.environ, "ZBRIDGE_LOG_FORMAT": "json", "PYTHONUNBUFFERED": "1"}
    with (bench.folder / "console.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", CONSOLE, *command], stdout=subprocess.PIPE, stderr=log, text=True, env=environment
        )
    bench.stack.callback(end, process, signal.SIGKILL)
    return process


async def through_console(bench: Bench, secrets: Secrets) -> bytes:
    """Log in by password, ask by token, and drive from a browser; give the console's log."""
    token, kept = new_token()
    user, hashed = "op1", hash_password(PASSWORD)
    save_users(bench.folder / "users.toml", {user: User("operator", hashed, {"lab": kept})})
    command = [
        "console",
        "--listen",
        f"{HOST}:0",
        "--connect",
        bench.endpoint,
        "--roster",
        str(bench.folder / "roster"),
    ]
    command += ["--users", str(bench.folder / "users.toml"), "--journal", str(bench.folder / "journal")]
    process = console(bench, command)
    assert process.stdout is not None
    programs = Programs(process.stdout.readline().split()[-1], {user: token})
    assert (await programs.ask("GET", "/api/robots", user=user)).status == 200
    assert (
        await programs.ask("POST", "/api/login", {"user": user, "password": "wrong horse"}, Origin=programs.at)
    ).status
    headers = await programs.browser(user)
    async with programs.page("/drive/r1", Cookie=headers["Cookie"]) as drive:
        await drive.send(json.dumps({"do": "take", "takeover": True}))
        await drive.recv()
    end(process)
    secrets.add("token", token.encode())
    secrets.add("password", PASSWORD.encode())
    secrets.add("hash", hashed.encode()[-24:])
    secrets.add("cookie", headers["Cookie"].partition("=")[2].encode())
    secrets.add("csrf", headers["X-Zbridge-Csrf"].encode())
    return (bench.folder / "console.log").read_bytes()
