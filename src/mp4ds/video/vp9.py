"""VP9 frames and superframes: key frames and picture size.

VP9 Bitstream & Decoding Process Specification 0.6: uncompressed header in 6.2, superframes in
annex B.
"""

from __future__ import annotations

from mp4ds.errors import Refused
from mp4ds.messages.coded import BitReader, CodedFrame, CodedPicture, NoPicture, check_size
from mp4ds.video.references import Chain

_SYNC_CODE = 0x498342
_RGB = 7
_HEADER_BYTES = 32


def split_superframe(data: memoryview) -> list[memoryview]:
    """The frames of a packet, without the index of a superframe.

    Raises:
        Refused: The index does not fit the packet.
    """
    if not len(data):
        raise Refused("it is empty")
    marker = data[-1]
    if marker & 0xE0 != 0xC0:
        return [data]
    count, size_bytes = (marker & 7) + 1, (marker >> 3 & 3) + 1
    index = len(data) - 2 - count * size_bytes
    if index < 0 or data[index] != marker:
        return [data]
    frames: list[memoryview] = []
    start = 0
    for number in range(count):
        at = index + 1 + number * size_bytes
        size = int.from_bytes(data[at : at + size_bytes], "little")
        frames.append(data[start : start + size])
        start += size
    if start != index or not all(map(len, frames)):
        raise Refused("the index of its VP9 superframe is wrong")
    return frames


class Vp9Pictures:
    """The pictures of one stream, packet by packet."""

    parameters = b""

    def __init__(self) -> None:
        self._size = (0, 0)

    def parse(self, body: memoryview) -> CodedPicture:
        """The picture in a packet.

        Raises:
            NoPicture: It shows nothing; a muxer would join it with the next packet.
            Refused: It shows several, or is not VP9.
        """
        keyframe = False
        shown = 0
        for number, frame in enumerate(split_superframe(body)):
            is_shown, is_key = self._frame(bytes(frame[:_HEADER_BYTES]))
            keyframe |= is_key and not number
            shown += is_shown
        if not shown:
            raise NoPicture("it shows no picture")
        if shown > 1:
            raise Refused("it holds more than one picture")
        if self._size == (0, 0):
            raise Refused("it comes before the first key frame")
        return CodedPicture(*self._size, keyframe)

    def _frame(self, header: bytes) -> tuple[bool, bool]:
        """Whether a frame is shown, and a key frame."""
        reader = BitReader(header)
        if reader.bits(2) != 2:
            raise Refused("it is not VP9: a frame does not begin with its marker")
        profile = reader.bits(1) | reader.bits(1) << 1
        if profile == 3 and reader.flag():
            raise Refused("it is VP9 of an unknown profile")
        if reader.flag():
            return True, False
        key = not reader.flag()
        shown = reader.flag()
        reader.flag()
        if key:
            self._size = _key_frame_size(reader, profile)
        return shown, key


def _key_frame_size(reader: BitReader, profile: int) -> tuple[int, int]:
    if reader.bits(24) != _SYNC_CODE:
        raise Refused("it is not VP9: a key frame has no sync code")
    if profile >= 2:
        reader.flag()
    if reader.bits(3) != _RGB:
        reader.flag()
        if profile & 1:
            reader.bits(3)
    elif profile & 1:
        reader.flag()
    else:
        raise Refused("its VP9 has colours that its profile does not have")
    width, height = reader.bits(16) + 1, reader.bits(16) + 1
    check_size(width, height)
    return width, height


class Vp9References(Chain):
    """VP9 keeps motion vectors, probabilities and segments from frame to frame."""

    def __init__(self, configuration: bytes) -> None:
        super().__init__()
        del configuration
        self._pictures = Vp9Pictures()

    def packet(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """The frame of a packet."""
        is_key = self._pictures.parse(data).keyframe
        return self.link(len(data), begins=is_key, key=key)
