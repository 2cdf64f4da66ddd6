from __future__ import annotations

import io
import json
import sys
import threading

from tests.e2e.rigs.lines import Lines

THREADS, EACH = 11, 200


class Slow(io.StringIO):
    """Lets other threads run in the midst of each write, and between two."""

    def write(self, text: str) -> int:
        for character in text:
            super().write(character)
            threading.Event().wait(0)
        return len(text)


def test_lines_of_many_threads_are_not_torn() -> None:
    stream = Slow()
    say = Lines(stream)

    def work(number: int) -> None:
        for count in range(EACH):
            say(thread=number, count=count)

    switching_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=work, args=(number,)) for number in range(THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(switching_s)
    written = [json.loads(line) for line in stream.getvalue().splitlines()]
    for number in range(THREADS):
        assert [line["count"] for line in written if line["thread"] == number] == list(range(EACH))
