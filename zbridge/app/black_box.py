"""The black box of a gateway: opened and closed with it, and what it answers on the bus.

``@rpc/blackbox/incidents`` lists the incidents, ``@rpc/blackbox/read/<name>`` returns a part of one of their files, and
``@rpc/blackbox/keep/<name>`` keeps the minutes before now. The disk is read by its own thread.
"""

from __future__ import annotations

import asyncio
import contextlib
import platform
from collections.abc import Callable, Iterator
from pathlib import Path

from zbridge.app.config import GatewayPlan
from zbridge.blackbox import BlackBox, BlackBoxSettings, BoxFolder
from zbridge.blackbox.reading import list_incidents, read_part
from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.control.admission import NameFilter
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.control.latch_store import state_folder
from zbridge.errors import Malformed, NotReady, PayloadError, Refused, ZbridgeError, describe
from zbridge.fleet import payload as payloads
from zbridge.fleet.incidents import ReadIncident
from zbridge.fleet.messages import Query, Text
from zbridge.fleet.topics import KeySpace, is_concrete, unescape
from zbridge.version import __version__

MARK = "mark"
"""The code of an incident that somebody asked for."""
WAITING = 8
"""Questions for the disk that may wait."""
_OF_THE_PROCESS_BEFORE = (FaultCode.GATEWAY_DIED, FaultCode.GATEWAY_HUNG)


def box_folder(settings: BlackBoxSettings, state: Path | None = None) -> Path:
    """Return the folder of all black boxes. state: where latched stops are kept; None: the usual folder."""
    if settings.dir is not None:
        return Path(settings.dir)
    return (state if state is not None else state_folder()) / "blackbox"


@contextlib.contextmanager
def open_black_box(
    plan: GatewayPlan, keys: KeySpace, open_faults: OpenFaults, state: Path | None, *, alone: bool
) -> Iterator[BlackBox | None]:
    """Yield the black box of a gateway, which is to be begun; None without ``[blackbox]``.

    alone: whether the process serves no other robot.
    """
    settings = plan.config.blackbox
    if settings is None or plan.device is None:
        yield None
        return
    protocol = plan.device.protocol.name
    box = BlackBox(
        keys,
        box_folder(settings, state),
        settings,
        {
            "versions": {"zbridge": __version__, "python": platform.python_version(), "protocol": protocol},
            "configuration": plan.written,
        },
        tell=lambda text: open_faults.set(FaultCode.BLACK_BOX, text),
        died=lambda text: _died(open_faults, text),
        alone=alone,
    )
    open_faults.occurred = lambda code, text: box.keep(code, text, died=code in _OF_THE_PROCESS_BEFORE)
    try:
        yield box
    except Exception as error:
        box.close(error if not isinstance(error, ZbridgeError) else None)
        raise
    finally:
        open_faults.occurred = lambda code, text: None
        box.close()


def _died(open_faults: OpenFaults, text: str) -> None:
    """Note the end of the process before this one, unless the supervisor said why it ended."""
    if not any(fault.code in _OF_THE_PROCESS_BEFORE for fault in open_faults.faults):
        open_faults.happened(FaultCode.GATEWAY_DIED, text)


class BoxServer:
    """Answers questions about the black box of one robot, until :meth:`close`. clock: seconds."""

    def __init__(self, bus: Bus, keys: KeySpace, box: BlackBox, clock: Callable[[], float]) -> None:
        self._box = box
        self._waiting = 0
        self._loop = asyncio.get_running_loop()
        prefix = keys.key("@rpc/blackbox")
        self._handles: list[Handle] = [
            bus.answer(f"{prefix}/incidents", self._list),
            bus.answer(f"{prefix}/read/*", self._read),
            bus.answer(f"{prefix}/keep/*", self._keep, priority=NameFilter(clock)),
        ]

    def __repr__(self) -> str:
        return f"<BoxServer {self._box!r}>"

    def close(self) -> None:
        """Answer no more; idempotent."""
        while self._handles:
            self._handles.pop().close()

    def _list(self, question: IncomingQuery) -> None:
        self._ask_disk(question, lambda: payloads.encode(list_incidents(self._box.folder)))

    def _read(self, question: IncomingQuery) -> None:
        def answer(folder: BoxFolder = self._box.folder) -> bytes:
            return payloads.encode(read_part(folder, payloads.decode(ReadIncident, question.payload)))

        self._ask_disk(question, answer)

    def _keep(self, question: IncomingQuery) -> None:
        try:
            if not is_concrete(question.asked.rpartition("/")[2]):
                raise Malformed("its key names nobody")
            mark = payloads.decode(Text, question.payload)
        except (Refused, PayloadError) as error:
            question.refuse(error if isinstance(error, Refused) else Malformed(str(error)))
            return
        who = unescape(question.asked.rpartition("/")[2])  # the rules of a secure bus vouch for it
        if self._box.keep(MARK, f"{mark.text} ({who})"):
            question.answer(payloads.encode(Query()))
        else:
            question.refuse(NotReady("the black box is not written, or has just kept something"))

    def _ask_disk(self, question: IncomingQuery, answer: Callable[[], bytes]) -> None:
        if self._waiting >= WAITING:
            question.refuse(NotReady("too many questions wait for the disk"))
            return
        self._waiting += 1
        self._box.disk.call(lambda: self._work(question, answer))

    def _work(self, question: IncomingQuery, answer: Callable[[], bytes]) -> None:
        """Find an answer, on the disk's thread."""
        found: bytes | Refused
        try:
            found = answer()
        except PayloadError as error:
            found = Malformed(str(error))
        except Refused as error:
            found = error
        except Exception as error:
            found = NotReady(f"the disk: {getattr(error, 'strerror', None) or describe(error)}")
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._answer, question, found)

    def _answer(self, question: IncomingQuery, found: bytes | Refused) -> None:
        self._waiting -= 1
        if isinstance(found, Refused):
            question.refuse(found)
        else:
            question.answer(found)
