"""``zbridge check``: what configurations would run, or what is wrong with them. Contacts nobody."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from zbridge.app import GatewayPlan, load
from zbridge.bus.tls.certificate import Certificate
from zbridge.bus.tls.files import ends_soon, out_of_date, utc_now
from zbridge.cli import hand_on_tls
from zbridge.cli.terminal import console, errors
from zbridge.errors import ConfigError
from zbridge.fleet.printable import as_json as to_json
from zbridge.fleet.printable import shown
from zbridge.host.addresses import require_free
from zbridge.host.files import RobotFile, compare, located, read
from zbridge.host.settings import (
    HOST_FILE,
    HostSettings,
    load_host,
    require_different_robots,
    require_one_bus,
    robot_files,
)
from zbridge.metrics import Metrics
from zbridge.security.member import check_member, not_checked
from zbridge.toml import prefixed


class Checked(msgspec.Struct):
    """One file. error: why nothing can run by it, with the file's name; of a sound file what it would run."""

    file: str
    error: str | None = None
    plan: GatewayPlan | None = None
    certificate: Certificate | None = None

    def fields(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        found = {"file": self.file, "ok": self.error is None, "error": self.error, "warning": self.warning()}
        if self.plan is None or self.error is not None:
            return found
        plan, certificate = self.plan, self.certificate
        device = plan.device and {
            "protocol": plan.device.protocol.name,
            "connect": [str(address) for address in plan.device.addresses],
        }
        listeners = [{"protocol": each.protocol.name, "listen": str(each.address)} for each in plan.listeners]
        return found | {
            "realm": plan.config.robot.realm,
            "robot": plan.config.robot.name,
            "device": device,
            "camera": plan.camera and str(plan.camera.source),
            "hq": listeners,
            "bus": plan.config.bus.effective_mode,
            "certificate": certificate and {"name": certificate.common_name, "ends": certificate.ends.isoformat()},
        }

    def line(self) -> str:
        """Say what a sound file would run."""
        if self.plan is None:
            return f"{self.file}: ok"
        owner = self.certificate
        valid = f", certificate of {owner.common_name} until {owner.ends:%Y-%m-%d}" if owner is not None else ""
        return f"{self.file}: ok: {self.plan.described}{valid}"

    def warning(self) -> str | None:
        """Return what will soon be wrong."""
        warning = ends_soon(self.certificate, utc_now()) if self.certificate is not None and not self.error else None
        return f"{self.file}: warning: {warning}" if warning else None


def check(path: Path, tls: Path | None = None, *, as_json: bool = False) -> bool:
    """Check a file, or all files of a directory; print a line for each, faults to stderr; return whether all are sound.

    Raises ConfigError for a directory without robot files.
    """
    directory = path.is_dir()
    results = _check_directory(path, tls) if directory else [_check_file(path, tls=tls)]
    for each in results:
        if as_json:
            console.print(to_json(each.fields()))
            continue
        if each.error is not None:
            errors.print(shown(f"zbridge: {each.error}"))
            continue
        console.print(shown(each.line()))
        if warning := each.warning():
            errors.print(shown(warning))
        if each.plan is not None and each.certificate is not None and not directory:
            console.print(shown(f"{each.file}: {not_checked(each.plan, each.certificate)}"))
    return all(each.error is None for each in results)


def _check_file(file: Path, *, tls: Path | None = None, content: bytes | None = None) -> Checked:
    checked = Checked(str(file))
    try:
        plan = checked.plan = load(file, tls=tls, content=content)
        with prefixed(f"{file}: "):
            require_free(plan)
            certificate = checked.certificate = check_member(plan)
            if plan.device is not None:
                plan.device.make_robot(Metrics())
            if certificate is not None and (problem := out_of_date(certificate, utc_now())):
                raise ConfigError(problem)
    except ConfigError as error:
        checked.error = str(error)
    return checked


def _check_directory(directory: Path, tls: Path | None) -> list[Checked]:
    """Check ``host.toml`` and all robot files, each by itself and beside the others, as ``zbridge run DIR`` does."""
    hand_on_tls(tls)
    results, host = list[Checked](), HostSettings()
    if (directory / HOST_FILE).exists():
        results.append(Checked(str(directory / HOST_FILE)))
        try:
            host = load_host(directory).host
        except ConfigError as error:
            results[0].error = str(error)
    files = [read(path, host.file_bytes) for path in robot_files(directory)]
    if not files:
        raise ConfigError(f"{directory}: no robot file (*.toml)")
    faults = {file.path: file.fault for file in _compared(files)}
    robots = [
        Checked(str(file.path), faults[file.path])
        if file.path in faults
        else _check_file(file.path, content=file.content)
        for file in files
    ]
    _check_together(robots, host)
    return results + robots


def _compared(files: Iterable[RobotFile]) -> tuple[RobotFile, ...]:
    """Return the files that are faulty by themselves, or name a robot or an address of one before them."""
    return compare({}, located(files)).faulty


def _check_together(robots: Iterable[Checked], host: HostSettings) -> None:
    """Note what sound files have in common that they must not, or must have."""
    sound = {f"{each.file}: ": each for each in robots if each.error is None}
    plans = [(Path(each.file), each.plan) for each in sound.values() if each.plan is not None]
    try:
        require_different_robots(plans)
        if host.together:
            require_one_bus(plans)
    except ConfigError as error:
        for begin, each in sound.items():
            if str(error).startswith(begin):
                each.error = str(error)
