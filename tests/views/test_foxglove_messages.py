"""Foxglove's messages: a scan byte for byte as the SDK encodes it, all others field by field as protobuf reads them."""

import base64
import math

import foxglove.messages as fox
import numpy as np
import pytest

from tests.views.protobuf import read
from zbridge.fleet.messages import Image, Map, Pose, Scan
from zbridge.views import pictures
from zbridge.views.schemas import foxglove_schema

STAMP_NS = 1_700_000_000_000_000_007
STAMP = "2023-11-14T22:13:20.000000007Z"


def scan(ranges: object, angle_min: float = -1.5, increment: float = 0.5) -> Scan:
    return Scan(
        angle_min=angle_min,
        angle_increment=increment,
        range_min=0.1,
        range_max=30.0,
        ranges=np.asarray(ranges, "<f4"),
    )


def as_the_sdk(message: Scan, frame: str, stamp_ns: int) -> bytes:
    return fox.LaserScan(
        timestamp=fox.Timestamp(stamp_ns // 10**9, stamp_ns % 10**9),
        frame_id=frame,
        pose=fox.Pose(position=fox.Vector3(x=0, y=0, z=0), orientation=fox.Quaternion(x=0, y=0, z=0, w=1)),
        start_angle=message.angle_min,
        end_angle=message.angle_min + message.angle_increment * (len(message.ranges) - 1),
        ranges=list(map(float, message.ranges)),
    ).encode()


@pytest.mark.parametrize("points", [1, 2, 16, 769, 3000])
@pytest.mark.parametrize("stamp_ns", [STAMP_NS, 1_000_000_001, 2**32 * 10**9 - 1])
def test_a_scan_is_encoded_byte_for_byte_as_the_sdk_encodes_it(points: int, stamp_ns: int) -> None:
    message = scan(np.linspace(0.5, 12, points))
    assert pictures.laser_scan(message, "r1/scan", stamp_ns) == as_the_sdk(message, "r1/scan", stamp_ns)


def test_a_scan_has_the_angles_of_its_first_and_last_point_and_nan_where_it_saw_nothing() -> None:
    payload = pictures.laser_scan(scan([1.0, math.nan, 2.5]), "r1/scan", STAMP_NS)
    fields = read(foxglove_schema("LaserScan"), payload)
    assert fields["ranges"] == [1.0, "NaN", 2.5]
    assert (fields["timestamp"], fields["frame_id"]) == (STAMP, "r1/scan")
    assert (fields["start_angle"], fields["end_angle"], fields["intensities"]) == (-1.5, -0.5, [])
    assert fields["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def test_a_scan_without_points_and_at_zero_can_be_read() -> None:
    fields = read(foxglove_schema("LaserScan"), pictures.laser_scan(scan([], 0.0), "r1/scan", 0))
    assert (fields["ranges"], fields["start_angle"], fields["end_angle"]) == ([], 0.0, 0.0)
    assert fields["timestamp"] == "1970-01-01T00:00:00Z"


def test_a_pose_turns_counter_clockwise_about_the_vertical() -> None:
    payload = pictures.pose_in_frame(Pose(1.5, -2.0, math.pi / 2), "r1/map", STAMP_NS)
    fields = read(foxglove_schema("PoseInFrame"), payload)
    assert (fields["timestamp"], fields["frame_id"]) == (STAMP, "r1/map")
    assert fields["pose"]["position"] == {"x": 1.5, "y": -2.0, "z": 0.0}
    half = math.sqrt(0.5)
    assert fields["pose"]["orientation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": half, "w": half})


def test_frames_lead_from_parent_to_child() -> None:
    placed = (("r1/map", "r1/base", Pose(1.0, 2.0, math.pi)), ("r1/base", "r1/scan", Pose(0.0, 0.0, 0.0)))
    fields = read(foxglove_schema("FrameTransforms"), pictures.transforms(placed, STAMP_NS))
    base, scanner = fields["transforms"]
    assert (base["parent_frame_id"], base["child_frame_id"], base["timestamp"]) == ("r1/map", "r1/base", STAMP)
    assert base["translation"] == {"x": 1.0, "y": 2.0, "z": 0.0}
    assert base["rotation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}, abs=1e-9)
    assert (scanner["parent_frame_id"], scanner["child_frame_id"]) == ("r1/base", "r1/scan")
    assert scanner["translation"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert scanner["rotation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def test_a_map_is_a_grid_of_colours_with_its_first_cell_at_the_origin() -> None:
    cells = np.array([[0, 1, 2], [2, 1, 77]], np.uint8)
    message = Map(rows=2, columns=3, cell=0.05, origin=(-1.0, -2.0), cells=cells)
    fields = read(foxglove_schema("Grid"), pictures.grid(message, "r1/map", STAMP_NS))
    assert (fields["frame_id"], fields["timestamp"]) == ("r1/map", STAMP)
    assert fields["pose"]["position"] == {"x": -1.0, "y": -2.0, "z": -0.02}
    assert (fields["column_count"], fields["row_stride"], fields["cell_stride"]) == (3, 12, 4)
    assert fields["cell_size"] == {"x": 0.05, "y": 0.05}
    assert [(field["name"], field["offset"], field["type"]) for field in fields["fields"]] == [
        ("red", 0, "UINT8"),
        ("green", 1, "UINT8"),
        ("blue", 2, "UINT8"),
        ("alpha", 3, "UINT8"),
    ]
    unknown, free, occupied, other = (127, 127, 127, 64), (240, 240, 240, 255), (20, 20, 20, 255), (255, 0, 255, 255)
    expected = [unknown, free, occupied, occupied, free, other]
    assert base64.b64decode(fields["data"]) == bytes(part for cell in expected for part in cell)


def test_a_log_tells_who_said_it_and_how_bad_it_is() -> None:
    fields = read(foxglove_schema("Log"), pictures.log("döor open", fox.LogLevel.Warning, "r1", STAMP_NS))
    assert (fields["message"], fields["level"], fields["name"], fields["timestamp"]) == (
        "döor open",
        "WARNING",
        "r1",
        STAMP,
    )


def test_an_image_keeps_its_bytes() -> None:
    image = Image(format="jpeg", data=b"\xff\xd8jpeg")
    payload = pictures.compressed_image(image, "r1/camera", STAMP_NS)
    fields = read(foxglove_schema("CompressedImage"), payload)
    assert base64.b64decode(fields["data"]) == b"\xff\xd8jpeg"
    assert (fields["format"], fields["frame_id"], fields["timestamp"]) == ("jpeg", "r1/camera", STAMP)


def test_a_trail_is_one_line_that_replaces_the_one_before() -> None:
    fields = read(foxglove_schema("SceneUpdate"), pictures.trail([(0.0, 1.0), (2.0, 3.0)], "r1/map", STAMP_NS))
    (entity,) = fields["entities"]
    assert (entity["id"], entity["frame_id"]) == ("trail", "r1/map")
    (line,) = entity["lines"]
    assert (line["type"], line["points"]) == (
        "LINE_STRIP",
        [{"x": 0.0, "y": 1.0, "z": 0.0}, {"x": 2.0, "y": 3.0, "z": 0.0}],
    )
