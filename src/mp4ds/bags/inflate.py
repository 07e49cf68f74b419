"""How much compressed data may unpack to: a few bytes can claim, and hold, gigabytes."""

from __future__ import annotations

CHUNK_RATIO = 256  # of lz4 it is 255
"""Times smaller than its content the data of a large chunk or message is at most."""

FILE_RATIO = 1024
"""The same of a whole file, which is not held in memory."""

ZSTD_PIECE = 2**11
"""Bytes of zstd that are unpacked at a time: they give 64 MiB at most."""

_ALWAYS = 128 * 2**20


def most_unpacked(packed: int, ratio: int = CHUNK_RATIO) -> int:
    """Bytes that so many compressed ones may unpack to.

    Small ones may hold anything, such as a black picture.
    """
    return max(_ALWAYS, ratio * packed)
