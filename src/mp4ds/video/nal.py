"""NAL units of H.264 and H.265: Annex B byte streams, and parameter sets of an mp4's track."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence

from mp4ds.errors import Refused
from mp4ds.messages.coded import CodedPicture, NoPicture

MAX_UNITS = 512
"""Maximum number of NAL units in one packet."""

MAX_ZEROS = 4096
"""Maximum number of consecutive zero bytes between NAL units."""

START_CODE = b"\0\0\0\1"
_START = b"\0\0\1"
_FRAMING = re.compile(r"[0-9]{1,4}(?: [0-9]{1,4})*(?: \+[0-9]{1,4})?")


def split(data: bytes | memoryview) -> tuple[list[bytes], str]:
    """Split a packet into its NAL units and their framing; `join` undoes it.

    Args:
        data: One access unit.

    Returns:
        The NAL units, none empty or ending in a zero byte, and the framing.

    Raises:
        Refused: It does not begin with a start code, a NAL unit is empty, or there are more NAL
            units or zero bytes than in any camera's packet.
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


def join(units: Sequence[bytes | memoryview], framing: str) -> bytes:
    """Put start codes before NAL units according to a framing.

    Raises:
        Refused: The framing is not valid, or is for another number of NAL units.
    """
    lengths, trailing = _lengths(framing)
    if len(lengths) != len(units):
        raise Refused(f"it has {len(units)} NAL units where its framing has {len(lengths)}")
    parts: list[bytes | memoryview] = []
    for unit, length in zip(units, lengths, strict=True):
        parts += (bytes(length - 1), b"\1", unit)
    return b"".join((*parts, bytes(trailing)))


def join_plain(units: Sequence[bytes | memoryview]) -> bytes:
    """NAL units, each after a start code of four bytes."""
    return b"".join(part for unit in units for part in (START_CODE, unit))


def split_length_prefixed(packet: bytes | memoryview) -> list[memoryview]:
    """The NAL units of an mp4's packet, each preceded by a length of four bytes, as views.

    Raises:
        Refused: The lengths do not add up, or there are too many.
    """
    packet = memoryview(packet)
    units: list[memoryview] = []
    offset = 0
    while offset < len(packet):
        length = int.from_bytes(packet[offset : offset + 4], "big")
        end = offset + 4 + length
        if not length or end > len(packet):
            raise Refused("a NAL unit's length in the video is wrong")
        if len(units) == MAX_UNITS:
            raise Refused(f"it holds more than {MAX_UNITS} NAL units")
        units.append(packet[offset + 4 : end])
        offset = end
    return units


def join_length_prefixed(packet: bytes | memoryview, framing: str) -> bytes:
    """The packet as it was before it was stored in an mp4.

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


# ---------------------------------------------------------------- configuration

_CUT_SHORT = "the parameters of the track are cut short"


def parameter_units(codec: str, configuration: bytes) -> list[bytes]:
    """The parameter sets, or AV1 units, in the configuration of a track.

    Args:
        codec: Name in the registry; codecs without such parameters give none.
        configuration: ``avcC`` or ``hvcC`` (ISO/IEC 14496-15, 5.3.3 and 8.3.3), or ``av1C``
            (AV1 in ISOBMFF, 2.3).

    Raises:
        Refused: It is malformed, or its NAL units are not preceded by lengths of four bytes.
    """
    if codec == "h264":
        return _avc_units(configuration)
    if codec == "h265":
        return _hevc_units(configuration)
    return [configuration[4:]] if codec == "av1" else []


def _avc_units(configuration: bytes) -> list[bytes]:
    _check(configuration, lengths_at=4)
    units, at = _sized(configuration, 6, configuration[5] & 31)
    if at >= len(configuration):
        raise Refused(_CUT_SHORT)
    return units + _sized(configuration, at + 1, configuration[at])[0]


def _hevc_units(configuration: bytes) -> list[bytes]:
    _check(configuration, lengths_at=21)
    units: list[bytes] = []
    at = 23
    for _ in range(configuration[22]):
        count = int.from_bytes(configuration[at + 1 : at + 3], "big")
        found, at = _sized(configuration, at + 3, count)
        units += found
    return units


def _check(configuration: bytes, *, lengths_at: int) -> None:
    if len(configuration) < lengths_at + 2 or configuration[0] != 1:
        raise Refused(_CUT_SHORT)
    if configuration[lengths_at] & 3 != 3:
        raise Refused("its NAL units do not have lengths of four bytes")


def _sized(configuration: bytes, at: int, count: int) -> tuple[list[bytes], int]:
    """NAL units behind lengths of two bytes, and the offset after them."""
    units: list[bytes] = []
    for _ in range(count):
        size = int.from_bytes(configuration[at : at + 2], "big")
        at += 2 + size
        if not size or at > len(configuration):
            raise Refused(_CUT_SHORT)
        units.append(configuration[at - size : at])
    return units, at


# ---------------------------------------------------------------- picture order


class PictureOrder:
    """Whether pictures are sent in the order shown, by their picture order counts.

    Slices state their low bits; the high ones are counted (H.264, 8.2.1.1; H.265, 8.3.1).

    Attributes:
        is_broken: Whether one was sent after another that is shown later.
    """

    def __init__(self) -> None:
        self._msb = self._lsb = 0
        self._last: int | None = None
        self.is_broken = False

    @property
    def has_begun(self) -> bool:
        """Whether there was a picture since the last restart."""
        return self._last is not None

    def restart(self, lsb: int = 0) -> None:
        """Start over, from low bits."""
        self._msb, self._lsb, self._last = 0, lsb, None

    def take(self, lsb: int, bits: int, *, counts: bool = True) -> None:
        """Compare a picture with the last one.

        Args:
            lsb: Its low bits.
            bits: How many there are.
            counts: Whether the high bits of later pictures are counted from it.
        """
        msb, half = self._msb, 1 << (bits - 1)
        if lsb < self._lsb and self._lsb - lsb >= half:
            msb += 2 * half
        elif lsb > self._lsb and lsb - self._lsb > half:
            msb -= 2 * half
        order = msb + lsb
        if counts:
            self._msb, self._lsb = msb, lsb
        if self._last is not None and order <= self._last:
            self.is_broken = True
        self._last = order


# ---------------------------------------------------------------- pictures


class UnitPictures(ABC):
    """The pictures of one stream of H.264 or H.265, access unit by access unit."""

    _kinds: frozenset[int]  # of parameter sets

    def __init__(self) -> None:
        self._sets: dict[tuple[int, int], bytes] = {}
        self._order = PictureOrder()

    @property
    def parameters(self) -> bytes:
        """The parameter sets seen so far, as Annex B; empty unless there are all kinds."""
        if {kind for kind, _ in self._sets} != self._kinds:
            return b""
        return join_plain([self._sets[key] for key in sorted(self._sets)])

    def parse(self, body: memoryview) -> CodedPicture:
        """The picture in an access unit.

        Raises:
            NoPicture: There is none.
            Refused: There are several, it needs parameters that were not sent, or it is sent
                out of the order shown.
        """
        units, framing = split(body)
        size, keyframe = self._picture(units)
        if not self.parameters:
            raise Refused("its parameter sets were not sent before it")
        return CodedPicture(*size, keyframe, framing)

    @abstractmethod
    def _picture(self, units: Sequence[bytes]) -> tuple[tuple[int, int], bool]:
        """Width and height of the picture in NAL units, and whether it is a key frame."""

    @staticmethod
    def _first(slices: Sequence[bytes], *, header: int) -> bytes:
        """The slice that begins the only picture, behind a header of so many bytes."""
        if not slices:
            raise NoPicture("it holds no picture, only parameters or remarks")
        first = [unit for unit in slices if len(unit) > header and unit[header] & 0x80]
        if len(first) != 1:
            raise Refused("it holds more than one picture, or a part of one")
        return first[0]
