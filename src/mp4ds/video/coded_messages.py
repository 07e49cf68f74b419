"""Coded messages to packets of a video track, and back."""

from __future__ import annotations

from typing import Protocol

from mp4ds.errors import Refused
from mp4ds.messages import jpeg, png
from mp4ds.messages.coded import CodedPicture, NoPicture
from mp4ds.video import av1, nal
from mp4ds.video.codecs import CODECS, part_of


def packet_codec(message_format: str) -> str:
    """The codec of the packets of a message.

    Args:
        message_format: `format` of Foxglove's CompressedVideo, or `encoding` of an
            FFMPEGPacket, whose first part names the codec or its encoder
            (``libx264``, ``hevc_nvenc``, ``h264;yuv420p;bgr8;bgr8``).

    Raises:
        Refused: No video here has that codec.
    """
    name = message_format.partition(";")[0].strip().lower()
    for codec, found in CODECS.items():
        # hardware encoders are called h264_nvenc, hevc_vaapi ...
        if name in found.names or name.partition("_")[0] in found.names:
            return codec
    raise Refused(f"its codec {message_format[:40]!r} is not one that becomes a video")


# ---------------------------------------------------------------- packets

PACKET_CODECS = tuple(name for name, codec in CODECS.items() if codec.pictures)
"""Codecs whose packets are stored in a video track as they are."""

_MAX_BODY = 2**30  # what an mp4 and its readers take for one packet


class PictureParser:
    """Inspects the bodies of one topic in the order they go into a video.

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
            raise ValueError(f"codec {codec!r} is not one of {', '.join(PACKET_CODECS)}")
        self._pictures: _Pictures = part_of(CODECS[codec].pictures)()
        self._whole = False

    @property
    def parameters(self) -> bytes:
        """Parameter sets as Annex B, or an AV1 sequence header, seen so far; else empty."""
        return self._pictures.parameters

    def parse(self, body: bytes | memoryview) -> CodedPicture:
        """Check that an mp4 can carry a body, and find what is needed to restore it.

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
        """Take back the picture parsed last: it does not go into the video after all."""
        self._whole = False


class _Pictures(Protocol):
    @property
    def parameters(self) -> bytes: ...

    def parse(self, body: memoryview) -> CodedPicture: ...


class Jpegs:
    """JPEG files, which are independent."""

    parameters = b""

    def parse(self, body: memoryview) -> CodedPicture:
        """The picture in a file."""
        info = jpeg.parse(body)
        return CodedPicture(info.width, info.height, keyframe=True)


class Pngs:
    """PNG files, which are independent."""

    parameters = b""

    def parse(self, body: memoryview) -> CodedPicture:
        """The picture in a file."""
        info = png.parse(body)
        png.check_whole(body)
        return CodedPicture(info.width, info.height, keyframe=True)


def plain_body(codec: str, body: bytes | memoryview) -> bytes:
    """A body as passed to a muxer, with the framing that every muxer understands.

    Its length is that of the packet in the mp4: a start code of four bytes becomes a length of
    four bytes.

    Raises:
        Refused: It is not of the codec.
    """
    framed = CODECS[codec].framing
    if framed == "units":
        return nal.join_plain(nal.split(body)[0])
    if framed == "obus":
        return bytes(av1.strip(body)[0])
    return bytes(body)


def body_of(codec: str, packet: bytes, framing: str) -> bytes:
    """The body that an mp4 holds as a packet.

    Args:
        codec: One of `PACKET_CODECS`.
        packet: As the mp4 holds it.
        framing: As in `CodedPicture`.

    Raises:
        Refused: The framing does not belong to the packet.
    """
    framed = CODECS[codec].framing
    if framed == "units":
        return nal.join_length_prefixed(packet, framing)
    if framed == "obus":
        return av1.join(packet, framing)
    if framing:
        raise Refused(f"{framing[:40]!r} is no framing of {codec}")
    return packet
