"""Robot files that come, change and go, as real files."""

import os
from pathlib import Path

import pytest

from zbridge.errors import ConfigError
from zbridge.host import files
from zbridge.host.files import Changes, Follower, RobotFile, paths_of, read, read_all
from zbridge.toml import FILE_BYTES


def write(folder: Path, name: str, robot: str = "", port: int = 0, more: str = "", host: str = "127.0.0.1") -> Path:
    """Write a robot's file; port 0: one of the name's own."""
    path = folder / f"{name}.toml"
    connect = f'connect = ["tcp://{host}:{port or 11000 + ord(name[0]) - 96}"]'
    path.write_text(f'[robot]\nname = "{robot or name}"\n[device]\nprotocol = "tcpudp"\n{connect}\n{more}')
    return path


class Scene:
    """A directory that is followed, and what runs by it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.follower = Follower((folder,))
        self.running: dict[Path, RobotFile] = {}

    def poll(self, *, twice: bool = False) -> dict[str, list[str]]:
        """ReadPayload, and do what the changes ask for; give the names of the files."""
        changes = self.follower.poll(self.running, twice=twice)
        for old, file in changes.moved:
            del self.running[old]
            self.running[file.path] = file
        for path in changes.gone:
            del self.running[path]
        self.running |= {file.path: file for file in (*changes.came, *changes.changed)}
        return names(changes)


def names(changes: Changes) -> dict[str, list[str]]:
    shown = {
        "came": [file.path.stem for file in changes.came],
        "changed": [file.path.stem for file in changes.changed],
        "gone": [path.stem for path in changes.gone],
        "moved": [f"{old.stem} {file.path.stem}" for old, file in changes.moved],
        "faulty": [file.path.stem for file in changes.faulty],
    }
    return {kind: found for kind, found in shown.items() if found}


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    write(tmp_path, "a")
    write(tmp_path, "b")
    scene = Scene(tmp_path)
    assert scene.poll() == {"came": ["a", "b"]}
    return scene


def test_files_that_come_change_and_go_are_told_once(scene: Scene) -> None:
    assert scene.poll() == {}
    write(scene.folder, "c")
    write(scene.folder, "a", port=11009)
    (scene.folder / "b.toml").unlink()
    assert scene.poll() == {"came": ["c"], "changed": ["a"], "gone": ["b"]}
    assert scene.poll() == {}


def test_a_file_that_changes_counts_when_two_looks_show_the_same(scene: Scene) -> None:
    assert scene.poll(twice=True) == {}
    for port in (11002, 11003):
        write(scene.folder, "a", port=port)
        assert scene.poll(twice=True) == {}
    assert scene.poll(twice=True) == {"changed": ["a"]}
    (scene.folder / "a.toml").unlink()
    assert scene.poll(twice=True) == {}
    assert scene.poll(twice=True) == {"gone": ["a"]}


def test_a_faulty_file_is_told_once_and_its_robot_goes_on(scene: Scene) -> None:
    sound = scene.running[scene.folder / "a.toml"]
    write(scene.folder, "a", more="colour = 1\n")
    assert scene.poll() == {"faulty": ["a"]}
    assert scene.poll() == {}
    assert scene.running[sound.path] is sound
    write(scene.folder, "a")
    assert scene.poll() == {}, "it is as it runs"
    write(scene.folder, "a", more="colour = 1\n")
    assert scene.poll() == {"faulty": ["a"]}


def test_a_second_file_with_the_name_of_a_robot_is_faulty_until_the_first_is_gone(scene: Scene) -> None:
    write(scene.folder, "aa", robot="b", port=11009)
    (faulty,) = scene.follower.poll(scene.running, twice=False).faulty
    assert faulty.fault is not None
    assert "robot.name = 'b'" in faulty.fault
    assert "b.toml" in faulty.fault
    (scene.folder / "b.toml").unlink()
    assert scene.poll() == {"came": ["aa"], "gone": ["b"]}


def test_a_second_file_with_the_address_of_a_robot_is_faulty_until_the_first_has_another_one(scene: Scene) -> None:
    write(scene.folder, "c", host="localhost", port=11002)
    (faulty,) = scene.follower.poll(scene.running, twice=False).faulty
    assert faulty.fault is not None
    assert f"device.connect: expected another address than that of {scene.folder}/b.toml" in faulty.fault
    write(scene.folder, "b", port=11009)
    scene.poll()
    assert scene.poll() == {"came": ["c"]}
    write(scene.folder, "b", port=11001, more="[control]\n")
    assert scene.poll() == {"faulty": ["b"]}, "that of another one that runs"


@pytest.mark.parametrize("twice", [False, True])
def test_a_file_that_is_renamed_keeps_its_robot(scene: Scene, twice: bool) -> None:
    (scene.folder / "a.toml").rename(scene.folder / "z.toml")
    looks = [scene.poll(twice=twice) for _ in range(2)]
    assert looks == ([{}, {"moved": ["a z"]}] if twice else [{"moved": ["a z"]}, {}])


def test_what_is_no_robot_file_is_left_alone(scene: Scene) -> None:
    (scene.folder / "host.toml").write_text("[host]\n")
    (scene.folder / "a.toml.bak").write_text("nothing")
    assert scene.poll() == {}


def test_directories_and_files_are_listed_once(scene: Scene) -> None:
    listed = paths_of((scene.folder / "b.toml", scene.folder))
    assert [path.stem for path in listed] == ["b", "a"]


def test_a_file_that_cannot_be_read_is_faulty(tmp_path: Path) -> None:
    assert read(tmp_path / "none.toml").fault == f"{tmp_path}/none.toml: No such file or directory"


@pytest.mark.parametrize(
    ("robots", "words"),
    [
        ({}, "no robot file"),
        ({"a": "r1", "b": "r1"}, "expected another name than that of"),
        ({"a": "not a name"}, "robot.name"),
    ],
)
def test_what_cannot_be_started_is_refused(tmp_path: Path, robots: dict[str, str], words: str) -> None:
    for name, robot in robots.items():
        write(tmp_path, name, robot=robot)
    with pytest.raises(ConfigError, match=words):
        read_all((tmp_path,))


@pytest.mark.parametrize("what", ["fifo", "device", "large", "brackets", "digits", "name", "bug"])
def test_whatever_a_file_is_it_is_faulty_and_the_others_are_followed(
    scene: Scene, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, ran = scene.folder / "c.toml", scene.running[scene.folder / "a.toml"]
    match what:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "large":
            path.write_text(f"a = [{3_000_000 * '1,'}]")
        case "brackets":
            path.write_text("a = " + 20_000 * "[")
        case "digits":
            path.write_text("a = " + 5_000 * "1")
        case "name":
            Path(os.fsdecode(os.fsencode(scene.folder) + b"/c\xff.toml")).write_bytes(ran.content)
        case "bug":
            monkeypatch.setattr("zbridge.host.files.load", lambda path, content: content / 2)
            path.write_text("a = 1")
    (faulty,) = scene.follower.poll(scene.running, twice=False).faulty
    assert faulty.fault is not None
    faulty.fault.encode()  # it is logged, and told to the code that takes this supervisor's place
    assert len(faulty.fault) < 500
    monkeypatch.undo()
    write(scene.folder, "a", port=11009)
    assert scene.poll()["changed"] == ["a"]


def test_a_faulty_file_that_is_the_same_is_checked_again_at_sighup_and_now_and_then(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked: list[Path] = []
    check = files.check
    monkeypatch.setattr(files, "check", lambda path, content: [checked.append(path), check(path, content)][1])
    write(scene.folder, "a", more="colour = 1\n")
    for _ in range(5):
        scene.poll(twice=True)
    assert len(checked) == 1, "a large file takes long to check"
    scene.poll(twice=False)
    assert len(checked) == 2
    monkeypatch.setattr(files, "CHECK_AGAIN_S", 0.0)
    scene.poll(twice=True)
    assert len(checked) == 3


def test_a_host_may_allow_larger_files(tmp_path: Path) -> None:
    path = write(tmp_path, "a", more="#" * FILE_BYTES)
    assert read(path).fault == f"{path}: {path.stat().st_size} bytes, expected {FILE_BYTES} at most"
    assert read(path, 2 * FILE_BYTES).fault is None


def test_a_faulty_file_does_not_keep_the_others_from_starting(tmp_path: Path) -> None:
    write(tmp_path, "a")
    write(tmp_path, "b", more="colour = 1\n")
    assert [file.fault is None for file in read_all((tmp_path,))] == [True, False]
