"""Broken variants of the product: name, profile that reaches it, file, old text, new text."""

from __future__ import annotations

from typing import NamedTuple


class Mutant(NamedTuple):
    """One broken variant. profile: None where any scenario may show it."""

    name: str
    profile: str | None
    file: str
    old: str
    new: str


AUTHORITY = "zbridge/control/authority.py"
MACHINE = "zbridge/control/authority_machine.py"
MOTION = "zbridge/control/commanded_motion.py"
HOLDERS = "zbridge/control/holders.py"
ENFORCER = "zbridge/control/enforcer.py"
LATCH = "zbridge/control/latch.py"
INTENT = "zbridge/hq/intent.py"
STICK = "zbridge/lease/stick.py"
OWNERSHIP = "zbridge/robot/ownership.py"
CLAIM_BUS = "zbridge/robot/claim_bus.py"
CLAIM = "zbridge/robot/claim.py"
COMMANDS = "zbridge/robot/commands.py"
DEVICE = "zbridge/robot/device.py"
STANDSTILL = "zbridge/control/standstill.py"
TCPUDP = "gateways/tcpudp/translate.py"
PRESENCE = "zbridge/robot/presence.py"

MUTANTS = (
    # the deadman
    Mutant("deadman never fires", None, AUTHORITY, "        elif now >= self.motion.stop_at:", "        elif False:"),
    Mutant("deadman not started", None, MACHINE, "        self.motion.start(cause.at)\n", "        pass\n"),
    Mutant(
        "repeated motion extends by three deadmen",
        None,
        MOTION,
        "            self.stop_at = given_at + self.deadman_s\n            return",
        "            self.stop_at = given_at + 3 * self.deadman_s\n            return",
    ),
    Mutant(
        "deadman as the robot allows",
        None,
        MACHINE,
        "Verifier(lease, token), deadman_s",
        "Verifier(lease, token), self.deadman_s",
    ),
    Mutant(
        "deadman sends no stop",
        None,
        MACHINE,
        "cause.reason, stops=cause.stops, cause=cause.stop))\n        motion.require_neutral",
        "cause.reason, stops=False, cause=cause.stop))\n        motion.require_neutral",
    ),
    Mutant(
        "timer not armed",
        None,
        ENFORCER,
        "if deadline is not None and deadline < self._timer_at:",
        "if False:",
    ),
    Mutant(
        "required neutral forgotten",
        None,
        MOTION,
        "        if self.needs_neutral is not None:\n            raise NeutralFirst",
        "        if False:\n            raise NeutralFirst",
    ),
    Mutant(
        "required neutral ends with motion",
        None,
        MOTION,
        "        self._still()\n        self.needs_neutral = reason\n",
        "        self._still()\n        self.needs_neutral = None\n",
    ),
    # the lease: expiry, token, proof
    Mutant(
        "lease never expires",
        "bus",
        AUTHORITY,
        'self.machine.handle(Input.EXPIRED, Cause(reason="lease expired", stop=StopCause.LEASE_EXPIRED))',
        "pass",
    ),
    Mutant(
        "expiry leaves the robot moving",
        "bus",
        MACHINE,
        "        Input.EXPIRED: (_end, State.STOPPED),\n",
        "",
    ),
    Mutant(
        "loss of the holder ignored",
        "bus",
        MACHINE,
        "        Input.HOLDER_LOST: (_end, State.STOPPED),\n",
        "",
    ),
    Mutant(
        "loss of the bus ignored",
        "bus",
        MACHINE,
        "        Input.BUS_LOST: (_end, State.STOPPED),\n",
        "",
    ),
    Mutant(
        "stop does not end the lease",
        "mixed",
        MACHINE,
        "        Input.STOP: (_end, State.STOPPED),\n        Input.LATCH: (_end, State.LATCHED),\n        Input.EXP",
        "        Input.LATCH: (_end, State.LATCHED),\n        Input.EXP",
    ),
    Mutant(
        "a held robot is granted to anybody",
        None,
        MACHINE,
        "Input.ACQUIRE: (_deny, None),",
        "Input.ACQUIRE: (_grant, State.HELD),",
    ),
    Mutant("ended leases still drive", None, HOLDERS, "    if holder.ended is not None:", "    if False:"),
    Mutant(
        "right proofs are wrong",
        None,
        HOLDERS,
        "        if not holder.verifier.proves(shown, key, payload):",
        "        if holder.verifier.proves(shown, key, payload):",
    ),
    Mutant(
        "proofs are not checked",
        "bus",
        HOLDERS,
        "        if not holder.verifier.proves(shown, key, payload):",
        "        if False:",
    ),
    Mutant(
        "the admission filter checks no proof",
        "bus",
        "zbridge/control/admission.py",
        "        if not verifier.proves(authorization, key, payload):",
        "        if False:",
    ),
    Mutant(
        "numbers may be used twice",
        "bus",
        HOLDERS,
        "    if not fresh:\n        raise Malformed",
        "    if False:\n        raise Malformed",
    ),
    Mutant(
        "release does not stop the robot",
        None,
        MACHINE,
        "stops = cause.kind in (EventKind.STOPPED, EventKind.LATCHED) or self.motion.moving",
        "stops = cause.kind in (EventKind.STOPPED, EventKind.LATCHED)",
    ),
    Mutant(
        "a lease is not renewed by commands",
        None,
        AUTHORITY,
        "            holder.expires_at = now + holder.lease_s\n        return Sender",
        "            pass\n        return Sender",
    ),
    # the age of commands
    Mutant("nothing is stale", "bus", HOLDERS, "        return late_s > self.limit_s", "        return False"),
    Mutant(
        "stale after four seconds",
        "bus",
        HOLDERS,
        "        return late_s > self.limit_s",
        "        return late_s > 10 * self.limit_s",
    ),
    Mutant(
        "baseline follows every sample",
        "bus",
        HOLDERS,
        "            self._baseline_ms = min(apart_ms, risen_ms)",
        "            self._baseline_ms = apart_ms",
    ),
    Mutant(
        "deadman counts from arrival",
        "situations",
        AUTHORITY,
        "return Sender(holder.who, now - late_s, late_s, stale)",
        "return Sender(holder.who, now, late_s, stale)",
    ),
    Mutant(
        "stale motion is not refused",
        "bus",
        COMMANDS,
        "            self._enforcer.require_fresh(sender)\n        else:",
        "            pass\n        else:",
    ),
    Mutant(
        "suspension not noticed", "mixed", ENFORCER, "if suspended_s > self._suspended_s + SUSPENDED_S:", "if False:"
    ),
    # stops and standing still
    Mutant(
        "no idle stops",
        "tcpudp",
        STANDSTILL,
        "            and now >= self._repeated_until\n",
        "            and False\n",
    ),
    Mutant(
        "stop never written",
        None,
        ENFORCER,
        "                if event.stops:\n                    self._send_stop(",
        "                if False:\n                    self._send_stop(",
    ),
    Mutant(
        "autonomous mode survives a stall",
        "tcpudp",
        "gateways/tcpudp/session/hq_role.py",
        "        if type(frame) is _Chosen and frame.autonomous:\n            self.sent_autonomous = True",
        "        if type(frame) is _Chosen:\n            self.sent_autonomous = frame.autonomous",
    ),
    Mutant(
        "stop does not end mode 3",
        "tcpudp",
        TCPUDP,
        "return (packets.ClientControllMode(mode), stop) if paired",
        "return (stop,) if paired",
    ),
    Mutant("neutral does not reach the robot", None, TCPUDP, "            self._neutral(session, now)\n", ""),
    Mutant(
        "stops 10 ms apart to robots that read seldom",
        "tcpudp",
        TCPUDP,
        "        if session.misreads and len(frames) > 1:",
        "        if False:",
    ),
    Mutant(
        "stalled link is written to",
        "situations",
        "zbridge/transport/conversation.py",
        "(waited_s > (0.0 if self.blocked else STALLED_S)) is not self.blocked",
        "self.blocked",
    ),
    Mutant(
        "drives wait for a stalled link for ever",
        "situations",
        PRESENCE,
        '            self._enforcer.require_neutral("the robot\'s link stalled", StopCause.LINK_STALLED, stops=True)',
        "            pass",
    ),
    Mutant(
        "a reconnected robot is not stopped",
        "situations",
        PRESENCE,
        "            self._standstill.stop(ordered=False)\n        self._enforcer.lease_hook",
        "            pass\n        self._enforcer.lease_hook",
    ),
    # ownership
    Mutant(
        "ownership never yields (split brain)",
        "ownership",
        CLAIM_BUS,
        "        return any(claim.better_than(own, zid, self._bus.zid) for zid, claim in claims.items())",
        "        return False",
    ),
    Mutant(
        "both gateways yield",
        "ownership",
        CLAIM,
        "        if first != second:\n            return first > second",
        "        if first != second:\n            return True",
    ),
    Mutant(
        "a claim is not announced",
        "ownership",
        CLAIM_BUS,
        "question.answer(write(self._claim()))",
        "question.answer(write(Claim()))",
    ),
    Mutant(
        "nobody looks before taking",
        "ownership",
        OWNERSHIP,
        "if self.hands_over or self._bus.gone or await self._sees(others):",
        "if False:",
    ),
    Mutant(
        "a yielded gateway continues",
        "ownership",
        "zbridge/app/serving.py",
        "        await self._device.step_aside()\n",
        "",
    ),
    Mutant(
        "a yielded gateway never returns",
        "situations",
        OWNERSHIP,
        "            OwnershipInput.BEST: (_show, OwnershipState.OWNING),\n"
        "            OwnershipInput.OUTBID: (_withdraw, OwnershipState.LOOKING),",
        "            OwnershipInput.OUTBID: (_withdraw, OwnershipState.LOOKING),",
    ),
    Mutant(
        "robot not stopped by who yields",
        "situations",
        DEVICE,
        "        self.enforcer.stop(_ASIDE, StopCause.ANOTHER_GATEWAY)\n",
        "",
    ),
    Mutant(
        "claim without latches",
        "ownership",
        OWNERSHIP,
        "            **msgspec.structs.asdict(standing.record),",
        "",
    ),
    Mutant(
        "claim without releases",
        "situations",
        "zbridge/control/latch.py",
        "                self._in_force.pop(stop_id, None)\n        return",
        "                pass\n        return",
    ),
    # latch
    Mutant("a latch is a plain stop", "latch", LATCH, "        if stop.latch is not True:", "        if True:"),
    Mutant(
        "a latched robot is granted",
        "latch",
        MACHINE,
        "            Input.ACQUIRE: (_refuse_latched, None),",
        "            Input.ACQUIRE: (_grant, State.HELD),",
    ),
    Mutant(
        "latches are not kept on disk",
        "latch",
        "zbridge/control/latch_store.py",
        "        self._put(self._own, latches.record)",
        "        pass",
    ),
    Mutant(
        "a takeover ends a latch",
        "latch",
        MACHINE,
        "            Input.TAKEOVER: (_refuse_latched, None),",
        "            Input.TAKEOVER: (_grant, State.HELD),",
    ),
    Mutant(
        "any unlatch frees the robot",
        "latch",
        AUTHORITY,
        "        if not self.latches:\n            self.machine.handle(Input.UNLATCH, Cause())",
        "        self.machine.handle(Input.UNLATCH, Cause())",
    ),
    Mutant(
        "latched robots forget at their start",
        "latch",
        MACHINE,
        "State.LATCHED if latches else State.FREE",
        "State.FREE",
    ),
    # motion by itself
    Mutant(
        "mode 3 is not written down",
        "situations",
        ENFORCER,
        "        self.authority.latches.autonomous = True\n        return self._save",
        "        return self._save",
    ),
    Mutant(
        "mode 3 does not wait for the disk",
        "situations",
        COMMANDS,
        "            if writing is not None:",
        "            if False:",
    ),
    Mutant(
        "a waiting gateway does not learn of mode 3",
        "situations",
        CLAIM,
        "        return LatchRecord(self.latches, self.released, self.released_fleet, self.autonomous)",
        "        return LatchRecord(self.latches, self.released, self.released_fleet)",
    ),
    Mutant(
        "what was written down of mode 3 stops nobody",
        "situations",
        TCPUDP,
        "        self._was_autonomous = True\n",
        "        return\n",
    ),
    # HQ programs
    Mutant(
        "HQ deadman ignored",
        "hq",
        STICK,
        "        if self._moving and now >= self._moved_at + self.deadman_s:",
        "        if False:",
    ),
    Mutant(
        "HQ programs need no neutral",
        "hq",
        STICK,
        "            StickInput.MOTION: (StickAction.REFUSE, None),\n            StickInput.NEUTRAL",
        "            StickInput.MOTION: (StickAction.ACQUIRE, StickState.ASKING),\n            StickInput.NEUTRAL",
    ),
    Mutant(  # both: what holds the lease gives it back with its token
        "a lost HQ program keeps the lease",
        "situations",
        "zbridge/hq/operator.py",
        '        if self.intent.held:\n            self._release("disconnected")\n        self._lease.close()',
        "        pass",
    ),
    Mutant("old neutral counts at once", "situations", INTENT, "        if self._waited:\n", "        if False:\n"),
    Mutant(  # both: what was queued meanwhile takes the robot from its program too
        "a frozen listener continues",
        "situations",
        "zbridge/hq/freeze.py",
        "        if frozen_s >= FROZEN_S:",
        "        if False:",
    ),
    Mutant(
        "HQ programs hold the robot for ever",
        "situations",
        STICK,
        "now >= self._last_used() + self.idle_s",
        "now >= self._last_used() + 1000",
    ),
    # what is shown
    Mutant(  # both: what is not published at once is published 0.05 s later
        "control is not published",
        None,
        ENFORCER,
        "            if self._control_due is None and not self._closed:\n"
        "                self._control_due = self._loop.call_later(_CONTROL_S, self.report)\n"
        "        if changed:\n            self.report()",
        "            pass",
    ),
    Mutant(
        "no heartbeat",
        None,
        DEVICE,
        "                self._presence.publish_status()\n                self.enforcer.beat()",
        "                pass",
    ),
    Mutant(
        "leases wait for ever",
        None,
        "zbridge/robot/fleet_latches.py",
        "        if not self._returned.is_set():\n            self._leases.wait(None)",
        "        pass",
    ),
    Mutant(
        "the client never learns of a loss",
        "situations",
        "zbridge/client/driver.py",
        "        self.lost.set()",
        "        pass",
    ),
    Mutant(
        "a session that locked up is kept",
        "situations",
        "zbridge/app/joining.py",
        "await can_connect(plan) and not await returns(RECONNECTS_S)",
        "False",
    ),
)
