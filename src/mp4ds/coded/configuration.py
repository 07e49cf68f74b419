"""The parameters of a stream as an mp4's track holds them: avcC, hvcC and av1C."""

from __future__ import annotations

from mp4ds.coded.base import Refused

_CUT_SHORT = "the parameters of the track are cut short"


def parameter_units(codec: str, configuration: bytes) -> list[bytes]:
    """The parameter sets, or AV1 units, in the configuration of a track.

    Args:
        codec: Name in the registry; codecs without such parameters give none.
        configuration: ``avcC`` or ``hvcC`` (ISO/IEC 14496-15, 5.3.3 and 8.3.3), or ``av1C``
            (AV1 in ISOBMFF, 2.3).

    Raises:
        Refused: It is malformed, or NAL units do not stand behind lengths of four bytes.
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
        raise Refused("its NAL units do not stand behind lengths of four bytes")


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
