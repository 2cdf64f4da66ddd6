"""A router of ``zbridge router`` with real certificates, and sessions of its members, each a client over mutual TLS.

What reaches another session went through the router; so everything is counted at the session of ``far``, which may do
everything.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from tests.access import COLUMNS, LAB, OTHER, REALM, Try, granted_by_the_code, tries
from tests.certificates import Authority
from tests.e2e.conftest import HOST, WAIT_S, until
from tests.machine import Patience
from tests.ports import free_port
from zbridge.security.access import Column, Keys, MessageKind, expressions
from zbridge.security.roles import Member, Roles, save_roles

FAR = "far"
GRACE_S = 0.3
"""How long the forbidden is waited for, after all that is allowed has come."""
AGAIN_S = 3.0
"""After how long what is allowed and did not come is sent again."""
BLOCK = zenoh.CongestionControl.BLOCK
EVERYTHING = tuple(expressions(Keys.EVERYTHING, REALM, "", ()))
ROLES = Roles({**LAB.names, FAR: Member("router"), "g3": Member("gateway", (OTHER,))})


def secure(folder: Path, mode: str = "client", **more: Any) -> zenoh.Config:
    """Configure a session with the files of a member. more: values by path, with ``__`` for ``/``."""
    tls = "transport/link/tls"
    values: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "connect/timeout_ms": 3000,
        f"{tls}/enable_mtls": True,
        f"{tls}/root_ca_certificate": str(folder / "ca.pem"),
    }
    for side in ("connect", "listen"):
        values[f"{tls}/{side}_certificate"] = str(folder / "certificate.pem")
        values[f"{tls}/{side}_private_key"] = str(folder / "key.pem")
    config = zenoh.Config()
    for path, value in {**values, **{path.replace("__", "/"): value for path, value in more.items()}}.items():
        config.insert_json5(path, json.dumps(value))
    return config


class SecureBus:
    """A router process and the certificates of its members."""

    def __init__(self, folder: Path, roles: Roles = ROLES) -> None:
        self.folder, self.authority = folder, Authority(folder / "authority")
        self.folders = {name: self.authority.issue(roles.common_name(name)) for name in roles.names}
        self.port = free_port()
        self.endpoint = f"tls/{HOST}:{self.port}"
        self._process: subprocess.Popen[bytes] | None = None
        self.start(roles)

    def start(self, roles: Roles) -> None:
        save_roles(self.folder / "roles.toml", roles)
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-m", "zbridge", "router", "--listen", self.endpoint),
                    *("--tls", str(self.folders["main"]), "--roles", str(self.folder / "roles.toml")),
                ],
                stderr=log,
            )
        until(lambda: b"router at" in (self.folder / "log").read_bytes(), what=f"router: {self.log()}")

    def log(self) -> str:
        return (self.folder / "log").read_text(errors="replace")

    @property
    def cpu_s(self) -> float:
        """The processor time that the router has used, in seconds. Linux only."""
        assert self._process is not None
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            code = self._process.wait(10)
            assert code == 0, f"the router ended with {code}: {self.log()[-2000:]}"
            self._process = None
            (self.folder / "log").unlink()

    def config(self, name: str, mode: str = "client", **more: Any) -> zenoh.Config:
        return secure(self.folders[name], mode, connect__endpoints=[self.endpoint], **more)

    @contextlib.contextmanager
    def session(self, name: str, mode: str = "client", **more: Any) -> Iterator[zenoh.Session]:
        with zenoh.open(self.config(name, mode, **more)) as session:
            yield session


class Matrix:
    """Tries every message of every member for real, and counts at the far end what came through."""

    def __init__(self, members: dict[Column, zenoh.Session], far: zenoh.Session) -> None:
        self.members, self.far = members, far
        self.seen: set[Try] = set()
        self._expected = granted_by_the_code()
        self._lock = threading.Lock()
        self._by: dict[tuple[str, str, MessageKind], Try] = {
            (each.column, each.key, each.kind): each for each in tries()
        }
        self.keys = sorted({each.key for each in tries()})

    def run(self) -> set[Try]:
        self._puts_and_queries()
        self._subscribers()
        self._queryables()
        self._tokens()
        self._looks()
        return self.seen

    def _note(self, column: str, key: str, kind: MessageKind) -> None:
        with self._lock:
            each = self._by.get((column, key, kind))
            if each is not None:
                self.seen.add(each)

    def _wait(self, *kinds: MessageKind, column: str | None = None, send: Callable[[], None] = lambda: None) -> None:
        """Send, and wait for what is allowed, as long as that may take; then a while for what is not.

        On a busy machine Zenoh drops some: replies to liveliness queries, and what comes before a declaration has
        spread. So all of it is sent again, the forbidden too, until everything that is allowed has come once.
        """
        expected = {each for each in self._expected if each.kind in kinds and column in (None, each.column)}
        patience = Patience(WAIT_S)
        while True:
            send()
            again = time.monotonic() + AGAIN_S
            while not expected <= self.seen and time.monotonic() < again:
                time.sleep(0.01)
            if expected <= self.seen or patience.over:
                break
        time.sleep(GRACE_S)

    def _of(self, kind: MessageKind) -> Iterator[tuple[Try, zenoh.Session]]:
        for each in tries():
            if each.kind is kind:
                yield each, self.members[each.column]

    def _puts_and_queries(self) -> None:
        def sample(sample: zenoh.Sample) -> None:
            kind = MessageKind.PUT if sample.kind == zenoh.SampleKind.PUT else MessageKind.DELETE
            self._note(text(sample.attachment), str(sample.key_expr), kind)

        def query(query: zenoh.Query) -> None:
            self._note(text(query.payload), str(query.key_expr), MessageKind.QUERY)
            query.drop()

        def send() -> None:
            for each, session in self._of(MessageKind.PUT):
                session.put(each.key, b"", attachment=each.column, congestion_control=BLOCK)
            for each, session in self._of(MessageKind.DELETE):
                session.delete(each.key, attachment=each.column, congestion_control=BLOCK)
            for each, session in self._of(MessageKind.QUERY):
                session.get(each.key, ignore, payload=each.column, timeout=WAIT_S, target=zenoh.QueryTarget.ALL)

        with declared(
            *(self.far.declare_subscriber(each, sample) for each in EVERYTHING),
            *(self.far.declare_queryable(each, query) for each in EVERYTHING),
        ):
            time.sleep(GRACE_S)
            self._wait(MessageKind.PUT, MessageKind.DELETE, MessageKind.QUERY, send=send)

    def _subscribers(self) -> None:
        def heard(column: Column) -> Callable[[zenoh.Sample], None]:
            def sample(sample: zenoh.Sample) -> None:
                if text(sample.attachment) == FAR:
                    self._note(column, str(sample.key_expr), MessageKind.SUBSCRIBE)

            return sample

        def send() -> None:
            for key in self.keys:
                self.far.put(key, b"", attachment=FAR, congestion_control=BLOCK)

        with declared(
            *(
                session.declare_subscriber(each.key, heard(each.column))
                for each, session in self._of(MessageKind.SUBSCRIBE)
            )
        ):
            time.sleep(GRACE_S)
            self._wait(MessageKind.SUBSCRIBE, send=send)

    def _queryables(self) -> None:
        def asked(column: Column, key: str) -> Callable[[zenoh.Query], None]:
            def query(query: zenoh.Query) -> None:
                if text(query.payload) == FAR:
                    self._note(column, key, MessageKind.QUERYABLE)
                    query.reply(key, column)
                query.drop()

            return query

        def replied(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._note(text(reply.ok.payload), str(reply.ok.key_expr), MessageKind.REPLY)

        def send() -> None:
            for key in self.keys:
                self.far.get(
                    key,
                    replied,
                    payload=FAR,
                    timeout=WAIT_S,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                )

        with declared(
            *(
                session.declare_queryable(each.key, asked(each.column, each.key))
                for each, session in self._of(MessageKind.QUERYABLE)
            )
        ):
            time.sleep(GRACE_S)
            self._wait(MessageKind.QUERYABLE, MessageKind.REPLY, send=send)

    def _tokens(self) -> None:
        now: list[Column] = []
        alive: set[str] = set()

        def changed(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                alive.add(str(sample.key_expr))
                self._note(now[-1], str(sample.key_expr), MessageKind.TOKEN)
            else:
                alive.discard(str(sample.key_expr))

        far = self.far.liveliness()
        with declared(*(far.declare_subscriber(key, changed) for key in self.keys)):
            time.sleep(GRACE_S)
            for column, session in self.members.items():  # one after the other: a token does not say whose it is
                now.append(column)
                keys = [each.key for each, _ in self._of(MessageKind.TOKEN) if each.column == column]
                with declared(*(session.liveliness().declare_token(key) for key in keys)):
                    self._wait(MessageKind.TOKEN, column=column)
                until(lambda: not alive, what="the end of the tokens")

    def _looks(self) -> None:
        def came(column: Column) -> Callable[[zenoh.Sample], None]:
            def change(sample: zenoh.Sample) -> None:
                self._note(column, str(sample.key_expr), MessageKind.WATCH_ALIVE)

            return change

        def found(column: Column) -> Callable[[zenoh.Reply], None]:
            def reply(reply: zenoh.Reply) -> None:
                if reply.ok is not None:
                    self._note(column, str(reply.ok.key_expr), MessageKind.ASK_ALIVE)

            return reply

        def send() -> None:
            for each, session in self._of(MessageKind.ASK_ALIVE):
                session.liveliness().get(each.key, found(each.column), timeout=WAIT_S)

        with declared(
            *(
                session.liveliness().declare_subscriber(each.key, came(each.column))
                for each, session in self._of(MessageKind.WATCH_ALIVE)
            )
        ):
            time.sleep(GRACE_S)
            with declared(*(self.far.liveliness().declare_token(key) for key in self.keys)):
                self._wait(MessageKind.WATCH_ALIVE)
                self._wait(MessageKind.ASK_ALIVE, send=send)


def ignore(_: object) -> None:
    """Take a reply that says nothing."""


def text(payload: zenoh.ZBytes | None) -> str:
    return payload.to_bytes().decode(errors="replace") if payload is not None else ""


@contextlib.contextmanager
def declared(*entities: Any) -> Iterator[None]:
    """Undeclare what was declared, in the end."""
    try:
        yield
    finally:
        for entity in entities:
            with contextlib.suppress(zenoh.ZError, RuntimeError):
                entity.undeclare()


__all__ = ["COLUMNS", "FAR", "GRACE_S", "Matrix", "SecureBus", "declared", "ignore", "secure", "text"]
