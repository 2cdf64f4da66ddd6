"""A participant of ROS 2, written from rmw_zenoh's sources alone: raw Zenoh, rosbags and xxhash, no code of ours.

Keys and tokens from liveliness_utils.cpp, attachments from attachment_helpers.cpp, requests from rmw_client_data.cpp,
late joiners from rmw_subscription_data.cpp (advanced subscribers). Used by tests and by the measuring programs.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

import xxhash
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SOON_S = 20.0
OPENS = 2
"""Attempts to open a session."""
SERVICE_HASHES = {
    "std_srvs/srv/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "std_srvs/srv/SetBool": "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
}
LATCHED = ":1:,1:,:,:,,"
DEFAULT = "::,10:,:,:,,"


class Heard:
    """One sample that a subscriber took: the message, its number, its time and the gid of its publisher."""

    def __init__(self, message: Any, attachment: bytes) -> None:
        assert len(attachment) == 33, f"a subscriber of ROS drops a sample with {len(attachment)} bytes beside it"
        assert attachment[16] == 16
        self.message = message
        self.number = int.from_bytes(attachment[:8], "little", signed=True)
        self.stamp_ns = int.from_bytes(attachment[8:16], "little", signed=True)
        self.gid = attachment[17:]
        self.at = time.monotonic()


def _opened(values: dict[str, Any]) -> Any:
    """Open a session, on a thread: of some thousand that open as peers, one never returns from Zenoh."""
    opened: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def attempt() -> None:
        config = zenoh.Config()
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
        try:
            opened.put(zenoh.open(config))
        except zenoh.ZError as error:
            opened.put(error)

    for _ in range(OPENS):
        threading.Thread(target=attempt, daemon=True).start()
        with contextlib.suppress(queue.Empty):
            session = opened.get(timeout=SOON_S)
            if isinstance(session, zenoh.ZError):
                raise session
            return session
    raise AssertionError(f"no session opens within {OPENS * SOON_S:g} s")


class Ros:
    """One process of ROS 2 with one node."""

    def __init__(
        self, endpoint: str, name: str, *, domain: int = 0, distro: str = "jazzy", namespace: str = ""
    ) -> None:
        self.session = _opened(
            {
                "mode": "peer",
                "connect/endpoints": [endpoint],
                "connect/exit_on_failure": True,
                "scouting/multicast/enabled": False,
                "timestamping/enabled": True,
                "transport/shared_memory/enabled": False,
            }
        )
        self.domain, self.distro = domain, distro
        self.store = get_typestore(Stores(f"ros2_{distro}"))
        for service, (request, response) in {
            "std_srvs/srv/Trigger": ("uint8 none", "bool success\nstring message"),
            "std_srvs/srv/SetBool": ("bool data", "bool success\nstring message"),
        }.items():
            for part, text in (("Request", request), ("Response", response)):
                self.store.register(get_types_from_msg(text, f"{service.replace('/srv/', '/msg/')}_{part}"))
        self._numbers = itertools.count(1)
        names = (namespace.replace("/", "%") or "%", name)
        self.place = f"{self.session.zid()}/0", f"%/{'/'.join(names)}"
        self._kept: list[Any] = [self._token(f"{self.place[0]}/0/NN/{self.place[1]}")]

    def declare(self, rest: str) -> None:
        """Declare a token until the end."""
        self._kept.append(self._token(rest))

    def _token(self, rest: str) -> Any:
        return self.session.liveliness().declare_token(f"@ros2_lv/{self.domain}/{rest}")

    def _hash(self, type_name: str) -> str:
        if self.distro == "humble":
            return "TypeHashNotSupported"
        return SERVICE_HASHES.get(type_name) or self.store.hash_rihs01(type_name)

    def names(self, topic: str, type_name: str) -> tuple[str, str]:
        """Return the key of a topic, and the part of a token that names it."""
        package, kind, name = type_name.split("/")
        shown, hashed = f"{package}::{kind}::dds_::{name}_", self._hash(type_name)
        return f"{self.domain}/{topic.strip('/')}/{shown}/{hashed}", f"{topic.replace('/', '%')}/{shown}/{hashed}"

    def _endpoint(self, kind: str, topic: str, type_name: str, qos: str) -> tuple[str, str]:
        key, named = self.names(topic, type_name)
        token = f"{self.place[0]}/{next(self._numbers)}/{kind}/{self.place[1]}/{named}/{qos}"
        self.declare(token)
        return key, f"@ros2_lv/{self.domain}/{token}"

    def subscribe(
        self, topic: str, type_name: str, take: Callable[[Heard], None] | None = None, *, latched: bool = False
    ) -> Subscriber:
        """Subscribe, as a late joiner where it is latched."""
        key, _ = self._endpoint("MS", topic, type_name, LATCHED if latched else DEFAULT)
        return Subscriber(self, key, type_name, take, latched=latched)

    def publisher(self, topic: str, type_name: str) -> Publisher:
        """Declare a publisher."""
        key, token = self._endpoint("MP", topic, type_name, DEFAULT)
        return Publisher(self, key, type_name, token, self._kept.pop())

    def call(self, service: str, type_name: str, request: Any) -> tuple[Any, bytes]:
        """Call a service; return its response, and what stands beside it. A client of ROS takes the first reply.

        request: a message, or its CDR.
        """
        key, token = self._endpoint("SC", service, type_name, DEFAULT)
        attachment = (1).to_bytes(8, "little") + time.time_ns().to_bytes(8, "little") + b"\x10" + gid(token)
        name = type_name.replace("/srv/", "/msg/")
        given = isinstance(request, bytes)
        payload = request if given else bytes(self.store.serialize_cdr(request, f"{name}_Request"))
        target, none = zenoh.QueryTarget.ALL_COMPLETE, zenoh.ConsolidationMode.NONE
        for reply in self.session.get(
            key, payload=payload, attachment=attachment, target=target, consolidation=none, timeout=SOON_S
        ):
            assert reply.ok is not None, reply.err
            assert reply.ok.attachment is not None
            back = reply.ok.attachment.to_bytes()
            assert back[:8] == attachment[:8], "the reply has another number than the request"
            assert back[16:] == attachment[16:], "the reply has another gid than the request"
            return self.store.deserialize_cdr(reply.ok.payload.to_bytes(), f"{name}_Response"), back
        raise AssertionError(f"{service}: no reply")

    def request(self, type_name: str, **fields: Any) -> Any:
        """Make a request."""
        return self.store.types[f"{type_name.replace('/srv/', '/msg/')}_Request"](**fields)

    def graph(self) -> list[list[str]]:
        """Return all tokens, in parts: what ``ros2 node list`` and ``ros2 topic list`` are made of."""
        replies = self.session.liveliness().get(f"@ros2_lv/{self.domain}/**", timeout=SOON_S)
        return sorted(str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None)

    def close(self) -> None:
        """Leave."""
        self.session.close()


class Subscriber:
    """What was heard on one topic."""

    def __init__(self, ros: Ros, key: str, type_name: str, take: Callable[[Heard], None] | None, *, latched: bool):
        self.heard: list[Heard] = []
        self.wrong: list[str] = []
        self._came = threading.Condition()
        self._take = take

        def on_sample(sample: zenoh.Sample) -> None:
            try:
                assert sample.attachment is not None
                message = ros.store.deserialize_cdr(sample.payload.to_bytes(), type_name)
                heard = Heard(message, sample.attachment.to_bytes())
            except Exception as error:
                self.wrong.append(repr(error))
                return
            if self._take is not None:
                self._take(heard)
                return
            with self._came:
                self.heard.append(heard)
                self._came.notify_all()

        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            declare = zenoh.ext.declare_advanced_subscriber
            self._subscriber: Any = declare(ros.session, key, on_sample, history=history, subscriber_detection=True)
        else:
            self._subscriber = ros.session.declare_subscriber(key, on_sample)

    def until(self, condition: Callable[[list[Heard]], Any]) -> list[Heard]:
        """Wait until what was heard meets a condition."""
        with self._came:
            met = self._came.wait_for(lambda: condition(self.heard), SOON_S)
            assert met, (self.heard[-3:], self.wrong[-3:])
            return list(self.heard)

    def close(self) -> None:
        """Unsubscribe; the token stays with the node."""
        self._subscriber.undeclare()


class Publisher:
    """Publishes on one topic."""

    def __init__(self, ros: Ros, key: str, type_name: str, token: str, declared: Any) -> None:
        self.key, self.gid = key, gid(token)
        self._ros, self._type_name, self._token = ros, type_name, declared
        self._publisher = ros.session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._numbers = itertools.count(1)

    def put(self, message: Any) -> None:
        """Publish a message."""
        self.put_payload(bytes(self._ros.store.serialize_cdr(message, self._type_name)))

    def put_payload(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish bytes, with another attachment where one is given."""
        if attachment is None:
            number, now_ns = next(self._numbers), time.time_ns()
            attachment = number.to_bytes(8, "little") + now_ns.to_bytes(8, "little") + b"\x10" + self.gid
        self._publisher.put(payload, attachment=attachment)

    def twist(self, forward: float = 0.0, turn: float = 0.0, left: float = 0.0) -> None:
        """Publish a Twist, or a TwistStamped with the stamp of an hour ago."""
        types = self._ros.store.types
        vector = types["geometry_msgs/msg/Vector3"]
        twist = types["geometry_msgs/msg/Twist"](vector(forward, left, 0.0), vector(0.0, 0.0, turn))
        if self._type_name.endswith("TwistStamped"):
            stamp = types["builtin_interfaces/msg/Time"](int(time.time()) - 3600, 0)
            header = types["std_msgs/msg/Header"](stamp, "base_link")
            twist = types["geometry_msgs/msg/TwistStamped"](header, twist)
        self.put(twist)

    def hide(self) -> None:
        """Undeclare the token; the publisher stays. Idempotent."""
        token, self._token = self._token, None
        if token is not None:
            token.undeclare()

    def close(self) -> None:
        """Undeclare the publisher, its token first."""
        self.hide()
        self._publisher.undeclare()


def gid(token: str) -> bytes:
    """Return the gid of a token: both halves of XXH3-128, low first, little-endian."""
    digest = xxhash.xxh3_128_digest(token.encode())  # canonical: high half first, big-endian
    return digest[8:][::-1] + digest[:8][::-1]
