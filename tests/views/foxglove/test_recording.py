"""Recordings as a playback reads them: whole, cut off, spoiled."""

from pathlib import Path

import pytest

from tests.views.foxglove.recordings import BEGIN_NS, POSE_NS, record
from zbridge.errors import ZbridgeError
from zbridge.views.foxglove.playback import IndexedRecording

S = 10**9
SHOWN = {"/r1/map", "/r1/status", "/r1/log", "/r1/pose", "/r1/tf", "/r1/trail", "/r1/scan"}


def test_a_recording_tells_its_times_and_the_channels_that_viewers_can_read(tmp_path: Path) -> None:
    recording = IndexedRecording(record(tmp_path / "a.mcap", 3))
    assert recording.whole
    assert (recording.begin_ns, recording.end_ns) == (BEGIN_NS, BEGIN_NS + 59 * POSE_NS)
    assert set(recording.channels) == SHOWN  # and not the fleet messages
    assert recording.channels["/r1/scan"].schema.name == "foxglove.LaserScan"


@pytest.mark.parametrize("whole", [True, False])
def test_messages_are_read_from_any_time_on_in_order(tmp_path: Path, whole: bool) -> None:
    recording = IndexedRecording(record(tmp_path / "a.mcap", 3, finish=whole))
    assert recording.whole is whole
    messages = list(recording.messages(BEGIN_NS + S))
    assert messages[0].log_ns == BEGIN_NS + S
    assert [message.log_ns for message in messages] == sorted(message.log_ns for message in messages)
    poses = [message for message in messages if message.topic == "/r1/pose"]
    assert len(poses) == (recording.end_ns - BEGIN_NS - S) // POSE_NS + 1
    assert len(poses) > 20


@pytest.mark.parametrize("whole", [True, False])
def test_the_last_messages_before_a_time_are_found(tmp_path: Path, whole: bool) -> None:
    recording = IndexedRecording(record(tmp_path / "a.mcap", 3, finish=whole))
    at_ns = BEGIN_NS + S + 1
    found = recording.last_before(["/r1/map", "/r1/pose", "/r1/scan", "/r1/nobody"], at_ns, BEGIN_NS)
    assert {message.topic: message.log_ns for message in found} == {
        "/r1/map": BEGIN_NS,
        "/r1/pose": BEGIN_NS + S,
        "/r1/scan": BEGIN_NS + S,
    }
    assert recording.last_before(["/r1/map"], at_ns, BEGIN_NS + 1) == []


def test_a_recording_that_is_cut_anywhere_is_read_up_to_the_cut_or_refused(tmp_path: Path) -> None:
    data = record(tmp_path / "a.mcap", 2).read_bytes()
    cut, most = tmp_path / "cut.mcap", 0
    for size in range(0, len(data) - 1, len(data) // 40):
        cut.write_bytes(data[:size])
        try:
            recording = IndexedRecording(cut)
        except ZbridgeError:
            continue
        assert not recording.whole
        read = len(list(recording.messages(0)))
        assert read >= most
        most = read
    assert most > 50


@pytest.mark.parametrize("data", [b"", b"\x89MCAP0\r\n", b"garbage" * 999, b"\x89MCAP0\r\n" + bytes(999)])
def test_what_is_no_recording_is_refused_with_its_name(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "no.mcap"
    file.write_bytes(data)
    with pytest.raises(ZbridgeError, match=r"no\.mcap: nothing in it"):
        IndexedRecording(file)
    with pytest.raises(ZbridgeError, match="No such file"):
        IndexedRecording(tmp_path / "nowhere.mcap")
