"""Broken variants that engineers chose who had read neither the rules nor the situations."""

from __future__ import annotations

from tests.simulated.mutants_data import (
    COMMANDS,
    DEVICE,
    ENFORCER,
    HOLDERS,
    INTENT,
    LATCH,
    MACHINE,
    PRESENCE,
    STANDSTILL,
    Mutant,
)


def _mutant(name: str, file: str, old: str, new: str) -> Mutant:
    return Mutant(name, "situations", file, old, new)


FOUND = (
    _mutant(
        "ages are counted from the first command",
        MACHINE,
        "        age.late_s(request.t, cause.received_ms)\n",
        "",
    ),
    _mutant(
        "a suspension ends no lease of a robot that does not move",
        ENFORCER,
        '            self.stop(f"the gateway\'s machine was suspended for {asleep_s:.1f} s", StopCause.SUSPENDED)\n',
        "            if self.authority.motion.moving:\n"
        "                self.stop(f'suspended for {asleep_s:.1f} s', StopCause.SUSPENDED)\n",
    ),
    _mutant(
        "a takeover does not wait for the fleet's latched stops",
        "zbridge/control/lease_server.py",
        "        self._require_latches()\n        request = _request(query)\n",
        "        request = _request(query)\n",
    ),
    _mutant(
        "a latch that another gateway knows to be released is adopted",
        LATCH,
        "for latch in answer.latches if latch.id not in released}",
        "for latch in answer.latches if latch.id not in answer.released}",
    ),
    _mutant(
        "the loss of a robot that does not move holds nobody back",
        PRESENCE,
        "            if not self._leaving:\n",
        "            if not self._leaving and self._enforcer.authority.motion.moving:\n",
    ),
    _mutant(
        "neutral does not call off a mode 3 that waits for the disk",
        COMMANDS,
        "            self._enforcer.require_fresh(sender)\n        else:\n            self._awaiting = None\n",
        "            self._enforcer.require_fresh(sender)\n",
    ),
    _mutant(
        "motion while the robot is away asks for no neutral",
        "zbridge/hq/operator.py",
        "            self.intent.refused(missing)\n",
        "",
    ),
    _mutant(
        "a restart that failed ends the look for other gateways",
        "zbridge/app/handover/restarts.py",
        "        self._ownership.hands_over = self._withdrawn = False\n",
        "        self._withdrawn = False\n",
    ),
    _mutant(
        "a gateway that is gone is shown for ever",
        "zbridge/app/serving.py",
        "        self._open_faults.set(FaultCode.SPLIT_CLAIMS, text if claims else None)\n",
        "        if claims:\n            self._open_faults.set(FaultCode.SPLIT_CLAIMS, text)\n",
    ),
    _mutant(
        "a stop is one of the wheels only",
        "gateways/wc2ec/translate.py",
        "            for device in self._table.motors(ROTATIONAL):\n                self._set_motor(device, 0.0,",
        "            for device in filter(None, map(self._table.named, self._velocities(Drive()))):\n"
        "                self._set_motor(device, 0.0,",
    ),
    _mutant(
        "a reconnected robot is stopped as if it had never been told mode 3",
        "gateways/tcpudp/session/hq_role.py",
        "predecessor is not None and predecessor.sent_autonomous",
        "False",
    ),
    _mutant(
        "a robot that sleeps after packet 4 is written to",
        "gateways/tcpudp/session/hq_role.py",
        "        self.outbox.quiet(self._silent_until)\n",
        "",
    ),
    _mutant(
        "a stop counts as confirmed where the robot is stopped already",
        "zbridge/client/stops.py",
        "lambda control: stop.id in control.stops, CONFIRM_S",
        'lambda control: control.state in ("stopped", "latched"), CONFIRM_S',
    ),
    _mutant(
        "a latched robot is sent no more stops than others",
        STANDSTILL,
        "(self._idle_stop_s or self._authority.latches)",
        "self._idle_stop_s",
    ),
    _mutant(
        "a mode 3 that waits for the disk outlives its lease",
        COMMANDS,
        " or waiting.verifier is not self._enforcer.authority.verifier:",
        ":",
    ),
    _mutant(
        "a gateway that yielded counts for less than one that reaches no robot",
        "zbridge/robot/claim.py",
        "not self.leaving, self.healthy, not self.yielded)",
        "not self.leaving, not self.yielded, self.healthy)",
    ),
    _mutant(
        "what HQ programs said before a silence counts until their lease ends",
        INTENT,
        "< self.heard_at < now - self.deadman_s:",
        "< self.heard_at < now - self.idle_s:",
    ),
    _mutant(
        "a connection that ended while it was stalled blocks the next one",
        PRESENCE,
        "        self._commands.blocked = False\n        self._context.open_faults.set(FaultCode.LINK_STALLED, None)\n",
        "",
    ),
    _mutant(
        "a latched stop that comes during a restart is lost",
        "zbridge/app/gateway.py",
        "                    device.enforcer.restore(store.load())  # one that came last is only in the file\n",
        "",
    ),
    _mutant(
        "a gateway that yielded continues repeating its stop",
        "zbridge/protocol/outbox.py",
        "            self._clear_slots()\n",
        "            pass\n",
    ),
    _mutant(
        "the stop of a gateway that serves its robot again comes before it may write",
        DEVICE,
        """        self.observed.aside = False
        for connection in self._links:
            connection.mute(False)
        self.publishers.mute(False)
        self._listen()
        self._refuse_all(None)
        self._latch_news.returned()
        self._standstill.begin()
        self.enforcer.stop("served again", StopCause.ANOTHER_GATEWAY)
""",
        """        self.observed.aside = False
        self.enforcer.stop("served again", StopCause.ANOTHER_GATEWAY)
        for connection in self._links:
            connection.mute(False)
        self.publishers.mute(False)
        self._listen()
        self._refuse_all(None)
        self._latch_news.returned()
        self._standstill.begin()
""",
    ),
    _mutant(
        "the baseline of ages rises faster with every command",
        HOLDERS,
        "            self._baseline_ms = min(apart_ms, risen_ms)\n        self._sampled_ms = received_ms\n",
        "            self._baseline_ms = min(apart_ms, risen_ms)\n"
        "        self._sampled_ms = self._sampled_ms or received_ms\n",
    ),
    _mutant(
        "a listener whose machine was suspended does not notice it",
        "zbridge/hq/freeze.py",
        "        frozen_s = now + self._suspended_s() - self._beat_at\n",
        "        frozen_s = now - self._beat_at\n",
    ),
    _mutant(
        "a latched stop that was released comes into force again",
        LATCH,
        "        if latch.id in self._released or latch.id in self._released_fleet:\n",
        "        if latch.id in self._released_fleet:\n",
    ),
    _mutant(
        "the baseline of an age rises from the first command on",
        "zbridge/control/holders.py",
        "            self._baseline_ms = apart_ms\n"
        "        else:\n"
        "            risen_ms = self._baseline_ms + (received_ms - self._sampled_ms) / 1000 * RISES_MS_PER_S\n"
        "            self._baseline_ms = min(apart_ms, risen_ms)\n"
        "        self._sampled_ms = received_ms\n",
        "            self._baseline_ms = apart_ms\n"
        "            self._sampled_ms = received_ms\n"
        "        else:\n"
        "            risen_ms = self._baseline_ms + (received_ms - self._sampled_ms) / 1000 * RISES_MS_PER_S\n"
        "            self._baseline_ms = min(apart_ms, risen_ms)\n",
    ),
    _mutant(
        "a listener declares no liveliness token",
        "zbridge/lease/lease_holder.py",
        "            self.announce()\n            self._spawn(self._ask(question))\n",
        "            self._spawn(self._ask(question))\n",
    ),
    _mutant(
        "a stop of a robot that its gateway tries to reach counts as confirmed",
        "zbridge/client/stops.py",
        '    if isinstance(status, Status) and status.state != "established":',
        '    if isinstance(status, Status) and status.state == "offline":',
    ),
    _mutant(
        "a yielded gateway serves the robot when its bus is cut",
        "zbridge/robot/ownership.py",
        "        if self._bus.gone:\n            return False\n        self._looks -= 1\n",
        "        self._looks -= 1\n",
    ),
    _mutant(
        "motion does not call off the wait for a neutral",
        "zbridge/hq/intent.py",
        "        self.expire(now)\n"
        "        self._rests_at = math.inf\n"
        '        if self.mode == "none" and self.needs_neutral is None:\n',
        '        self.expire(now)\n        if self.mode == "none" and self.needs_neutral is None:\n',
    ),
    _mutant(
        "a gateway that serves its robot again forgets the owner's latched stops",
        "zbridge/app/serving.py",
        "        self._device.enforcer.merge(self._owners_record)\n        await self._device.step_in()\n",
        "        await self._device.step_in()\n",
    ),
    _mutant(
        "a stopped vehicle repeats its motion with another light",
        "gateways/alf/translate.py",
        "        self._send(self._neutral(), now, urgent=True)\n",
        "        if self._session is None:\n"
        '            raise NotReady("offline")\n'
        "        self._session.drive(self._neutral(), now, urgent=True)\n",
    ),
    _mutant(
        "a text that is no UTF-8 raises",
        "zbridge/fleet/payload.py",
        "    except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:\n"
        '        raise PayloadError(f"{message.__name__}: {error}") from error\n'
        "    return decoded\n",
        "    except (msgspec.MsgspecError, OverflowError, RecursionError) as error:\n"
        '        raise PayloadError(f"{message.__name__}: {error}") from error\n'
        "    return decoded\n",
    ),
    _mutant(
        "parts that moved are forgotten when neutral is needed once more",
        "zbridge/control/commanded_motion.py",
        "        self.moved |= self.parts\n",
        "        self.moved = set(self.parts)\n",
    ),
    _mutant(
        "one released latch of two frees the robot",
        "zbridge/control/authority.py",
        "            self.machine.events.append(Event(EventKind.UNLATCHED, _ANOTHER_GATEWAY))\n"
        "        if before and not self.latches:\n"
        "            self.machine.handle(Input.UNLATCH, Cause())\n",
        "            self.machine.events.append(Event(EventKind.UNLATCHED, _ANOTHER_GATEWAY))\n"
        "            self.machine.handle(Input.UNLATCH, Cause())\n",
    ),
    _mutant(
        "a restart that is undone loses the claim",
        "zbridge/app/handover/restarts.py",
        "        if self._withdrawn and self._claim is not None:\n"
        "            self._ownership.restore(self._claim)\n"
        "        self._ownership.hands_over = self._withdrawn = False\n",
        "        self._ownership.hands_over = self._withdrawn = False\n"
        "        if self._withdrawn and self._claim is not None:\n"
        "            self._ownership.restore(self._claim)\n",
    ),
    _mutant(
        "a refused push is no push",
        "zbridge/hq/operator.py",
        "        self._pushed[topic.path] = now\n        self._require_robot()\n        do = intent.motion(now)\n",
        "        self._require_robot()\n        do = intent.motion(now)\n        self._pushed[topic.path] = now\n",
    ),
    _mutant(
        "who has yielded never serves a robot whose owner cannot",
        "zbridge/robot/claim.py",
        "return (self.held_s > 0, not self.leaving, self.healthy, not self.yielded)",
        "return (self.held_s > 0, not self.leaving, not self.yielded, self.healthy)",
    ),
    _mutant(
        "a stick of ALF at rest turns other robots",
        "gateways/alf/hq.py",
        "        if not speed and self.view.protocol != NAME:",
        "        if False:",
    ),
    _mutant(
        "a motor that runs backward counts as neutral",
        "zbridge/fleet/messages.py",
        "        return bool(self.value)\n",
        "        return self.value > 0\n",
    ),
    _mutant(
        "a latch is confirmed before it is on disk",
        "zbridge/client/stops.py",
        "    control = await _shown(bus, keys, stop, lambda control: stop.id in control.stops, CONFIRM_S)\n",
        "\n"
        "    def taken(control: Control) -> bool:\n"
        "        return stop.id in control.stops or any(latch.id == stop.id for latch in control.latches)\n"
        "\n"
        "    control = await _shown(bus, keys, stop, taken, CONFIRM_S)\n",
    ),
    _mutant(
        "a restart that failed ends the watch for others",
        "zbridge/app/handover/restarts.py",
        "        self._ownership.hands_over = self._withdrawn = False\n",
        "        self._withdrawn = False\n",
    ),
    _mutant(
        "an unplugged controller keeps the robot for seconds",
        "gateways/wc2ec/hq.py",
        "            if client.silent_s > self.deadman_s - ATTEND_S:\n",
        "            if client.silent_s > self.deadman_s / ATTEND_S:\n",
    ),
)
