"""Runs what a page tells to type, from top to bottom: ``python -m tests.docs.run_page docs/tutorial/first-robot.md``.

In namespaces of its own: literal ports and addresses are free there, and the names of the pages lead to this machine.
"""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from tests.docs.pages import ROOT, Block, blocks, difference, exchanges
from tests.e2e.rigs.processes import ip, run

NAMES = ("hub.lab", "hub", "gateway.lab", "console.lab", "router.lab", "router-1", "router-2", "robot.lab")
ADDRESSES = ("192.168.0.2/16", "192.168.0.10/32", "192.168.0.11/32", "192.168.1.11/32", "10.77.0.1/24", "10.77.0.2/32")
COMMAND_S = 60.0
READY_S = 20.0
READS_S = 0.7
"""Seconds that the quickest reader needs from what a command says to the next one."""
AGAIN = re.compile(r"zbridge (ls|health|top|doctor|echo|check|info)\b")
"""What only looks, and may be typed again until what it looks at is there."""
AGAIN_S = 12.0
PAUSED = ("errors.NeutralFirst:", "errors.Stale:")
KEYS = {"space": " ", "enter": "\r", "ctrl-c": "\x03", "esc": "\x1b"}
KEY_S = 0.3
_STATE = 'trap \'export -p > "$PAGE_STATE/env"; pwd > "$PAGE_STATE/cwd"\' EXIT\n'


class PageError(Exception):
    """What a page says does not hold; the text has its line, what was typed and what came."""


class Page:
    """One run of a page."""

    def __init__(self, path: Path, stack: contextlib.ExitStack, scratch: Path) -> None:
        self._path, self._stack = path, stack
        self._home, self._state = scratch / "home", scratch / "state"
        for folder in (self._home, self._state):
            folder.mkdir()
        self._environment: Mapping[str, str] = {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(scratch),
            "XDG_STATE_HOME": str(scratch / "kept"),
            "PAGE_STATE": str(self._state),
            "PYTHONPATH": str(ROOT),
            "PYTHONUNBUFFERED": "1",
            "COLUMNS": "100",
            "TERM": "xterm",
            "NO_COLOR": "1",
            "LANG": "C.UTF-8",
        }

    def run(self) -> None:
        """Run every block; raise PageError at the first that fails."""
        for block in blocks(self._path.read_text()):
            if block.not_here:
                continue
            for number, hidden in enumerate(argument for word, argument in block.how if word == "setup"):
                command, _, until = hidden.partition(" until ")
                self._background(f"{block.line}.{number}", command, until or None)
            with self._at(block):
                self._block(block)

    @contextlib.contextmanager
    def _at(self, block: Block) -> Iterator[None]:
        try:
            yield
        except (OSError, subprocess.TimeoutExpired, PageError) as error:
            logs = (f"-- in the background:\n{log.read_text()[-1500:]}" for log in self._state.glob("background-*"))
            raise PageError("\n".join([f"{self._path.relative_to(ROOT)}:{block.line}: {error}", *logs])) from error

    def _block(self, block: Block) -> None:
        if block.title is not None:
            self._write(block, block.title)
        elif block.language == "toml":
            self._check(block, self._write(block, ".fragment.toml"))
        elif block.language == "python":
            self._must(f"{sys.executable} {self._write(block, '.program.py')}")
        elif block.language == "console":
            for command, shown in exchanges(block.text):
                self._compare(command, shown)
        elif block.language == "sh":
            self._type(block)

    def _type(self, block: Block) -> None:
        until = block.says("background")
        if (keys := block.says("keys")) is not None:
            self._on_terminal(block.text.strip(), keys)
        elif until is not None:
            *before, last = _commands(block.text)
            if before:
                self._must("\n".join(before))
            self._background(str(block.line), last, until.removeprefix("until ") or None)
        else:
            self._must(block.text)

    def _write(self, block: Block, name: str) -> Path:
        path = self._cwd() / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text)
        if name.endswith(".toml") and block.title is not None:
            self._check(block, path)
        return path

    def _check(self, block: Block, path: Path) -> None:
        whole = "--whole" if block.title is not None else "--part"
        self._must(f"{sys.executable} -m tests.docs.check_listing {whole} {path}")

    def _cwd(self) -> Path:
        at = self._state / "cwd"
        return Path(at.read_text().strip()) if at.exists() else self._home

    def _shell(self, command: str) -> list[str]:
        load = '[ ! -e "$PAGE_STATE/env" ] || . "$PAGE_STATE/env"\n'
        return ["bash", "-e", "-o", "pipefail", "-c", load + _STATE + command]

    def _ran(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a command to its end; three times where a busy machine paused it for longer than its deadman."""
        for _ in range(2):
            ran = self._once(command)
            if not any(error in ran.stdout for error in PAUSED):
                return ran
        return self._once(command)

    def _once(self, command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self._shell(command),
            cwd=self._cwd(),
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=COMMAND_S,
            check=False,
        )

    def _must(self, command: str) -> None:
        done = self._ran(command)
        if done.returncode:
            raise PageError(f"exit code {done.returncode}\n$ {command.strip()}\n{done.stdout}")

    def _compare(self, command: str, shown: str) -> None:
        until = time.monotonic() + (AGAIN_S if AGAIN.match(command) else 0.0)
        while True:
            wrong = difference(shown, self._ran(command).stdout)
            if wrong is None:
                return
            if time.monotonic() > until:
                raise PageError(f"\n$ {command}\n{wrong}")
            time.sleep(0.5)

    def _background(self, name: str, command: str, until: str | None) -> None:
        log = self._state / f"background-{name}"
        with log.open("w") as output:
            process = subprocess.Popen(
                self._shell(f"trap - EXIT\n{command}"),
                cwd=self._cwd(),
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._stack.callback(_end, process)
        over = time.monotonic() + READY_S
        ready = time.monotonic() + 1.5  # without a word to wait for: whoever reads on needs longer than that
        while time.monotonic() < (over if until else ready):
            if process.poll() is not None:
                raise PageError(f"ended with exit code {process.returncode}\n$ {command}\n{log.read_text()}")
            if until and until in log.read_text():
                time.sleep(READS_S)
                return
            time.sleep(0.05)
        if until:
            raise PageError(f"no {until!r} within {READY_S:g} s\n$ {command}\n{log.read_text()}")

    def _on_terminal(self, command: str, keys: str) -> None:
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            self._shell(command),
            cwd=self._cwd(),
            env=self._environment,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        )
        self._stack.callback(_end, process)
        os.close(theirs)
        came = _read(ours, 3.0)
        for key in keys.split():
            os.write(ours, KEYS.get(key, key).encode())
            came += _read(ours, KEY_S)
        came += _read(ours, 10.0)
        os.close(ours)
        if process.wait(timeout=10):
            raise PageError(f"exit code {process.returncode}\n$ {command}\n{came}")


def _read(descriptor: int, seconds: float) -> str:
    """Read what comes within some seconds, or until the end."""
    over, came = time.monotonic() + seconds, b""
    while (left := over - time.monotonic()) > 0:
        if select.select([descriptor], [], [], left)[0]:
            try:
                part = os.read(descriptor, 65536)
            except OSError:  # Linux: nobody has the other end any more
                break
            if not part:
                break
            came += part
    return came.decode(errors="replace")


def _commands(text: str) -> list[str]:
    """Split a listing into commands: a line each, or several that a backslash joins."""
    lines = [line for line in text.replace("\\\n", "\0").splitlines() if line.strip() and not line.startswith("#")]
    return [line.replace("\0", "\\\n") for line in lines]


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def settle(scratch: Path) -> None:
    """Prepare the namespaces: a loopback that carries the addresses of the pages, and their host names."""
    ip("link set lo up multicast on", "route add 224.0.0.0/4 dev lo", *(f"address add {at} dev lo" for at in ADDRESSES))
    hosts = scratch / "hosts"
    hosts.write_text("127.0.0.1 localhost\n192.168.0.2 " + " ".join(NAMES) + "\n")
    run("mount", "--bind", str(hosts), "/etc/hosts")
    run("hostname", "hub")


def main() -> None:
    """Run one page; print what failed, and end with exit code 1."""
    with contextlib.ExitStack() as stack:
        scratch = Path(tempfile.mkdtemp(prefix="page-"))
        stack.callback(shutil.rmtree, scratch, ignore_errors=True)
        settle(scratch)
        try:
            Page((ROOT / sys.argv[1]).resolve(), stack, scratch).run()
        except PageError as error:
            sys.exit(str(error))


if __name__ == "__main__":
    main()
