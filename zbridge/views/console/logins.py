"""Who is logged in, and how often somebody may try to. Sans-IO; time is an argument.

A login is known by a random secret in its cookie, of which only the hash is kept. It ends :data:`UNUSED_S` after its
last use, :data:`LONGEST_S` after it began, by logout, and when its user is removed or changed.
"""

from __future__ import annotations

import secrets
from collections import OrderedDict
from collections.abc import Mapping

import msgspec

from zbridge.protocol.rate_limit import RateLimit
from zbridge.views.console.users import User, hash_token

LONGEST_S = 12 * 3600.0
UNUSED_S = 3600.0
LOGINS, LOGINS_EACH = 1000, 20
"""Most logins, and most of one user: a further one ends the oldest."""
BY_ADDRESS = (0.1, 5.0)
"""Attempts a second of one address, and how many at once."""
BY_NAME = (0.5, 30.0)
"""The same at one name, from anywhere: enough that one address cannot lock its user out."""
ADDRESSES = 4096
"""Addresses and names whose attempts are counted; those seen longest ago are forgotten."""


class Login(msgspec.Struct):
    """One browser's login. csrf: what its requests that change something must carry."""

    user: str
    account: User
    csrf: str
    began_at: float
    used_at: float


class Logins:
    """All logins, by the hash of their secrets."""

    def __init__(self) -> None:
        self._logins: OrderedDict[str, Login] = OrderedDict()

    def __len__(self) -> int:
        return len(self._logins)

    def __repr__(self) -> str:
        return f"<Logins {len(self)}>"

    def begin(self, user: str, account: User, now: float) -> str:
        """Log a user in; return the secret for the cookie."""
        secret = secrets.token_urlsafe(32)
        own = [key for key, login in self._logins.items() if login.user == user]
        for key in own[: max(0, len(own) - LOGINS_EACH + 1)]:
            del self._logins[key]
        while len(self._logins) >= LOGINS:
            self._logins.popitem(last=False)
        self._logins[hash_token(secret)] = Login(user, account, secrets.token_urlsafe(24), now, now)
        return secret

    def find(self, key: str, users: Mapping[str, User], now: float) -> Login | None:
        """Return a login by the hash of its secret, and note that it is used; None if there is none any more."""
        login = self._logins.get(key)
        if login is None:
            return None
        ended = now - login.began_at >= LONGEST_S or now - login.used_at >= UNUSED_S
        if ended or not _is_same(users.get(login.user), login.account):
            del self._logins[key]
            return None
        login.used_at = now
        return login

    def end(self, key: str) -> None:
        """Log out; idempotent."""
        self._logins.pop(key, None)


def _is_same(user: User | None, account: User) -> bool:
    """Return whether a user logs in as before. A new token for a program changes nothing."""
    return user is not None and (user.role, user.password) == (account.role, account.password)


class Attempts:
    """How often each address may try to log in, and how often somebody may try each name."""

    def __init__(self) -> None:
        self._addresses: OrderedDict[str, RateLimit] = OrderedDict()
        self._names: OrderedDict[str, RateLimit] = OrderedDict()

    def __repr__(self) -> str:
        return f"<Attempts of {len(self._addresses)}>"

    def take(self, address: str, name: str, now: float) -> bool:
        """Return whether an attempt may be made now, and count it. One that its address is refused costs no name."""
        by_address = _bucket(self._addresses, address, BY_ADDRESS)
        if by_address.fill(now) < 1:
            return False
        return _bucket(self._names, name, BY_NAME).take(now) and by_address.take(now)

    def succeeded(self, address: str) -> None:
        """Give the address back the attempt that was a login."""
        if (bucket := self._addresses.get(address)) is not None:
            bucket.left += 1


def _bucket(buckets: OrderedDict[str, RateLimit], key: str, rate: tuple[float, float]) -> RateLimit:
    bucket = buckets[key] = buckets.pop(key, RateLimit(*rate))
    if len(buckets) > ADDRESSES:
        buckets.popitem(last=False)
    return bucket
