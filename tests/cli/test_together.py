from __future__ import annotations

from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest

from zbridge import cli
from zbridge.app.config import LogSettings
from zbridge.errors import ConfigError
from zbridge.host.settings import HostFile, HostSettings
from zbridge.host.together import Together

ROBOT = '[robot]\nname = "{0}"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://{0}.test:1"]\n{1}'
HOST = HostFile(HostSettings(together=True))


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[set[str]]:
    """The robots that were to be served, instead of serving them."""
    served: list[set[str]] = []

    def run_loop(work: Coroutine[Any, Any, Any]) -> None:
        work.close()

    async def run(self: Together) -> None:
        """Never awaited."""

    def until_signal(work: Coroutine[Any, Any, None]) -> Coroutine[Any, Any, None]:
        return work

    made = Together.__init__

    def init(self: Together, plans: dict[str, Any], host: HostSettings, **more: Any) -> None:
        made(self, plans, host, **more)
        served.append(set(plans))

    monkeypatch.setattr(cli, "run_loop", run_loop)
    monkeypatch.setattr(cli, "until_signal", until_signal)
    monkeypatch.setattr(Together, "__init__", init)
    monkeypatch.setattr("zbridge.cli.gc.freeze", lambda: None)
    return served


def written(folder: Path, **files: str) -> list[Path]:
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    return [folder / f"{name}.toml" for name in files]


def test_a_faulty_file_is_reported_and_the_other_robots_run(tmp_path: Path, served, caplog) -> None:
    cli.run_together(written(tmp_path, a=ROBOT.format("r1", ""), b="[robto]", c=ROBOT.format("r3", "")), HOST)
    assert served == [{"r1", "r3"}]
    assert "b.toml: robto = {}: unknown key" in caplog.text


JSON = '[log]\nformat = "json"\n'


@pytest.mark.parametrize(
    ("host", "files", "form"),
    [
        (LogSettings(), (JSON, JSON), "json"),
        (LogSettings(), (JSON, ""), None),
        (LogSettings("console"), (JSON, JSON), "console"),
    ],
    ids=["as all files say", "the files differ", "as the host says"],
)
def test_robots_of_one_process_have_one_log(
    host: LogSettings, files: tuple[str, str], form: str | None, tmp_path: Path, served, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[LogSettings] = []
    monkeypatch.setattr(cli, "set_up_log", lambda *, verbose, settings: asked.append(settings))
    first, second = (ROBOT.format(name, more) for name, more in zip(("r1", "r2"), files, strict=True))
    cli.run_together(written(tmp_path, a=first, b=second), HostFile(HOST.host, host))
    assert asked[-1].format == form


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"a": "[robto]"}, "a.toml: robto = {}: unknown key"),
        (
            {"a": ROBOT.format("r1", ""), "b": ROBOT.format("r1", "")},
            "b.toml: robot.name = 'r1': expected another name",
        ),
        (
            {"a": ROBOT.format("r1", ""), "b": ROBOT.format("r2", "").replace("r2.test", "r1.test")},
            "b.toml: device.connect: expected another address than that of",
        ),
        (
            {"a": ROBOT.format("r1", ""), "b": ROBOT.format("r2", '[bus]\nconnect = ["tcp/127.0.0.1:1"]')},
            "b.toml: bus: expected the same as in",
        ),
    ],
    ids=["no robot is left", "one robot twice", "one address twice", "two buses"],
)
def test_what_cannot_run_together_is_refused(tmp_path: Path, served, files: dict[str, str], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        cli.run_together(written(tmp_path, **files), HOST)
    assert said in str(error.value)
    assert served == []
