"""Who may use the console: a file with hashes only, logins that end, attempts that are limited."""

from __future__ import annotations

import base64
import os
from pathlib import Path

import pytest

from zbridge.errors import ConfigError
from zbridge.security.access import GRANTS, Keys, MessageKind
from zbridge.views.console import users
from zbridge.views.console.http_server import network_of
from zbridge.views.console.logins import ADDRESSES, LOGINS, LOGINS_EACH, LONGEST_S, UNUSED_S, Attempts, Logins
from zbridge.views.console.rights import NEEDS, Action, Caller, rights_of
from zbridge.views.console.users import User, hash_password, hash_token, is_password, load_users, new_token, save_users

ANN = User("operator", "hash")


def test_a_role_may_do_what_it_may_on_the_bus() -> None:
    look_and_stop = {Action.LOOK, Action.STOP}
    assert rights_of("viewer") == look_and_stop
    assert rights_of("operator") == look_and_stop | {Action.DRIVE, Action.SWITCH, Action.UNLATCH}
    assert rights_of("supervisor") == set(Action)
    assert rights_of("gateway") == rights_of("") == frozenset()
    for role in ("viewer", "operator", "supervisor"):
        granted = {(grant.keys, kind) for grant in GRANTS[role] for kind in grant.kinds}  # type: ignore[index]
        assert ((Keys.TAKEOVER, MessageKind.QUERY) in granted) is (Action.TAKE_OVER in rights_of(role))
    assert set(NEEDS) == set(Action)


def test_a_refusal_names_who_may() -> None:
    ann = Caller("ann", "viewer", rights_of("viewer"))
    assert ann.refusal(Action.DRIVE) == "ann (viewer) may not drive: it takes the role operator or supervisor"
    boss = Caller("boss", "supervisor", rights_of("operator"))
    assert boss.refusal(Action.TAKE_OVER).startswith("the certificate of this console does not permit anybody to take")
    nobody = Caller("", "operator", rights_of("operator"))
    assert nobody.refusal(Action.TAKE_OVER).startswith("this console (operator) may not take a robot over")


def test_users_are_kept_hashed_and_for_their_owner_only(tmp_path: Path) -> None:
    file = tmp_path / "users.toml"
    token, kept = new_token()
    known = {
        "ann": User("operator", hash_password("correct horse")),
        "robot-7": User("viewer", tokens={"a lab's": kept}),
    }
    save_users(file, known)
    assert load_users(file) == known
    assert file.stat().st_mode & 0o777 == 0o600
    content = file.read_text()
    assert token not in content
    assert "correct horse" not in content


@pytest.mark.parametrize("mode", [0o604, 0o660, 0o620, 0o602])
def test_a_file_that_others_can_read_or_write_is_an_error(tmp_path: Path, mode: int) -> None:
    file = tmp_path / "users.toml"
    save_users(file, {"ann": ANN})
    os.chmod(file, mode)
    with pytest.raises(ConfigError, match=r"others can read or write it; expected 0600"):
        load_users(file)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('[users.ann]\nrole = "king"', r"users\.ann\.role = 'king': expected one of"),
        ("[users.ann]\n", r"users\.ann\.role: missing"),
        ('[users."a.b"]\nrole = "viewer"', "user 'a.b': expected letters"),
        ('[users."../x"]\nrole = "viewer"', "expected letters"),
        ("[users", "not TOML"),
        ('[user.ann]\nrole = "viewer"', "unknown key"),
    ],
)
def test_what_is_no_file_of_users_is_an_error(tmp_path: Path, text: str, error: str) -> None:
    file = tmp_path / "users.toml"
    file.write_text(text)
    file.chmod(0o600)
    with pytest.raises(ConfigError, match=error):
        load_users(file)


def test_a_missing_file_and_too_many_users_are_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_users(tmp_path / "nothing")
    monkeypatch.setattr(users, "USERS", 1)
    save_users(tmp_path / "users.toml", {"ann": ANN, "bob": ANN})
    with pytest.raises(ConfigError, match="2 users, expected 1 at most"):
        load_users(tmp_path / "users.toml")


def test_only_the_password_is_the_password() -> None:
    hashed = hash_password("correct horse")
    assert is_password(hashed, "correct horse")
    assert hash_password("correct horse") != hashed, "each has a salt of its own"
    for wrong in ("", "correct hors", "Correct horse", "correct horse ", "\ud800", "x" * 10_000):
        assert not is_password(hashed, wrong)
    for broken in (None, "", "scrypt$1$1$1$AA==$AA==", "plain$16384$8$1$AA==$AA==", "a$b", hashed[:-4]):
        assert not is_password(broken, "")
        assert not is_password(broken, "correct horse")


def test_the_hash_is_scrypt_as_the_standard_gives_it() -> None:
    """The example of RFC 7914, section 12, third one, begins with these bytes."""
    salt, expected = "U29kaXVtQ2hsb3JpZGU=", "cCO9yzr9c0hGHAbNgf04624="
    assert not is_password(f"scrypt$16384$8$1${salt}${expected}", "pleaseletmein"), "it must be 32 bytes long"
    whole = bytes.fromhex("7023bdcb3afd7348461c06cd81fd38ebfda8fbba904f8e3ea9b543f6545da1f2")
    assert is_password(f"scrypt$16384$8$1${salt}${base64.b64encode(whole).decode()}", "pleaseletmein")


@pytest.mark.parametrize("password", ["", "short", "x" * 1001])
def test_a_password_has_a_length(password: str) -> None:
    with pytest.raises(ConfigError, match=f"a password of {len(password)} characters: expected 8 to 1000"):
        hash_password(password)


# Logins


def test_a_login_ends_by_time_by_logout_and_with_its_user() -> None:
    logins, known = Logins(), {"ann": ANN}
    key = hash_token(logins.begin("ann", ANN, 0.0))
    assert logins.find(key, known, UNUSED_S - 1) is not None
    assert logins.find(key, known, 2 * UNUSED_S - 2) is not None, "it was used meanwhile"
    assert logins.find(key, known, 3 * UNUSED_S) is None
    for step in range(1, round(LONGEST_S / 1000)):
        key = key if step > 1 else hash_token(logins.begin("ann", ANN, 0.0))
        assert logins.find(key, known, 1000.0 * step) is not None
    assert logins.find(key, known, LONGEST_S) is None
    key = hash_token(logins.begin("ann", ANN, 0.0))
    with_token = User("operator", "hash", {"lab": "token"})
    assert logins.find(key, {"ann": with_token}, 1.0) is not None
    logins.end(key)
    for changed in ({}, {"ann": User("viewer", "hash")}, {"ann": User("operator", "another")}):
        key = hash_token(logins.begin("ann", ANN, 0.0))
        assert logins.find(key, changed, 1.0) is None
        assert logins.find(key, known, 1.0) is None, "it does not come back"
    key = hash_token(logins.begin("ann", ANN, 0.0))
    logins.end(key)
    logins.end(key)
    assert logins.find(key, known, 1.0) is None
    assert len(logins) == 0


def test_logins_are_bounded_and_the_oldest_ends() -> None:
    logins = Logins()
    first = hash_token(logins.begin("ann", ANN, 0.0))
    for _ in range(LOGINS_EACH):
        logins.begin("ann", ANN, 0.0)
    assert logins.find(first, {"ann": ANN}, 1.0) is None
    assert len(logins) == LOGINS_EACH
    for number in range(LOGINS):
        logins.begin(f"u{number}", ANN, 0.0)
    assert len(logins) == LOGINS


def test_attempts_are_limited_by_address_and_one_address_locks_nobody_out() -> None:
    attempts = Attempts()
    assert sum(attempts.take("evil", "ann", 0.0) for _ in range(1000)) == 5
    assert not attempts.take("evil", "bob", 0.0)
    assert attempts.take("desk", "ann", 0.0)
    assert not attempts.take("evil", "ann", 9.0)
    assert attempts.take("evil", "ann", 11.0)
    assert not attempts.take("evil", "ann", 11.0)
    attempts.succeeded("evil")
    assert attempts.take("evil", "ann", 11.0)
    assert not attempts.take("evil", "ann", 11.0), "a login is no licence to try others"


def test_the_attempts_of_one_address_forget_those_at_no_name() -> None:
    attempts = Attempts()
    for number in range(30):
        attempts.take(f"address{number}", "ann", 0.0)
    for number in range(2 * ADDRESSES):
        attempts.take("evil", f"name{number}", 0.0)
    assert not attempts.take("desk", "ann", 0.0), "they are limited as before"


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::ffff:2", "2001:db8::/64"),
        ("2001:db8:0:1::1", "2001:db8:0:1::/64"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", ""),
    ],
)
def test_a_host_has_one_network_and_many_addresses(address: str, network: str) -> None:
    assert network_of(address) == network


def test_attempts_at_one_name_from_everywhere_are_limited_and_forgotten_in_time() -> None:
    attempts = Attempts()
    assert sum(attempts.take(f"address{number}", "ann", 0.0) for number in range(1000)) == 30
    for number in range(2 * ADDRESSES):
        attempts.take(f"other{number}", f"name{number}", 0.0)
    assert len(repr(attempts)) < 40
    assert str(ADDRESSES) in repr(attempts)
