"""Pictures cut out of a camera's answer: as legacy robots write it, as other cameras do, and as none should."""

from __future__ import annotations

import random

import pytest

from tests.bounds import most_kept
from tests.camera.camera_bytes import HEAD, jpeg, part
from zbridge.camera.mjpeg import HEAD_BYTES, PICTURE_BYTES, MjpegReader
from zbridge.errors import ProtocolError

ONE, TWO, THREE = jpeg(1), jpeg(2, 3000), jpeg(3)
PLAIN = HEAD + part(ONE) + part(TWO) + part(THREE)


def head(content_type: bytes) -> bytes:
    return b"HTTP/1.1 200 OK\r\ncontent-type: " + content_type + b"\r\n\r\n"


MIXED = b"multipart/x-mixed-replace"
IMAGE = b"Content-Type: image/jpeg\r\n"
CAMERAS = {
    "a legacy robot": PLAIN,
    "no length": HEAD + b"".join(b"--FRAME\r\n" + IMAGE + b"\r\n" + each + b"\r\n" for each in (ONE, TWO, THREE))
    + b"--FRAME\r\n",
    "no length and bare line feeds": head(MIXED + b";boundary=x").replace(b"\r", b"")
    + b"".join(b"--x\nContent-type:image/jpeg\n\n" + each + b"\n" for each in (ONE, TWO, THREE))
    + b"--x--",
    "dashes in the parameter, no line break before or after a delimiter": head(MIXED + b"; boundary=--jpgboundary")
    + b"".join(
        b"--jpgboundary" + IMAGE + b"Content-length: %d\r\n\r\n" % len(each) + each for each in (ONE, TWO, THREE)
    ),
    "dashes in the parameter, and two more": head(MIXED + b'; charset=x; Boundary="--b"')
    + b"".join(b"\r\n----b\r\ncontent-length:%d\r\n\r\n" % len(each) + each for each in (ONE, TWO, THREE)),
    "a preamble, and an end": HEAD + b"hello\r\n" + part(ONE) + part(TWO) + part(THREE) + b"--FRAME--\r\nbye",
    "zeros after the picture": HEAD + b"".join(part(each + b"\0\0") for each in (ONE, TWO, THREE)),
    "no end of picture": HEAD + b"".join(part(each[:-2]) for each in (ONE, TWO, THREE)) + part(ONE)[:9],
}  # fmt: skip


def pictures(data: bytes, *cuts: int) -> list[bytes]:
    reader, begin, found = MjpegReader(), 0, list[bytes]()
    for cut in (*cuts, len(data)):
        found += [each.jpeg for each in reader.receive(data[begin:cut])]
        begin = cut
    return found


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_picture_is_cut_out_byte_for_byte_wherever_reads_end(camera: str) -> None:
    data = CAMERAS[camera]
    whole = pictures(data)
    assert [each.rstrip(b"\0").removesuffix(b"\xff\xd9") for each in whole] == [
        each.removesuffix(b"\xff\xd9") for each in (ONE, TWO, THREE)
    ]
    assert pictures(data, *range(1, len(data))) == whole, "byte by byte"
    for cut in range(0, len(data), 7):
        assert pictures(data, cut) == whole, cut


def test_the_head_and_each_header_are_kept_as_the_camera_wrote_them() -> None:
    reader = MjpegReader()
    parts = reader.receive(PLAIN)
    assert (reader.head, reader.boundary) == (HEAD, b"FRAME")
    assert reader.head + b"".join(each.head + each.jpeg + b"\r\n" for each in parts) == PLAIN


def test_a_picture_is_given_as_soon_as_its_last_byte_has_come() -> None:
    assert pictures(HEAD + part(ONE).removesuffix(b"\r\n")) == [ONE]


def test_the_end_of_the_stream_is_told_and_nothing_after_it_is_read() -> None:
    reader = MjpegReader()
    reader.receive(PLAIN)
    assert not reader.ended
    assert reader.receive(b"--FRAME--\r\n" + part(ONE)) == []
    assert (reader.ended, reader.receive(part(ONE))) == (True, [])


@pytest.mark.parametrize(
    "other",
    [b"--FRAME\r\nContent-Length: 5\r\n\r\nhello\r\n", b"--FRAME\r\nContent-Length: 0\r\n\r\n\r\n"]
    + [part(ONE).replace(b"image/jpeg", b"text/plain"), b"--FRAME\r\n\r\nno length, no picture\r\n"],
)
def test_a_part_that_is_no_jpeg_is_left_out_and_counted(other: bytes) -> None:
    reader = MjpegReader()
    assert [each.jpeg for each in reader.receive(HEAD + part(ONE) + other + part(TWO))] == [ONE, TWO]
    assert reader.rejected == 1


LONG = b"x" * (HEAD_BYTES + 1)
LIES: dict[str, tuple[bytes, str]] = {
    "no HTTP": (b"\0\x01\x02\r\n\r\n", "not HTTP"),
    "not found": (b"HTTP/1.0 404 File not found\r\n\r\n", "the answer is HTTP 404"),
    "moved": (b"HTTP/1.1 302 Found\r\nLocation: http://10.0.0.1/\r\n\r\n", "the answer is HTTP 302"),
    "chunks": (head(MIXED + b"; boundary=x\r\nTransfer-Encoding: chunked"), "transfer-encoding"),
    "packed": (head(MIXED + b"; boundary=x\r\nContent-Encoding: gzip"), "content-encoding"),
    "one picture": (head(b"image/jpeg"), "not multipart/x-mixed-replace"),
    "no type": (b"HTTP/1.0 200 OK\r\n\r\n", "not multipart/x-mixed-replace"),
    "no boundary": (head(MIXED), "names no boundary"),
    "an empty boundary": (head(MIXED + b"; boundary="), "names no boundary"),
    "an endless head": (b"HTTP/1.0 200 OK\r\nX: " + LONG, "an HTTP head of more than 16384 bytes"),
    "an endless head of many fields": (b"HTTP/1.0 200 OK\r\n" + b"a: b\r\n" * 4000, "an HTTP head of more than 16384"),
    "no part": (HEAD + LONG, "no part within 16384 bytes"),
    "an endless header": (HEAD + b"--FRAME\r\nX: " + LONG, "the header of a part of more than 16384 bytes"),
    "endless line breaks": (HEAD + part(ONE) + b"\r\n" * 5, "line breaks after a picture"),
    "a length that is none": (HEAD + b"--FRAME\r\nContent-Length: -5\r\n\r\n", "no number of bytes"),
    "a length of many digits": (HEAD + b"--FRAME\r\nContent-Length: " + b"9" * 5000 + b"\r\n\r\n", "no number of"),
    "a picture too large": (
        HEAD + b"--FRAME\r\nContent-Length: 4194305\r\n\r\n", "a picture of 4194305 bytes exceeds 4194304"
    ),
    "a picture without end": (HEAD + b"--FRAME\r\n\r\n" + b"\xff" * (PICTURE_BYTES + 20), "a picture of more than"),
    "too short a length": (HEAD + part(ONE).replace(b"113", b"107") + part(TWO), "no delimiter where a part ends"),
    "too long a length": (HEAD + part(ONE).replace(b"113", b"116") + part(TWO), "no delimiter where a part ends"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_what_contradicts_the_form_or_a_bound_is_an_error_and_gives_no_picture(lie: str) -> None:
    assert len(ONE) == 113, "the lengths above are of this picture"
    data, text = LIES[lie]
    with pytest.raises(ProtocolError, match=text):
        pictures(data)
    with pytest.raises(ProtocolError, match=text):
        assert pictures(data, *range(1000, len(data), 1000)) == [], "bytes that come later contradict"


def test_a_picture_of_the_largest_size_is_taken_with_and_without_a_length() -> None:
    largest = jpeg(1, PICTURE_BYTES - 49)
    assert len(largest) == PICTURE_BYTES
    assert pictures(HEAD + part(largest)) == [largest]
    assert pictures(HEAD + b"--FRAME\r\n\r\n" + largest + b"\r\n--FRAME\r\n") == [largest]


def test_what_is_kept_of_a_stream_that_never_ends_a_picture_is_bounded() -> None:
    reader = MjpegReader()
    reader.receive(HEAD + b"--FRAME\r\n\r\n\xff\xd8\xff")
    most = 0

    def flood() -> None:
        nonlocal most
        for _ in range(100):
            reader.receive(bytes(64 * 1024))
            most = max(most, most_kept(reader))

    with pytest.raises(ProtocolError):
        flood()
    assert 0 < most <= PICTURE_BYTES + 100


@pytest.mark.parametrize("seed", range(4))
def test_random_bytes_and_spoiled_streams_give_pictures_or_a_protocol_error(seed: int) -> None:
    rng = random.Random(seed)
    for _ in range(100):
        data = bytearray(PLAIN)
        for _ in range(rng.randrange(8)):
            at = rng.randrange(len(data))
            data[at : at + rng.randrange(9)] = rng.randbytes(rng.randrange(9))
        reader = MjpegReader()
        try:
            for begin in range(0, len(data), 500):
                for each in reader.receive(bytes(data[begin : begin + 500])):
                    assert each.jpeg.startswith(b"\xff\xd8\xff")
        except ProtocolError:
            continue
