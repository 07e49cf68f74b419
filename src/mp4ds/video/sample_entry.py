"""What the track of an mp4 says of the codec of its packets, as it stands in the file."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

from mp4ds.errors import VideoError
from mp4ds.video.boxes import Box, DamagedBoxError, boxes, find_box

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
    def width(self) -> int:
        """Columns."""
        return int.from_bytes(self.values[24:26], "big")

    @property
    def height(self) -> int:
        """Rows."""
        return int.from_bytes(self.values[26:28], "big")

    @property
    def size(self) -> str:
        """Width and height in pixels."""
        return f"{self.width}x{self.height}"

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
            box = Box(b"", 0, path.stat().st_size)
            for kind in _TO_DESCRIPTION:
                box = find_box(file, kind, box.start, box.end, outermost=kind == b"moov")
            return parse_descriptions(file, box)
        except DamagedBoxError as error:
            raise VideoError(
                "video-unreadable", path, f"has no description of one track: {error}"
            ) from None


def parse_descriptions(file: BinaryIO, stsd: Box) -> SampleEntry:
    """The only entry of a track's ``stsd``.

    Args:
        file: Where it is; at most 1 MiB of it is read.
        stsd: Its place there.

    Raises:
        DamagedBoxError: There is not just one, or it contradicts itself.
    """
    if stsd.size > _LONGEST_ENTRY:
        raise DamagedBoxError("it is too long")
    file.seek(stsd.start)
    data = file.read(stsd.size)
    if data[4:8] != b"\0\0\0\1":
        raise DamagedBoxError("there are several")
    file = io.BytesIO(data)
    entry = next(boxes(file, 8, len(data)), None)
    if entry is None or entry.size < _ENTRY_BYTES:
        raise DamagedBoxError("a box is damaged")
    values_end = entry.start + _ENTRY_BYTES
    parts = []
    for box in boxes(file, values_end, entry.end):
        if box.kind != b"btrt":
            body = data[box.start : box.end]
            body = _without_rates(body) if box.kind == b"esds" else body
            parts.append((box.kind.decode("latin-1"), body))
    return SampleEntry(entry.kind.decode("latin-1"), data[entry.start : values_end], tuple(parts))


def _without_rates(esds: bytes) -> bytes:
    """An elementary stream descriptor as ffmpeg writes it, with its size of a buffer and rates 0.

    ISO/IEC 14496-1, 7.2.6.5 and 7.2.6.6: tags, each with a length of four bytes, an ES_ID and
    flags of three bytes, and two bytes that tell the codec.
    """
    if esds[4:5] != b"\3" or esds[12:13] != b"\4" or len(esds) < 30:
        return esds
    return esds[:19] + bytes(11) + esds[30:]
