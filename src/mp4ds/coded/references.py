"""What the coded frames of a stream refer to, so that one can be decoded without its neighbours.

A frame decodes to the same samples when a decoder is given, in the order coded, only those frames
that it needs, those that these need, and so on to the key frame. What is said here is never too
little: where a codec's syntax does not tell, a frame is taken to need all frames before it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Protocol

from mp4ds.coded.base import Refused
from mp4ds.coded.coded_frame import CodedFrame, UnknownStructure

__all__ = ["CodedFrame", "ReferenceParser", "UnknownStructure"]

_FFV1_KEY = 0x7F80


class _Parser(Protocol):
    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]: ...

    def forget(self) -> None: ...


class ReferenceParser:
    """Tells what the coded frames of one stream refer to, packet by packet.

    It may begin at any key packet. After a refusal packets are refused up to the next key packet.

    Args:
        codec: Name in the registry (``h264``), or of a sample entry (``avc1``).
        configuration: What the track says of the codec: the payload of ``avcC``, ``hvcC`` or
            ``av1C``; of other codecs it is not looked at.

    Raises:
        UnknownStructure: Nothing is known of the references of that codec, or the configuration is
            malformed.
    """

    def __init__(self, codec: str, configuration: bytes) -> None:
        make = _PARSERS.get(codec)
        if make is None:
            raise UnknownStructure(f"what frames of the codec {codec[:40]!r} refer to is not known")
        try:
            self._parser = make(bytes(configuration))
        except Refused as error:
            raise UnknownStructure(str(error)) from None

    def packet(self, data: bytes | memoryview, *, key: bool) -> list[CodedFrame]:
        """The coded frames of the next packet, in the order coded.

        Args:
            data: As the mp4 holds it.
            key: Whether the file says that decoding can begin here.

        Returns:
            At least one frame. Their ranges do not overlap. Of AV1 each is of one frame, with the
            sequence header just before a key frame, and what is in none (metadata, padding) is
            not needed to decode; of other codecs there is one frame, the whole packet.

        Raises:
            UnknownStructure: The references cannot be told, they reach across the key packet, or
                decoding cannot begin where `key` says so.
        """
        try:
            return self._parser.packet(memoryview(data), key=key)
        except Refused as error:
            self._parser.forget()
            raise UnknownStructure(str(error)) from None


class _Intra:
    """Codecs all of whose frames are key frames."""

    def __init__(self, configuration: bytes) -> None:
        del configuration

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        return [CodedFrame(0, len(data), (), shown=True, existing=False)]

    def forget(self) -> None:
        """There is nothing to forget."""


class _Chained:
    """Codecs whose frames take over what the last one left in the decoder, shown or not.

    VP9 keeps motion vectors, probabilities and segments from frame to frame, FFV1 the states of
    its contexts.
    """

    def __init__(self, is_key: Callable[[memoryview], bool]) -> None:
        self._is_key = is_key
        self._begun = False

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        is_key = self._is_key(data)
        if key and not is_key:
            raise UnknownStructure("it is marked as a key frame and is none")
        if not is_key and not self._begun:
            raise UnknownStructure("it comes before the first key frame")
        self._begun = True
        return [CodedFrame(0, len(data), () if is_key else (1,), shown=True, existing=False)]

    def forget(self) -> None:
        self._begun = False


def _vp9_is_key(data: memoryview) -> bool:
    """Whether a packet begins with a key frame (VP9, 6.2)."""
    from mp4ds.coded.vp9 import split_superframe

    shown = 0
    keys = []
    for frame in split_superframe(data):
        head = int.from_bytes(frame[:2].tobytes().ljust(2, b"\0"), "big")
        if head >> 14 != 2:
            raise UnknownStructure("it is no VP9: a frame does not begin with its marker")
        bits = head << 1 if head >> 12 & 3 == 3 else head  # profile 3 has a reserved bit more
        existing = bool(bits & 0x800)
        keys.append(not existing and not bits & 0x400)
        shown += existing or bool(bits & 0x200)
    if shown != 1:
        raise UnknownStructure(
            "it shows no picture" if not shown else "it holds more than one picture"
        )
    return keys[0]


def _ffv1_is_key(data: memoryview) -> bool:
    """Whether the first value that a frame codes, its `keyframe`, is set (RFC 9043, 4.3).

    A range coder of even odds (3.8.1.1) gives 1 where the first 16 bits are in the upper half of
    its range, 0xFF00.
    """
    if len(data) < 2:
        raise UnknownStructure("it is no FFV1: it is too short")
    return int.from_bytes(data[:2], "big") >= _FFV1_KEY


# each imports its parser when it is needed: a video is of one codec


def _h264(configuration: bytes) -> _Parser:
    from mp4ds.coded.nal_references import H264References

    return H264References(configuration)


def _h265(configuration: bytes) -> _Parser:
    from mp4ds.coded.nal_references import H265References

    return H265References(configuration)


def _av1(configuration: bytes) -> _Parser:
    from mp4ds.coded.av1_references import Av1References

    return Av1References(configuration)


def _vp9(_: bytes) -> _Parser:
    return _Chained(_vp9_is_key)


def _ffv1(_: bytes) -> _Parser:
    return _Chained(_ffv1_is_key)


_PARSERS: Mapping[str, Callable[[bytes], _Parser]] = MappingProxyType(
    {
        **dict.fromkeys(("h264", "avc1", "avc3"), _h264),
        **dict.fromkeys(("h265", "hevc", "hvc1", "hev1"), _h265),
        **dict.fromkeys(("av1", "av01"), _av1),
        **dict.fromkeys(("vp9", "vp09"), _vp9),
        **dict.fromkeys(("ffv1", "FFV1"), _ffv1),
        **dict.fromkeys(("mjpeg", "jpeg", "png"), _Intra),
    }
)
