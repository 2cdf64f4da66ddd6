"""The HQ programs of both captures at a listener: they are greeted, understood and shown what their robot showed."""

import math

import pytest

from tests.captures import payloads
from tests.gateways.tcpudp.frames import ANSWER_TRUE, LISTED, START
from tests.gateways.tcpudp.test_hq import EMPTY_MAP, NO_MAP, POSE, REQUEST, Client, robot, side
from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Scan, Text
from zbridge.fleet.topics import Topic
from zbridge.hq.intent import Intent
from zbridge.lease.stick import StickAction
from zbridge.protocol.session import State

OLD, NEW = "tcpudp-1.1-tcp.hex", "tcpudp-1.3-udp.hex"
Commands = list[tuple[float, Topic, FleetMessage]]

each_capture = pytest.mark.parametrize("name", [OLD, NEW])


def captured(name: str) -> Client:
    """A captured HQ that has just connected to the listener it met."""
    if name == OLD:
        return Client(side(robot("1.1", "joystick"), versions=("1.1",), udp=False))
    return Client(side(robot("1.3", "udp", "lidar_sim", "slam_map"), slam_map_size=2048, slam_map_interval=16))


def replay(client: Client, name: str, late: float = 0.0) -> Commands:
    """Feed what the HQ sent, ``late`` seconds after it did and without a handshake that is done; give its commands."""
    client.session.name = "hq.2"
    commands: Commands = []
    done = client.session.state is State.ESTABLISHED
    for record in payloads(name, destination=11001):
        at, packet_id = record.seconds + late, record.payload[5]
        if done and packet_id < 10 and packet_id != 1:
            continue
        if record.transport == "UDP" and packet_id == 5:
            assert client.session.claims(record.payload, record.source)
        receive = client.datagram if record.transport == "UDP" else client.stream
        for message in receive(record.payload, at):
            commands += [(at, topic, command) for topic, command in client.listener.take(client.session, message)]
    assert client.session.traffic.malformed == 0
    return commands


def check_documented(commands: Commands, *more: Topic) -> None:
    """A text, control mode 2, move, rotate, stop, position, map, and ``more``."""
    motion = [topics.CMD_DRIVE] * 3
    expected = [topics.CMD_TEXT, topics.CMD_MODE, *motion, topics.RPC_POSE, topics.RPC_MAP, *more]
    assert [topic for _, topic, _ in commands] == expected
    text, mode, move, rotate, stop, *_ = (command for _, _, command in commands)
    assert (text, mode) == (Text("hi there", sender="hq.2"), Mode("manual"))
    assert isinstance(move, Drive)
    # x 0.6, y 0.8 at 1.5: half more than full scale
    assert (move.forward, move.left, move.turn) == pytest.approx((0.8, -0.6, 0.0))
    assert math.hypot(move.forward, move.left) <= 1.0
    assert (rotate, stop) == (Drive(turn=0.75), Drive())


@pytest.mark.parametrize("anew", [False, True], ids=["its own listener", "a listener of all versions"])
def test_the_captured_hq_of_1_1_commands_what_is_documented(anew: bool) -> None:
    client = Client(side()) if anew else captured(OLD)
    check_documented(replay(client, OLD))
    greeted, *more = client.frames("tcp")
    assert anew or greeted == bytes.fromhex("0f000000 01 02 02 03000000 312e31 0000010000")
    assert more == [START] * anew, "it announces datagrams and sends none: nothing it says is lost"
    assert client.frames("udp") == []
    client.until(10.0)
    assert (client.session.state, client.session.version) == (State.ESTABLISHED, "1.1")


def test_the_captured_hq_of_1_3_commands_what_is_documented() -> None:
    client = captured(NEW)
    commands = replay(client, NEW)
    check_documented(commands, topics.CMD_SCAN)
    greeted = "21000000 01 02 02 0b000000" + LISTED.hex() + "01000000000101 00080000 10000000"
    assert client.frames("tcp") == [bytes.fromhex(greeted), START]
    assert client.frames("udp") == [ANSWER_TRUE]
    assert (client.session.version, client.session.transport) == ("1.3", "udp")
    scan = commands[-1][2]
    assert isinstance(scan, Scan)
    assert scan.ranges.tolist() == pytest.approx([1.0 + degree * 0.005 for degree in range(360)])
    assert scan.range_max == pytest.approx(2.795)


@each_capture
def test_the_shown_robot_is_what_the_captured_one_showed(name: str) -> None:
    client = captured(name)
    replay(client, name)
    client.sent.clear()
    news = ((topics.POSE, POSE), (topics.TEXT, Text("bye")), (topics.TEXT, REQUEST), (topics.MAP, NO_MAP))
    for topic, message in news:
        client.shown(topic, message)
    from_robot = [record for record in payloads(name, source=11001) if record.payload[5] not in (2, 4, 6)]
    recorded = {(record.transport.lower(), record.payload) for record in from_robot if len(record.payload) < 400}
    if name == OLD:  # whose robot leaves out the int that HQ programs need
        recorded = recorded - {("tcp", bytes.fromhex("02000000 01 35"))} | {("tcp", EMPTY_MAP)}
    assert recorded <= {(sent.by, sent.frame) for sent in client.sent}


def carried_out(intent: Intent, commands: Commands) -> list[StickAction | str]:
    """What the intent makes of motion and modes; a refusal by its reason."""
    done: list[StickAction | str] = []
    for at, _, command in commands:
        try:
            match command:
                case Mode():
                    done.append(intent.choose(command.mode, at))
                case Drive():
                    done.append(intent.motion(at) if command.moving else intent.neutral(at))
        except Refused as refusal:
            done.append(str(refusal))
    return done


@each_capture
def test_a_captured_hq_drives_only_after_it_has_said_neutral_once(name: str) -> None:
    client = captured(name)
    intent = Intent(client.listener.deadman_s)
    assert intent.choose("none", 0.0) is StickAction.NOTHING
    owed = "connected: centre the joystick first"
    assert carried_out(intent, replay(client, name)) == [StickAction.NOTHING, owed, owed, StickAction.NOTHING]
    again = replay(client, name, late=10.0)
    assert carried_out(intent, again) == [StickAction.NOTHING, StickAction.ACQUIRE, StickAction.WAIT, StickAction.WAIT]
    intent.granted(3.0)
    assert carried_out(intent, replay(client, name, late=20.0)) == [StickAction.SEND] * 4
