"""How much time this machine kept from what was measured on it. Without that, a limit on time fails on a busy one."""

import contextlib
import os
import time
from collections.abc import Iterable
from pathlib import Path

_TICK_S = 1 / os.sysconf("SC_CLK_TCK")
_STEAL = 8
"""The place of it in the first line of ``/proc/stat``."""
_PUT_OFF = 5
"""How many times the limit a wait may be put off by."""


class Withheld:
    """The processor time that was withheld from some processes so far.

    That is how long their threads were ready to run and had no processor, all of them together, and how long this
    machine had none to give: no less than any of them was late for want of a processor. On an idle machine it is next
    to nothing.
    """

    def __init__(self) -> None:
        self._known: dict[int, float] = {}

    def seconds(self, processes: Iterable[int] = ()) -> float:
        """Give it for this process and others; what was known of one that has ended counts on."""
        for pid in (os.getpid(), *processes):
            self._known[pid] = max(self._known.get(pid, 0.0), _waited_s(pid))
        return sum(self._known.values()) + _stolen_s()


def contended_s() -> float:
    """Give for how long so far anything at all on this machine was ready to run and had no processor.

    A process that is killed ends only when each of its threads had one, and nobody can ask it afterwards.
    """
    with contextlib.suppress(OSError, ValueError, IndexError), open("/proc/pressure/cpu") as file:
        return int(file.readline().rpartition("total=")[2]) / 1e6
    return 0.0


class Patience:
    """The longest wait for something, put off by what a busy machine withheld; on an idle one it is ``limit_s``."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s, self._began, self._contended = limit_s, time.monotonic(), contended_s()

    @property
    def over(self) -> bool:
        """Whether it has waited long enough; at most :data:`_PUT_OFF` times the limit more."""
        late_s = time.monotonic() - self._began - self._limit_s
        return late_s >= 0 and late_s >= min(contended_s() - self._contended, _PUT_OFF * self._limit_s)


def _waited_s(pid: int) -> float:
    waited_s = 0.0
    with contextlib.suppress(OSError):  # it has ended, or the system does not tell
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, ValueError, IndexError):
                waited_s += int((thread / "schedstat").read_text().split()[1]) / 1e9
    return waited_s


def _stolen_s() -> float:
    with contextlib.suppress(OSError, ValueError, IndexError), open("/proc/stat") as file:
        return int(file.readline().split()[_STEAL]) * _TICK_S
    return 0.0
