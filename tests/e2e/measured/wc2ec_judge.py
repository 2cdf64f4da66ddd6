"""Mixed commands through a real gateway against the fragile Webots controller: no violation, and everything arrives.

    python -m tests.e2e.measured.wc2ec_judge                     # both dialects, 2000 commands each
    python -m tests.e2e.measured.wc2ec_judge --commands 300 --dialect draft

What a robot of the dialect cannot do must be refused and never arrive. Of motion the newest wins: a few drives that
were overtaken are excused, and as much motion as came while the gateway was kept from the processor; nothing else is.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from tests.e2e.measured import mixed
from tests.e2e.measured.mixed import Arrival, Judgement, Put, Run
from tests.e2e.rigs.processes import report

LEFT, RIGHT, LIFT = 8, 9, 10
"""Numbers of the fragile robot's motors."""
MOTOR = 130
"""The packet that moves one."""
LIGHTS, VALUES = 4, 3
FORBIDDEN = 1e6
"""Every value of a command that must be refused is greater."""


def rounded(value: Any) -> tuple[float, ...]:
    values = value if isinstance(value, list | tuple) else [] if value is None else [value]
    return tuple(round(float(one), 6) for one in values)


def came(command: int, number: int, *values: float) -> tuple[Arrival]:
    return ((command, number, rounded(values)),)


def wheels(fields: dict[str, float], left: float, right: float) -> Put:
    return Put("drive", fields, came(MOTOR, LEFT, left) + came(MOTOR, RIGHT, right))


def share(number: int) -> float:
    """Give a fraction of full scale that is this number's own."""
    return (number % 9973 + 1) / 10_000


def motor(name: str, device: int, value: float) -> Put:
    return Put(f"motor/{name}", {"value": value}, came(MOTOR, device, value))


def wheel(number: int) -> Put:
    return motor("right%20wheel%20motor", RIGHT, 20 + number / 1000)


def lift(number: int) -> Put:
    return motor("lift", LIFT, 0.001 + number / 100_000)


def light(number: int, fields: dict[str, Any], command: int, *values: float) -> list[Put]:
    return [Put(f"sensor/light{number % LIGHTS}", fields, came(command, number % LIGHTS, *values))]


def refused(number: int) -> list[Put]:
    """What neither dialect has."""
    return [
        Put("mode", {"mode": ("none", "manual", "autonomous")[number % 3]}),
        Put("light", {"on": True}),
        Put("text", {"text": f"command {number}"}),
        Put("raw/wc2ec", {"id": 130, "body": b"\x35\x63" + bytes(8)}),
        Put("drive", b"\xff\x00rubbish"),
        Put("motor/lift", b"\x81\xa5value\xa3abc"),
        Put("sensor/light0", b"\xc1"),
    ]


def refused_deployed(number: int) -> list[Put]:
    names = ("nobody", "%", "lift%20", "left%20wheel%20motor%239", "rotational-9", "99", f"ds{number % 8}")
    return [
        Put("drive", {"left": 0.5}),
        *(Put(f"motor/{name}", {"value": FORBIDDEN + number}) for name in names),
        *(Put("motor/lift", {"value": value}) for value in (float("nan"), float("inf"), -float("inf"), 1e300)),
        Put(f"sensor/ds{number % 8}", {"index": 0, "value": FORBIDDEN + number}),
        Put(f"sensor/ds{number % 8}", {"enable": True}),
    ]


def refused_draft(number: int) -> list[Put]:
    too_much, names = FORBIDDEN + number, ("light4", "nobody", "%", "light-0")
    return [
        Put("drive", {"forward": 0.5}),
        Put("motor/light0", {"value": too_much}),
        *(Put(f"sensor/{name}", {"enable": True}) for name in names),
        *(Put(f"sensor/{name}", {"values": [too_much] * VALUES}) for name in names),
        *(Put("sensor/light0", {"index": index, "value": too_much}) for index in (VALUES, 255, 256, -1)),
        *(Put("sensor/light0", {"values": [too_much] * count}) for count in (0, VALUES - 1, VALUES + 1, 300)),
    ]


class _Webots(Run):
    options: ClassVar = {"values": VALUES}
    pace_s = 0.01

    def arrivals(self, report: dict[str, Any]) -> list[Arrival]:
        return [(command, number, rounded(value)) for _, command, _, number, value in report["received"]]

    def may_miss(self, arrival: Arrival) -> bool:
        drives = self.judgement.sent["drive"] + self.judgement.sent["turn"]
        by_drives = arrival[1] == LEFT or (arrival[1] == RIGHT and abs(arrival[2][0]) < 20)
        overtaken = len(self.judgement.overtaken)
        by_lateness = arrival[0] == MOTOR and (overtaken + 1) * self.pace_s < self.judgement.late_s
        return by_lateness or (by_drives and overtaken < max(3, drives // 20))

    def compare(self, report: dict[str, Any]) -> None:
        super().compare(report)
        for arrival in self.arrivals(report):
            if any(abs(value) >= FORBIDDEN or math.isnan(value) for value in arrival[2]):
                self.judgement.faults.append(f"{arrival} should have been refused")


class Deployed(_Webots):
    """For a robot of the field. What is put in a burst arrives joined."""

    robot = "wc2ec"
    kinds: ClassVar = {
        "drive": lambda n: [wheels({"forward": share(n)}, share(n) * 10, share(n) * 10)],
        "turn": lambda n: [wheels({"turn": share(n)}, -share(n) * 3, share(n) * 3)],
        "wheel": lambda n: [wheel(n)],
        "lift": lambda n: [lift(n)],
        "burst": lambda n: [*(lift(10_000 * part + n) for part in range(1, 6)), wheel(100_000 + n)],
        "neutral": lambda n: [Put("drive", {})],
        "refused": refused,
        "refused_deployed": refused_deployed,
    }
    weights: ClassVar = {**dict.fromkeys(kinds, 3), "refused": 5, "refused_deployed": 5, "neutral": 1, "stop": 1}

    def compare(self, report: dict[str, Any]) -> None:
        """ReadPayload at the last word to each wheel besides, which was the stop; the lift was left where it is."""
        super().compare(report)
        received = self.arrivals(report)
        for device in (LEFT, RIGHT):
            values = [values for _, number, values in received if number == device]
            if values[-1:] != [(0.0,)]:
                self.judgement.faults.append(f"the stop of device {device}: {values[-1:]}")
        if any(values == (0.0,) for _, number, values in received if number == LIFT):
            self.judgement.faults.append("the lift was set to 0 by a stop")


class Draft(_Webots):
    """For a robot of the document."""

    robot = "wc2ec-draft"
    kinds: ClassVar = {
        "change": lambda n: light(n, {"index": n % VALUES, "value": 1 + n / 1000}, 130, n % VALUES, 1 + n / 1000),
        "set": lambda n: light(n, {"values": [1 + n / 1000, -2.0, 0.5]}, 131, 1 + n / 1000, -2.0, 0.5),
        "enable": lambda n: light(n, {"enable": True}, 128),
        "disable": lambda n: light(n, {"enable": False}, 129),
        "refused": refused,
        "refused_draft": refused_draft,
    }
    weights: ClassVar = {**dict.fromkeys(kinds, 4), "stop": 1}

    def may_miss(self, arrival: Arrival) -> bool:
        return False


DIALECTS: dict[str, type[Run]] = {"deployed": Deployed, "draft": Draft}


def judge(dialect: str, *, commands: int, seed: int = 1) -> Judgement:
    """Judge one dialect."""
    return mixed.judged(DIALECTS[dialect], dialect, commands=commands, seed=seed)


def main() -> None:
    parser = mixed.options(__doc__)
    parser.add_argument("--dialect", choices=DIALECTS)
    wanted = parser.parse_args()
    dialects = [wanted.dialect] if wanted.dialect else DIALECTS
    report(judge(dialect, commands=wanted.commands, seed=wanted.seed) for dialect in dialects)


if __name__ == "__main__":
    main()
