"""Recognises who asks: a browser by its cookie, a program by its token, or nobody in particular on an open console.

Theory of operation. Without users everybody is the same caller, with the rights of the console's own certificate (all
rights on an open bus). With users, a caller has the rights of its role, as far as that certificate has them too. A
password is hashed on a thread, one at a time, after the attempt was counted; so a flood of attempts costs neither the
processor nor those who drive. Callers are checked again while their sockets are open (:meth:`Callers.is_valid`).
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Callable
from pathlib import Path

from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.types import Scope

from zbridge.errors import ConfigError, RateLimited, Unsupported
from zbridge.views.console.http_server import network_of
from zbridge.views.console.logins import LONGEST_S, Attempts, Login, Logins
from zbridge.views.console.rights import Caller, rights_of
from zbridge.views.console.users import User, hash_token, is_password, load_users

COOKIE = "__Host-zbridge"
"""The browser itself binds a cookie of this name to the host that set it, and to encrypted connections."""
CSRF_HEADER = "x-zbridge-csrf"
HASHES = 8
"""Most passwords that are hashed or wait for it; a further attempt is refused."""
_BEARER = "bearer "


class Callers:
    """Everybody who may use the console. users_file: None: there are no users. own_role: None: the bus is open."""

    def __init__(
        self, users_file: Path | None, own_role: str | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file = users_file
        self._own_role = own_role
        self._rights = rights_of(own_role or "supervisor")
        self._clock = clock
        self._users: dict[str, User] = {}
        self._tokens: dict[str, str] = {}
        """Names by hashed token."""
        self._stamp: tuple[int, int] | None = None
        self._logins = Logins()
        self._attempts = Attempts()
        self._hashing = asyncio.Lock()
        self._hashes = 0
        if users_file is not None:
            self._load(load_users(users_file))

    def __repr__(self) -> str:
        return f"<Callers {len(self._users)} users, {self._logins!r}>"

    @property
    def with_login(self) -> bool:
        """Whether users log in."""
        return self._file is not None

    def has(self, name: str) -> bool:
        """Return whether there is a user of this name."""
        return name in self._users

    def refresh(self) -> str | None:
        """Read the file of users again if it has changed; return why it cannot be read. May run on a thread."""
        if self._file is None:
            return None
        try:
            state = self._file.stat()
            if (stamp := (state.st_mtime_ns, state.st_ino)) != self._stamp:
                self._load(load_users(self._file))
                self._stamp = stamp
        except (OSError, ConfigError) as error:
            return str(error)
        return None

    def recognise(self, scope: Scope) -> Caller | None:
        """Return who sent a request; None if it must log in first."""
        address = scope["client"][0] if scope.get("client") else ""
        if self._file is None:
            return Caller("", self._own_role or "supervisor", self._rights, address)
        headers = Headers(scope=scope)
        authorization = headers.get("authorization", "")
        if authorization:
            return self._by_token(authorization, address)
        key = hash_token(cookie_parser(headers.get("cookie", "")).get(COOKIE, ""))
        login = self._find(key)
        return self._caller(login.user, login.account, address, key) if login is not None else None

    def is_valid(self, caller: Caller) -> bool:
        """Return whether a caller whose socket is open may still be there."""
        if self._file is None:
            return True
        if caller.login:
            return self._find(caller.login) is not None
        user = self._users.get(caller.user)
        return user is not None and user.role == caller.role and self._tokens.get(caller.token) == caller.user

    def csrf(self, caller: Caller) -> str:
        """Return what the changing requests of a browser must carry in :data:`CSRF_HEADER`; "": nothing."""
        login = self._find(caller.login) if caller.login else None
        return login.csrf if login is not None else ""

    def is_forged(self, caller: Caller, scope: Scope) -> bool:
        """Return whether a changing request lacks the token of its login: a page of another site may have sent it."""
        expected = self.csrf(caller)
        given = Headers(scope=scope).get(CSRF_HEADER, "")
        return bool(caller.login) and not secrets.compare_digest(given.encode(), expected.encode())

    async def log_in(self, name: str, password: str, address: str) -> tuple[str, Caller]:
        """Return the secret for the cookie, and the caller; raise RateLimited, or Unsupported for a wrong password."""
        network = network_of(address)
        if not self._attempts.take(network, name, self._clock()):
            raise RateLimited("too many attempts: wait a minute")
        if self._hashes >= HASHES:
            raise RateLimited("too many people log in at this moment: try again")
        account = self._users.get(name)
        self._hashes += 1
        try:
            async with self._hashing:
                hashed = account.password if account is not None else None
                right = await asyncio.to_thread(is_password, hashed, password)
        finally:
            self._hashes -= 1
        if account is None or not right:
            raise Unsupported("no such user, or another password")
        self._attempts.succeeded(network)
        secret = self._logins.begin(name, account, self._clock())
        return secret, self._caller(name, account, address, hash_token(secret))

    def log_out(self, caller: Caller) -> None:
        """End the login of a browser; its sockets end soon."""
        self._logins.end(caller.login)

    @staticmethod
    def cookie(secret: str) -> str:
        """Write the cookie of a login; of no secret: its end."""
        age = round(LONGEST_S) if secret else 0
        return f"{COOKIE}={secret}; Path=/; Max-Age={age}; HttpOnly; Secure; SameSite=Strict"

    def _load(self, users: dict[str, User]) -> None:
        self._users = users
        self._tokens = {token: name for name, user in users.items() for token in user.tokens.values()}

    def _find(self, key: str) -> Login | None:
        return self._logins.find(key, self._users, self._clock())

    def _by_token(self, authorization: str, address: str) -> Caller | None:
        if authorization[: len(_BEARER)].lower() != _BEARER:
            return None
        token = hash_token(authorization[len(_BEARER) :].strip())
        name = self._tokens.get(token, "")
        account = self._users.get(name)
        return self._caller(name, account, address, token=token) if account is not None else None

    def _caller(self, name: str, account: User, address: str, login: str = "", token: str = "") -> Caller:
        return Caller(name, account.role, rights_of(account.role) & self._rights, address, login, token)
