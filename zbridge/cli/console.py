"""``zbridge console``: serves the fleet to browsers and programs; and the users who may use it."""

from __future__ import annotations

import getpass
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from zbridge.cli import set_up_log
from zbridge.cli.options import Connect, Json, Realm, TlsFolder
from zbridge.cli.terminal import Column, Table
from zbridge.client import bus_settings
from zbridge.errors import ConfigError
from zbridge.fleet.printable import as_json

app = typer.Typer(invoke_without_command=True, rich_markup_mode=None)
users_app = typer.Typer(
    help="Manage who may use the console: a file with roles, hashed passwords and tokens.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(users_app, name="user")

UsersFile = Annotated[Path, typer.Option("--file", help="the file of the users")]
Name = Annotated[str, typer.Argument(help="letters, digits, '_' and '-'", show_default=False)]


@app.callback()
def console(
    context: typer.Context,
    listen: Annotated[str, typer.Option(help="host:port for browsers; port 0: any free one")] = "127.0.0.1:8080",
    users: Annotated[
        Path | None, typer.Option(help="file of who may log in (`zbridge console user`); needed off loopback")
    ] = None,
    tls_certificate: Annotated[Path | None, typer.Option(help="certificate for https; needed off loopback")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="the key of that certificate")] = None,
    host: Annotated[
        list[str] | None, typer.Option(help="a name by which browsers reach the console; once for each")
    ] = None,
    proxied: Annotated[
        bool, typer.Option("--proxied", help="a reverse proxy with TLS on this machine passes requests on")
    ] = False,
    roster: Annotated[
        Path | None, typer.Option(help="file of the known robots; by default in the user's state folder")
    ] = None,
    journal: Annotated[
        Path | None, typer.Option(help="file of what users did; with --users by default in the user's state folder")
    ] = None,
    connect: Connect = [],
    tls: TlsFolder = None,
    realm: Realm = "fleet",
) -> None:
    """Serve the fleet to browsers and programs until SIGTERM or SIGINT."""
    if context.invoked_subcommand is not None:
        return
    from zbridge.cli.viewers import run_console

    set_up_log()
    given = {name: value for name, value in locals().items() if name != "context"} | {"host": host or []}
    run_console(bus_settings(connect, tls), realm, given)


@users_app.command()
def add(
    name: Name,
    role: Annotated[str, typer.Option(help="viewer, operator or supervisor", show_default=False)],
    no_password: Annotated[bool, typer.Option("--no-password", help="a program: it uses tokens only")] = False,
    file: UsersFile = Path("users.toml"),
) -> None:
    """Add a user; the password is asked for, or is the first line of standard input."""
    from zbridge.views.console.rights import USER_ROLES
    from zbridge.views.console.users import User, check_name, hash_password

    known = _load(file, missing_ok=True)
    check_name(name)
    if role not in USER_ROLES:
        raise ConfigError(f"--role {role!r}: expected one of {', '.join(USER_ROLES)}")
    if name in known:
        raise ConfigError(f"{file}: there is a user {name!r}: remove it first, or change its password with passwd")
    password = None if no_password else hash_password(_password())
    _save(file, {**known, name: User(role, password)})


@users_app.command()
def passwd(name: Name, file: UsersFile = Path("users.toml")) -> None:
    """Change a user's password; all logins of the user end."""
    import msgspec

    from zbridge.views.console.users import hash_password

    known = _load(file)
    user = _find(known, name, file)
    _save(file, {**known, name: msgspec.structs.replace(user, password=hash_password(_password()))})


@users_app.command()
def remove(name: Name, file: UsersFile = Path("users.toml")) -> None:
    """Remove a user; all logins and tokens of the user end."""
    known = _load(file)
    _find(known, name, file)
    _save(file, {other: user for other, user in known.items() if other != name})


@users_app.command()
def token(
    name: Name,
    label: Annotated[str, typer.Option(help="what the token is for: names it in the list")] = "token",
    revoke: Annotated[bool, typer.Option("--revoke", help="remove the token of this label")] = False,
    file: UsersFile = Path("users.toml"),
) -> None:
    """Make a token for a program of a user, and print it: it cannot be shown again."""
    import msgspec

    from zbridge.views.console.users import TOKENS, new_token

    known = _load(file)
    user = _find(known, name, file)
    tokens = dict(user.tokens)
    if revoke and tokens.pop(label, None) is None:
        raise ConfigError(f"{file}: {name} has no token {label!r}")
    secret = ""
    if not revoke:
        if label in tokens or len(tokens) >= TOKENS:
            raise ConfigError(f"{file}: {name} has a token {label!r}, or {TOKENS} tokens: revoke one first")
        secret, tokens[label] = new_token()
    _save(file, {**known, name: msgspec.structs.replace(user, tokens=tokens)})
    if secret:
        print(secret)  # noqa: T201


@users_app.command("list")
def list_users(file: UsersFile = Path("users.toml"), json: Json = False) -> None:
    """List the users, their roles, and the labels of their tokens."""
    known = sorted(_load(file).items())
    if json:
        for name, user in known:
            fields = {"user": name, "role": user.role, "password": user.password is not None}
            print(as_json(fields | {"tokens": sorted(user.tokens)}))  # noqa: T201
        return
    columns = [Column("user"), Column("role", 1), Column("password", 3), Column("tokens", 2)]
    rows = [(name, user.role, "yes" if user.password else "no", ", ".join(user.tokens)) for name, user in known]
    Table(columns, rows).print()


def _password() -> str:
    """Ask for a password twice on a terminal; else read a line."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    password = getpass.getpass("password: ")
    if password != getpass.getpass("again: "):
        raise ConfigError("the passwords differ: nothing was changed")
    return password


def _load(file: Path, *, missing_ok: bool = False) -> dict[str, Any]:
    from zbridge.views.console.users import load_users

    return {} if missing_ok and not file.exists() else load_users(file)


def _save(file: Path, users: dict[str, Any]) -> None:
    from zbridge.views.console.users import save_users

    save_users(file, users)


def _find(users: dict[str, Any], name: str, file: Path) -> Any:
    if name not in users:
        raise ConfigError(f"{file}: there is no user {name!r}")
    return users[name]
