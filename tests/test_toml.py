"""Files that are no robot's, and TOML that no program wrote: a reason in one line, and nobody waits."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from zbridge.app.config import load
from zbridge.errors import ConfigError
from zbridge.toml import FILE_BYTES, as_toml, parse_toml, read_file, read_toml


def fault(path: Path, most_bytes: int = FILE_BYTES) -> str:
    """Say why a file is not read, in one line that begins with its name."""
    with pytest.raises(ConfigError) as refused:
        read_toml(path, most_bytes)
    name, _, reason = str(refused.value).partition(": ")
    assert name == str(path)
    assert "\n" not in reason
    return reason


def test_a_fifo_and_a_device_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.toml")
    (tmp_path / "device.toml").symlink_to("/dev/zero")
    assert fault(tmp_path / "fifo.toml") == "expected a regular file"
    assert fault(tmp_path / "device.toml") == "expected a regular file"
    assert fault(tmp_path) == "expected a regular file"
    assert fault(tmp_path / "none.toml") == "No such file or directory"


def test_a_pipe_is_read_where_somebody_waits_for_it(tmp_path: Path) -> None:
    os.mkfifo(fifo := tmp_path / "fifo.toml")
    writer = threading.Thread(target=fifo.write_bytes, args=(b"a = 1",))
    writer.start()
    assert read_file(fifo, waits=True) == b"a = 1"
    writer.join()


def test_a_file_of_the_largest_size_is_read_and_a_larger_one_refused_with_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(100 * b"#")
    assert read_toml(path, 100) == {}
    assert fault(path, 99) == "100 bytes, expected 99 at most"
    path.write_text(f"a = [{3_000_000 * '1,'}]")
    assert fault(path) == f"6000006 bytes, expected {FILE_BYTES} at most"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a = " + 5_000 * b"1", "not TOML: Exceeds the limit"),
        (b"a = " + 20_000 * b"[", "not TOML: nested too deeply"),
        (b"a = " + 20_000 * b"{a=", "not TOML: nested too deeply"),
        (b"a = '\xff'", "not TOML: 'utf-8' codec can't decode byte 0xff"),
        (b"a = 2024-13-41", "not TOML: "),
        (b"nonsense", "not TOML: Expected"),
    ],
)
def test_what_cannot_be_parsed_is_told_in_one_line(content: bytes, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_toml(Path("a.toml"), content)
    assert str(refused.value).startswith(f"a.toml: {said}")
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("parts", [1001, 500_000])
def test_a_key_of_thousands_of_parts_is_a_fault_of_the_file(parts: int) -> None:
    with pytest.raises(ConfigError, match=r"a\.toml: not TOML: nested too deeply"):
        load(Path("a.toml"), content=b".".join(parts * [b"a"]) + b" = 1")


def test_a_key_of_hundreds_of_parts_is_read_but_no_table_goes_so_deep() -> None:
    with pytest.raises(ConfigError, match=r"a\.toml: nested too deeply"):
        load(Path("a.toml"), content=b".".join(1000 * [b"a"]) + b" = 1")


def test_a_wrong_value_is_shown_by_its_beginning() -> None:
    with pytest.raises(ConfigError) as refused:
        load(Path("a.toml"), content=b'[robot]\nname = "r1"\ncolours = [%s]' % (10_000 * b"1,"))
    assert str(refused.value).startswith("a.toml: robot.colours = [1, 1, 1")
    assert len(str(refused.value)) < 400


def test_the_content_that_was_read_counts_whatever_the_file_holds_now(tmp_path: Path) -> None:
    path = tmp_path / "r1.toml"
    path.write_text("nonsense")
    connect = b'[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:1"]\n'
    assert load(path, content=b'[robot]\nname = "r1"\n' + connect).config.robot.name == "r1"


def test_what_is_written_as_toml_is_read_as_it_was() -> None:
    value = {
        "names": ["r1", 'a "b"\\', "Gr\u00fc\u00dfe \U0001f916"],
        "at": {"x y": 0.5, "on": True, "many": [[1, 2], []]},
    }
    assert parse_toml(Path("a.toml"), f"value = {as_toml(value)}\n".encode()) == {"value": value}
    assert as_toml(("tls/a:1", "tls/b:2")) == '["tls/a:1", "tls/b:2"]'
