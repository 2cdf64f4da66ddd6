"""Which pictures the messages of a robot have: their channels, frames and times, and what has none."""

import json
import math

import msgspec
import numpy as np
import pytest

from tests.views.protobuf import read
from zbridge.fleet import messages as m
from zbridge.fleet import topics
from zbridge.fleet.topics import Topic
from zbridge.views.pictures import FoxglovePictures, Picture, channels_of, sources_of

NOW_NS = 1_700_000_000_000_000_000
SECOND_NS = 10**9
SCAN = m.Scan(
    angle_min=-1.0, angle_increment=1.0, range_min=0.1, range_max=9.0, ranges=np.array([1, 2, 3], "<f4"), stamp_ns=5
)
MAP = m.Map(rows=1, columns=2, cell=0.1, origin=(0.0, 0.0), cells=np.array([[1, 2]], np.uint8))
REFUSED = m.Refusal(who="op", command="drive", code="held", reason="held by hq", count=1)


def names(pictures: list[Picture]) -> list[str]:
    return [picture.channel.topic for picture in pictures]


CHANNELS = [
    ("scan", {"/r1/scan": "foxglove.LaserScan", "/r1/tf": "foxglove.FrameTransforms"}),
    (
        "pose",
        {
            "/r1/pose": "foxglove.PoseInFrame",
            "/r1/tf": "foxglove.FrameTransforms",
            "/r1/trail": "foxglove.SceneUpdate",
        },
    ),
    ("map", {"/r1/map": "foxglove.Grid"}),
    ("image", {"/r1/image": "foxglove.CompressedImage"}),
    ("text", {"/r1/log": "foxglove.Log"}),
    ("status", {"/r1/status": "zbridge.Status.v1", "/r1/log": "foxglove.Log"}),
    ("control", {"/r1/control": "zbridge.Control.v1", "/r1/log": "foxglove.Log"}),
    ("motion", {"/r1/motion": "zbridge.Motion.v1"}),
    ("sensor/front%20left", {"/r1/sensor/front%20left": "zbridge.Reading.v1"}),
    ("lidar", {"/r1/lidar": "zbridge.Switch.v1"}),
    ("@cmd/drive", {"/r1/@cmd/drive": "zbridge.Drive.v1"}),
    ("@cmd/scan", {"/r1/@cmd/scan": "foxglove.LaserScan"}),
    ("@cmd/text", {"/r1/@cmd/text": "zbridge.Text.v1"}),
    ("raw/alf", {"/r1/raw/alf": "zbridge.Raw.v1"}),
    ("nonsense", {}),
]


@pytest.mark.parametrize(("path", "expected"), CHANNELS)
def test_each_path_is_drawn_on_its_channels(path: str, expected: dict[str, str]) -> None:
    channels = channels_of("r1", path)
    assert {channel.topic: channel.schema.name for channel in channels} == expected
    assert all(path in sources_of(channel) for channel in channels)


def test_what_keeps_its_last_value_on_the_bus_keeps_it_for_viewers() -> None:
    kept = {
        channel.path: channel.keeps_last
        for path in ("map", "status", "scan", "pose")
        for channel in channels_of("r1", path)
    }
    assert kept == {
        "map": True,
        "status": True,
        "log": False,
        "scan": False,
        "tf": False,
        "pose": False,
        "trail": True,
    }


def test_a_picture_has_the_time_of_measurement_or_else_of_arrival() -> None:
    robot = FoxglovePictures("r1")
    for stamp_ns, expected in ((7, 7), (msgspec.UNSET, NOW_NS), (-1, NOW_NS), (2**62, NOW_NS)):
        pictures = robot.draw(topics.MOTION, m.Motion(speed=1.0, stamp_ns=stamp_ns), NOW_NS)
        assert [picture.stamp_ns for picture in pictures] == [expected]


def test_only_wanted_channels_are_drawn() -> None:
    robot = FoxglovePictures("r1")
    pose = m.Pose(0.0, 0.0, 0.0)
    assert names(robot.draw(topics.POSE, pose, NOW_NS, {"tf"})) == ["/r1/tf"]
    assert names(robot.draw(topics.POSE, pose, NOW_NS, ())) == []
    assert names(robot.draw(topics.POSE, pose, NOW_NS)) == ["/r1/pose", "/r1/tf", "/r1/trail"]


def test_frames_come_with_every_pose_and_once_a_second_where_only_scans_come() -> None:
    robot = FoxglovePictures("r1")

    def frames(topic: Topic, message: m.FleetMessage, after_s: float) -> list[list[str]]:
        pictures = robot.draw(
            topic, msgspec.structs.replace(message, stamp_ns=NOW_NS + int(after_s * SECOND_NS)), 0, {"tf"}
        )
        drawn = [read(picture.channel.schema, picture.payload)["transforms"] for picture in pictures]
        return [[frame["child_frame_id"] for frame in frames] for frames in drawn]

    pose = m.Pose(1.0, 2.0, 3.0)
    assert frames(topics.SCAN, SCAN, 0.0) == [["r1/scan"]]
    assert frames(topics.SCAN, SCAN, 0.9) == []
    assert frames(topics.SCAN, SCAN, 1.0) == [["r1/scan"]]
    assert frames(topics.POSE, pose, 1.1) == [["r1/base", "r1/scan"]]
    assert frames(topics.POSE, pose, 1.2) == [["r1/base", "r1/scan"]]
    assert frames(topics.SCAN, SCAN, 1.3) == []


def test_a_trail_grows_by_what_the_robot_moves_and_no_further_than_its_bound() -> None:
    robot = FoxglovePictures("r1")
    drawn = []
    for step in range(1000):
        pose = m.Pose(step * 0.02, 0.0, 0.0, stamp_ns=NOW_NS + step * SECOND_NS)
        drawn += robot.draw(topics.POSE, pose, 0, {"trail"})
    assert len(drawn) == 334  # a point every third pose, at 0.06 m
    (entity,) = read(drawn[-1].channel.schema, drawn[-1].payload)["entities"]
    points = [point["x"] for point in entity["lines"][0]["points"]]
    assert len(points) == 256
    assert points[-1] == pytest.approx(19.98)


def test_a_trail_is_drawn_at_most_five_times_a_second() -> None:
    robot = FoxglovePictures("r1")
    poses = [m.Pose(float(step), 0.0, 0.0, stamp_ns=NOW_NS + step * SECOND_NS // 20) for step in range(21)]
    assert sum(len(robot.draw(topics.POSE, pose, 0, {"trail"})) for pose in poses) == 6


def log(robot: FoxglovePictures, topic: Topic, message: m.FleetMessage) -> list[tuple[str, str, str]]:
    fields = [read(drawn.channel.schema, drawn.payload) for drawn in robot.draw(topic, message, NOW_NS, {"log"})]
    return [(entry["level"], entry["name"], entry["message"]) for entry in fields]


def test_the_log_has_texts_changes_of_state_and_refusals_that_are_new() -> None:
    robot = FoxglovePictures("r1")
    assert log(robot, topics.TEXT, m.Text("hello")) == [("DEBUG", "r1", "hello")]
    assert log(robot, topics.TEXT, m.Text("hi", "chat", "anna")) == [("INFO", "anna", "hi")]
    assert log(robot, topics.STATUS, m.Status("offline", "no answer")) == [("WARNING", "r1", "offline: no answer")]
    assert log(robot, topics.STATUS, m.Status("offline", "no answer")) == []
    assert log(robot, topics.STATUS, m.Status("established")) == [("INFO", "r1", "established")]
    deadman = m.Fault("deadman", "no command", 1)
    told = [("ERROR", "r1", "fault deadman: no command")]
    assert log(robot, topics.STATUS, m.Status("established", faults=(deadman,))) == told
    again = m.Fault("deadman", "no command", 1, 7)
    assert log(robot, topics.STATUS, m.Status("established", faults=(again,))) == []
    anew = m.Fault("deadman", "no command", 2)
    assert log(robot, topics.STATUS, m.Status("established", faults=(anew,))) == told
    assert log(robot, topics.STATUS, m.Status("established")) == []
    assert log(robot, topics.CONTROL, m.Control("held", refusals=(REFUSED,))) == [
        ("WARNING", "r1", "drive of op refused: held by hq (1)")
    ]
    assert log(robot, topics.CONTROL, m.Control("held", refusals=(REFUSED,))) == []


def test_json_has_the_fields_of_the_message_and_its_schema_names_them() -> None:
    robot = FoxglovePictures("r1")
    message = m.Control("held", holder="op", lease=b"\x01" * 8, expires_in_s=math.nan, refusals=(REFUSED,), seq=3)
    (picture,) = robot.draw(topics.CONTROL, message, NOW_NS, {"control"})
    fields = json.loads(picture.payload)
    assert (fields["holder"], fields["lease"], fields["seq"]) == ("op", "AQEBAQEBAQE=", 3)
    assert fields["expires_in_s"] is None
    schema = json.loads(picture.channel.schema.data)
    assert set(fields) < set(schema["properties"])
    assert schema["properties"]["refusals"]["items"]["properties"]["count"] == {"type": "integer"}
    assert (picture.channel.schema.encoding, picture.channel.schema.message_encoding) == ("jsonschema", "json")


def test_every_message_that_a_robot_publishes_has_a_schema_of_plain_types() -> None:
    plain = {"array", "boolean", "integer", "number", "object", "string"}
    published = [topic for topic in vars(topics).values() if isinstance(topic, Topic)]
    for topic in published:
        for channel in channels_of("r1", topic.path):
            if channel.schema.encoding == "jsonschema":
                schema = json.loads(channel.schema.data)
                assert schema["type"] == "object"
                assert {field["type"] for field in schema["properties"].values()} <= plain


NOTHING = [
    (topics.POSE, m.Pose(math.nan, 0.0, 0.0)),
    (topics.POSE, m.Pose(0.0, 0.0, math.inf)),
    (topics.IMAGE, m.Image("jpeg", b"")),
    (topics.MAP, m.Map(rows=0, columns=2**40, cell=1.0, origin=(0.0, 0.0), cells=np.zeros((0, 2**40), np.uint8))),
]


@pytest.mark.parametrize(("topic", "message"), NOTHING)
def test_what_has_no_content_has_no_picture(topic: Topic, message: m.FleetMessage) -> None:
    assert FoxglovePictures("r1").draw(topic, message, NOW_NS, {"pose", "map", "trail", "image"}) == []


def test_a_map_a_scan_and_an_image_stand_in_the_frames_of_their_robot() -> None:
    robot = FoxglovePictures("r.2")
    (grid,) = robot.draw(topics.MAP, MAP, NOW_NS)
    (scan,) = robot.draw(topics.SCAN, SCAN, NOW_NS, {"scan"})
    (image,) = robot.draw(topics.IMAGE, m.Image("jpeg", b"\xff\xd8"), NOW_NS)
    frames = [read(drawn.channel.schema, drawn.payload)["frame_id"] for drawn in (grid, scan, image)]
    assert frames == ["r.2/map", "r.2/scan", "r.2/base"]
