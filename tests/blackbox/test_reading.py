"""What is read of a black box: parts of its files, nothing else, and messages at the times they came."""

from __future__ import annotations

import msgspec
import pytest

from tests.blackbox.scene import EPOCH_NS, S_NS, Process, Scene, messages, scene, segment, texts
from zbridge.blackbox.incidents import INFO, segments_of
from zbridge.blackbox.reading import Findings, list_incidents, read_part, read_records
from zbridge.blackbox.segments import Record, SegmentHead
from zbridge.errors import Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet.incidents import PART_BYTES, ReadIncident

__all__ = ["scene"]


@pytest.fixture
def process(scene: Scene) -> Process:
    """A process with one incident of three segments, that is still open."""
    made = scene.process(minutes=1.0)
    made.begin()
    made.run(30)
    made.keep("deadman")
    made.keep("deadman")
    made.keep("robot_lost")
    return made


def head(wall_s: float, mono_s: float, *, pid: int = 100, boot: str = "boot", lost: int = 0) -> SegmentHead:
    return SegmentHead("fleet", "r1", boot, pid, EPOCH_NS + int(wall_s * S_NS), int(mono_s * S_NS), lost)


def said(text: str, mono_s: float) -> Record:
    return (int(mono_s * S_NS), "fleet/r1/debug", text.encode(), None)


def written(scene: Scene, *contents: bytes) -> list:
    scene.folder.make()
    for number, content in enumerate(contents, 1):
        (scene.folder.ring / f"{number:010d}.zbb").write_bytes(content)
    return scene.ring


def seconds(scene: Scene, findings: Findings | None = None) -> list[float]:
    """Return when the messages of the ring came, after the epoch."""
    return [(record.at_ns - EPOCH_NS) / S_NS for record in read_records(scene.ring, findings or Findings())]


# Parts of files


def test_incidents_are_listed_with_their_causes_and_sizes(scene: Scene, process: Process) -> None:
    answer = list_incidents(scene.folder)
    (entry,) = answer.incidents
    assert (entry.name, entry.codes, entry.text, entry.open) == (
        scene.names[0],
        ("deadman", "robot_lost"),
        "why deadman",
        True,
    )
    assert entry.began_ns == EPOCH_NS + 30 * S_NS
    assert entry.bytes == sum(path.stat().st_size for path in scene.folder.parts(entry.name))
    process.end()
    assert [entry.open for entry in list_incidents(scene.folder).incidents] == [False]
    assert payloads.encode(answer)


def test_a_folder_that_was_never_written_has_no_incidents(scene: Scene) -> None:
    assert list_incidents(scene.folder).incidents == ()


def test_an_incident_is_read_file_by_file_and_part_by_part(scene: Scene, process: Process) -> None:
    name = scene.names[0]
    large = scene.folder.incidents / name / "0000000009.zbb"
    large.write_bytes(bytes(range(256)) * (PART_BYTES // 256) + b"end")
    listed = read_part(scene.folder, ReadIncident(name))
    assert [file for file, _ in listed.files] == [INFO, *(f"{n:010d}.zbb" for n in (1, 2, 3, 9))]
    assert listed.data == b""
    for file, size in listed.files:
        data = b""
        while part := read_part(scene.folder, ReadIncident(name, file, len(data))).data:
            assert len(part) <= PART_BYTES
            data += part
        assert (len(data), data) == (size, (scene.folder.incidents / name / file).read_bytes())


@pytest.mark.parametrize("offset", [10_000, 2**31, 2**63 - 1, 2**63, 2**64 - 1])
def test_beyond_the_end_of_a_file_there_is_nothing(scene: Scene, process: Process, offset: int) -> None:
    question = payloads.decode(ReadIncident, payloads.encode(ReadIncident(scene.names[0], INFO, offset)))
    assert read_part(scene.folder, question).data == b""


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../ring", "../incidents/{name}", "/etc", "{name}/", "{name}/..", "none", "{name}\0", "*"]
)
def test_what_is_no_incident_is_refused(scene: Scene, process: Process, name: str) -> None:
    (scene.folder.path / "0000000001.zbb").write_bytes(b"secret")
    for file in ("", "0000000001.zbb", INFO):
        with pytest.raises(Unsupported, match="no incident"):
            read_part(scene.folder, ReadIncident(name.format(name=scene.names[0]), file))


@pytest.mark.parametrize(
    "file",
    [
        "../../etc/passwd",
        "/etc/passwd",
        ".",
        "..",
        "none",
        "0000000099.zbb",
        "../{name}/incident.json",
        "./incident.json",
        "incident.json/",
        "notes.txt",
        "link",
        "INCIDENT.JSON",
    ],
)
def test_what_is_no_file_of_it_is_refused(scene: Scene, process: Process, file: str) -> None:
    folder = scene.folder.incidents / scene.names[0]
    (folder / "notes.txt").write_text("secret")
    (folder / "link").symlink_to("/etc/passwd")
    with pytest.raises(Unsupported, match="has no file"):
        read_part(scene.folder, ReadIncident(scene.names[0], file.format(name=scene.names[0])))


def test_a_name_or_a_place_that_no_gateway_gives_is_refused_before_it_is_looked_for() -> None:
    for fields in ({"incident": "x" * 201}, {"incident": "x", "file": "y" * 65}, {"incident": "x", "offset": -1}):
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert(fields, ReadIncident)


# Times and losses


def test_messages_have_the_time_of_day_at_which_they_came(scene: Scene) -> None:
    written(scene, segment(said("a", 5), said("b", 6), head=head(100, 4)), segment(said("c", 16), head=head(110, 14)))
    findings = Findings()
    assert seconds(scene, findings) == [101, 102, 112]
    assert (findings.records, findings.damaged, findings.lost, findings.set_back_s) == (3, 0, 0, 0.0)
    assert len(findings.heads) == 2


def test_a_clock_that_is_set_back_in_steps_is_told_and_times_rise(scene: Scene) -> None:
    heads = [head(0, 0), head(-3590, 10), head(-7180, 20)]
    written(scene, *(segment(said("x", 10 * number), head=each) for number, each in enumerate(heads)))
    findings = Findings()
    assert seconds(scene, findings) == [0, 10, 20]
    assert findings.set_back_s == pytest.approx(7200)


def test_a_clock_that_is_adjusted_a_little_is_not_told(scene: Scene) -> None:
    written(scene, segment(said("a", 0), head=head(0, 0)), segment(said("b", 10), head=head(9.95, 10)))
    findings = Findings()
    assert seconds(scene, findings) == [0, 10]
    assert findings.set_back_s == 0.0


def test_a_clock_that_is_set_forward_dates_what_comes_after(scene: Scene) -> None:
    written(scene, segment(said("a", 0), head=head(0, 0)), segment(said("b", 10), head=head(3610, 10)))
    assert seconds(scene) == [0, 3610]


def test_after_a_restart_of_the_machine_the_clock_of_that_one_counts(scene: Scene) -> None:
    written(scene, segment(said("a", 900), head=head(0, 900)), segment(said("b", 7), head=head(60, 5, boot="new")))
    assert seconds(scene) == [0, 62]


def test_a_machine_that_starts_with_a_wrong_clock_dates_its_messages_by_it(scene: Scene) -> None:
    written(scene, segment(said("a", 900), head=head(0, 900)), segment(said("b", 7), head=head(-5000, 5, boot="new")))
    assert seconds(scene) == [0, -4998]


def test_messages_behind_a_damaged_head_have_their_times(scene: Scene) -> None:
    contents = [segment(said(f"{n}", 10 * n), head=head(10 * n, 10 * n)) for n in range(3)]
    for hit in range(3):
        damaged = list(contents)
        damaged[hit] = b"\xff" + damaged[hit][1:]
        written(scene, *damaged)
        assert seconds(scene) == [0, 10, 20]


def test_damage_amid_a_segment_costs_itself_and_is_counted(scene: Scene) -> None:
    data = bytearray(segment(*(said(f"message {number}", number) for number in range(5))))
    data[data.index(b"message 2")] ^= 1
    written(scene, bytes(data), b"", bytes(100))
    findings = Findings()
    assert [record.payload[-1:] for record in messages(scene.ring, findings)] == [b"0", b"1", b"3", b"4"]
    assert 100 < findings.damaged < 200


@pytest.mark.parametrize(
    ("heads", "lost"),
    [
        ([(100, 3)], 0),
        ([(100, 3), (100, 3), (100, 10)], 7),
        ([(100, 5), (101, 0), (101, 2)], 2),
        ([(100, 5), (101, 1), (100, 6), (101, 4)], 4),
        ([(100, 5), (100, 9), (100, 0), (100, 1)], 5),
        ([(1, 5), (1, 0)], 0),
    ],
)
def test_messages_that_were_lost_are_counted_by_process(scene: Scene, heads: list, lost: int) -> None:
    """A process that begins again with the same id begins to count again."""
    written(scene, *(segment(head=head(n, n, pid=pid, lost=count)) for n, (pid, count) in enumerate(heads)))
    findings = Findings()
    assert list(read_records(scene.ring, findings)) == []
    assert findings.lost == lost


def test_an_incident_cut_off_anywhere_is_read_up_to_there(scene: Scene, process: Process) -> None:
    last = segments_of(scene.folder.incidents / scene.names[0])[-1]
    data = last.read_bytes()
    for size in range(0, len(data), 7):
        last.write_bytes(data[:size])
        assert scene.kept(scene.names[0])[:2] == ["1000", "1010"]
    last.write_bytes(data)
    assert texts([last]) == ["1020"]
