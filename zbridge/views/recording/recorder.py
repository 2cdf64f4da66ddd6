"""The thread that writes what arrives on the bus to the files of a recording.

Theory of operation. Every :data:`PAUSE_S` the thread takes all that waits in the intake, and a message writer writes
it. A disk that is full ends the recording: the files are ended with what they hold, ``error`` says why, and what still
arrives is counted as lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

from zbridge.log import Log
from zbridge.views.recording.contents import Pictures
from zbridge.views.recording.intake import Arrival, Intake
from zbridge.views.recording.message_writer import MessageWriter
from zbridge.views.recording.tape import Tape

log = Log("zbridge.views.recording")

PAUSE_S = 0.05
"""Seconds between two reads of the intake."""


class Recorder:
    """Writes until :meth:`close`. metadata: written at the begin of each file. failed: called when the disk is full.

    fleet: record the messages as they were. pictures: what draws them, None for none. All methods but the thread's own
    may be called from any thread.
    """

    def __init__(
        self,
        tape: Tape,
        intake: Intake,
        metadata: Mapping[str, Mapping[str, str]],
        *,
        fleet: bool = True,
        pictures: Pictures | None = None,
        failed: Callable[[], object] = lambda: None,
    ) -> None:
        self.error: str | None = None
        self._tape = tape
        self._intake = intake
        self._writer = MessageWriter(tape, metadata, fleet=fleet, pictures=pictures)
        self._failed = failed
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="zbridge-record", daemon=True)

    def __repr__(self) -> str:
        return f"<Recorder {self._tape!r}, {self.messages} messages>"

    @property
    def messages(self) -> int:
        """Messages that came from the intake so far."""
        return self._writer.messages

    def start(self) -> None:
        """Begin the first file; raise ZbridgeError if that is not possible."""
        self._writer.begin()
        self._thread.start()

    def close(self, timeout_s: float = 30.0) -> None:
        """Write what waits, end the file, and return; idempotent."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        for arrival in self._intake.take():
            self._tape.unwritten.add(arrival.key)

    def losses(self) -> dict[str, dict[str, int]]:
        """Return what was lost, by reason and key."""
        reasons = {
            "the disk was too slow": self._intake.dropped,
            "not written": self._tape.unwritten,
            "too many channels": self._writer.refused,
            "missing in the sequence": self._writer.missing,
        }
        return {reason: dict(losses) for reason, losses in reasons.items() if losses}

    # The thread

    def _run(self) -> None:
        ending = False
        try:
            while not ending:
                ending = self._ending.wait(PAUSE_S)  # read first: what came before it is still written
                self._write_batch(self._intake.take())
            self._tape.close()
        except OSError as error:
            self._give_up(error.strerror or str(error))
        except Exception as error:
            log.exception("recording_failed", "the recording failed")
            self._give_up(f"{type(error).__name__}: {error}")

    def _write_batch(self, batch: list[Arrival]) -> None:
        for done, arrival in enumerate(batch):
            try:
                self._writer.write(arrival)
                if not done % 256:
                    self._writer.keep_time(arrival.arrived_ns)
            except OSError:
                for lost in batch[done + 1 :]:
                    self._tape.unwritten.add(lost.key)
                raise
        self._writer.keep_time(time.time_ns())

    def _give_up(self, why: str) -> None:
        ended = self._tape.salvage()
        self.error = f"the recording ends: {why}" + ("" if ended else "; the file has no proper end")
        self._failed()
        while not self._ending.wait(PAUSE_S):
            for arrival in self._intake.take():
                self._tape.unwritten.add(arrival.key)
