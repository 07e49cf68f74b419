"""Coded messages as the packets of a video track, and back.

One table over the codecs: what a message's body becomes in an mp4, and what it takes to get the
body back. A *body* is what the message holds, a *packet* what an mp4 holds of it; they differ by
the body's *framing*, a short text.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from mp4ds.coded import annexb, av1, jpeg, png
from mp4ds.coded.base import Refused
from mp4ds.coded.pictures import NoPicture, Picture

if TYPE_CHECKING:
    from mp4ds.coded.av1 import Av1Pictures
    from mp4ds.coded.h264 import H264Pictures
    from mp4ds.coded.h265 import H265Pictures
    from mp4ds.coded.vp9 import Vp9Pictures

PACKET_CODECS = ("mjpeg", "png", "h264", "h265", "av1", "vp9")
"""Codecs whose packets a video track takes as they are."""

_MAX_BODY = 2**30  # what an mp4 and its readers take for one packet


@dataclass(frozen=True, slots=True)
class CodedPicture:
    """A body that a video track carries.

    Attributes:
        width: Columns.
        height: Rows.
        keyframe: Whether decoding can begin here.
        framing: What an mp4 does not keep of the body, see `body_of`.
    """

    width: int
    height: int
    keyframe: bool
    framing: str = ""


class PictureParser:
    """Looks at the bodies of one topic in the order they go into a video.

    A video that begins in the middle, or lacks a packet, decodes to garbage until the next key
    frame. So bodies are refused up to the first key frame whose parameters are known, and again
    after a refused picture.

    Args:
        codec: One of `PACKET_CODECS`.

    Raises:
        ValueError: The codec is another one; lists those.
    """

    def __init__(self, codec: str) -> None:
        if codec not in PACKET_CODECS:
            raise ValueError(f"codec {codec!r} is none of {', '.join(PACKET_CODECS)}")
        self._pictures = _PARSERS[codec]()
        self._whole = False

    @property
    def parameters(self) -> bytes:
        """Parameter sets as Annex B, or an AV1 sequence header, seen so far; else empty."""
        return self._pictures.parameters

    def parse(self, body: bytes | memoryview) -> CodedPicture:
        """Check that an mp4 carries a body, and find what is needed to get it back.

        Raises:
            Refused: It does not; says why. A packet of parameters alone is refused too, but
                they are kept in mind.
        """
        if len(body) > _MAX_BODY:
            raise Refused(f"it has more than {_MAX_BODY} bytes")
        try:
            picture = self._pictures.parse(memoryview(body))
        except NoPicture:
            raise
        except Refused:
            self._whole = False
            raise
        if not self._whole and not picture.keyframe:
            raise Refused("it needs pictures before it that are not in the video")
        self._whole = True
        return picture

    def leave_out(self) -> None:
        """Tell that the picture parsed last does not go into the video after all."""
        self._whole = False


class _Stills:
    """Pictures of which none needs another."""

    parameters = b""

    def __init__(self, size: Callable[[memoryview], tuple[int, int]]) -> None:
        self._size = size

    def parse(self, body: memoryview) -> CodedPicture:
        return CodedPicture(*self._size(body), keyframe=True)


class _Units:
    """H.264 or H.265."""

    def __init__(self, pictures: H264Pictures | H265Pictures) -> None:
        self._pictures = pictures

    @property
    def parameters(self) -> bytes:
        return self._pictures.parameters

    def parse(self, body: memoryview) -> CodedPicture:
        units, framing = annexb.split(body)
        picture = self._pictures.picture(units)
        if not self.parameters:
            raise Refused("its parameter sets were not sent before it")
        return _coded(picture, framing)


class _Whole:
    """AV1 or VP9."""

    def __init__(self, pictures: Av1Pictures | Vp9Pictures, *, delimited: bool) -> None:
        self._pictures = pictures
        self._delimited = delimited

    @property
    def parameters(self) -> bytes:
        return self._pictures.parameters

    def parse(self, body: memoryview) -> CodedPicture:
        packet, framing = av1.strip(body) if self._delimited else (body, "")
        return _coded(self._pictures.picture(packet), framing)


def _coded(picture: Picture, framing: str) -> CodedPicture:
    return CodedPicture(picture.width, picture.height, picture.keyframe, framing)


def _jpeg_size(body: memoryview) -> tuple[int, int]:
    info = jpeg.parse(body)
    return info.width, info.height


def _png_size(body: memoryview) -> tuple[int, int]:
    info = png.parse(body)
    png.check_whole(body)
    return info.width, info.height


# each imports its parser when it is needed: a topic is of one codec


def _h264() -> _Units:
    from mp4ds.coded.h264 import H264Pictures

    return _Units(H264Pictures())


def _h265() -> _Units:
    from mp4ds.coded.h265 import H265Pictures

    return _Units(H265Pictures())


def _av1() -> _Whole:
    from mp4ds.coded.av1 import Av1Pictures

    return _Whole(Av1Pictures(), delimited=True)


def _vp9() -> _Whole:
    from mp4ds.coded.vp9 import Vp9Pictures

    return _Whole(Vp9Pictures(), delimited=False)


_PARSERS: MappingProxyType[str, Callable[[], _Stills | _Units | _Whole]] = MappingProxyType(
    {
        "mjpeg": lambda: _Stills(_jpeg_size),
        "png": lambda: _Stills(_png_size),
        "h264": _h264,
        "h265": _h265,
        "av1": _av1,
        "vp9": _vp9,
    }
)


def plain_body(codec: str, body: bytes | memoryview) -> bytes:
    """A body as a muxer is given it, with the framing that all muxers read alike.

    Its length is that of the packet in the mp4: a start code of four bytes becomes a length of
    four bytes.

    Raises:
        Refused: It is not of the codec.
    """
    if codec in ("h264", "h265"):
        return annexb.join_plain(annexb.split(body)[0])
    if codec == "av1":
        return bytes(av1.strip(body)[0])
    return bytes(body)


def body_of(codec: str, packet: bytes, framing: str) -> bytes:
    """The body that an mp4 holds as a packet.

    Args:
        codec: One of `PACKET_CODECS`.
        packet: As the mp4 holds it.
        framing: As `CodedPicture` has it.

    Raises:
        Refused: The framing does not belong to the packet.
    """
    if codec in ("h264", "h265"):
        return annexb.join_length_prefixed(packet, framing)
    if codec == "av1":
        return av1.join(packet, framing)
    if framing:
        raise Refused(f"{framing[:40]!r} is no framing of {codec}")
    return packet
