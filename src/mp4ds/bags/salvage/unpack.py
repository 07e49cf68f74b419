"""What can be unpacked of the compressed content of a damaged chunk."""

from __future__ import annotations

from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from typing import NamedTuple

import lz4.frame
import zstandard

from mp4ds.bags.inflate import ZSTD_PIECE, most_unpacked

_PIECE = 2**12
_SMALL_PIECE = 64
"""Bytes unpacked at a time from damaged data: the piece that shows the damage gives nothing."""

_CLOSE = 16
"""Bytes at the end, of a mark and a checksum, that are unpacked one by one."""

_LZ4_RATIO = 255
_LZ4_BLOCK = 2**23  # the largest is 4 MiB, and one may be waiting

_MAX_AT_ONCE = 64 * 2**20

_MAGIC = {b"BZh": "bz2", b"\x04\x22\x4d\x18": "lz4", b"\x28\xb5\x2f\xfd": "zstd"}


class Unpacked(NamedTuple):
    """Content of a chunk.

    Attributes:
        content: What came out, from its beginning.
        used: Bytes of the data that belong to it, 0 where that does not show.
        problem: What is wrong, a phrase; empty where nothing is.
        is_sound: Whether what came out is what went in, though some of it may be missing.
    """

    content: bytes
    used: int
    problem: str
    is_sound: bool = True


def unpack(compression: str, data: memoryview, size: int) -> Unpacked:
    """Unpack as much as there is.

    Args:
        compression: Its name: ``none`` or empty, ``bz2``, ``lz4`` or ``zstd``; where that is
            damaged, the data tells.
        data: As it is in the file, perhaps cut short.
        size: Bytes that it should give; no more are unpacked, and no more than data of its
            length may hold.
    """
    if compression in ("", "none"):
        content = bytes(data[:size])
        problem = "" if len(content) == size else "a chunk is cut short"
        return Unpacked(content, len(content), problem)
    size = min(size, most_unpacked(len(data)))
    start = bytes(data[:4])
    found = next((name for magic, name in _MAGIC.items() if start.startswith(magic)), compression)
    if found not in _MACHINES:
        return Unpacked(b"", 0, f"a chunk is compressed by {compression!r}, which is not known")
    pieces: list[bytes] = []
    left = size + 1
    machine = _MACHINES[found]()
    step = len(data) if size <= _MAX_AT_ONCE else _PIECE
    at = 0
    try:
        while at < len(data) and left > 0 and not machine.eof:
            pieces.append(machine.decompress(data[at : at + step], left))
            left -= len(pieces[-1])
            at += step
    except _DAMAGE:
        if step > _PIECE:
            pieces, left = _by_pieces(found, data, size)
        problem = f"the {found} data of a chunk is damaged"
        return Unpacked(b"".join(pieces)[:size], 0, problem, found == "bz2")
    content = b"".join(pieces)
    if not machine.eof:
        if left <= 0:
            problem = f"the {found} data of a chunk unpacks to more than {size} bytes"
            # bz2 verifies a block at its end, which was not reached
            return Unpacked(b"" if found == "bz2" else content[:size], 0, problem, False)
        return Unpacked(content, 0, f"the {found} data of a chunk is cut short")
    used = min(at, len(data)) - machine.unused
    if len(content) != size:
        problem = f"a chunk holds {len(content)} bytes instead of {size}"
        return Unpacked(content, used, problem, found == "bz2")
    return Unpacked(content, used, "")


def _by_pieces(compression: str, data: memoryview, size: int) -> tuple[list[bytes], int]:
    """What comes out before the damage."""
    machine = _MACHINES[compression]()
    pieces: list[bytes] = []
    left = size
    try:
        for start, end in _small_pieces(len(data)):
            piece = machine.decompress(data[start:end], left)
            left -= len(piece)
            if compression == "bz2" and left <= 0 and not machine.eof:
                break  # its last block was not verified
            pieces.append(piece)
            if left <= 0 or machine.eof:
                break
    except _DAMAGE:
        pass
    return pieces, left


def _small_pieces(length: int) -> Iterator[tuple[int, int]]:
    body = max(0, length - _CLOSE)
    for start in range(0, body, _SMALL_PIECE):
        yield start, min(start + _SMALL_PIECE, body)
    for start in range(body, length):
        yield start, start + 1


_DAMAGE = (OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError)


class _Bz2:
    def __init__(self) -> None:
        self._machine = BZ2Decompressor()

    @property
    def eof(self) -> bool:
        return self._machine.eof

    @property
    def unused(self) -> int:
        return len(self._machine.unused_data)

    def decompress(self, data: memoryview, size: int) -> bytes:
        return self._machine.decompress(data, max_length=size)


class _Lz4:
    def __init__(self) -> None:
        self._machine = lz4.frame.LZ4FrameDecompressor()

    @property
    def eof(self) -> bool:
        return bool(self._machine.eof)

    @property
    def unused(self) -> int:
        return len(self._machine.unused_data or b"")

    def decompress(self, data: memoryview, size: int) -> bytes:
        # It allocates what it is allowed: more than this cannot come of the data at once.
        room = min(size, _LZ4_RATIO * len(data) + _LZ4_BLOCK)
        pieces: list[bytes] = [self._machine.decompress(data, max_length=room)]
        size -= len(pieces[-1])
        while size > 0 and pieces[-1] and not self._machine.eof and not self._machine.needs_input:
            pieces.append(self._machine.decompress(b"", max_length=min(size, _LZ4_BLOCK)))
            size -= len(pieces[-1])
        return b"".join(pieces)


class _Zstd:
    def __init__(self) -> None:
        self._machine = zstandard.ZstdDecompressor().decompressobj()
        self._not_fed = 0

    @property
    def eof(self) -> bool:
        return self._machine.eof

    @property
    def unused(self) -> int:
        return len(self._machine.unused_data) + self._not_fed

    def decompress(self, data: memoryview, size: int) -> bytes:
        # It knows no limit: small pieces bound what comes of one.
        pieces: list[bytes] = []
        for at in range(0, len(data), ZSTD_PIECE):
            if size < 0 or self._machine.eof:
                self._not_fed = len(data) - at
                break
            pieces.append(self._machine.decompress(data[at : at + ZSTD_PIECE]))
            size -= len(pieces[-1])
        return b"".join(pieces)


_Machine = _Bz2 | _Lz4 | _Zstd
_MACHINES: dict[str, Callable[[], _Machine]] = {"bz2": _Bz2, "lz4": _Lz4, "zstd": _Zstd}
