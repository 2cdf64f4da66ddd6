"""An incident as a recording: every message, in order, with marks at the causes."""

from __future__ import annotations

import json
from pathlib import Path

import msgpack
import pytest
from mcap.reader import make_reader

from tests.blackbox.scene import EPOCH_NS, S_NS, STATUS, Disk, Process, Scene, disk, scene
from tests.views.recording import files
from zbridge.blackbox.incidents import IncidentInfo
from zbridge.blackbox.reading import Findings
from zbridge.blackbox.spool import NextSegment
from zbridge.errors import ZbridgeError
from zbridge.views.recording.contents import Pictures
from zbridge.views.recording.incident import export_incident

__all__ = ["disk", "scene"]
POSE = files.packed(x=1.0, y=2.0, heading=0.5)


@pytest.fixture
def process(scene: Scene) -> Process:
    """A process that has begun."""
    made = scene.process()
    made.begin()
    return made


def exported(scene: Scene, output: Path, pictures: Pictures | None = None) -> Findings:
    """Write the only incident as a recording."""
    info = scene.only_incident()
    return export_incident(scene.folder.parts(info.name), info, output, pictures)


def read(path: Path) -> list[tuple[str, float, bytes]]:
    """Return key, seconds after the epoch, and payload of all messages."""
    return [(topic, (log_ns - EPOCH_NS) / S_NS, data) for topic, log_ns, _, data in files.read(path)]


def metadata(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as file:
        return {each.name: each.metadata for each in make_reader(file).iter_metadata()}


def test_every_message_is_kept_in_order_at_the_time_it_came(scene: Scene, process: Process, tmp_path: Path) -> None:
    sent = []
    for number in range(1000):
        if number % 100 == 0:
            process.write(NextSegment([process.record(STATUS, "status")]))
            sent.append(("fleet/r1/status", STATUS))
        payload = files.packed(seq=number)
        process.write(process.record(payload, "pose" if number % 2 else "@wire/robot/in"))
        sent.append(("fleet/r1/pose" if number % 2 else "fleet/r1/@wire/robot/in", payload))
        scene.now += 0.05
    process.keep()
    findings = exported(scene, tmp_path / "a.mcap")
    kept = [message for message in read(tmp_path / "a.mcap") if message[0] != "fleet/@mark"]
    assert [(key, payload) for key, _, payload in kept] == sent
    assert [seconds for _, seconds, _ in kept] == sorted(seconds for _, seconds, _ in kept)
    assert kept[-1][1] == pytest.approx(49.95, abs=0.001)
    assert (findings.records, findings.damaged) == (len(sent), 0)


def test_marks_stand_where_the_causes_were(scene: Scene, process: Process, tmp_path: Path) -> None:
    process.run(20)
    process.keep("deadman")
    process.run(20)
    process.keep("robot_lost")
    process.run(20)
    scene.now += 5
    process.keep("latched")
    exported(scene, tmp_path / "a.mcap")
    course = []
    for key, seconds, payload in read(tmp_path / "a.mcap"):
        if key == "fleet/@mark":
            mark = msgpack.unpackb(payload)
            assert (mark["sender"], mark["kind"]) == ("r1 black box", "chat")
            assert mark["stamp_ns"] == EPOCH_NS + seconds * S_NS
            course.append((seconds, mark["text"]))
        elif key == "fleet/r1/debug":
            course.append((seconds, ""))
    assert course == [
        *((0, ""), (10, "")),
        *((20, "deadman: why deadman"), (20, ""), (30, "")),
        *((40, "robot_lost: why robot_lost"), (40, ""), (50, "")),
        (65, "latched: why latched"),
    ]


@pytest.mark.parametrize(
    ("key", "kept"),
    [
        ("fleet/*/@cmd/stop", "fleet/r1/@cmd/stop"),
        ("fleet/r*/@cmd/stop", "fleet/r1/@cmd/stop"),
        ("fleet/**/@cmd/stop", "fleet/r1/@cmd/stop"),
        ("fleet/r1/@cmd/stop", "fleet/r1/@cmd/stop"),
        ("fleet/r1/@cmd/*/stop", "fleet/r1/@cmd/*/stop"),
    ],
)
def test_a_stop_for_all_robots_has_the_key_of_this_one(
    scene: Scene, process: Process, tmp_path: Path, key: str, kept: str
) -> None:
    process.write((scene.mono_ns, key, b"\x80", None))
    process.keep()
    exported(scene, tmp_path / "a.mcap")
    assert kept in [topic for topic, *_ in read(tmp_path / "a.mcap")]
    assert key == kept or key not in [topic for topic, *_ in read(tmp_path / "a.mcap")]


def test_a_command_is_followed_by_who_sent_it(scene: Scene, process: Process, tmp_path: Path) -> None:
    lease = bytes(range(8))
    process.write(
        process.record(files.packed(state="held", holder="ann", lease=lease), "control"),
        (scene.mono_ns, "fleet/r1/@cmd/drive", b"\x80", files.packed(lease=lease, seq=1, proof=bytes(16))),
    )
    process.keep()
    exported(scene, tmp_path / "a.mcap")
    (sent,) = (msgpack.unpackb(data) for topic, _, data in read(tmp_path / "a.mcap") if topic.endswith("/@sent"))
    assert sent["holder"] == "ann"


def test_damage_in_the_middle_costs_itself_and_is_told(scene: Scene, process: Process, tmp_path: Path) -> None:
    process.run(50)
    process.keep()
    parts = scene.folder.parts(scene.names[0])
    data = bytearray(parts[2].read_bytes())
    data[data.index(b"1010")] ^= 1
    parts[2].write_bytes(data)
    parts[3].write_bytes(parts[3].read_bytes()[:-3])
    parts[4].write_bytes(bytes(1000))
    findings = exported(scene, tmp_path / "a.mcap")
    said = [payload for key, _, payload in read(tmp_path / "a.mcap") if key == "fleet/r1/debug"]
    assert said == [b"1000", b"1040"]
    assert findings.damaged > 1000


def test_an_incident_of_nothing_but_its_description_has_its_marks(
    scene: Scene, process: Process, tmp_path: Path
) -> None:
    process.keep()
    assert exported(scene, tmp_path / "a.mcap").records == 0
    assert [key for key, *_ in read(tmp_path / "a.mcap")] == ["fleet/@mark"]


def test_the_recording_says_whose_it_is_and_why_it_was_kept(scene: Scene, process: Process, tmp_path: Path) -> None:
    process.run(20)
    process.keep(frame=[process.record(STATUS, "status")])
    exported(scene, tmp_path / "a.mcap")
    described = metadata(tmp_path / "a.mcap")
    assert described["zbridge"] == {"version": "of 100", "realm": "fleet", "robots": "r1", "wire": "true"}
    assert json.loads(described["configuration/r1"]["configuration"]) == {"robot": "r1"}
    incident = described["incident"]
    assert (incident["name"], incident["robot"], incident["before"]) == (scene.names[0], "r1", "")
    assert [cause["code"] for cause in json.loads(incident["causes"])] == ["deadman"]
    frame = json.loads(incident["frame"])
    assert frame["status"]["state"] == "established"
    assert "configuration" not in frame


@pytest.mark.parametrize("frame", [{}, {"versions": "1"}, {"versions": {}, "configuration": None}])
def test_a_frame_of_another_content_is_no_error(scene: Scene, process: Process, tmp_path: Path, frame: dict) -> None:
    process.keep()
    info = scene.only_incident()
    odd = IncidentInfo(info.name, "fleet", "r1", 1, info.causes, frame=frame)
    export_incident(scene.folder.parts(info.name), odd, tmp_path / "a.mcap", None)
    assert metadata(tmp_path / "a.mcap")["zbridge"]["version"] == ""


def test_pictures_are_drawn_where_they_are_wanted(scene: Scene, process: Process, tmp_path: Path) -> None:
    process.write(process.record(POSE, "pose"))
    process.keep()
    exported(scene, tmp_path / "a.mcap", Pictures())
    assert {key for key, *_ in read(tmp_path / "a.mcap")} >= {"fleet/r1/pose", "/r1/pose"}


def test_a_disk_that_is_full_is_an_error_that_names_it(
    scene: Scene, process: Process, tmp_path: Path, disk: Disk
) -> None:
    process.run(50)
    process.keep()
    disk.room = 100
    with pytest.raises(ZbridgeError, match="No space left on device"):
        exported(scene, tmp_path / "a.mcap")


def test_a_segment_that_is_gone_is_an_error_that_names_it(scene: Scene, process: Process, tmp_path: Path) -> None:
    process.run(50)
    process.keep()
    info = scene.only_incident()
    parts = scene.folder.parts(info.name)
    parts[3].unlink()
    with pytest.raises(ZbridgeError, match=r"0000000003\.zbb: No such file"):
        export_incident(parts, info, tmp_path / "a.mcap", None)


def test_an_output_that_exists_is_not_overwritten(scene: Scene, process: Process, tmp_path: Path) -> None:
    process.keep()
    (tmp_path / "a.mcap").write_text("precious")
    with pytest.raises((ZbridgeError, FileExistsError)):
        exported(scene, tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_text() == "precious"
