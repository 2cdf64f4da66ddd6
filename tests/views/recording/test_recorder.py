"""The recorder on a fake bus, and its file read by the library: keys, times, senders, pictures, losses."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import msgpack
import pytest
from mcap.reader import make_reader

from tests.fake_bus import FakeBus
from tests.machine import Patience
from tests.views.recording import files
from zbridge.errors import ZbridgeError
from zbridge.fleet import topics
from zbridge.fleet.topics import KeySpace
from zbridge.views.recording import recorder as recording
from zbridge.views.recording import tape as written
from zbridge.views.recording.capture import BusCapture, RecordPlan
from zbridge.views.recording.contents import Pictures
from zbridge.views.recording.intake import Intake
from zbridge.views.recording.recorder import Recorder
from zbridge.views.recording.summary import summarize
from zbridge.views.recording.tape import Tape, TapeSettings

KEYS = KeySpace("fleet", "r1")
LEASE, PROOF = bytes(range(8)), bytes(16)
POSE = files.packed(stamp_ns=files.BEGAN_NS, x=1.0, y=2.0, heading=0.5)
STATUS = files.packed(state="established", protocol="tcpudp", version="1.3", features=["cam", "lidar"])


class Scene:
    """A recorder of all robots, with the bus that it listens to."""

    def __init__(self, path: Path, plan: RecordPlan | None = None, *, bound: int = 2**20, **options: Any) -> None:
        self.path = path
        self.bus = FakeBus()
        self.intake = Intake(bound)
        self.tape = Tape(TapeSettings(path, **options.pop("tape", {})))
        self.recorder = Recorder(self.tape, self.intake, {"zbridge": {"version": "9"}}, **options)
        self._recording = BusCapture(self.bus.join("viewer"), plan or RecordPlan(), self.intake)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[Scene]:
        self.recorder.start()
        self._recording.open()
        try:
            yield self
        finally:
            self._recording.close()
            await asyncio.to_thread(self.recorder.close)

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        topic = topics.find(KEYS.path(key)) or topics.POSE
        self.bus.publisher(key, topic).put(payload, attachment)

    def read(self) -> list[tuple[str, int, int, bytes]]:
        return files.read(self.path)


async def soon(condition: Callable[[], object]) -> None:
    """Wait for the recorder's thread."""
    patience = Patience(10.0)
    while not condition():
        assert not patience.over
        await asyncio.sleep(recording.PAUSE_S / 5)


async def test_what_comes_after_the_end_is_no_loss_and_nothing_is_unsubscribed_where_that_could_hang(
    tmp_path: Path,
) -> None:
    scene = Scene(tmp_path / "a.mcap")
    async with scene.running():
        scene.put("fleet/r1/status", STATUS)
        await soon(lambda: scene.recorder.messages)
    scene.put("fleet/r1/status", STATUS)
    assert [key for key, *_ in scene.read()] == ["fleet/r1/status"]
    assert scene.recorder.losses() == {}
    assert scene.bus.network.subscribers != []


async def test_a_message_is_recorded_as_it_was_published_at_its_stamp(tmp_path: Path) -> None:
    async with Scene(tmp_path / "a.mcap").running() as scene:
        scene.put("fleet/r1/pose", POSE)
    ((topic, arrived_ns, publish_ns, payload),) = scene.read()
    assert (topic, publish_ns, payload) == ("fleet/r1/pose", files.BEGAN_NS, POSE)
    assert arrived_ns > files.BEGAN_NS


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xc1garbage", files.packed(stamp_ns="x"), files.packed(stamp_ns=-5), files.packed(stamp_ns=2**63)],
)
async def test_a_message_without_a_stamp_that_can_be_one_is_published_when_it_arrived(
    tmp_path: Path, payload: bytes
) -> None:
    async with Scene(tmp_path / "a.mcap").running() as scene:
        scene.put("fleet/r1/pose", payload)
    ((_, arrived_ns, publish_ns, read),) = scene.read()
    assert (publish_ns, read) == (arrived_ns, payload)


async def test_channels_say_how_their_messages_are_encoded(tmp_path: Path) -> None:
    async with Scene(tmp_path / "a.mcap", RecordPlan(wire=True)).running() as scene:
        scene.put("fleet/r1/pose", POSE)
        scene.put("fleet/r1/@wire/robot/in", b"\x02\x00")
        scene.put("fleet/r1/@wire/robot/in", b"\x03\x00", b"datagram")
        scene.put("fleet/r1/unknown", b"\x80")
    with scene.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    kinds = {
        (channel.topic, channel.message_encoding, schema.name if schema else "", tuple(channel.metadata.items()))
        for channel in summary.channels.values()
        for schema in [summary.schemas.get(channel.schema_id)]
    }
    assert kinds == {
        ("fleet/r1/pose", "msgpack", "zbridge.Pose.v1", ()),
        ("fleet/r1/@wire/robot/in", "octet-stream", "", ()),
        ("fleet/r1/@wire/robot/in", "octet-stream", "", (("transport", "datagram"),)),
        ("fleet/r1/unknown", "msgpack", "", ()),
    }
    (schema,) = summary.schemas.values()
    assert schema.encoding == "jsonschema"
    assert set(json.loads(schema.data)["$defs"]["Pose"]["properties"]) >= {"x", "y", "heading", "stamp_ns"}


async def test_a_command_is_followed_by_the_lease_it_claims_and_its_holder(tmp_path: Path) -> None:
    shown = files.packed(lease=LEASE, seq=4, proof=PROOF)
    async with Scene(tmp_path / "a.mcap").running() as scene:
        scene.put("fleet/r1/control", files.packed(state="held", holder="op1", lease=LEASE))
        scene.put("fleet/r1/@cmd/drive", files.packed(forward=0.5), shown)
        scene.put("fleet/r1/@cmd/drive", files.packed(forward=0.5), files.packed(lease=b"another.", seq=1, proof=PROOF))
        scene.put("fleet/r1/@cmd/stop", b"")
    sent = [(topic, msgpack.unpackb(data)) for topic, _, _, data in scene.read() if topic.endswith("/@sent")]
    assert sent == [
        ("fleet/r1/@cmd/drive/@sent", {"lease": LEASE, "holder": "op1", "attachment": shown}),
        (
            "fleet/r1/@cmd/drive/@sent",
            {"lease": b"another.", "holder": None, "attachment": files.packed(lease=b"another.", seq=1, proof=PROOF)},
        ),
        ("fleet/r1/@cmd/stop/@sent", {"lease": None, "holder": None, "attachment": b""}),
    ]


async def test_marks_tokens_and_sessions_are_recorded(tmp_path: Path) -> None:
    scene = Scene(tmp_path / "a.mcap")
    scene.bus.answer("fleet/r1/@rpc/sessions/gateway", lambda query: query.answer(files.packed(sessions=[])))
    async with scene.running():
        token = scene.bus.announce("fleet/r1/@alive/gateway")
        scene.put("fleet/@mark", files.packed(text="now"))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        token.close()
    read = {(topic, data) for topic, _, _, data in scene.read()}
    assert read >= {
        ("fleet/r1/@alive/gateway", files.packed(alive=True)),
        ("fleet/r1/@alive/gateway", files.packed(alive=False)),
        ("fleet/@mark", files.packed(text="now")),
        ("fleet/r1/@rpc/sessions/gateway", files.packed(sessions=[])),
    }


async def test_states_from_before_the_recording_are_asked_for(tmp_path: Path) -> None:
    scene = Scene(tmp_path / "a.mcap")
    scene.put("fleet/r1/status", STATUS)
    scene.bus.announce("fleet/r1/@alive/gateway")
    async with scene.running():
        for _ in range(5):
            await asyncio.sleep(0)
    assert ("fleet/r1/status", STATUS) in {(topic, data) for topic, _, _, data in scene.read()}
    with scene.path.open("rb") as file:
        described = {each.name: each.metadata for each in make_reader(file).iter_metadata()}
    assert described["zbridge"] == {"version": "9"}
    assert described["robot/r1"]["protocol"] == "tcpudp"
    assert described["robot/r1"]["features"] == "cam, lidar"


PLANS = {
    "all": (RecordPlan(wire=True), {"fleet/r1/pose", "fleet/r2/pose", "fleet/r1/@cmd/stop", "fleet/r1/@wire/robot/in"}),
    "one robot": (RecordPlan(robots=("r1",)), {"fleet/r1/pose", "fleet/r1/@cmd/stop"}),
    "keys": (RecordPlan(keys="fleet/*/pose"), {"fleet/r1/pose", "fleet/r2/pose"}),
}


@pytest.mark.parametrize("name", PLANS)
async def test_what_was_named_is_recorded_and_nothing_else(tmp_path: Path, name: str) -> None:
    plan, expected = PLANS[name]
    async with Scene(tmp_path / "a.mcap", plan).running() as scene:
        for key in ("fleet/r1/pose", "fleet/r2/pose", "fleet/r1/@cmd/stop", "fleet/r1/@wire/robot/in", "other/r1/pose"):
            scene.put(key, b"\x80")
    assert {topic for topic, *_ in scene.read() if not topic.endswith("@sent")} == expected


async def test_pictures_stand_beside_the_messages_or_alone(tmp_path: Path) -> None:
    for fleet in (True, False):
        scene = Scene(tmp_path / f"{fleet}.mcap", fleet=fleet, pictures=Pictures())
        async with scene.running():
            scene.put("fleet/r1/pose", POSE)
        topics_read = {topic for topic, *_ in scene.read()}
        assert topics_read >= {"/r1/pose", "/r1/tf"}
        assert ("fleet/r1/pose" in topics_read) is fleet


async def test_the_messages_of_all_files_are_counted_as_their_readers_count_them(tmp_path: Path) -> None:
    """Senders, pictures, and states that each file begins with, besides what came."""
    scene = Scene(tmp_path / "a.mcap", pictures=Pictures(), tape={"split_bytes": 1})
    async with scene.running():
        scene.put("fleet/r1/status", STATUS)
        scene.put("fleet/r1/pose", POSE)
        scene.put("fleet/r1/@cmd/drive", files.packed(forward=0.5))
        await soon(lambda: len(scene.tape.files) >= 3)
    assert scene.tape.messages == sum(summarize(path).messages for path in scene.tape.files)
    assert scene.tape.messages > scene.recorder.messages == 3


async def test_what_exceeds_the_bound_is_dropped_and_counted_by_key(tmp_path: Path) -> None:
    scene = Scene(tmp_path / "a.mcap", bound=10_000)
    for _ in range(30):
        scene.intake.put("fleet/r1/scan", bytes(1000))
    scene.recorder.start()
    await asyncio.to_thread(scene.recorder.close)
    kept = len(scene.read())
    assert 0 < kept < 30
    assert scene.recorder.losses() == {"the disk was too slow": {"fleet/r1/scan": 30 - kept}}


async def test_a_hole_in_a_sequence_is_counted(tmp_path: Path) -> None:
    async with Scene(tmp_path / "a.mcap").running() as scene:
        for seq in (5, 6, 9, 10, 2, 3):
            scene.put("fleet/r1/scan", files.packed(seq=seq))
    assert scene.recorder.losses() == {"missing in the sequence": {"fleet/r1/scan": 2}}


async def test_a_full_disk_ends_the_recording_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    scene = Scene(tmp_path / "a.mcap", failed=lambda: told.append(True))
    scene.recorder.start()

    def no_room(descriptor: int, data: bytes) -> int:
        monkeypatch.undo()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(written.os, "write", no_room)
    scene.intake.put("fleet/r1/scan", os.urandom(900_000))
    await soon(lambda: told)
    scene.intake.put("fleet/r1/pose", b"late")
    await asyncio.to_thread(scene.recorder.close)
    assert scene.recorder.error == "the recording ends: No space left on device"
    assert scene.recorder.losses() == {"not written": {"fleet/r1/scan": 1, "fleet/r1/pose": 1}}
    assert (scene.read(), scene.tape.messages) == ([], 0)


async def test_another_file_begins_with_the_last_states(tmp_path: Path) -> None:
    scene = Scene(tmp_path / "a.mcap", tape={"split_bytes": 1})
    async with scene.running():
        scene.put("fleet/r1/status", STATUS)
        await soon(lambda: len(scene.tape.files) >= 3)
    assert ("fleet/r1/status", STATUS) in {(topic, data) for topic, _, _, data in files.read(scene.tape.files[1])}
    with scene.tape.files[1].open("rb") as file:
        assert {each.name for each in make_reader(file).iter_metadata()} == {"zbridge", "robot/r1"}


def test_a_file_that_exists_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with pytest.raises(ZbridgeError, match="exists"):
        Scene(tmp_path / "a.mcap").recorder.start()
