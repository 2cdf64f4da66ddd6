"""A real fork server, as a process of its own; what it forks is the gateway of a file that is not there."""

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from zbridge.errors import NotReady
from zbridge.host import fork_client as module
from zbridge.host.fd_channel import FdChannel, Fork, in_memory
from zbridge.host.fork_client import ForkClient, fork_server_command, installed
from zbridge.host.replacement import SupervisorState, encode
from zbridge.host.supervisor import become_reaper

SOON_S = 30.0


@contextlib.asynccontextmanager
async def forks(command: list[str] | None = None) -> AsyncIterator[ForkClient]:
    made = ForkClient(command or fork_server_command())
    try:
        yield made
    finally:
        made.close()


async def ended(pid: int) -> int:
    """Wait for the end of a child, and give its exit code."""
    async with asyncio.timeout(SOON_S):
        while True:
            found, status = os.waitpid(pid, os.WNOHANG)  # noqa: ASYNC222 - does not wait
            if found:
                return os.waitstatus_to_exitcode(status)
            await asyncio.sleep(0.01)


async def forked(made: ForkClient, file: Path, content: bytes = b"") -> int:
    """Fork the gateway of a file with this content; nobody listens to what it tells."""
    channel, far = FdChannel.pair()
    with far, contextlib.closing(channel):
        return await made.fork(Fork(str(file), "r1"), far, content)


async def test_a_forked_gateway_is_a_child_of_ours_and_shows_its_end(tmp_path: Path, capfd) -> None:
    become_reaper()
    async with forks() as made:
        pids = [await forked(made, tmp_path / f"r{number}.toml") for number in range(2)]
        assert [await ended(pid) for pid in pids] == [2, 2], "the exit code of a faulty configuration"
    said = capfd.readouterr().err
    assert said.count("robot: missing, it is required") == 2, said
    assert "Traceback" not in said


async def test_a_protocol_that_cannot_be_loaded_stops_no_gateway_of_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = tmp_path / "torn-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: torn\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[zbridge.protocols]\ntorn = torn:PROTOCOL\n")
    (tmp_path / "torn.py").write_text("import sys\nsys.exit(5)\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH")))))
    become_reaper()
    async with forks() as made:
        assert await ended(await forked(made, tmp_path / "r1.toml")) == 2


async def test_a_forked_gateway_runs_by_the_content_that_it_is_given_not_by_what_the_file_holds(
    tmp_path: Path, capfd
) -> None:
    become_reaper()
    file = tmp_path / "r1.toml"
    file.write_text("of = 'the file'\n")
    content = b"large = '%s'\ngiven = 1\n" % (200_000 * b"x")
    async with forks() as made:
        assert await ended(await forked(made, file, content)) == 2
    assert "large = 'xxx" in capfd.readouterr().err


async def test_without_a_free_descriptor_no_gateway_is_forked_and_the_reason_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str) -> int:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(os, "memfd_create", fail)
    async with forks() as made:
        with pytest.raises(NotReady, match="no memory for a file: Too many open files"):
            await forked(made, tmp_path / "r1.toml")


async def test_a_fork_server_says_whether_its_code_takes_the_state_of_a_supervisor() -> None:
    async with forks() as made:
        with in_memory("state", encode(SupervisorState(("robots",), at=1.0))) as state:
            await made.rehearse(state)
        with in_memory("state", b"\0") as state, pytest.raises(NotReady, match="no state of a supervisor"):
            await made.rehearse(state)


async def test_a_fork_server_whose_code_is_broken_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    async with forks(["false"]) as made:
        with pytest.raises(NotReady, match="did not start"):
            await made.renew()
    async with forks(["/no/such/program"]) as made:
        with pytest.raises(NotReady, match="No such file"):
            await made.renew()


async def test_a_changed_installation_gets_a_server_of_its_own_and_a_broken_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = [(b"one", True)]
    monkeypatch.setattr(module, "installed", lambda: stamps[-1])
    become_reaper()

    def changes(*, settled: bool = True) -> None:
        stamps.append((b"%d" % len(stamps), settled))

    async def server(prepare: Callable[[], object] = lambda: None) -> int | None:
        prepare()
        await made.renew()
        return made.pid

    command = fork_server_command()
    async with forks(command) as made:
        first = await server()
        assert await server() == first
        assert await server(lambda: changes(settled=False)) == first, "an installer is at work"
        second = await server(changes)
        assert second != first
        command[:] = ["false"]
        assert await server(changes) == second
        assert "the old code continues" in caplog.text
        assert await ended(await forked(made, tmp_path / "none.toml")) == 2


def test_the_stamp_of_an_installation_changes_with_its_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from zbridge.host import fork_client as installation

    monkeypatch.setattr(installation, "HOME", tmp_path)
    source = tmp_path / "code.py"
    source.write_text("a = 1\n")
    os.utime(source, (1e9, 1e9))
    before, _ = installed()
    assert before == installed()[0]
    source.write_text("a = 22\n")
    after, settled = installed()
    assert after != before
    assert not settled
