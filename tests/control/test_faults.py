import pytest

from zbridge.control.events import AuthorityEvent, EventKind, StopCause
from zbridge.control.faults import EVENT_S, EVENTS, IN_A_ROW, INCIDENTS, SETTLE_S, EventFaults, FaultCode, OpenFaults
from zbridge.errors import Code
from zbridge.fleet.messages import Latch


class Scene:
    """Faults on a clock of their own."""

    def __init__(self) -> None:
        self.now = 100.0
        self.changes = 0
        self.occurred: list[tuple[str, str]] = []
        self.open_faults = OpenFaults(self._changed, lambda: self.now, lambda: int(self.now * 1e9))
        self.open_faults.occurred = lambda code, text: self.occurred.append((code, text))
        self.events = EventFaults(self.open_faults, lambda: self.now)

    def _changed(self) -> None:
        self.changes += 1

    def after(self, seconds: float) -> None:
        self.now += seconds
        self.open_faults.expire()

    @property
    def open(self) -> dict[str, int]:
        return {fault.code: fault.count for fault in self.open_faults.faults}


@pytest.fixture
def scene() -> Scene:
    return Scene()


def refused(code: Code = Code.NOT_READY, who: str | None = "ann", command: str = "drive") -> AuthorityEvent:
    return AuthorityEvent(EventKind.REFUSED, who, "no", command=command, code=code)


def test_a_lasting_fault_opens_at_once_and_heals_when_its_cause_is_gone_for_long_enough(scene: Scene) -> None:
    scene.open_faults.set(FaultCode.LINK_STALLED, "is stalled")
    scene.after(3600.0)
    assert (scene.open, scene.open_faults.texts) == ({"link_stalled": 1}, ("is stalled",))
    scene.open_faults.set(FaultCode.LINK_STALLED, None)
    scene.after(SETTLE_S - 0.1)
    assert (scene.open, scene.open_faults.texts) == ({"link_stalled": 1}, ())
    scene.after(0.2)
    assert scene.open == {}


def test_a_fault_that_flaps_opens_once_and_counts_its_occurrences(scene: Scene) -> None:
    for _ in range(20):
        scene.open_faults.set(FaultCode.LINK_STALLED, "is stalled")
        scene.after(1.0)
        scene.open_faults.set(FaultCode.LINK_STALLED, None)
        scene.after(1.0)
    assert scene.open == {"link_stalled": 20}
    assert scene.open_faults.counts == {FaultCode.LINK_STALLED: 1}
    assert scene.occurred == [("link_stalled", "is stalled")] * 20
    scene.after(SETTLE_S)
    scene.open_faults.set(FaultCode.LINK_STALLED, "is stalled")
    assert scene.open_faults.counts == {FaultCode.LINK_STALLED: 2}


def test_an_event_heals_by_itself_a_minute_after_it_happened_last(scene: Scene) -> None:
    stopped = AuthorityEvent(EventKind.STOPPED, "ann", "deadman", stops=True, cause=StopCause.DEADMAN)
    scene.events.note(stopped)
    scene.after(EVENT_S / 2)
    scene.events.note(stopped)
    scene.after(EVENT_S - 1)
    assert scene.open == {"deadman": 2}
    assert scene.open_faults.texts == (), "it is no lasting condition"
    scene.after(1.1)
    assert scene.open == {}


@pytest.mark.parametrize(
    ("cause", "code"),
    [
        (StopCause.DEADMAN, "deadman"),
        (StopCause.HOLDER_LOST, "holder_lost"),
        (StopCause.BUS_LOST, "bus_lost"),
        (StopCause.COMMAND, None),
        (StopCause.RELEASED, None),
        (StopCause.RESTART, None),
    ],
)
def test_stops_that_nobody_ordered_are_faults(scene: Scene, cause: StopCause, code: str | None) -> None:
    scene.events.note(AuthorityEvent(EventKind.STOPPED, "ann", "why", stops=True, cause=cause))
    assert list(scene.open) == ([code] if code else [])
    assert scene.occurred == ([(code, "why (ann)")] if code else [])


def test_ten_motions_of_the_driver_refused_in_a_row_are_a_fault(scene: Scene) -> None:
    for _ in range(IN_A_ROW - 1):
        scene.events.note(refused())
    scene.events.moved()
    scene.events.note(refused())
    assert scene.open == {}, "one was carried out between them"
    for _ in range(IN_A_ROW - 1):
        scene.events.note(refused())
    assert scene.open == {"refused_motion": 1}


def test_motions_that_come_too_late_have_a_code_of_their_own(scene: Scene) -> None:
    for _ in range(IN_A_ROW):
        scene.events.note(refused(Code.STALE, command="motor/left"))
    assert scene.open == {"stale_commands": 1}


@pytest.mark.parametrize(
    "event",
    [
        refused(Code.NO_LEASE),
        refused(Code.HELD),
        refused(who=None),
        refused(command="acquire"),
        refused(command="light"),
    ],
)
def test_refusals_of_strangers_and_of_other_commands_are_no_fault(scene: Scene, event: AuthorityEvent) -> None:
    for _ in range(5 * IN_A_ROW):
        scene.events.note(event)
    assert scene.open == {}


def test_refusals_with_pauses_between_them_are_no_row(scene: Scene) -> None:
    for _ in range(5 * IN_A_ROW):
        scene.events.note(refused())
        scene.after(3.0)
    assert scene.open == {}


def test_a_latch_of_before_this_process_is_a_fault_and_no_incident(scene: Scene) -> None:
    latch = Latch(bytes(16), "ann", "wet floor")
    scene.events.latched((latch,), anew=False)
    assert (scene.open, scene.occurred) == ({"latched": 1}, [])
    scene.events.latched(())
    scene.after(SETTLE_S)
    scene.events.latched((latch,))
    assert scene.occurred == [("latched", "latched by ann (wet floor)")]


def test_a_change_is_told_once_and_a_quiet_one_not_at_all(scene: Scene) -> None:
    for _ in range(3):
        scene.open_faults.set(FaultCode.AUDIT_LOG, "disk full")
    assert scene.changes == 1
    scene.open_faults.set(FaultCode.ROBOT_LOST, "closed", quiet=True)
    scene.open_faults.set(FaultCode.ROBOT_LOST, None, quiet=True)
    assert scene.changes == 1
    scene.after(SETTLE_S)
    assert scene.changes == 2


def test_every_event_is_an_incident_and_full_disks_and_files_are_none() -> None:
    assert EVENTS < INCIDENTS < set(FaultCode)
    assert not INCIDENTS & {FaultCode.AUDIT_LOG, FaultCode.LATCH_FILE, FaultCode.BLACK_BOX, FaultCode.CAMERA}
