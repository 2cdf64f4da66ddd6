"""``zbridge check``: one file, or a directory as ``zbridge run DIR`` would run it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.certificates import Authority
from zbridge.cli.check import check
from zbridge.errors import ConfigError

HQ = '[[hq]]\nprotocol = "tcpudp"\nlisten = "tcp://127.0.0.1:11002"\n'


def robot(name: str, port: int = 11001, more: str = "") -> str:
    device = f'[device]\nprotocol = "tcpudp"\nconnect = ["tcp://10.0.0.7:{port}"]\n'
    return f'[robot]\nname = "{name}"\n{device}{more}'


def written(folder: Path, **files: str) -> Path:
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    return folder


Captured = pytest.CaptureFixture[str]


def test_each_file_of_a_directory_is_a_line(tmp_path: Path, capsys: Captured) -> None:
    written(
        tmp_path, host="[host]\nstagger_s = 1.0\n", r1=robot("r1"), r2=robot("r2", 2), desk='[robot]\nname="d"\n' + HQ
    )
    assert check(tmp_path)
    out, err = capsys.readouterr()
    assert (out.splitlines(), err) == (
        [
            f"{tmp_path}/host.toml: ok",
            f"{tmp_path}/desk.toml: ok: fleet/d, tcpudp HQ programs at tcp://127.0.0.1:11002, bus as peer",
            f"{tmp_path}/r1.toml: ok: fleet/r1, tcpudp at tcp://10.0.0.7:11001, bus as peer",
            f"{tmp_path}/r2.toml: ok: fleet/r2, tcpudp at tcp://10.0.0.7:2, bus as peer",
        ],
        "",
    )


@pytest.mark.parametrize(
    ("files", "faults"),
    [
        ({"a": "robot = 1"}, ["a.toml: robot = 1: expected `object`, got `int`"]),
        ({"a": robot("r1"), "b": robot("r1", 2)}, ["b.toml: robot.name = 'r1': expected another name than that of"]),
        ({"a": robot("r1"), "b": robot("r2")}, ["b.toml: device.connect: expected another address than that of"]),
        (
            {"a": robot("r1", 1, HQ), "b": robot("r2", 2, HQ)},
            ["b.toml: hq[0].listen = 'tcp://127.0.0.1:11002': expected"],
        ),
        ({"host": "[host]\nstagger_s = -1", "a": robot("r1")}, ["host.toml: host.stagger_s = -1: expected"]),
        ({"host": "[host]\nfile_bytes = 1000", "a": robot("r1") + 1000 * "#"}, ["a.toml: 1", "expected 1000 at most"]),
        (
            {"host": "[host]\ntogether = true", "a": robot("r1"), "b": robot("r2", 2, "[bus]\nmulticast = false")},
            ["b.toml: bus: expected the same as in"],
        ),
    ],
)
def test_a_faulty_file_of_a_directory_is_named_and_the_others_are_checked(
    tmp_path: Path, capsys: Captured, files: dict[str, str], faults: list[str]
) -> None:
    assert not check(written(tmp_path, **files))
    out, err = capsys.readouterr()
    assert len(err.splitlines()) == 1
    assert err.startswith(f"zbridge: {tmp_path}/{faults[0]}")
    assert all(fault in err for fault in faults)
    assert len(out.splitlines()) == len(files) - 1


def test_a_directory_without_robot_files_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no robot file"):
        check(written(tmp_path, host="[host]\n"))


def test_json_says_what_a_file_would_run_or_what_is_wrong(tmp_path: Path, capsys: Captured) -> None:
    folder = Authority(tmp_path / "lab").issue("gateway.r1")
    secure = f'[bus]\nconnect = ["tls/hub.lab:7447"]\ntls = {{ ca = "{folder}/ca.pem", certificate = "{folder}/'
    secure += f'certificate.pem", key = "{folder}/key.pem" }}\n'
    assert not check(written(tmp_path, a=robot("r1", 1, HQ + secure), b="[robot]"), as_json=True)
    out, err = capsys.readouterr()
    good, bad = map(json.loads, out.splitlines())
    assert err == ""
    assert good.pop("certificate")["name"] == "gateway.r1"
    assert "ends on" in good.pop("warning")
    assert good == {
        "file": f"{tmp_path}/a.toml",
        "ok": True,
        "error": None,
        "realm": "fleet",
        "robot": "r1",
        "device": {"protocol": "tcpudp", "connect": ["tcp://10.0.0.7:1"]},
        "camera": None,
        "hq": [{"protocol": "tcpudp", "listen": "tcp://127.0.0.1:11002"}],
        "bus": "client",
    }
    assert bad == {
        "file": f"{tmp_path}/b.toml",
        "ok": False,
        "error": f"{tmp_path}/b.toml: robot.name: missing, it is required",
        "warning": None,
    }
