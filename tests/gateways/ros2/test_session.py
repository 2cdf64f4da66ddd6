"""The conversation with a ROS 2 robot: who is heard, how it is driven, when it counts as lost."""

from __future__ import annotations

import random
import struct

import pytest

from gateways.ros2.messages import Velocity
from tests.gateways.ros2.scene import KINDS, STAMPED, TWIST, TYPES, RosScene, header, key, token
from zbridge.errors import NotReady
from zbridge.protocol import KeyedSample, SampleKind
from zbridge.ros2.rmw_zenoh import gid_of

WATCHED = "@ros2_lv/0/*/*/*/{}/*/*/*/%{}/*/*/*"
ZEROS = bytes.fromhex("00010000") + bytes(48)


def twist(forward: float, left: float = 0.0, turn: float = 0.0) -> bytes:
    """CDR by hand: the encapsulation, then linear and angular, three doubles each."""
    return bytes.fromhex("00010000") + struct.pack("<6d", forward, left, 0, 0, 0, turn)


def puts(samples: list[KeyedSample]) -> list[bytes]:
    return [sample.payload for sample in samples if sample.kind is SampleKind.PUT]


def test_a_session_shows_its_node_and_watches_the_robots_topics_only() -> None:
    scene = RosScene()
    first, *watches = scene.written
    assert first == KeyedSample(SampleKind.ANNOUNCE, "@ros2_lv/0/cafe/0/0/NN/%/%/zbridge")
    assert {watch.kind for watch in watches} == {SampleKind.WATCH}
    expected = {WATCHED.format("MP", topic.replace("/", "%")) for topic in KINDS}
    assert {watch.key for watch in watches} == expected | {WATCHED.format(kind, "cmd_vel") for kind in ("MP", "MS")}


def test_what_is_missing_is_asked_for_again_every_two_seconds_and_known_tokens_change_nothing() -> None:
    scene = RosScene()
    by, known = scene.appears("odom"), len(scene.session.graph.watched())
    for seconds, asked in ((0.5, known), (0.5, 0), (1.6, known)):
        scene.now += seconds
        scene.written.clear()
        scene.feed(KeyedSample(SampleKind.OPENED, payload=b"cafe", stamp_ns=scene.time_ns))
        assert [one.kind for one in scene.written] == [SampleKind.WATCH] * asked
    scene.written.clear()
    scene.appears("odom")
    assert scene.written == []
    scene.hears("odom", by)
    scene.appears("cmd_vel", TWIST, "MS", number=2)
    scene.now += 5.0
    scene.written.clear()
    scene.feed(KeyedSample(SampleKind.OPENED, payload=b"cafe", stamp_ns=scene.time_ns))
    assert scene.written == []


def test_a_publisher_is_subscribed_to_with_a_token_of_our_own_and_the_last_map_is_wanted() -> None:
    scene = RosScene()
    scene.written.clear()
    scene.appears("map")
    announced, subscribed = scene.written
    assert announced.kind is SampleKind.ANNOUNCE
    assert "/MS/%/%/zbridge/%map/nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150" in announced.key
    assert subscribed == KeyedSample(SampleKind.SUBSCRIBE, key("map", KINDS["map"]), b"kept")


def test_a_robot_is_there_when_something_came_from_a_publisher_with_a_token() -> None:
    scene = RosScene()
    assert "nobody publishes /scan, /odom" in str(scene.session.busy)
    by = scene.appears("odom")
    assert (scene.session.state.value, scene.session.busy) == ("handshaking", "its publishers are silent")
    scene.hears("odom", by)
    assert (scene.session.state.value, scene.session.busy) == ("established", "nobody subscribes to /cmd_vel")
    scene.appears("cmd_vel", TWIST, "MS", number=2)
    assert scene.session.busy is None


def test_a_robot_that_says_nothing_for_two_seconds_is_told_to_stand_still_and_is_lost() -> None:
    scene = RosScene()
    scene.establish()
    scene.session.drive(Velocity(0.3), scene.now)
    assert puts(scene.write()) == [twist(0.3)]
    assert scene.session.deadline() is not None
    scene.after(1.9)
    assert scene.session.state.value == "established"
    assert puts(scene.after(0.11))[-1] == ZEROS
    assert (scene.session.state.value, scene.session.busy) == ("established", "nothing came for 2 s")
    assert [puts(scene.after(0.1)) for _ in range(4)] == [[ZEROS]] * 4
    scene.after(0.11)
    assert (scene.session.state.value, scene.session.reason) == ("closed", "nothing came for 2 s")


def test_a_robot_whose_last_publisher_is_gone_is_told_to_stand_still_and_is_lost() -> None:
    scene = RosScene()
    by = scene.establish()
    scene.session.drive(Velocity(0.3), scene.now)
    scene.write()
    scene.written.clear()
    scene.gone(by)
    assert puts(scene.written) == [ZEROS]
    assert (scene.session.state.value, scene.session.busy) == ("established", "its publishers are gone")
    scene.after(0.51)
    assert (scene.session.state.value, scene.session.reason) == ("closed", "its publishers are gone")


def test_a_robot_that_speaks_again_at_once_is_kept() -> None:
    scene = RosScene()
    by = scene.establish()
    scene.after(2.01)
    scene.now += 0.3
    scene.hears("odom", by, header=header(scene.time_ns))
    scene.after(1.9)
    assert (scene.session.state.value, scene.session.busy) == ("established", None)


def test_a_drive_is_repeated_ten_times_a_second_with_rising_numbers_and_times() -> None:
    scene = RosScene()
    scene.establish()
    scene.session.drive(Velocity(0.5, turn=-1.0), scene.now)
    sent = [*scene.write(), *scene.after(0.1), *scene.after(0.1)]
    assert puts(sent) == [twist(0.5, turn=-1.0)] * 3
    own = next(one.key for one in scene.written if one.kind is SampleKind.ANNOUNCE and "/MP/" in one.key)
    for number, sample in enumerate(sent, 1):
        assert sample.key == key("cmd_vel", TWIST)
        sent_ns = scene.time_ns - (3 - number) * 100_000_000
        assert sample.attachment is not None
        assert struct.unpack("<qqB16s", sample.attachment) == (
            number,
            pytest.approx(sent_ns, abs=1000),
            16,
            gid_of(own),
        )


def test_zeros_are_repeated_for_a_second_and_no_longer() -> None:
    scene = RosScene()
    scene.establish()
    scene.session.drive(Velocity(), scene.now)
    scene.write()
    assert puts(scene.after(0.9)) == [ZEROS]
    scene.after(0.2)
    assert puts(scene.after(0.5)) == []


def test_a_stamped_twist_has_the_time_of_the_robots_clock_whatever_that_is() -> None:
    scene = RosScene()
    by = scene.establish(STAMPED)
    scene.hears("odom", by, header=header(5_000_000_000))  # a simulation in its sixth second
    scene.now += 0.25
    scene.session.drive(Velocity(0.5), scene.now)
    (payload,) = puts(scene.write())
    frame_id = b"\x0a\0\0\0base_link\0"
    assert payload[:26] == bytes.fromhex("00010000") + struct.pack("<iI", 5, 250_000_000) + frame_id
    assert payload[26:] == bytes(2) + twist(0.5)[4:]


def test_every_type_that_is_taken_is_written() -> None:
    scene = RosScene()
    scene.establish()
    scene.appears("cmd_vel", STAMPED, "MS", number=3)
    scene.session.drive(Velocity(0.5), scene.now)
    assert {sample.key for sample in scene.write()} == {key("cmd_vel", TWIST), key("cmd_vel", STAMPED)}


def test_a_robot_of_humble_has_no_hashes_in_its_keys() -> None:
    scene = RosScene(distro="humble")
    scene.appears("cmd_vel", TWIST, "MS", hashed="TypeHashNotSupported")
    scene.session.drive(Velocity(0.5), scene.now)
    (sample,) = [one for one in scene.write() if one.kind is SampleKind.PUT]
    assert sample.key == "0/cmd_vel/geometry_msgs::msg::dds_::Twist_/TypeHashNotSupported"


def test_nobody_to_drive_is_said() -> None:
    scene = RosScene()
    with pytest.raises(NotReady, match="nobody subscribes to /cmd_vel"):
        scene.session.drive(Velocity(0.5), scene.now)


WRONG = {
    "another type": (token("scan", "sensor_msgs/msg/Imu"), "/scan is sensor_msgs/msg/Imu, expected sensor_msgs/msg/La"),
    "another hash": (token("scan", KINDS["scan"], hashed="RIHS01_00"), "/scan has another sensor_msgs/msg/LaserScan"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_publisher_that_is_not_what_it_should_be_is_counted_shown_and_not_heard(case: str) -> None:
    scene = RosScene()
    scene.written.clear()
    made, reason = WRONG[case]
    scene.feed(KeyedSample(SampleKind.APPEARED, made, stamp_ns=scene.time_ns))
    assert scene.session.traffic.malformed == 1
    assert reason in str(scene.session.busy)
    assert scene.written == []
    scene.gone(made)
    assert "nobody publishes" in str(scene.session.busy)


def test_garbage_lying_attachments_and_strangers_are_counted_and_change_nothing() -> None:
    scene = RosScene()
    by = scene.establish()
    good, rng = struct.pack("<qqB", 1, 1, 16) + gid_of(by), random.Random(1)
    whole = TYPES.encode(TYPES.message(KINDS["odom"]))
    lies = [None, b"", good[:-1], good + b"\0", bytes(33), struct.pack("<qqB", -1, 1, 16) + gid_of(by)]
    lies.append(struct.pack("<qqB", 1, 1, 16) + gid_of("nobody"))
    for attachment in lies:
        sample = KeyedSample(SampleKind.SAMPLE, key("odom", KINDS["odom"]), whole, attachment, 1)
        assert scene.feed(sample) == []
    for size in range(0, 300, 7):
        assert scene.says("odom", by, rng.randbytes(size)) == []
    assert scene.feed(KeyedSample(SampleKind.SAMPLE, "0/other/x/y", b"", good, 1)) == []
    assert scene.session.traffic.malformed == len(lies) + 43 + 1
    assert scene.session.state.value == "established"


def test_a_thousand_endpoints_on_one_topic_are_bounded() -> None:
    scene = RosScene()
    for number in range(1000):
        scene.appears("scan", number=number)
    assert len(scene.session.graph.publishers) == 64
    assert scene.session.traffic.malformed == 936


# Other drivers


def other_says(scene: RosScene, payload: bytes) -> list[bytes]:
    scene.written.clear()
    scene.says("cmd_vel", token("cmd_vel", TWIST, number=9, node="nav"), payload, TWIST)
    return puts(scene.written)


def test_what_another_node_says_is_answered_by_what_we_said_last() -> None:
    scene = RosScene()
    scene.establish()
    made = scene.appears("cmd_vel", TWIST, "MP", number=9, node="nav")
    assert scene.session.doubts == ("/nav publishes /cmd_vel too, and is overruled",)
    assert other_says(scene, twist(0.7)) == [ZEROS]
    scene.session.drive(Velocity(0.2), scene.now)
    scene.write()
    assert other_says(scene, twist(0.7)) == [twist(0.2)]
    assert scene.metrics.total("commands_overruled") == 2
    scene.gone(made)
    assert scene.session.doubts == ()


def test_answers_to_another_node_are_bounded() -> None:
    scene = RosScene()
    scene.establish()
    assert sum(len(other_says(scene, twist(0.7))) for _ in range(1000)) <= 101


def test_a_shared_robot_is_left_to_others_while_nobody_drives_it_here() -> None:
    scene = RosScene(shared=True)
    scene.establish()
    scene.appears("cmd_vel", TWIST, "MP", number=9, node="nav")
    assert scene.session.doubts == ()
    assert not [one for one in scene.written if one.kind is SampleKind.SUBSCRIBE and "cmd_vel" in one.key]
    scene.robot.stop(scene.now, scene.now)  # the stop of an idle robot
    assert puts(scene.write()) == []
    scene.robot.stop(scene.now, scene.now + 1.0)  # somebody's stop
    assert puts(scene.write()) == [ZEROS]


def test_our_own_commands_that_come_back_are_no_other_drivers() -> None:
    scene = RosScene()
    scene.establish()
    scene.session.drive(Velocity(0.2), scene.now)
    (sent,) = scene.write()
    scene.written.clear()
    scene.feed(KeyedSample(SampleKind.SAMPLE, sent.key, sent.payload, sent.attachment, scene.time_ns))
    assert (scene.written, scene.session.traffic.malformed) == ([], 0)


def test_several_other_drivers_are_named() -> None:
    scene = RosScene()
    scene.establish()
    for number, node in enumerate(("d", "c", "b", "a"), 9):
        scene.appears("cmd_vel", TWIST, "MP", number=number, node=node)
    assert scene.session.doubts == ("/a, /b, /c publish /cmd_vel too, and is overruled",)


# What it shows of itself, and its end


def test_our_own_endpoints_are_no_others() -> None:
    scene = RosScene()
    scene.establish()
    own = [one.key for one in scene.written if one.kind is SampleKind.ANNOUNCE]
    assert len(own) == 4, "a node, a reader of odometry, a writer and a reader of commands"
    for made in own:
        scene.feed(KeyedSample(SampleKind.APPEARED, made, stamp_ns=scene.time_ns))
    assert (scene.session.doubts, scene.session.traffic.malformed) == ((), 0)
    assert len(scene.session.graph.publishers) == len(scene.session.graph.subscribers) == 1


OWN = {"map": ("MS", ":1:,1:,:,:,,"), "scan": ("MS", "2::,5:,:,:,,"), "cmd_vel": ("MP", "::,10:,:,:,,")}


@pytest.mark.parametrize("topic", OWN)
def test_our_endpoints_have_the_quality_of_service_of_their_topics_and_a_number_each(topic: str) -> None:
    scene = RosScene()
    scene.appears("odom", number=1)
    made = scene.appears(topic, KINDS.get(topic, TWIST), "MP" if topic in KINDS else "MS", number=2)
    role, qos = OWN[topic]
    tokens = [one.key.split("/") for one in scene.written if one.kind is SampleKind.ANNOUNCE]
    (shown,) = [one for one in tokens if one[9:10] == [f"%{topic}"] and one[5] == role]
    assert shown[12] == qos
    assert len({one[4] for one in tokens}) == len(tokens)
    scene.written.clear()
    scene.gone(made)
    scene.appears(topic, KINDS.get(topic, TWIST), "MP" if topic in KINDS else "MS", number=3)
    assert [one for one in scene.written if one.kind is SampleKind.ANNOUNCE] == [], "shown already"


def test_topics_that_are_published_are_shown_by_name() -> None:
    scene = RosScene()
    scene.appears("scan", number=5)
    scene.establish()
    assert scene.session.features == ("/odom", "/scan")
    assert scene.session.state.value == "established"


def test_the_end_of_a_session_tells_the_robot_to_stand_still() -> None:
    scene = RosScene()
    scene.establish()
    scene.session.drive(Velocity(0.3), scene.now)
    scene.write()
    scene.session.close("restarted", scene.now)
    assert puts(scene.write()) == [ZEROS]
    assert not scene.session.moving


def test_a_shared_robot_that_others_drive_is_left_alone_at_the_end() -> None:
    scene = RosScene(shared=True)
    scene.establish()
    scene.session.close("restarted", scene.now)
    assert puts(scene.write()) == []


def test_samples_that_the_link_dropped_are_counted() -> None:
    scene = RosScene()
    for count in (7, 5):
        scene.feed(KeyedSample(SampleKind.DROPPED, payload=struct.pack("<I", count), stamp_ns=scene.time_ns))
    assert scene.session.traffic.dropped == 12


def test_a_drive_is_repeated_as_long_as_the_robot_is_there() -> None:
    scene = RosScene(silent_s=60.0)
    scene.establish()
    scene.session.drive(Velocity(0.3), scene.now)
    scene.write()
    assert [puts(scene.after(1.0)) for _ in range(20)] == [[twist(0.3)]] * 20


def test_a_clock_of_the_robot_that_no_stamp_can_hold_gives_a_stamp_of_zero() -> None:
    scene = RosScene()
    by = scene.establish(STAMPED)
    for stamp_ns, written in ((2**31 * 10**9 - 10**9, 2**31 - 1), (2**31 * 10**9 - 1, 0)):
        scene.hears("odom", by, header=header(stamp_ns))
        scene.session.drive(Velocity(0.5), scene.now)
        scene.now += 0.1
        payload = puts(scene.write())[-1]
        assert struct.unpack_from("<i", payload, 4) == (written,)
