"""A bare Zenoh queryable: answers where it is asked, as a lease is renewed but without anything behind it.

``python -m tests.benchmarks.answering ENDPOINT``
"""

from __future__ import annotations

import sys

import zenoh

from tests.benchmarks.drives import CONTROL, packed
from tests.benchmarks.peer import hear, open_session, tell


def main() -> None:
    """Answer until the harness is gone."""
    key = f"{CONTROL}/renew"
    fields = {"ok": True, "lease": None, "token": None, "expires_in_s": 3.0, "holder": "bench"}
    answer = packed({**fields, "reason": None, "code": None})

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, answer, express=True)

    with open_session(listen=sys.argv[1]) as session:
        session.declare_queryable(key, reply)
        tell(ready=True)
        while True:
            hear()


if __name__ == "__main__":
    main()
