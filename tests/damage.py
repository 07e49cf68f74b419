"""Damaging recordings, and knowing what of them must still be there.

A recording is taken apart here by the two formats' own rules: nothing uses mp4ds, so that its
tests have an independent source.
"""

from __future__ import annotations

import bz2
import random
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import lz4.frame
import zstandard

Key = tuple[str, int, bytes]
"""A message: its topic, its log time in ns, its payload."""


@dataclass
class Piece:
    """A stretch of a file that is read as a whole or not at all.

    Attributes:
        start: Byte where it begins.
        end: Byte after it.
        messages: Channel id, log time and payload of the messages that lie in it.
        defines: Topics of the channels that it defines, by their id.
        is_index: Whether it only repeats what stands elsewhere.
    """

    start: int
    end: int
    messages: list[tuple[int, int, bytes]] = field(default_factory=list)
    defines: dict[int, str] = field(default_factory=dict)
    is_index: bool = False


# ---------------------------------------------------------------- ROS 1 bag


def bag_fields(raw: bytes) -> dict[bytes, bytes]:
    found, at = {}, 0
    while at < len(raw):
        (size,) = struct.unpack_from("<I", raw, at)
        name, _, value = raw[at + 4 : at + 4 + size].partition(b"=")
        found[name] = value
        at += 4 + size
    return found


def bag_records(data: bytes, at: int) -> Iterator[tuple[int, int, int, dict[bytes, bytes]]]:
    """Start, start of the body, end, and header of each record."""
    while at < len(data):
        (head,) = struct.unpack_from("<I", data, at)
        fields = bag_fields(data[at + 4 : at + 4 + head])
        (size,) = struct.unpack_from("<I", data, at + 4 + head)
        body = at + 8 + head
        yield at, body, body + size, fields
        at = body + size


def _bag_piece(data: bytes, record: tuple[int, int, int, dict[bytes, bytes]]) -> Piece:
    start, body, end, fields = record
    piece = Piece(start, end)
    if fields[b"op"] == b"\x02":
        seconds, nanoseconds = struct.unpack("<II", fields[b"time"])
        (connection,) = struct.unpack("<I", fields[b"conn"])
        time = seconds * 10**9 + nanoseconds
        piece.messages.append((connection, time, data[body:end]))
    elif fields[b"op"] == b"\x07":
        (connection,) = struct.unpack("<I", fields[b"conn"])
        piece.defines[connection] = fields[b"topic"].decode()
    return piece


def bag_pieces(data: bytes) -> list[Piece]:
    """The pieces of a bag, in order; uncompressed chunks fall apart into their records."""
    pieces: list[Piece] = [Piece(0, 13)]
    index = False
    for record in bag_records(data, 13):
        start, body, end, fields = record
        if fields[b"op"] != b"\x05":
            piece = _bag_piece(data, record)
            index = index or bool(piece.defines)
            piece.is_index = index or fields[b"op"] == b"\x04"
            pieces.append(piece)
            continue
        kind = fields[b"compression"]
        if kind == b"none":
            pieces.append(Piece(start, body))
            inner = data[:end]
            pieces += [_bag_piece(inner, part) for part in bag_records(inner, body)]
            continue
        raw = bz2.decompress(data[body:end]) if kind == b"bz2" else _unlz4(data[body:end])
        whole = Piece(start, end)
        for part in bag_records(raw, 0):
            found = _bag_piece(raw, part)
            whole.messages += found.messages
            whole.defines |= found.defines
        pieces.append(whole)
    return pieces


def _unlz4(data: bytes) -> bytes:
    raw: bytes = lz4.frame.decompress(data)
    return raw


# ---------------------------------------------------------------- MCAP


def _mcap_records(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Start, opcode, start of the body, and end of each record."""
    while at < end:
        opcode, size = struct.unpack_from("<BQ", data, at)
        yield at, opcode, at + 9, at + 9 + size
        if opcode == 2:
            return
        at += 9 + size


def _mcap_piece(data: bytes, start: int, opcode: int, body: int, end: int) -> Piece:
    piece = Piece(start, end)
    if opcode == 5:
        channel, _, time, _ = struct.unpack_from("<HIQQ", data, body)
        piece.messages.append((channel, time, data[body + 22 : end]))
    elif opcode == 4:
        channel, _, size = struct.unpack_from("<HHI", data, body)
        piece.defines[channel] = data[body + 8 : body + 8 + size].decode()
    elif opcode == 3:
        (schema,) = struct.unpack_from("<H", data, body)
        piece.defines[-schema] = ""
    return piece


def mcap_pieces(data: bytes) -> list[Piece]:
    """The pieces of an MCAP file, in order; uncompressed chunks fall apart into records."""
    pieces = [Piece(0, 8)]
    index = False
    for start, opcode, body, end in _mcap_records(data, 8, len(data)):
        if opcode != 6:
            piece = _mcap_piece(data, start, opcode, body, end)
            index = index or opcode == 15
            piece.is_index = index or opcode == 7
            pieces.append(piece)
            continue
        size, _, length = struct.unpack_from("<QII", data, body + 16)
        compression = data[body + 32 : body + 32 + length]
        first = body + 32 + length + 8
        if not compression:
            pieces.append(Piece(start, first))
            parts = _mcap_records(data, first, end)
            pieces += [_mcap_piece(data, *part) for part in parts]
            continue
        packed = data[first:end]
        raw = _unlz4(packed) if compression == b"lz4" else _unzstd(packed, size)
        whole = Piece(start, end)
        for part in _mcap_records(raw, 0, len(raw)):
            found = _mcap_piece(raw, *part)
            whole.messages += found.messages
            whole.defines |= found.defines
        pieces.append(whole)
    pieces.append(Piece(len(data) - 8, len(data), is_index=True))
    return pieces


def _unzstd(data: bytes, size: int) -> bytes:
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)


def pieces_of(path: Path) -> list[Piece]:
    """The pieces of an intact bag or MCAP file."""
    data = path.read_bytes()
    return bag_pieces(data) if data.startswith(b"#ROSBAG") else mcap_pieces(data)


# ---------------------------------------------------------------- damage


@dataclass(frozen=True)
class Damage:
    """What was done to a file.

    Attributes:
        start: First byte of the original that is not as it was.
        end: The byte after the last one.
        shift: How much further what follows stands now.
    """

    start: int
    end: int
    shift: int = 0

    def touches(self, piece: Piece) -> bool:
        """Whether a piece is not as it was."""
        if self.start == self.end:
            return piece.start < self.start < piece.end
        return piece.start < self.end and self.start < piece.end


Injury = Callable[[bytes, random.Random], tuple[bytes, Damage]]


def flip(data: bytes, rng: random.Random) -> tuple[bytes, Damage]:
    """One bit."""
    place = rng.randrange(len(data))
    return _changed(data, place, bytes([data[place] ^ 1 << rng.randrange(8)]))


def burst(data: bytes, rng: random.Random) -> tuple[bytes, Damage]:
    """A few bytes that follow each other, each to another value."""
    place = rng.randrange(len(data) - 32)
    return _changed(data, place, bytes(byte ^ 0x5A for byte in data[place : place + 24]))


def zeros(data: bytes, rng: random.Random) -> tuple[bytes, Damage]:
    """A sector that was never written."""
    place = rng.randrange(len(data)) // 512 * 512
    return _changed(data, place, bytes(len(data[place : place + 512])))


def cut(data: bytes, rng: random.Random) -> tuple[bytes, Damage]:
    """The end is gone."""
    place = rng.randrange(1, len(data))
    return data[:place], Damage(place, len(data))


def gap(data: bytes, rng: random.Random) -> tuple[bytes, Damage]:
    """Bytes in the middle are gone."""
    place = rng.randrange(len(data))
    size = min(rng.randrange(1, 5000), len(data) - place)
    return data[:place] + data[place + size :], Damage(place, place + size, -size)


def stuffing(data: bytes, rng: random.Random) -> tuple[bytes, Damage]:
    """Bytes that do not belong there stand in the middle."""
    place = rng.randrange(len(data))
    size = rng.randrange(1, 5000)
    return data[:place] + rng.randbytes(size) + data[place:], Damage(place, place, size)


def _changed(data: bytes, place: int, new: bytes) -> tuple[bytes, Damage]:
    return data[:place] + new + data[place + len(new) :], Damage(place, place + len(new))


INJURIES: dict[str, Injury] = {
    "flip": flip,
    "burst": burst,
    "zeros": zeros,
    "cut": cut,
    "gap": gap,
    "stuffing": stuffing,
}


def all_messages(pieces: Sequence[Piece]) -> list[Key]:
    """All messages, in the order of the file."""
    topics = {key: topic for piece in pieces for key, topic in piece.defines.items()}
    return [(topics[m[0]], *m[1:]) for piece in pieces for m in piece.messages]


def sound_messages(pieces: Sequence[Piece], damages: Sequence[Damage]) -> list[Key]:
    """Messages that lie in undamaged pieces, and whose channel does so before or with them."""
    topics: dict[int, str] = {}
    sound: list[Key] = []
    for piece in pieces:
        if any(damage.touches(piece) for damage in damages):
            continue
        if not piece.is_index:
            topics |= piece.defines
        sound += [(topics[m[0]], *m[1:]) for m in piece.messages if m[0] in topics]
    return sound
