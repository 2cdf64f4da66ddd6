from __future__ import annotations

from pathlib import Path

import pytest

from zbridge.app import plan
from zbridge.app.config import LogSettings
from zbridge.errors import ConfigError
from zbridge.host.settings import (
    HostFile,
    HostSettings,
    load_host,
    require_different_robots,
    require_one_bus,
    robot_files,
)


def robot(name: str, port: int = 0, **tables: object) -> tuple[Path, object]:
    raw = {
        "robot": {"name": name},
        "hq": [{"protocol": "tcpudp", "listen": f"tcp://127.0.0.1:{port}"}],
        **tables,
    }
    return Path(f"{name}-{port}.toml"), plan(raw)


def test_a_directory_without_a_host_file_has_the_defaults(tmp_path: Path) -> None:
    assert load_host(tmp_path).host == HostSettings()


def test_the_host_file_is_read_and_is_no_robots(tmp_path: Path) -> None:
    (tmp_path / "host.toml").write_text("[host]\ntogether = true\nstagger_s = 0.1\n")
    for name in ("b.toml", "a.toml", "notes.txt"):
        (tmp_path / name).touch()
    assert load_host(tmp_path).host == HostSettings(together=True, stagger_s=0.1)
    assert [path.name for path in robot_files(tmp_path)] == ["a.toml", "b.toml"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[host]\ntogehter = true\n", "host.togehter = True: unknown key"),
        ("[hots]\n", "hots = {}: unknown key"),
        ("[host]\nstagger_s = -1\n", "host.stagger_s = -1: expected `float` >= 0.0"),
        ("[host]\nshare = 0\n", "host.share = 0: expected `float` > 0.0"),
        ("host", "not TOML"),
    ],
)
def test_what_is_wrong_in_the_host_file_is_said_with_file_key_and_value(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "host.toml").write_text(text)
    with pytest.raises(ConfigError) as error:
        load_host(tmp_path)
    assert str(error.value).startswith(f"{tmp_path}/host.toml: ")
    assert said in str(error.value)


def test_a_directory_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        robot_files(tmp_path / "none")


def test_two_files_with_one_robot_or_one_address_are_refused() -> None:
    require_different_robots([robot("r1", 1), robot("r2", 2), robot("r3"), robot("r4")])
    with pytest.raises(ConfigError, match=r"r1-2\.toml: robot\.name = 'r1': expected another name than r1-1.toml's"):
        require_different_robots([robot("r1", 1), robot("r1", 2)])
    with pytest.raises(ConfigError, match=r"r2-1.toml: hq\[0\].listen = .*: expected another address than r1-1.toml's"):
        require_different_robots([robot("r1", 1), robot("r2", 1)])


def test_two_files_with_one_address_of_a_robot_are_refused_unless_both_share_it() -> None:
    def at(host: str, **more: object) -> dict[str, object]:
        return {"device": {"protocol": "tcpudp", "connect": [f"tcp://{host}:11001"], **more}}

    shared = {"allow_shared_address": True}
    require_different_robots([robot("r1", **at("127.0.0.1")), robot("r2", **at("127.0.0.2"))])
    require_different_robots([robot("r1", **at("127.0.0.1", **shared)), robot("r2", **at("127.0.0.1", **shared))])
    for more in ({}, shared):
        with pytest.raises(
            ConfigError, match=r"r2-0\.toml: device\.connect: expected another address than that of r1-0"
        ):
            require_different_robots([robot("r1", **at("127.0.0.1")), robot("r2", **at("localhost", **more))])


def test_robots_that_share_a_session_have_one_bus() -> None:
    router = {"connect": ["tcp/127.0.0.1:7447"]}
    require_one_bus([robot("r1", bus=router), robot("r2", bus=router)])
    with pytest.raises(ConfigError, match=r"r2-0\.toml: bus: expected the same as in r1-0\.toml"):
        require_one_bus([robot("r1", bus=router), robot("r2")])


def test_the_documented_file_has_the_defaults(tmp_path: Path) -> None:
    documented = Path(__file__).parents[2] / "deploy" / "config" / "host.toml"
    (tmp_path / "host.toml").write_text(documented.read_text())
    assert load_host(tmp_path) == HostFile()
    for field in (*HostSettings.__struct_fields__, *(f"# {name}" for name in LogSettings.__struct_fields__)):
        assert f"\n{field} = " in documented.read_text()


def test_an_address_of_the_metrics_that_is_none_is_an_error_that_names_file_and_key(tmp_path: Path) -> None:
    (tmp_path / "host.toml").write_text('[metrics]\nlisten = "9100"\n')
    with pytest.raises(ConfigError, match=r"host.toml: metrics.listen = '9100': expected host:port"):
        load_host(tmp_path)
