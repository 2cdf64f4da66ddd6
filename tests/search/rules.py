"""What must hold in every state and after every move, judged by accounts of its own.

The accounts know what was granted, stopped and released, as the answers, the stops and the time tell; they never look
into the authority to learn who may drive.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from tests.search.world import DEADMAN_S, LEASE_S, MAX_AGE_S, MOVES, World
from zbridge.control.events import EventKind
from zbridge.lease.proof import read

TOLERANCE_S = 1e-6
_NONE: frozenset[str] = frozenset()


class Account(NamedTuple):
    """Who may drive, by this account. lease: its id; None: nobody. owes: neutral must come before motion."""

    lease: bytes | None = None
    program: int = -1
    expires_at: float = math.inf
    owes: bool = False
    baseline_s: float = 0.0
    """The fastest delivery of what is dated in this lease: what is later by more than the limit is stale."""
    latched: frozenset[str] = frozenset()
    released: frozenset[str] = frozenset()
    moving: frozenset[str] = frozenset()
    """Parts of the robot that move, by the commands that were carried out."""
    alive: str = ""
    """The token that the holder's question named."""
    asked_at: float = 0.0
    used: bool = False
    """Whether anything was sent with the lease."""
    moved: frozenset[str] = frozenset()
    """Parts that moved when neutral began to be owed, and have not rested since."""

    def named(self, world: World) -> Any:
        """Write what of the account the state does not say; for the name of the state."""
        return (
            self.program,
            self.owes,
            round(self.baseline_s, 1),
            tuple(sorted(self.latched)),
            tuple(sorted(self.released)),
            tuple(sorted(self.moving)),
            tuple(sorted(self.moved)),
            self.lease is None or self.used or round(world.now - self.asked_at, 1),
        )


class Violation(AssertionError):
    """A rule does not hold."""


def judge(before: World, account: Account, after: World, move: str) -> Account:
    """Follow one move with the account; raise Violation."""
    moved_before = before.robot.in_motion
    for what, said in after.decisions:
        account = _FOLLOW[what](account, after, said)
    deadline = after.authority.deadline()
    if move == "time" and deadline is not None and after.now >= deadline:
        raise Violation("what was due was not done")
    _state_holds(after, account)
    lost = before.authority.verifier is not None and (
        after.authority.verifier is None or after.authority.verifier.lease != before.authority.verifier.lease
    )
    if lost and moved_before and after.robot.in_motion and not any(what == "told" for what, _ in after.decisions):
        raise Violation("a lease ended while the robot moved, and no stop was sent")
    return account


def _state_holds(world: World, account: Account) -> None:
    authority = world.authority
    holding = [holder.client._signer.lease for holder in world.holders if holder.client._signer is not None]
    if len(holding) != len(set(holding)):
        raise Violation("two programs hold one lease")
    if (authority.verifier is None) != (authority.holders.current is None):
        raise Violation("proofs of no lease are verified")
    lease = authority.verifier.lease if authority.verifier is not None else None
    if lease != account.lease:
        raise Violation(f"the authority says that {lease!r} is held, the account {account.lease!r}")
    if bool(account.latched) != (authority.state == "latched"):
        raise Violation(f"latched by {set(account.latched)}, shown as {authority.state}")
    robot = world.robot
    if robot.in_motion and account.lease is None and not world.overtaken:
        raise Violation("the robot moves, and nobody has the lease")
    if robot.in_motion and not authority.motion.moving:
        raise Violation("the robot moves, and the authority does not know")
    deadline = authority.deadline()
    if robot.in_motion and deadline is None:
        raise Violation("commanded motion has no deadline")
    if deadline is not None and deadline - world.now > max(LEASE_S, DEADMAN_S) + TOLERANCE_S:
        raise Violation(f"a deadline {deadline - world.now:g} s away")
    if robot.moving and world.now >= robot.moved_at + DEADMAN_S - TOLERANCE_S and not _was_late(world):
        raise Violation("the robot moves longer than its deadman")


def _was_late(world: World) -> bool:
    """Whether the gateway was frozen, and has not turned since the deadline."""
    deadline = world.authority.deadline()
    return deadline is not None and world.now >= deadline


# What the account makes of each decision


def _acquire(account: Account, world: World, said: Any) -> Account:
    query, reply = said
    program, question = query.program, query.question
    account = _expired(account, world)
    taking = "/takeover/" in question.key
    held = account.lease is not None
    outranks = held and world.programs[program].priority > world.programs[account.program].priority
    same = (program, query.alive) == (account.program, account.alive)
    again = held and not account.used and same and question.asked_at > account.asked_at
    allowed = not account.latched and (not held or taking or outranks or again)
    if reply.ok != allowed:
        raise Violation(
            f"a question for the lease was {'granted' if reply.ok else 'refused'}: {account}, {reply.reason}"
        )
    if not reply.ok:
        return account
    return account._replace(
        lease=reply.lease, program=program, expires_at=world.now + LEASE_S, owes=False, moving=_NONE,
        moved=_NONE, baseline_s=world.now - question.asked_at, alive=query.alive,
        asked_at=question.asked_at, used=False,
    )  # fmt: skip


def _renew(account: Account, world: World, said: Any) -> Account:
    _, shown, reply = said
    account = _expired(account, world)
    if reply.ok and shown.lease != account.lease:
        raise Violation("a lease was renewed that is not held")
    if shown.lease != account.lease or not reply.ok:
        return account
    account, stale = _dated(account._replace(used=True), world.now - shown.t / 1000)
    return account if stale else account._replace(expires_at=world.now + LEASE_S)


def _release(account: Account, world: World, said: Any) -> Account:
    _, shown, reply = said
    account = _expired(account, world)
    if not reply.ok:
        return account
    if shown.lease != account.lease:
        raise Violation("a lease was released that is not held")
    return _ended(account)


def _admitted(account: Account, world: World, said: Any) -> Account:
    command, sender = said
    account = _expired(account, world)
    if read(command.attachment).lease != account.lease:
        raise Violation("a command of somebody else was admitted")
    account, stale = _dated(account._replace(used=True), world.now - command.given_ms / 1000)
    if stale != sender.stale:
        raise Violation(f"a command that was late is {'stale' if stale else 'fresh'}, and was not taken for it")
    return account if stale else account._replace(expires_at=world.now + LEASE_S)


def _told(account: Account, world: World, said: Any) -> Account:
    command, _ = said
    _, stale = _dated(account, world.now - command.given_ms / 1000)
    if account.latched:
        raise Violation("the robot is latched, and was told something by a program")
    if command.what in MOVES:
        if account.owes:
            raise Violation("motion was carried out before neutral")
        if stale:
            raise Violation("stale motion was carried out")
    return _carried_out(account, command.what, stale)


def _carried_out(account: Account, what: str, stale: bool) -> Account:
    """Note which parts move; a neutral drive pays for all parts, the neutral of a part for that one."""
    part = "motor" if "motor" in what else "drive"
    if what in ("motion", "motor"):
        return account._replace(moving=account.moving | {part})
    if what not in ("neutral", "motor neutral"):
        return account
    account = account._replace(moving=account.moving - {part})
    if stale or account.moving:
        return account
    moved = frozenset() if what == "neutral" else account.moved - {part}
    return account._replace(moved=moved, owes=account.owes and bool(moved))


def _owes(account: Account) -> Account:
    """Owe neutral from now on: the robot is at rest."""
    held = account.lease is not None
    return account._replace(owes=held, moved=(account.moved | account.moving) if held else _NONE, moving=frozenset())


def _recorded(account: Account, world: World, said: Any) -> Account:
    """Follow what was carried out though the lease may have ended since it was admitted."""
    command, sender = said
    return _carried_out(account, command.what, sender.stale) if command.lease == account.lease else account


def _dated(account: Account, took_s: float) -> tuple[Account, bool]:
    """Take something that took so long on its way; tell whether it is stale."""
    account = account._replace(baseline_s=min(account.baseline_s, took_s))
    return account, took_s - account.baseline_s > MAX_AGE_S


def _ended(account: Account) -> Account:
    return account._replace(
        lease=None, program=-1, owes=False, baseline_s=0.0, expires_at=math.inf, moving=frozenset(), moved=frozenset()
    )


def _stopped(account: Account, world: World, latch: Any) -> Account:
    latched = account.latched
    if latch is not None and latch not in account.released:
        latched |= {latch}
    if world.robot.in_motion:
        raise Violation("a stop did not stop the robot")
    return _ended(account)._replace(latched=latched)


def _folded(account: Account, world: World, said: Any) -> Account:
    if account.lease is not None or world.robot.in_motion:
        raise Violation("a stop was folded that changes something")
    return account


def _unlatched(account: Account, world: World, latch: Any) -> Account:
    return account._replace(latched=account.latched - {latch}, released=account.released | {latch})


def _neutral_required(account: Account, world: World, said: Any) -> Account:
    return _owes(account)


def _event(account: Account, world: World, event: Any) -> Account:
    if event.what is EventKind.STOPPED and event.reason == "deadman":
        return _owes(account)
    if event.what is EventKind.ENDED and event.reason in ("bus lost", "holder lost", "lease expired"):
        if event.reason == "lease expired" and world.now + TOLERANCE_S < account.expires_at:
            raise Violation("a lease expired before its time")
        return _ended(account)
    return account


def _expired(account: Account, world: World) -> Account:
    """End the account's lease where its time has come."""
    gone = account.lease is not None and world.now >= account.expires_at - TOLERANCE_S
    return _ended(account) if gone else account


_FOLLOW = {
    "acquire": _acquire,
    "renew": _renew,
    "release": _release,
    "admitted": _admitted,
    "told": _told,
    "recorded": _recorded,
    "stop": _stopped,
    "folded": _folded,
    "unlatched": _unlatched,
    "neutral required": _neutral_required,
    "event": _event,
}
