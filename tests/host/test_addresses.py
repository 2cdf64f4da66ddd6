"""Robot addresses, whose they are: real names in the kernel's abstract namespace, which other tests use at a time."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.ports import free_port
from zbridge.app import plan
from zbridge.app.config import GatewayPlan
from zbridge.errors import ConfigError
from zbridge.host import addresses
from zbridge.host.addresses import AddressLock, hold_addresses, holders, require_free, resolve
from zbridge.protocol.address import Address, DatagramAddress, SerialAddress, ZenohAddress, parse_device_address


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def held() -> Iterator[list[AddressLock]]:
    locks: list[AddressLock] = []
    yield locks
    for lock in locks:
        lock.close()


def robot(name: str, port: int, host: str = "127.0.0.1", **device: Any) -> GatewayPlan:
    connect = [f"tcp://{host}:{port}"]
    return plan({"robot": {"name": name}, "device": {"protocol": "tcpudp", "connect": connect, **device}})


def forms(text: str) -> set[str]:
    address = parse_device_address(text)
    return set(resolve([address])[address])


def test_ports_of_udp_are_the_robots_or_ours_and_none_of_tcp() -> None:
    for address, form in (
        (DatagramAddress("127.0.0.1", 7), {"udp 127.0.0.1 7"}),
        (DatagramAddress("0.0.0.0", 7, waits=True), {"udp-in 127.0.0.1 7"}),
        (DatagramAddress("127.0.0.1", 0), set[str]()),
    ):
        assert resolve([address])[address] == form


def test_an_address_is_the_same_however_it_is_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert forms("tcp://127.0.0.1:7") == {"tcp 127.0.0.1 7"} <= forms("tcp://localhost:7") & forms("tcp://LocalHost:7")
    assert forms("tcp://0.0.0.0:7") == forms("tcp://[::ffff:127.0.0.1]:7") == {"tcp 127.0.0.1 7"}
    assert forms("tcp://[::1]:7") == forms("tcp://[0:0::1]:7") == {"tcp ::1 7"}
    line = tmp_path / "ttyUSB0"
    line.touch()
    (tmp_path / "by-id").symlink_to(line)
    assert forms(f"serial://{tmp_path}/by-id?baud=9600") == forms(f"serial://{line}?baud=115200") == {f"serial {line}"}


def test_a_port_that_is_any_and_a_router_of_many_robots_are_nobodys() -> None:
    any_port, router = Address("127.0.0.1", 0), ZenohAddress("127.0.0.1", 7447)
    assert set(resolve([any_port, router]).values()) == {frozenset()}


def test_a_host_name_that_is_not_resolved_in_time_stands_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = threading.Event()

    def slow(host: str, *_: Any, **__: Any) -> list[Any]:
        if host == "slow.test":
            answers.wait(10.0)
        elif host == "none.test":
            raise socket.gaierror(-2, "Name or service not known")
        return [(0, 0, 0, "", ("192.0.2.7", 0))]

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    named = [Address(host, 7) for host in ("Slow.test", "slow.test", "none.test", "robot.test")]
    found = resolve(named, within_s=0.2)
    assert [set(found[address]) for address in named] == [
        {"tcp 192.0.2.7 7"},
        {"tcp slow.test 7"},
        {"tcp none.test 7"},
        {"tcp 192.0.2.7 7"},
    ]
    answers.set()


def test_the_first_robot_keeps_the_address_and_the_second_learns_who_has_it(held: list[AddressLock], port: int) -> None:
    form = f"tcp 127.0.0.1 {port}"
    first, second, standby = AddressLock("fleet", "r1"), AddressLock("fleet", "r2"), AddressLock("fleet", "r1")
    held += [first, second, standby]
    assert first.take([form]) is None
    other = second.take([form])
    assert other is not None
    assert (other.robot, other.pid, other.shares) == ("fleet/r1", os.getpid(), False)
    assert standby.take([form]) is None, "of the same robot: a standby, or a successor"
    first.close()
    assert second.take([form]) is not None
    standby.close()
    assert second.take([form]) is None
    assert AddressLock("fleet", "r2.").take([form]) is not None


def test_the_same_name_in_another_realm_is_another_robot(held: list[AddressLock], port: int) -> None:
    held += [AddressLock("hall1", "r1"), AddressLock("hall2", "r1")]
    assert held[0].take([f"tcp 127.0.0.1 {port}"]) is None
    assert held[1].take([f"tcp 127.0.0.1 {port}"]) is not None


def test_robots_share_an_address_only_where_both_say_so(held: list[AddressLock], port: int) -> None:
    form = f"tcp 127.0.0.1 {port}"
    shares, too = AddressLock("fleet", "r1", shares=True), AddressLock("fleet", "r2", shares=True)
    alone = AddressLock("fleet", "r3")
    held += [shares, too, alone]
    assert shares.take([form]) is too.take([form]) is None
    assert alone.take([form]) is not None
    shares.close()
    too.close()
    assert alone.take([form]) is None
    assert too.take([form]) is not None


def test_very_long_names_are_told_apart(held: list[AddressLock], port: int) -> None:
    form, name = f"tcp 127.0.0.1 {port}", 200 * "r"
    held += [AddressLock("fleet", name + "1"), AddressLock("fleet", name + "1"), AddressLock("fleet", name + "2")]
    assert held[0].take([form]) is held[1].take([form]) is None
    assert held[2].take([form]) is not None


def test_nothing_is_held_of_an_address_in_several_forms_of_which_one_is_taken(
    held: list[AddressLock], port: int
) -> None:
    held += [AddressLock("fleet", "r1"), AddressLock("fleet", "r2")]
    assert held[0].take([f"tcp ::1 {port}"]) is None
    assert held[1].take([f"tcp 127.0.0.1 {port}", f"tcp ::1 {port}"]) is not None
    assert holders(f"tcp 127.0.0.1 {port}") == []


def test_the_hold_of_a_process_that_is_killed_goes_with_it(port: int) -> None:
    form = f"tcp 127.0.0.1 {port}"
    code = (
        "import sys, time; from zbridge.host.addresses import AddressLock\n"
        f"lock = AddressLock('fleet', 'r1'); lock.take(['{form}']); print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        assert [(found.robot, found.pid) for found in holders(form)] == [("fleet/r1", process.pid)]
        process.kill()
        process.wait()
    assert holders(form) == []


def test_of_many_that_take_an_address_at_the_same_moment_one_has_it(port: int) -> None:
    code = (
        "import sys; from zbridge.host.addresses import AddressLock\n"
        "lock = AddressLock('fleet', sys.argv[1]); print('up', flush=True); sys.stdin.readline()\n"
        f"print(lock.take(['tcp 127.0.0.1 {port}']) is None, flush=True); sys.stdin.readline()"
    )
    command, pipe = [sys.executable, "-c", code], subprocess.PIPE
    processes = [subprocess.Popen([*command, f"r{n}"], stdin=pipe, stdout=pipe, text=True) for n in range(6)]
    for process in processes:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    answers = [process.stdout.readline() for process in processes if process.stdout is not None]
    for process in processes:
        process.communicate("\n")
    assert sorted(answers) == 5 * ["False\n"] + ["True\n"]


# Gateways


async def test_a_gateway_of_another_name_is_refused_with_the_key_the_name_and_what_to_do(port: int) -> None:
    async with hold_addresses(robot("r1", port)):
        for second in (robot("r2", port), robot("r2", port, host="localhost")):
            with pytest.raises(ConfigError) as refused:
                require_free(second)
            assert str(refused.value) == (
                f"device.connect = {[*second.config.device.connect]!r}: expected an address of its own: fleet/r1"  # type: ignore[union-attr]
                f" (process {os.getpid()}) serves it on this machine. Where the robot accepts several clients:"
                " device.allow_shared_address = true in both"
            )
        require_free(robot("r1", port))
        require_free(robot("r2", port + 1))
    require_free(robot("r2", port))


async def test_a_gateway_waits_for_one_that_is_just_leaving_and_no_longer(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    leaving = AddressLock("fleet", "r1")
    assert leaving.take([f"tcp 127.0.0.1 {port}"]) is None
    asyncio.get_running_loop().call_later(0.05, leaving.close)
    async with hold_addresses(robot("r2", port)):
        monkeypatch.setattr(addresses, "LEAVE_S", 0.0)
        with pytest.raises(ConfigError, match="fleet/r2"):
            async with hold_addresses(robot("r3", port)):
                pass


async def test_a_robot_that_accepts_several_clients_is_served_under_several_names(port: int) -> None:
    async with (
        hold_addresses(robot("r1", port, allow_shared_address=True)),
        hold_addresses(robot("r2", port, allow_shared_address=True)),
    ):
        with pytest.raises(ConfigError):
            require_free(robot("r3", port))


def test_a_serial_line_has_no_host_to_resolve() -> None:
    assert resolve([SerialAddress("/dev/null", 9600)]) == {SerialAddress("/dev/null", 9600): {"serial /dev/null"}}
