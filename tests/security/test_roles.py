"""``roles.toml``: what is written is read again, and what may not stand in the file is told with its key."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from zbridge.errors import ConfigError
from zbridge.security.roles import OF_ROBOTS, ROLES, Member, Role, Roles, common_name, load_roles, save_roles

LAB = Roles(
    {
        "ann": Member("viewer"),
        "op-1": Member("operator"),
        "r1": Member("gateway", ("r1", "arm.left")),
        "r2": Member("gateway", ("r2",), listeners=True),
        "2nd_router": Member("router"),
    },
    ("lost", "old-1"),
)

WRONG_FILES = [
    ("[names.a]\nrole = 'driver'", "names.a.role = 'driver': expected one of 'gateway', 'hq', 'operator', 'recorder'"),
    ("[names.a]\nrobots = []", "names.a.role: missing, it is required"),
    (
        "[names.a]\nrole = 'viewer'\nrobot = 'r1'",
        "names.a.robot = 'r1': unknown key; expected one of role, robots",
    ),
    ("[names.a]\nrole = 'gateway'", "names.a.robots = []: expected the robots of this gateway, at least one"),
    ("[names.a]\nrole = 'hq'\nrobots = []", "names.a.robots = []: expected the robots of this hq, at least one"),
    ("[names.a]\nrole = 'viewer'\nrobots = ['r1']", "names.a.robots = ['r1']: expected none: the role viewer is for"),
    ("[names.a]\nrole = 'router'\nrobots = ['r1']", "names.a.robots = ['r1']: expected none: the role router is for"),
    ("[names.a]\nrole = 'gateway'\nrobots = ['*']", "names.a.robots = ['*']: '*': expected letters"),
    ("[names.a]\nrole = 'gateway'\nrobots = ['r1/**']", "names.a.robots = ['r1/**']: 'r1/**': expected letters"),
    ("[names.a]\nrole = 'gateway'\nrobots = ['r1', 'r1']", "names.a.robots = ['r1', 'r1']: expected each robot once"),
    ("[names.a]\nrole = 'gateway'\nrobots = 'r1'", "names.a.robots = 'r1': expected `array`, got `str`"),
    ("[names.a]\nrole = 'viewer'\nlisteners = true", "names.a.listeners = true: expected only in a gateway"),
    ("[names.hq]\nrole = 'viewer'", "names = 'hq': the names of all listeners begin with it"),
    ("[names.'a.b']\nrole = 'viewer'", "names = 'a.b': expected at most 48 letters"),
    ("[names.'$*']\nrole = 'viewer'", "names = '$*': expected at most 48 letters"),
    ("[names.'']\nrole = 'viewer'", "names = '': expected at most 48 letters"),
    ("[names.-a]\nrole = 'viewer'", "names = '-a': expected at most 48 letters"),
    ("[names." + 49 * "a" + "]\nrole = 'viewer'", "expected at most 48 letters"),
    ("revoked = ['a']\n[names.a]\nrole = 'viewer'", "names = 'a': this name is revoked; expected a new name"),
    ("revoked = ['a.b']", "revoked = 'a.b': expected at most 48 letters"),
    ("name = 1", "name = 1: unknown key; expected one of names, revoked"),
    ("[names", "not TOML"),
]


def written(folder: Path, text: str) -> Path:
    path = folder / "roles.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_saved_is_loaded_again(tmp_path: Path) -> None:
    for roles in (LAB, Roles()):
        save_roles(tmp_path / "roles.toml", roles)
        assert load_roles(tmp_path / "roles.toml") == roles
        assert [path.name for path in tmp_path.iterdir()] == ["roles.toml"]


def test_the_file_reads_as_its_form_says(tmp_path: Path) -> None:
    save_roles(tmp_path / "roles.toml", LAB)
    table = tomllib.loads((tmp_path / "roles.toml").read_text())
    assert table["revoked"] == ["lost", "old-1"]
    assert table["names"]["r1"] == {"role": "gateway", "robots": ["r1", "arm.left"]}
    assert table["names"]["ann"] == {"role": "viewer"}


@pytest.mark.parametrize(("text", "error"), WRONG_FILES)
def test_a_wrong_file_is_told_with_its_name_and_key(tmp_path: Path, text: str, error: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as raised:
        load_roles(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert error in str(raised.value)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"roles\.toml: No such file"):
        load_roles(tmp_path / "roles.toml")


@pytest.mark.parametrize("role", ROLES)
def test_every_role_makes_a_common_name_that_a_certificate_can_carry(tmp_path: Path, role: Role) -> None:
    name = 48 * "x"
    roles = Roles().with_member(name, Member(role, ("r1",) if role in OF_ROBOTS else ()))
    assert roles.common_name(name) == common_name(name, role) == f"{role}.{name}"
    assert len(roles.common_name(name)) <= 64


def test_a_revoked_name_leaves_the_names_and_is_never_given_again() -> None:
    roles = LAB.without("op-1")
    assert "op-1" not in roles.names
    assert roles.revoked == ("lost", "old-1", "op-1")
    with pytest.raises(ConfigError, match="'op-1': this name is revoked"):
        roles.with_member("op-1", Member("viewer"))


def test_only_a_known_name_is_revoked() -> None:
    for name in ("nobody", "lost"):
        with pytest.raises(
            ConfigError, match=f"'{name}': not a name of this bus; known: ann, op-1, r1, r2, 2nd_router"
        ):
            LAB.without(name)


def test_roles_that_are_not_valid_are_not_saved(tmp_path: Path) -> None:
    save_roles(tmp_path / "roles.toml", LAB)
    with pytest.raises(ConfigError, match=r"names.x.robots"):
        save_roles(tmp_path / "roles.toml", Roles({"x": Member("viewer", ("r1",))}))
    assert load_roles(tmp_path / "roles.toml") == LAB
