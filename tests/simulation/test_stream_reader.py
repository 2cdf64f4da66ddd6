"""The thread that reads a stream and says how late it was, on a pair of sockets."""

import queue
import socket
import time

from zbridge.simulation.stream_reader import Read, StreamReader

SOON_S = 5.0


def test_each_read_is_given_up_to_the_end_of_the_stream_and_data_that_waited_unread_makes_the_reader_late() -> None:
    reads: queue.Queue[Read] = queue.Queue()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        reader = StreamReader(ours, time.time() - 0.5, reads.put)
        theirs.send(b"one")
        reader.start()
        first = reads.get(timeout=SOON_S)
        assert first.data == b"one"
        assert first.late_s >= 0.5
        theirs.send(b"two")
        second = reads.get(timeout=SOON_S)
        assert (second.data, second.why) == (b"two", "")
        theirs.close()
        assert reads.get(timeout=SOON_S).data == b""
        reader.join(SOON_S)
        assert not reader.is_alive()
