"""A recorder that comes and goes, and whose disk is small: a tmpfs in a mount namespace of its own."""

from __future__ import annotations

import contextlib
import itertools
import random
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

from tests.e2e.rigs.processes import ROOT, Part
from zbridge.views.recording.reader import RecordingReader

DISK = "3m"
END_S = 60.0


class Recorder:
    """``zbridge record --all`` at times; each file must be readable as far as it was written."""

    def __init__(self, stack: contextlib.ExitStack, endpoint: str, rng: random.Random) -> None:
        self.done: Counter[str] = Counter()
        self.faults: list[str] = []
        self.messages = 0
        self._endpoint, self._rng, self._stack = endpoint, rng, stack
        does = f"mount -t tmpfs -o size={DISK} soak /mnt && echo open && exec cat"
        keeper = Part(stack, "unshare", "--mount", "sh", "-c", does)
        assert keeper.line() == "open"
        self._disk = Path(f"/proc/{keeper.pid}/root/mnt")
        self._numbers = itertools.count()
        self._process: subprocess.Popen[str] | None = None
        stack.callback(self.end)

    def comes_or_goes(self) -> None:
        """Start one; or end that which runs, in order or not."""
        if self._process is None:
            self._file = self._disk / f"{next(self._numbers)}.mcap"
            command = [sys.executable, "-m", "zbridge", "record", "--all", "-o", str(self._file)]
            self._process = subprocess.Popen(
                [*command, "--connect", self._endpoint], stderr=subprocess.PIPE, text=True, cwd=ROOT
            )
            return
        if self._process.poll() is not None:
            self._judge("its disk was full", 1)
        elif self._rng.random() < 0.5:
            self._process.send_signal(signal.SIGINT)
            self._judge("ended", 0)
        else:
            self._process.kill()
            self._judge("killed", -signal.SIGKILL)

    def end(self) -> None:
        """End what runs."""
        if self._process is not None:
            self.comes_or_goes()

    def _judge(self, how: str, code: int) -> None:
        """Wait for the end of the process, and read its file."""
        process, self._process = self._process, None
        assert process is not None
        try:
            _, errors = process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            _, errors = process.communicate()
            self.faults.append(f"the recorder did not end within {END_S:g} s")
        said = [line for line in errors.splitlines() if line][-2:]
        if "No space" in errors:
            how, code = "its disk was full", 1
        if not self._file.exists():  # it was ended before it began
            return
        self.done[f"recorder: {how}"] += 1
        if process.returncode != code:
            self.faults.append(f"the recorder ({how}) ended with {process.returncode}: {said}")
        with self._file.open("rb") as file:
            reader = RecordingReader(file)
            self.messages += sum(1 for _ in reader.messages())
            if reader.fault and (how != "killed" or not reader.fault.startswith("cut off")):
                self.faults.append(f"a recording ({how}): {reader.fault}")
        self._file.unlink()
