"""Bytes of any file changed, with no regard for what they mean, or little."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from fuzz_records import LENGTHS


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four injuries."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(INJURIES)(data, rng) or b"\0"
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data))
    return _put(data, place, bytes([data[place] ^ 1 << rng.randrange(8)]))


def _byte(data: bytes, rng: random.Random) -> bytes:
    return _put(data, rng.randrange(len(data)), bytes([rng.choice((0, 1, 0x7F, 0x80, 0xFF, 10))]))


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _range(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data))
    return start, min(len(data), start + rng.choice((1, 4, 9, 64, 512, 4096)))


def _remove(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    return data[:start] + data[end:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 50)) + data[end:]


def _splice(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    place = rng.randrange(len(data))
    return _put(data, place, data[start:end])[: len(data)]


def _zero(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    return _put(data, start, bytes(end - start))


def _length(data: bytes, rng: random.Random) -> bytes:
    """A number of 2, 4 or 8 bytes that may be a length gets another value."""
    form = rng.choice(("<H", "<I", "<Q", ">H", ">I", ">Q"))
    size = struct.calcsize(form)
    if len(data) < size:
        return data
    likely = [rng.randrange(len(data) - size + 1) for _ in range(16)]
    place = min(likely, key=lambda at: struct.unpack_from(form, data, at)[0] or 2**64)
    old = struct.unpack_from(form, data, place)[0]
    new = rng.choice((*LENGTHS, old + 1, old - 1, old * 2, len(data), len(data) - place))
    return _put(data, place, struct.pack(form, new % 2 ** (8 * size)))


def _header(data: bytes, rng: random.Random) -> bytes:
    """A field of a bag's record, or the opcode or length of an MCAP record."""
    words: tuple[bytes, ...] = (
        b"op=",
        b"conn=",
        b"size=",
        b"count=",
        b"ver=",
        b"index_pos=",
        b"chunk_count=",
    )
    words += (b"chunk_pos=", b"conn_count=", b"time=", b"start_time=", b"end_time=")
    places = _places(data, words)
    if data.startswith(b"\x89MCAP0\r\n"):
        places = _mcap_places(data)
    if not places:
        return _length(data, rng)
    place = rng.choice(places)
    value = struct.pack("<Q", rng.choice(LENGTHS))[: rng.choice((1, 4, 8))]
    return _put(data, place, value)[: len(data)]


def _places(data: bytes, words: tuple[bytes, ...]) -> list[int]:
    found = []
    for word in words:
        place = data.find(word)
        while place >= 0:
            found.append(place + len(word))
            place = data.find(word, place + 1)
    return found


def _mcap_places(data: bytes) -> list[int]:
    found, at = [], 8
    while at + 9 < len(data):
        (size,) = struct.unpack_from("<Q", data, at + 1)
        found += [at, at + 1, *range(at + 9, min(at + 9 + size, at + 49), 2)]
        at += 9 + size
    return [place for place in found if place < len(data)]


def _token(data: bytes, rng: random.Random) -> bytes:
    """A value of a text gets another one; of other files, a word."""
    lines = data.split(b"\n")
    number = rng.randrange(len(lines))
    key, colon, _ = lines[number].partition(b":")
    if not colon or len(key) > 60:
        return _byte(data, rng)
    values: tuple[bytes, ...] = (
        b"-1",
        b"9999999999999999999999",
        b"null",
        b"[]",
        b"{}",
        b"true",
        b'""',
        b"1e999",
    )
    values += (b"../../etc/passwd", b"'" + b"x" * 5000 + b"'", b"&a [*a]", b"!!python/none x", b".")
    comma = b"," if lines[number].rstrip().endswith(b",") else b""
    lines[number] = key + b": " + rng.choice(values) + comma
    return b"\n".join(lines)


INJURIES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *(_flip, _flip, _byte, _cut, _remove, _repeat, _splice, _zero),
    *(_length, _length, _header, _header, _token, _token),
)


def _put(data: bytes, place: int, new: bytes) -> bytes:
    return data[:place] + new + data[place + len(new) :]
