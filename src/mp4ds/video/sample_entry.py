"""What the track of an mp4 says of the codec of its packets, as it stands in the file."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

from mp4ds.errors import VideoError

_TO_DESCRIPTION = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
_ENTRY_BYTES = 78  # of a video's sample entry, between its header and the boxes in it
_LONGEST_ENTRY = 1 << 20


@dataclass(frozen=True, slots=True)
class SampleEntry:
    """The description of all packets of a track (ISO/IEC 14496-12, 8.5.2).

    Bit rates are left out: they are of the packets, not of the codec.

    Attributes:
        codec: Its four letters.
        values: Size, resolution and depth as they stand.
        boxes: What follows: parameter sets, colour, aspect ratio, ...
    """

    codec: str
    values: bytes
    boxes: tuple[tuple[str, bytes], ...]

    @property
    def aspect_ratio(self) -> Fraction:
        """Width to height of a pixel; 0 if nothing is said."""
        pasp = dict(self.boxes).get("pasp", b"")
        across, down = struct.unpack(">II", pasp) if len(pasp) == 8 else (0, 1)
        return Fraction(across, down) if down else Fraction(0)

    @property
    def size(self) -> str:
        """Width and height in pixels."""
        width, height = struct.unpack_from(">HH", self.values, 24)
        return f"{width}x{height}"

    def differences(self, other: SampleEntry) -> str:
        """What differs, in words; empty if nothing does."""
        if self == other:
            return ""
        if self.codec != other.codec:
            return f"their codec ({self.codec} and {other.codec})"
        if self.size != other.size:
            return f"their size ({self.size} and {other.size})"
        kinds = sorted({kind for kind, _ in set(self.boxes) ^ set(other.boxes)})
        return f"what they say of their codec ({', '.join(kinds) or 'order or depth'})"


def read_sample_entry(path: Path) -> SampleEntry:
    """The description of the first track's packets.

    Args:
        path: An mp4 of which nothing needs to be true; at most 1 MiB of it is held.

    Raises:
        VideoError: ``file-missing``, or ``video-unreadable`` where there is not just one
            description.
        OSError: It cannot be read.
    """
    if not path.is_file():
        raise VideoError("file-missing", path, "does not exist")
    with path.open("rb") as file:
        try:
            return _parsed(_description(file, path.stat().st_size))
        except (struct.error, ValueError) as error:
            raise VideoError(
                "video-unreadable", path, f"has no description of one track: {error}"
            ) from None


def _description(file: BinaryIO, length: int) -> bytes:
    """The only entry of the first track's ``stsd``.

    Raises:
        ValueError, struct.error: There is none.
    """
    start, end = 0, length
    for kind in _TO_DESCRIPTION:
        start, end = _find(file, kind, start, end)
    if end - start > _LONGEST_ENTRY:
        raise ValueError("it is too long")
    file.seek(start)
    data = file.read(end - start)
    if struct.unpack_from(">I", data, 4) != (1,):
        raise ValueError("there are several")
    return data[8:]


def _find(file: BinaryIO, wanted: bytes, start: int, end: int) -> tuple[int, int]:
    """Where the contents of the first box of a kind begin and end."""
    while start < end:
        file.seek(start)
        size, kind = struct.unpack(">I4s", file.read(8))
        header = 8
        if size == 1:
            (size,) = struct.unpack(">Q", file.read(8))
            header = 16
        if size < header or start + size > end:
            raise ValueError("a box is damaged")
        if kind == wanted:
            return start + header, start + size
        start += size
    raise ValueError(f"box {wanted.decode()} is missing")


def _parsed(data: bytes) -> SampleEntry:
    size, kind = struct.unpack_from(">I4s", data)
    if not 8 + _ENTRY_BYTES <= size <= len(data):
        raise ValueError("a box is damaged")
    boxes, at, end = [], 8 + _ENTRY_BYTES, size
    while at < end:
        size, name = struct.unpack_from(">I4s", data, at)
        if not 8 <= size <= end - at:
            raise ValueError("a box is damaged")
        if name != b"btrt":
            body = data[at + 8 : at + size]
            body = _without_rates(body) if name == b"esds" else body
            boxes.append((name.decode("latin-1"), body))
        at += size
    return SampleEntry(kind.decode("latin-1"), data[8 : 8 + _ENTRY_BYTES], tuple(boxes))


def _without_rates(esds: bytes) -> bytes:
    """An elementary stream descriptor as ffmpeg writes it, with its size of a buffer and rates 0.

    ISO/IEC 14496-1, 7.2.6.5 and 7.2.6.6: tags, each with a length of four bytes, an ES_ID and
    flags of three bytes, and two bytes that tell the codec.
    """
    if esds[4:5] != b"\3" or esds[12:13] != b"\4" or len(esds) < 30:
        return esds
    return esds[:19] + bytes(11) + esds[30:]
