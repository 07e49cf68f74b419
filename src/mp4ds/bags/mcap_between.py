"""What stands between the chunks of an MCAP file, found without reading the chunks."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from mp4ds.bags.mcap_index import Summary
from mp4ds.bags.mcap_records import (
    MAGIC,
    MAX_RECORD_BYTES,
    PRIVATE_OPCODE,
    DamageError,
    RecordStream,
)
from mp4ds.errors import SourceError

_FRAME = struct.Struct("<BQ")
_OTHERS = (Opcode.ATTACHMENT, Opcode.METADATA)


@dataclass
class Between:
    """What stands between the chunks that a summary lists.

    Attributes:
        is_sound: Whether the chunks are where the summary says, and no messages beside them.
        others: Byte offsets of the attachments and metadata records.
        private: How many records of each private opcode there are.
    """

    is_sound: bool = True
    others: array[int] = field(default_factory=lambda: array("Q"))
    private: Counter[int] = field(default_factory=Counter)


def look_between(stream: RecordStream, summary: Summary) -> Between:
    """Look at the records between the chunks, leaving the stream anywhere.

    Args:
        stream: A stream of known size.
        summary: Its summary; its chunks must be sound.
    """
    found = Between(private=Counter(summary.private))
    place = len(MAGIC)
    for start, _, end in summary.chunks.places():
        if start != place:
            _look(stream, place, start, found)
        if not found.is_sound:
            return found
        place = end
    _look(stream, place, summary.offset, found)
    return found


def _look(stream: RecordStream, place: int, end: int, found: Between) -> None:
    try:
        while place < end and found.is_sound:
            opcode, following = read_frame(stream, place)
            if opcode in _OTHERS:
                found.others.append(place)
            elif opcode >= PRIVATE_OPCODE:
                found.private[opcode] += 1
            elif opcode in (Opcode.MESSAGE, Opcode.CHUNK, Opcode.FOOTER):
                found.is_sound = False
            place = following
    except (DamageError, SourceError):
        found.is_sound = False  # reading it all tells what is wrong
    found.is_sound &= place == end


def read_frame(stream: RecordStream, place: int) -> tuple[int, int]:
    """The opcode of the record at a byte offset, and the offset of the next one.

    Raises:
        DamageError: There is no record.
        SourceError: The file cannot be read.
    """
    stream.seek(place)
    stream.start = place
    opcode, length = _FRAME.unpack(stream.read(_FRAME.size))
    if length > MAX_RECORD_BYTES:
        raise DamageError(f"it tells of {length} bytes")
    return opcode, place + _FRAME.size + length


def read_frames(stream: RecordStream) -> Iterator[tuple[int, int]]:
    """Seek over all records of a file up to its footer.

    Args:
        stream: A stream of known size; it may be moved between the frames.

    Yields:
        Opcode and byte offset of each.

    Raises:
        SourceError: The file is damaged or cut short.
    """
    place = len(MAGIC)
    while True:
        try:
            opcode, following = read_frame(stream, place)
        except DamageError as error:
            raise stream.damaged(error) from None
        if stream.size is not None and following > stream.size:
            raise stream.cut_short()
        if opcode == Opcode.FOOTER:
            break
        yield opcode, place
        place = following
    stream.seek(following)
    stream.read_magic()
