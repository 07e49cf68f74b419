"""Annex B byte streams of H.264 and H.265: NAL units and the bytes that frame them.

ITU-T H.264 and H.265, annex B. A video in an mp4 holds NAL units behind four-byte lengths
(ISO/IEC 14496-15), so the start codes are kept as a *framing*: for each NAL unit the length of
its start code with all zero bytes before it, and at last ``+N`` if N zero bytes trail, such as
``4 4 3 +2``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from mp4ds.coded.base import Refused

MAX_UNITS = 512
"""Most NAL units in one packet."""

MAX_ZEROS = 4096
"""Most zero bytes in a row between NAL units."""

START_CODE = b"\0\0\0\1"
_START = b"\0\0\1"
_FRAMING = re.compile(r"[0-9]{1,4}(?: [0-9]{1,4})*(?: \+[0-9]{1,4})?")


def split(data: bytes | memoryview) -> tuple[list[bytes], str]:
    """Split a packet into its NAL units and their framing; `join` undoes it.

    Args:
        data: One access unit.

    Returns:
        The NAL units, none of which is empty or ends in a zero byte, and the framing.

    Raises:
        Refused: It does not begin with a start code, a NAL unit is empty, or there are more of
            them, or of zero bytes, than a packet of a camera has.
    """
    data = bytes(data)
    start = data.find(_START)
    if start < 0 or data[:start].strip(b"\0"):
        raise Refused("it does not begin with a start code")
    units: list[bytes] = []
    lengths: list[int] = []
    zeros = start
    while True:
        begin = start + len(_START)
        start = data.find(_START, begin)
        padded = data[begin : start if start >= 0 else len(data)]
        unit = padded.rstrip(b"\0")
        if not unit:
            raise Refused("it holds an empty NAL unit")
        units.append(unit)
        lengths.append(zeros + len(_START))
        zeros = len(padded) - len(unit)
        if zeros > MAX_ZEROS or lengths[-1] > MAX_ZEROS:
            raise Refused(f"it holds more than {MAX_ZEROS} zero bytes in a row")
        if len(units) > MAX_UNITS:
            raise Refused(f"it holds more than {MAX_UNITS} NAL units")
        if start < 0:
            return units, " ".join(map(str, lengths)) + (f" +{zeros}" if zeros else "")


def join(units: Sequence[bytes], framing: str) -> bytes:
    """Put start codes before NAL units as a framing says.

    Raises:
        Refused: The framing is none, or is of another number of NAL units.
    """
    lengths, trailing = _lengths(framing)
    if len(lengths) != len(units):
        raise Refused(f"it has {len(units)} NAL units where its framing has {len(lengths)}")
    parts: list[bytes] = []
    for unit, length in zip(units, lengths, strict=True):
        parts += (bytes(length - 1), b"\1", unit)
    return b"".join((*parts, bytes(trailing)))


def join_plain(units: Sequence[bytes]) -> bytes:
    """NAL units behind start codes of four bytes each."""
    return b"".join(part for unit in units for part in (START_CODE, unit))


def split_length_prefixed(packet: bytes | memoryview) -> list[bytes]:
    """The NAL units of an mp4's packet, which stand behind lengths of four bytes.

    Raises:
        Refused: The lengths do not add up, or there are too many.
    """
    packet = memoryview(packet)
    units: list[bytes] = []
    offset = 0
    while offset < len(packet):
        length = int.from_bytes(packet[offset : offset + 4], "big")
        end = offset + 4 + length
        if not length or end > len(packet):
            raise Refused("a NAL unit's length in the video is wrong")
        if len(units) == MAX_UNITS:
            raise Refused(f"it holds more than {MAX_UNITS} NAL units")
        units.append(bytes(packet[offset + 4 : end]))
        offset = end
    return units


def join_length_prefixed(packet: bytes | memoryview, framing: str) -> bytes:
    """The packet as it was before it went into an mp4.

    Args:
        packet: As the mp4 holds it.
        framing: As `split` gave it.

    Raises:
        Refused: They do not belong together.
    """
    return join(split_length_prefixed(packet), framing)


def _lengths(framing: str) -> tuple[list[int], int]:
    if not _FRAMING.fullmatch(framing):
        raise Refused(f"{framing[:40]!r} is no framing of NAL units")
    tokens = framing.split(" ")
    trailing = int(tokens.pop()) if tokens[-1].startswith("+") else 0
    lengths = list(map(int, tokens))
    if min(lengths) < len(_START) or max(*lengths, trailing) > MAX_ZEROS:
        raise Refused(f"{framing[:40]!r} is no framing of NAL units")
    return lengths, trailing


def unescape(unit: bytes) -> bytes:
    """A NAL unit without its emulation prevention bytes (H.264, 7.3.1; H.265, 7.3.1.1)."""
    return unit.replace(b"\0\0\3", b"\0\0")
