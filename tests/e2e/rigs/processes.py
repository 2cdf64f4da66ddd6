"""The parts of a scene that are processes of their own: words go to their stdin, lines come from their stdout."""

from __future__ import annotations

import contextlib
import itertools
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

LINE_S = 20.0
"""Longest wait for a line."""
ROOT = Path(__file__).parents[3]
_ENDS_WITH_US = ("setpriv", "--pdeathsig", "KILL") if shutil.which("setpriv") else ()


def module(name: str, *arguments: object) -> list[str]:
    """Give the command that runs a module of these tests as a part of a scene."""
    return [sys.executable, "-m", name, *map(str, arguments)]


class Part:
    """A process that is killed, whatever state it is in, with the stack; Ctrl-C is for us alone."""

    def __init__(
        self, stack: contextlib.ExitStack, *command: str, heard: Callable[[str], object] | None = None
    ) -> None:
        self.process = subprocess.Popen(
            [*_ENDS_WITH_US, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            start_new_session=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, args=(heard or self._lines.put,), daemon=True)
        self._reader.start()
        stack.callback(self.kill)

    @property
    def pid(self) -> int:
        return self.process.pid

    def _read(self, heard: Callable[[str], object]) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.endswith("\n"):  # a process that is killed may leave a part of one
                heard(line.rstrip("\n"))
        self._lines.put("")

    def line(self, timeout_s: float = LINE_S) -> str:
        """Wait for a line that nobody hears; an end without one is an error."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise AssertionError(f"{self.process.args} says nothing") from None
        assert line, f"{self.process.args} ended with {self.process.wait()}"
        return line

    def rest(self, timeout_s: float = LINE_S) -> list[str]:
        """Wait for its end; give the lines that nobody took."""
        assert self.process.wait(timeout=timeout_s) == 0, self.process.args
        self._reader.join()
        return [line for line in iter(self._lines.get, "") if line]

    def say(self, word: str) -> None:
        """Give it a word, unless it has ended."""
        assert self.process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(f"{word}\n")
            self.process.stdin.flush()

    def close(self) -> None:
        """Say that there will be no more words."""
        assert self.process.stdin is not None
        self.process.stdin.close()

    def signal(self, number: int) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        """End it; idempotent."""
        self.process.kill()
        self.process.wait()
        self._reader.join()
        for stream in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(BrokenPipeError):
                assert stream is not None
                stream.close()


def frozen(pid: int) -> bool:
    """Tell whether every thread of a process stands still: on a busy machine some are told late."""
    states = [(task / "stat").read_text().rpartition(")")[2].split()[0] for task in Path(f"/proc/{pid}/task").iterdir()]
    return set(states) == {"T"}


# Network namespaces


class NotHereError(Exception):
    """This machine does not let us make network namespaces; says why."""


def run(*command: str, words: str = "") -> None:
    done = subprocess.run(command, input=words, capture_output=True, text=True, timeout=10, check=False)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip() or f'exit {done.returncode}'}")


def ip(*lines: str, enter: tuple[str, ...] = ()) -> None:
    """Carry out lines of ``ip``, in this namespace or another one."""
    run(*enter, "ip", "-batch", "-", words="\n".join(lines) + "\n")


class Namespace:
    """A network namespace, for as long as the process that keeps it; ``does``: a shell command for each word."""

    def __init__(self, stack: contextlib.ExitStack, does: str = ":") -> None:
        self.keeper = Part(
            stack, "unshare", "--net", "sh", "-c", f"echo open; while read word; do {does}; echo done; done"
        )
        assert self.keeper.line() == "open"
        self.enter = ("nsenter", "--target", str(self.keeper.pid), "--net")


_numbers = itertools.count()


class Road:
    """Two network namespaces: one forwards packets or not, in the other one lives who may be cut off.

    To be used in a namespace of the measurement's own. ``near``: our address; ``far``: that of the other end.
    """

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self._gate = Namespace(stack, "echo $word > /proc/sys/net/ipv4/ip_forward")
        there, number = Namespace(stack), next(_numbers)
        device, net = f"near{number}", f"10.{64 + number // 250 % 60}.{number % 250}"
        self.near, self.far, self.enter = f"{net}.1", f"{net}.6", there.enter
        self._hole: str | None = None
        """The route by which one direction is cut."""
        ip(
            f"link add {device} type veth peer name left netns {self._gate.keeper.pid}",
            f"address add {net}.1/30 dev {device}",
            f"link set {device} up",
        )
        stack.callback(ip, f"link delete {device}")
        ip(
            f"link add right type veth peer name end netns {there.keeper.pid}",
            f"address add {net}.2/30 dev left",
            f"address add {net}.5/30 dev right",
            "link set left up",
            "link set right up",
            enter=self._gate.enter,
        )
        ip(
            "link set lo up",
            f"address add {net}.6/30 dev end",
            "link set end up",
            f"route add default via {net}.5",
            enter=there.enter,
        )
        ip(f"route add {net}.4/30 via {net}.2")
        self.mend()

    def cut(self) -> None:
        """Lose every packet, in both directions, from now on; nobody is told."""
        self._forward("0")

    def cut_one_way(self, out: bool) -> None:
        """Lose every packet that goes to the far end (``out``), or every one that comes from there."""
        self._hole = f"blackhole {self.far if out else self.near}/32"
        ip(f"route add {self._hole}", enter=self._gate.enter)

    def mend(self) -> None:
        """Lose no packet any more."""
        if self._hole is not None:
            ip(f"route delete {self._hole}", enter=self._gate.enter)
            self._hole = None
        self._forward("1")

    def _forward(self, word: str) -> None:
        self._gate.keeper.say(word)
        assert self._gate.keeper.line() == "done"


_TRIAL = "ip link set lo up && ip link add here type veth peer name there && unshare --net true"
_THERE = "ZBRIDGE_TESTS_APART"
_APART = (("unshare", "--net"), ("unshare", "--map-root-user", "--net"))


def apart() -> tuple[str, ...]:
    """Give the command that runs another one in a network namespace of its own; raise NotHereError."""
    for tool in ("unshare", "nsenter", "ip"):
        if shutil.which(tool) is None:
            raise NotHereError(f"no {tool} on this machine")
    reasons = []
    for prefix in _APART:
        try:
            run(*prefix, "sh", "-c", _TRIAL)
        except OSError as error:
            reasons.append(str(error))
        else:
            return prefix
    raise NotHereError("; ".join(reasons))


def go_apart(name: str) -> bool:
    """Become the same program in a network namespace of its own: nothing is changed in that of the caller.

    Tell whether we are there; where this machine does not allow it, say why.
    """
    if _THERE in os.environ:
        ip("link set lo up")
        return True
    try:
        prefix = apart()
        os.execvpe(prefix[0], [*prefix, *module(name, *sys.argv[1:])], {**os.environ, _THERE: "1"})
    except NotHereError as error:
        print(f"Nothing is cut: {error}")
    return False


# What came of it


@dataclass(kw_only=True)
class Finding:
    """What one measurement or judgement found; its text is the report."""

    faults: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def report(findings: Iterable[Finding]) -> None:
    """Print findings as they come, with what is wrong, and end; whether all is clean is the exit code."""
    failed = False
    for finding in findings:
        print(finding, flush=True)
        for fault in finding.faults[:20]:
            print("   ", fault)
        failed = failed or not finding.clean
    sys.exit(failed)
