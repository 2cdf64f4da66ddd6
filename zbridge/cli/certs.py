"""``zbridge certs``: an authority, and the certificates of everyone who may use a secure bus.

Modules that need the package ``cryptography``, an extra, are imported by the commands that use them.
"""

from __future__ import annotations

import importlib.util
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from zbridge.cli.options import Json
from zbridge.cli.terminal import Column, Table
from zbridge.errors import ConfigError
from zbridge.fleet.printable import as_json, shown
from zbridge.security.files import Folder
from zbridge.security.roles import OF_ROBOTS, ROLES, Member, load_roles

if TYPE_CHECKING:
    from zbridge.security.certs.authority import Issued, ListedCertificate

app = typer.Typer(
    help="Make the certificates of a secure bus: an authority, and one certificate for each name.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Directory = Annotated[Path, typer.Option("--dir", help="the folder of the authority")]
Name = Annotated[str, typer.Argument(help="letters, digits, '_' and '-'", show_default=False)]
Days = Annotated[int, typer.Option(help="how long the certificate is valid")]
Force = Annotated[bool, typer.Option("--force", help="replace what exists")]

RESTART = "Restart the router, which reads roles.toml when it starts. That loses the bus: every driven robot stops."
_PRINT = 8
"""Bytes of a fingerprint shown in the table; --json shows all."""
_COLUMNS = (
    *(Column("name"), Column("role", 3), Column("robots", 5), Column("hosts", 4)),
    *(Column("expires", 1, number=True), Column("fingerprint", 6), Column("problem", 2)),
)


@app.command()
def init(
    place: Annotated[
        Path | None, typer.Argument(metavar="[DIR]", help="the folder to make", show_default="certs")
    ] = None,
    directory: Directory = Path("certs"),
    force: Annotated[bool, typer.Option("--force", help="replace an authority; roles.toml stays")] = False,
) -> None:
    """Make an authority, and an empty roles.toml."""
    folder = opened(place or directory)
    from zbridge.security.certs import authority

    made = authority.init(folder, now(), force=force)
    say(f"{folder.ca}: {made.common_name}, expires {made.expires:%Y-%m-%d}, {made.fingerprint}")
    say(f"Keep {folder.ca_key} secret: its holder can issue a certificate for any name and role.")
    if load_roles(folder.roles).names:
        say("Names in roles.toml need certificates of this authority: zbridge certs renew --all")


@app.command()
def issue(
    name: Name,
    role: Annotated[str, typer.Option(help="one of: " + ", ".join(ROLES), show_default=False)],
    robot: Annotated[
        list[str] | None, typer.Option(help=f"a robot of this {' or '.join(OF_ROBOTS)}; once for each")
    ] = None,
    host: Annotated[
        list[str] | None, typer.Option(help="a host name or IP address of this router; once for each")
    ] = None,
    listeners: Annotated[
        bool, typer.Option("--listeners", help="a gateway that serves HQ programs too, and drives its robots for them")
    ] = False,
    days: Days = 365,
    directory: Directory = Path("certs"),
    force: Force = False,
) -> None:
    """Make the key and the certificate of a name, and write the name into roles.toml."""
    folder = opened(directory)
    from zbridge.security.certs.authority import CertificateRequest
    from zbridge.security.certs.authority import issue as make

    if role not in ROLES:
        raise ConfigError(f"--role {role!r}: expected one of {', '.join(ROLES)}")
    if listeners and role != "gateway":
        raise ConfigError(f"--listeners: a gateway's; the role {role} has none")
    member = Member(role, tuple(robot or ()), listeners)
    issued = make(folder, CertificateRequest(name, member, tuple(host or ()), days), now(), force=force)
    print_issued(folder, name, issued)
    if issued.replaced_until is not None:
        say(
            f"The certificate that it replaces is valid until {issued.replaced_until:%Y-%m-%d} all the same."
            f" If its key is lost: zbridge certs revoke {name}, and issue another name."
        )
    if host and role != "router":
        say("It is a server's certificate too: whoever has its key can pose as a router on these hosts.")
    say(RESTART)


@app.command()
def renew(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", show_default=False, help="names to renew; or --all")
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="every name in roles.toml")] = False,
    days: Days = 365,
    directory: Directory = Path("certs"),
) -> None:
    """Replace the certificate of a name by a new one for the same key, with the same hosts."""
    folder = opened(directory)
    from zbridge.security.certs import authority

    if bool(names) == every:
        raise ConfigError("name one NAME or more, or give --all")
    for name in names or load_roles(folder.roles).names:
        print_issued(folder, name, authority.renew(folder, name, now(), days=days))
    say(
        "The key stays: copy certificate.pem to where the old one is used, ca.pem too if the authority is new; restart."
    )


@app.command("list")
def list_names(
    directory: Directory = Path("certs"),
    json: Json = False,
) -> None:
    """List the names: role, robots, hosts, expiry, fingerprint, and what is wrong."""
    folder = opened(directory)
    from zbridge.security.certs import authority

    entries = authority.list_names(folder, now())
    if json:
        for entry in entries:
            expires = entry.expires.isoformat() if entry.expires else None
            say(as_json(msgspec.structs.asdict(entry) | {"expires": expires}))
    else:
        Table(_COLUMNS, map(_row, entries)).print()


@app.command()
def revoke(name: Name, directory: Directory = Path("certs")) -> None:
    """Remove a name from roles.toml for good."""
    folder = opened(directory)
    from zbridge.security.certs import authority

    gone = authority.revoke(folder, name)
    say(f"{gone.common_name} is revoked, and {name} cannot be issued again.")
    if gone.until is not None:
        say(
            f"Its certificate is valid until {gone.until:%Y-%m-%d}: Zenoh has no revocation lists. A router lets it"
            " connect, and after a restart allows it nothing."
        )
    if gone.server:
        say(
            "It is a server's certificate: whoever has its key can pose as a router, which no rule prevents. If the key"
            " is lost: zbridge certs init --force, then zbridge certs renew --all."
        )
    say(RESTART)


@app.command()
def bundle(
    name: Name,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", show_default=False, help="the folder to write")
    ],
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Zenoh endpoint of a router, tls/HOST:PORT; by default the routers issued here, port 7447"),
    ] = None,
    at: Annotated[
        Path | None,
        typer.Option(help="path of the folder on the other machine; FOLDER by default", show_default=False),
    ] = None,
    directory: Directory = Path("certs"),
    force: Force = False,
) -> None:
    """Pack a name for another machine: ca.pem, certificate.pem, key.pem, and bus.toml (a router: roles.toml)."""
    folder = opened(directory)
    from zbridge.security.certs.bundle import Packing
    from zbridge.security.certs.bundle import bundle as pack

    for path in pack(folder, name, Packing(output, tuple(connect or ()), at), now(), force=force):
        say(path)


def opened(directory: Path, command: str = "zbridge certs") -> Folder:
    """Return the folder of the authority; raise ConfigError if the package ``cryptography`` is missing."""
    if importlib.util.find_spec("cryptography") is None:
        raise ConfigError(f"{command} needs the package cryptography: pip install 'zbridge[certs]'")
    return Folder(directory)


def now() -> datetime:
    """Return the time, to the second, as certificates have it."""
    return datetime.now(UTC).replace(microsecond=0)


def say(text: object) -> None:
    """Print one line."""
    typer.echo(shown(text))


def print_issued(folder: Folder, name: str, issued: Issued) -> None:
    """Print where a certificate is, and what it is."""
    say(f"{folder.of(name).folder}: {issued.common_name}, expires {issued.expires:%Y-%m-%d}, {issued.fingerprint}")


def _row(entry: ListedCertificate) -> tuple[str, ...]:
    expires = f"{entry.expires:%Y-%m-%d}" if entry.expires else ""
    fingerprint = f"{entry.fingerprint[: 3 * _PRINT]}..." if entry.fingerprint else ""
    return (
        entry.name,
        entry.role or "",
        " ".join(entry.robots),
        " ".join(entry.hosts),
        expires,
        fingerprint,
        entry.problem,
    )
