"""The traces: what is done when, and what is read off. Programs are open, and know of each other, at :data:`T`."""

from __future__ import annotations

import itertools

from tests.simulated.bus_validation.trace import Finding, Log, Step, Trace

DRIVE, STOP, STATE = "fleet/r1/@cmd/drive", "fleet/r1/@cmd/stop", "fleet/r1/control"
TOKEN, OTHER_TOKEN, TOKENS = "fleet/r1/@alive/operator.p.1", "fleet/r1/@alive/operator.s.1", "fleet/r1/@alive/*"
GATEWAY = "fleet/r1/@alive/gateway"
QUERY, QUERIES = "fleet/r1/@rpc/claim/a", "fleet/r1/@rpc/claim/*"
T = 1.0
"""When it begins, seconds."""
TWO = {"p": "router1", "s": "router1"}
APART = {"p": "router1", "s": "router2"}


def _drives(hz: float, count: int, size: int = 0, at: float = T, kind: str = "drive") -> tuple[Step, ...]:
    """Subscribe, and send a stream of commands from ``at`` on."""
    return (
        Step(0.9, "s", "subscribe", (DRIVE,)),
        Step(0.9, "p", "publisher", (DRIVE, kind)),
        Step(at, "p", "stream", ([DRIVE], "d", hz, count, size)),
    )


_WATCHED = (
    Step(0.8, "p", "announce", (TOKEN,)),
    Step(0.8, "s", "announce", (OTHER_TOKEN,)),
    Step(0.8, "p", "watch", (TOKENS,)),
    Step(0.8, "s", "watch", (TOKENS,)),
    Step(0.8, "p", "watch_connected"),
    Step(0.8, "s", "watch_connected"),
)


# What is read off


def _arrivals(log: Log, count: int, who: str = "s", key: str = DRIVE, tag: str = "d") -> dict[str, Finding]:
    numbers = log.numbers(who, key, tag)
    return {
        "lost": count - len(set(numbers)),
        "twice": len(numbers) - len(set(numbers)),
        "in order": numbers == sorted(numbers),
    }


def _of_cut(log: Log, cut: float, mended: float, who: str = "s", tag: str = "d") -> dict[str, Finding]:
    """Tell what became of the samples that were put while something was cut, and of the first put afterwards."""
    got = log.of(who, "got", DRIVE, tag)
    kept = [each for each in got if cut + 0.05 < each.fields[3] < mended and each.at > mended]
    new = [each for each in got if each.fields[3] >= mended]
    return {
        "put meanwhile, delivered": len(kept),
        "the first of them": kept[0].at - mended if kept else None,
        "put afterwards, first": new[0].at - mended if new else None,
        "arrived meanwhile": any(cut + 0.05 < each.at < mended for each in got),
    }


def _news(log: Log, who: str, token: str, since: float, until: float = 1e9) -> dict[str, Finding]:
    """Tell what a program was told of a token from then on."""
    told = [each for each in log.of(who, "alive", token) if since <= each.at < until]
    gone = next((each.at - since for each in told if not each.fields[1]), None)
    return {
        f"{who}: news": "".join("+" if each.fields[1] else "-" for each in told),
        f"{who}: token gone": gone,
    }


def _back(log: Log, who: str, token: str, since: float) -> Finding:
    return log.first(who, "alive", token, True, since=since)


def _links(log: Log, who: str, lost: float, back: float) -> dict[str, Finding]:
    return {
        f"{who}: not connected": log.first(who, "connected", False, since=lost),
        f"{who}: connected again": log.first(who, "connected", True, since=back),
    }


def _answers(log: Log, tag: str, who: str = "p") -> dict[str, Finding]:
    found = log.of(who, "answered", tag)
    if not found:
        return {f"{tag}: answers": "never ended"}
    return {f"{tag}: answers": ", ".join(found[0].fields[1]), f"{tag}: took": found[0].fields[2]}


# Samples


def _two_keys(log: Log) -> dict[str, Finding]:
    got = [(each.fields[2], each.fields[0] == DRIVE) for each in log.of("s", "got")]
    overtaken = sum(1 for one, other in itertools.pairwise(got) if one > other)
    return {"commands": len(got), "a stop is overtaken": overtaken > 0} | {
        f"{key.rpartition('/')[2]} in order": (each := log.numbers("s", key, "d")) == sorted(each)
        for key in (DRIVE, STOP)
    }


def _wildcards(log: Log) -> dict[str, Finding]:
    return {
        key: "".join(sorted(each.fields[1] for each in log.of("s", "got") if each.fields[1] in tags and each.at))
        for key, tags in (("wild put", "w"), ("stop", "s"), ("state", "c"))
    }


def _late_subscriber(log: Log) -> dict[str, Finding]:
    got = log.of("s", "got", DRIVE, "d")
    return {
        "first put that arrives": got[0].fields[3] - 2.5 if got else None,
        "after the end": any(each.at > 4.2 for each in got),
        "in order": _arrivals(log, 0)["in order"],
    }


def _late_join(log: Log) -> dict[str, Finding]:
    got = log.of("s", "got", STATE)
    return {
        "values": " ".join(f"{each.fields[1]}{each.fields[2]}" for each in got),
        "last value": got[0].at - 2.0 if got else None,
    }


SAMPLES = (
    Trace("samples arrive", TWO, _drives(100, 100), 4.0, lambda log: _arrivals(log, 100)),
    Trace(
        "two keys of one publisher",
        TWO,
        (
            Step(0.9, "s", "subscribe", ("fleet/r1/@cmd/*",)),
            Step(0.9, "p", "publisher", (DRIVE, "drive")),
            Step(0.9, "p", "publisher", (STOP, "stop")),
            Step(T, "p", "stream", ([STOP, DRIVE], "d", 100, 100)),
        ),
        4.0,
        _two_keys,
        quick=True,
    ),
    Trace(
        "wildcards",
        TWO,
        (
            *(Step(0.9, "s", "subscribe", (key,)) for key in (DRIVE, STOP, "fleet/*/@cmd/**", "fleet/**", "fleet/*/*")),
            Step(0.9, "p", "publisher", ("fleet/*/@cmd/stop", "stop")),
            Step(0.9, "p", "publisher", (STOP, "stop")),
            Step(0.9, "p", "publisher", (STATE, "state")),
            Step(T, "p", "put", ("fleet/*/@cmd/stop", "w")),
            Step(T + 0.1, "p", "put", (STOP, "s")),
            Step(T + 0.2, "p", "put", (STATE, "c")),
        ),
        3.0,
        _wildcards,
        quick=True,
    ),
    Trace(
        "a late subscriber",
        TWO,
        (
            Step(0.9, "p", "publisher", (DRIVE, "drive")),
            Step(T, "p", "stream", ([DRIVE], "d", 250, 750)),
            Step(2.5, "s", "subscribe", (DRIVE,)),
            Step(4.0, "s", "unsubscribe", (DRIVE,)),
        ),
        5.0,
        _late_subscriber,
    ),
    Trace(
        "a late joiner",
        TWO,
        (
            Step(0.8, "p", "announce", (GATEWAY,)),
            Step(0.9, "p", "publisher", (STATE, "state")),
            Step(T, "p", "put", (STATE, "c", 1)),
            Step(2.0, "s", "subscribe", (STATE, True)),
            Step(3.0, "p", "put", (STATE, "c", 2)),
        ),
        4.0,
        _late_join,
        quick=True,
    ),
    Trace(
        "samples through two routers",
        APART,
        _drives(100, 100),
        4.0,
        lambda log: _arrivals(log, 100),
        quick=True,
    ),
)


# Cuts


def _gap(road: str, cut: float, mended: float) -> tuple[Step, Step]:
    return Step(cut, road, "cut"), Step(mended, road, "mend")


def _cut(name: str, cut_s: float, lasts_s: float, hz: float = 20, size: int = 0, kind: str = "drive") -> Trace:
    """Cut the publisher off for a while."""
    count = int(hz * (lasts_s - T - 0.5))
    cut, mended = T + 0.5, T + 0.5 + cut_s

    def read(log: Log) -> dict[str, Finding]:
        found = _arrivals(log, count)
        found |= _of_cut(log, cut, mended) | _news(log, "s", TOKEN, cut) | _links(log, "p", cut, mended)
        return found | {
            "s: token back": _back(log, "s", TOKEN, mended),
            "s: not connected": log.first("s", "connected", False),
        }

    steps = (*_WATCHED, *_drives(hz, count, size, kind=kind), *_gap("p-router1", cut, mended))
    return Trace(name, TWO, steps, lasts_s, read)


def _cut_receiver(name: str, cut_s: float, lasts_s: float) -> Trace:
    """Cut the subscriber off for a while."""
    count = int(20 * (lasts_s - T - 0.5))
    cut, mended = T + 0.5, T + 0.5 + cut_s

    def read(log: Log) -> dict[str, Finding]:
        found = _arrivals(log, count) | _of_cut(log, cut, mended) | _news(log, "s", TOKEN, cut)
        return found | _links(log, "s", cut, mended)

    steps = (*_WATCHED, *_drives(20, count), *_gap("s-router1", cut, mended))
    return Trace(name, TWO, steps, lasts_s, read)


def _cut_one_way(name: str, outward: bool, cut_s: float, lasts_s: float) -> Trace:
    """Cut one direction between the publisher and its router."""
    count = int(20 * (lasts_s - T - 0.5))
    cut, mended = T + 0.5, T + 0.5 + cut_s

    def read(log: Log) -> dict[str, Finding]:
        found = _arrivals(log, count) | _of_cut(log, cut, mended) | _news(log, "s", TOKEN, cut)
        return found | _links(log, "p", cut, mended)

    steps = (
        *_WATCHED,
        *_drives(20, count),
        Step(cut, "p-router1", "cut one way", (outward,)),
        Step(mended, "p-router1", "mend"),
    )
    return Trace(name, TWO, steps, lasts_s, read)


def _routers_cut(name: str, cut_s: float, lasts_s: float) -> Trace:
    """Cut the two routers apart for a while."""
    count = int(20 * (lasts_s - T - 0.5))
    cut, mended = T + 0.5, T + 0.5 + cut_s

    def read(log: Log) -> dict[str, Finding]:
        found = _arrivals(log, count) | _of_cut(log, cut, mended)
        found |= _news(log, "s", TOKEN, cut) | _news(log, "p", OTHER_TOKEN, cut)
        return found | {"s: token back": _back(log, "s", TOKEN, mended)} | _links(log, "s", cut, mended)

    steps = (*_WATCHED, *_drives(20, count), *_gap("router2-router1", cut, mended))
    return Trace(name, APART, steps, lasts_s, read)


CUTS = (
    _cut("a cut of 1 s", 1.0, 6.0),
    _cut("a cut of 3 s", 3.0, 11.0),
    _cut("a cut of 6.5 s", 6.5, 26.0),
    _cut("a cut of 8 s", 8.0, 24.0),
    _cut("a cut of 9 s", 9.0, 25.0),
    _cut("a cut of 14 s", 14.0, 36.0),
    _cut("a flood while cut", 3.0, 12.0, hz=1000, size=150),
    _cut("a flood of stops while cut", 3.0, 12.0, hz=200, size=200, kind="stop"),
    _cut_receiver("the receiver is cut for 3 s", 3.0, 11.0),
    _cut_receiver("the receiver is cut for 14 s", 14.0, 36.0),
    _cut_one_way("nothing reaches the publisher for 4 s", True, 4.0, 14.0),
    _cut_one_way("nothing reaches the publisher for 14 s", True, 14.0, 34.0),
    _cut_one_way("nothing leaves the publisher for 4 s", False, 4.0, 14.0),
    _routers_cut("two routers, a cut of 3 s", 3.0, 11.0),
    _routers_cut("two routers, a cut of 14 s", 14.0, 36.0),
)


# Ends and returns


def _ended(log: Log) -> dict[str, Finding]:
    return _news(log, "s", TOKEN, 2.0) | {"s: not connected": log.first("s", "connected", False)}


def _restarted(log: Log) -> dict[str, Finding]:
    return _news(log, "s", TOKEN, 2.0) | {"s: token back": _back(log, "s", TOKEN, 3.0)}


def _router_restarted(log: Log) -> dict[str, Finding]:
    found = _links(log, "p", 2.0, 3.5) | _links(log, "s", 2.0, 3.5) | _news(log, "s", TOKEN, 2.0)
    after = [each for each in log.of("s", "got", DRIVE, "d") if each.fields[3] > 2.05]
    late = [each.at - each.fields[3] for each in after]
    answered = [each.at for each in log.of("p", "answered", "q") if each.fields[1] == ["a"]]
    again = next((at - 3.5 for at in answered if at > 3.5), None)
    return found | {
        "s: token back": _back(log, "s", TOKEN, 3.5),
        "first put that arrives": after[0].fields[3] - 3.5 if after else None,
        "old samples": any(each > 0.5 for each in late),
        "first answer": again,
    }


def _frozen(log: Log) -> dict[str, Finding]:
    found = _news(log, "s", TOKEN, 2.0) | {"s: token back": _back(log, "s", TOKEN, 16.0)}
    return found | _links(log, "p", 2.0, 16.0)


def _frozen_receiver(log: Log) -> dict[str, Finding]:
    return _arrivals(log, 100) | _of_cut(log, 2.0, 5.0) | _news(log, "s", TOKEN, 2.0)


ENDS = (
    Trace("a client is killed", TWO, (*_WATCHED, Step(2.0, "p", "kill")), 4.0, _ended, quick=True),
    Trace("a client closes", TWO, (*_WATCHED, Step(2.0, "p", "close")), 4.0, _ended),
    Trace(
        "a client beyond two routers is killed",
        APART,
        (*_WATCHED, Step(2.0, "p", "kill")),
        4.0,
        _ended,
    ),
    Trace(
        "a client is killed while who watches it is cut off",
        TWO,
        (*_WATCHED, *_gap("s-router1", 2.0, 5.0), Step(2.5, "p", "kill")),
        10.0,
        _ended,
    ),
    Trace(
        "a client that is cut off is killed",
        TWO,
        (*_WATCHED, *_gap("p-router1", 2.0, 5.0), Step(2.5, "p", "kill")),
        14.0,
        _ended,
    ),
    Trace(
        "a client is killed and started",
        TWO,
        (
            *_WATCHED,
            Step(2.0, "p", "kill"),
            Step(3.0, "p", "start"),
            Step(4.0, "p", "announce", (TOKEN,)),
        ),
        6.0,
        _restarted,
    ),
    Trace(
        "a router is restarted",
        TWO,
        (
            *_WATCHED,
            *_drives(20, 240),
            Step(0.9, "s", "answer", (QUERY, "at once", "a")),
            Step(T, "p", "keep_asking", (QUERY, "q", 40, 0.3)),
            Step(2.0, "router1", "kill"),
            Step(3.5, "router1", "start"),
        ),
        15.0,
        _router_restarted,
    ),
    Trace(
        "a frozen program for 14 s",
        TWO,
        (*_WATCHED, Step(2.0, "p", "pause"), Step(16.0, "p", "resume")),
        30.0,
        _frozen,
    ),
    Trace(
        "a frozen receiver for 3 s",
        TWO,
        (*_WATCHED, *_drives(20, 100), Step(2.0, "s", "pause"), Step(5.0, "s", "resume")),
        8.0,
        _frozen_receiver,
    ),
)


# Tokens and queries


def _history(log: Log) -> dict[str, Finding]:
    listed = log.of("s", "listed")
    return {
        "told of": " ".join(sorted(each.fields[0].rpartition("/")[2] for each in log.of("s", "alive"))),
        "listed": " ".join(key.rpartition("/")[2] for key in listed[0].fields[1]) if listed else "never",
        "own token": log.first("p", "alive", TOKEN) is not None,
        "told after": log.first("s", "alive", since=2.0),
    }


def _twice(log: Log) -> dict[str, Finding]:
    def told(begun: float, until: float) -> str:
        return "".join("+" if each.fields[1] else "-" for each in log.of("s", "alive") if begun <= each.at < until)

    return {
        "both announce": told(0, 2.0),
        "one withdraws": told(2.0, 3.0),
        "it announces again": told(3.0, 4.0),
        "the other one is killed": told(4.0, 5.0),
        "both are gone": told(5.0, 9.0),
    }


_THREE = {"p": "router1", "s": "router1", "q": "router1"}
_THREE_APART = {"p": "router1", "s": "router1", "q": "router2"}


def _asked(name: str, how: str, *steps: Step, apart: bool = False, lasts_s: float = 5.0, quick: bool = False) -> Trace:
    """Ask for a key while something happens to who answers; ``q`` answers too."""
    agents = _THREE_APART if apart else _THREE
    begun = (
        Step(0.9, "s", "answer", (QUERY, how, "a")),
        Step(0.9, "q", "answer", ("fleet/r1/@rpc/claim/b", "at once", "b")),
        Step(2.0, "p", "ask", (QUERY, "one")),
        Step(2.0, "p", "ask", (QUERIES, "all")),
    )
    return Trace(
        name,
        agents,
        (*begun, *steps),
        lasts_s,
        lambda log: _answers(log, "one") | _answers(log, "all"),
        quick=quick,
    )


QUESTIONS = (
    Trace(
        "history of tokens",
        TWO,
        (
            Step(0.8, "p", "announce", (TOKEN,)),
            Step(0.8, "p", "announce", (GATEWAY,)),
            Step(1.0, "p", "watch", (TOKENS,)),
            Step(2.0, "s", "watch", (TOKENS,)),
            Step(2.5, "s", "list", (TOKENS, "l")),
        ),
        4.0,
        _history,
        quick=True,
    ),
    Trace(
        "two announce the same token",
        _THREE,
        (
            Step(0.7, "s", "watch", (TOKENS,)),
            Step(0.8, "p", "announce", (TOKEN,)),
            Step(1.2, "q", "announce", (TOKEN,)),
            Step(2.0, "p", "withdraw", (TOKEN,)),
            Step(3.0, "p", "announce", (TOKEN,)),
            Step(4.0, "p", "kill"),
            Step(5.0, "q", "kill"),
        ),
        7.0,
        _twice,
    ),
    _asked("questions are answered", "at once"),
    _asked("questions through two routers", "at once", apart=True, quick=True),
    _asked("a question is refused", "refused"),
    _asked("a question is never answered", "never"),
    _asked("the answerer is killed while it is asked", "never", Step(2.3, "s", "kill")),
    _asked("the answerer closes while it is asked", "never", Step(2.3, "s", "close")),
    _asked("the answerer was just cut off", "at once", Step(1.8, "s-router1", "cut")),
    _asked("the asker was just cut off", "at once", Step(1.8, "p-router1", "cut")),
    _asked("the asker is cut off and mended", "late", Step(2.2, "p-router1", "cut"), Step(2.6, "p-router1", "mend")),
    _asked("nobody is there to answer", "at once", Step(1.5, "s", "kill"), Step(1.5, "q", "kill")),
    _asked("the router is killed while it is asked", "never", Step(2.3, "router1", "kill")),
    _asked("nobody reaches a router", "at once", Step(1.7, "router1", "kill")),
)

TRACES = SAMPLES + CUTS + ENDS + QUESTIONS
