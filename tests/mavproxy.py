"""MAVProxy, unmodified, drives a simulated Webots robot through a real gateway.

What it prints is checked, and how the robot really moves.

    python -m tests.mavproxy                          # installs MAVProxy first, in an environment of its own
    python -m tests.mavproxy --environment ~/mavproxy # that is there, or made there
    python -m tests.mavproxy --log                    # shows what it printed, too

Not a part of the suite: MAVProxy (GPLv3) has 1.2 GB of dependencies. 0.35 GB do for what is used here; this command
installs them, below the temporary directory, where nothing is yet:

    python -m venv DIR
    DIR/bin/pip install --no-deps MAVProxy pymavlink pyserial defusedxml numpy lxml fastcrc

The exit code is 1 where anything was not as expected.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Callable
from pathlib import Path

from tests.e2e.conftest import HOST, end, until
from tests.e2e.rigs.ground_stations import FULL_M_S, FULL_RAD_S, GroundStationScene
from tests.e2e.rigs.loss import LATE_S

PACKAGES = ("MAVProxy", "pymavlink", "pyserial", "defusedxml", "numpy", "lxml", "fastcrc")
MODULES = "mode,arm,rc,param,ftp,cmdlong,link"
DEADMAN_S = 0.5
SILENT_S = DEADMAN_S + LATE_S + 0.02
"""Seconds until the robot, which tells once a step, must be told to stand still when nothing is heard any more."""
LINKS: dict[str, Callable[[GroundStationScene], str]] = {
    "tcp": lambda scene: f"tcp:{HOST}:{scene.tcp}",
    "udp": lambda scene: f"udpout:{HOST}:{scene.udp}",
    "spoken": lambda scene: f"udpin:{HOST}:{scene.desk}",
}
"""How MAVProxy connects; ``spoken``: by UDP, and the gateway speaks first."""
SETTLE_S = 0.6
"""Seconds between arming and motion, as a person takes: once it is armed, the stick must be seen at rest for 0.3 s."""
PARAMS_S = 10.0
"""Seconds for the parameters: it asks after 3 s."""


Check = Callable[[GroundStationScene, "MavProxy"], None]


class MavProxy:
    """A running MAVProxy: commands go in, and all that it prints is read."""

    def __init__(self, stack: contextlib.ExitStack, environment: Path, folder: Path, master: str) -> None:
        self._log, self._read = folder / "mavproxy.log", 0
        command = [
            *(str(environment / "bin" / "python"), str(environment / "bin" / "mavproxy.py")),
            *("--master", master, "--state-basedir", str(folder), f"--default-modules={MODULES}"),
        ]
        log = stack.enter_context(self._log.open("w"))
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, text=True, cwd=folder
        )
        stack.callback(self.kill)

    @property
    def printed(self) -> str:
        """Everything that it has printed."""
        return self._log.read_text(errors="replace")

    def prints(self, text: str, within_s: float = 10.0) -> None:
        """Wait until it prints a text after the last command."""

        def there() -> bool:
            if self._process.poll() is not None:
                raise AssertionError(f"MAVProxy ended with {self._process.returncode}")
            return text in self.printed[self._read :]

        until(there, within_s, f"MAVProxy prints {text!r}")

    def type(self, command: str) -> None:
        """Type a line."""
        self._read = len(self.printed)
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def kill(self) -> None:
        """Kill it; idempotent."""
        self._process.kill()
        end(self._process)


def drive(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Arm, and push the throttle."""
    for channel in (1, 3):
        proxy.type(f"rc {channel} 1500")
    proxy.type("mode manual")
    proxy.prints("DO_SET_MODE: ACCEPTED")  # modes are told every two seconds at most
    proxy.type("arm throttle")
    proxy.prints("COMPONENT_ARM_DISARM: ACCEPTED")
    proxy.prints("ARMED")
    time.sleep(SETTLE_S)
    proxy.type("rc 3 1700")
    scene.drives(0.4 * FULL_M_S, 0.0)


def sees_it(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Detect the vehicle, and receive all parameters."""
    proxy.prints("Detected vehicle 7:1", 5.0)
    proxy.prints("Mode HOLD")
    proxy.prints("Received ", PARAMS_S)
    proxy.prints(" parameters")


def drives_it(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Drive ahead, to the right, backward and to the left."""
    drive(scene, proxy)
    proxy.type("rc 1 1600")
    scene.drives(0.4 * FULL_M_S, -0.2 * FULL_RAD_S)
    proxy.type("rc 3 1300")
    scene.drives(-0.4 * FULL_M_S, -0.2 * FULL_RAD_S)
    proxy.type("rc 1 1400")
    scene.drives(-0.4 * FULL_M_S, 0.2 * FULL_RAD_S)


def holds_it(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Stop by the mode HOLD, and not arm while the throttle is pushed."""
    asked = time.monotonic()
    proxy.type("mode hold")
    proxy.prints("DO_SET_MODE: ACCEPTED")
    proxy.prints("DISARMED")
    assert scene.robot.stopped(asked, 1.0) < 1.0, "the stop is late"  # MAVProxy reads its commands ten times a second
    scene.free()
    proxy.type("arm throttle")
    proxy.prints("COMPONENT_ARM_DISARM: FAILED")
    assert scene.robot.still(), "it moves"


def disarms_it(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Stop by DISARM."""
    drive(scene, proxy)
    asked = time.monotonic()
    proxy.type("disarm")
    proxy.prints("COMPONENT_ARM_DISARM: ACCEPTED")
    proxy.prints("DISARMED")
    assert scene.robot.stopped(asked, 1.0) < 1.0, "the stop is late"
    scene.free()


def is_refused(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Be refused, with the holder's name, while another program holds the robot; drive when that has left."""
    scene.bench.fleet.hold("r1", "desk", lease_s=2.0)
    until(lambda: scene.control["holder"] == "desk", what="the holder is shown")
    for channel in (1, 3):
        proxy.type(f"rc {channel} 1500")
    proxy.type("arm throttle")
    proxy.prints("COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED")
    proxy.prints("desk")
    proxy.type("mode manual")
    proxy.prints("DO_SET_MODE: TEMPORARILY_REJECTED")
    scene.bench.fleet.release("r1")
    scene.free()
    drive(scene, proxy)


def is_frozen(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Stop when MAVProxy hangs; the throttle that it repeats afterwards moves nothing."""
    assert not scene.robot.still()
    frozen = time.monotonic()
    proxy.signal(signal.SIGSTOP)
    scene.stops(frozen, SILENT_S)
    proxy.signal(signal.SIGCONT)
    thawed = time.monotonic()
    time.sleep(DEADMAN_S)
    assert scene.robot.still(thawed), "it moves on by itself"
    proxy.type("mode hold")
    proxy.prints("DO_SET_MODE: ACCEPTED")
    scene.free()
    drive(scene, proxy)


def is_lost(scene: GroundStationScene, proxy: MavProxy) -> None:
    """Stop when MAVProxy is killed."""
    killed = time.monotonic()
    proxy.kill()
    scene.stops(killed, SILENT_S)


CHECKS: tuple[Check, ...] = (*(sees_it, drives_it, holds_it, disarms_it, is_refused, is_frozen, is_lost),)


def installed(environment: Path) -> Path:
    """Install MAVProxy where it is not there yet."""
    if not (environment / "bin" / "mavproxy.py").exists():
        print(f"installing {', '.join(PACKAGES)} in {environment}", flush=True)
        venv.create(environment, with_pip=True)
        subprocess.run([environment / "bin" / "pip", "install", "--quiet", "--no-deps", *PACKAGES], check=True)
    return environment


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    own = Path(tempfile.gettempdir()) / "zbridge-mavproxy"
    parser.add_argument("--environment", type=Path, default=own, metavar="DIR")
    parser.add_argument("--link", action="append", choices=LINKS, help="default: one after the other")
    parser.add_argument("--log", action="store_true", help="show what MAVProxy printed")
    wanted = parser.parse_args()
    environment = installed(wanted.environment)
    results = [run(environment, link, log=wanted.log) for link in wanted.link or LINKS]
    sys.exit(not all(results))


def run(environment: Path, link: str, *, log: bool) -> bool:
    """Let MAVProxy do all of it by one link; tell whether it did."""
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        scene = GroundStationScene(Path(folder), stack, "wc2ec")
        proxy = MavProxy(stack, environment, Path(folder), LINKS[link](scene))
        went_well = all(_judge(check, scene, proxy, link) for check in CHECKS)
        if log or not went_well:
            print(proxy.printed)
        if not went_well:
            print(scene.gateway.log)
        return went_well


def _judge(check: Check, scene: GroundStationScene, proxy: MavProxy, link: str) -> bool:
    began = time.monotonic()
    try:
        check(scene, proxy)
    except AssertionError as error:
        print(f"FAILED {link} {check.__name__}: {error}", flush=True)
        return False
    print(f"ok {link} {check.__name__} ({time.monotonic() - began:.1f} s): {check.__doc__}", flush=True)
    return True


if __name__ == "__main__":
    main()
