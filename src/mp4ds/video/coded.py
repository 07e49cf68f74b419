"""What packets of a codec tell without being decoded, and how an mp4 holds them.

A `StreamParser` per codec. Here are those of JPEG and FFV1, which need little of it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from mp4ds.errors import Refused
from mp4ds.messages.encodings import check_size

_MAX_UE_BITS = 32


class BitReader:
    """Reads fields of bits, most significant first.

    Args:
        data: The bytes; only a header's worth, since each read costs their length.
    """

    def __init__(self, data: bytes) -> None:
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def bits(self, count: int) -> int:
        """An unsigned integer of `count` bits.

        Raises:
            Refused: Fewer are left.
        """
        if count > self._left:
            raise Refused("it ends inside of a header")
        self._left -= count
        return (self._value >> self._left) & ((1 << count) - 1)

    def flag(self) -> bool:
        """One bit."""
        return bool(self.bits(1))

    def ue(self) -> int:
        """An unsigned Exp-Golomb code (H.264, 9.1)."""
        zeros = 0
        while not self.bits(1):
            zeros += 1
            if zeros > _MAX_UE_BITS:
                raise Refused("a header holds a number beyond 32 bits")
        return (1 << zeros) - 1 + self.bits(zeros)

    def se(self) -> int:
        """A signed Exp-Golomb code (H.264, 9.1.1)."""
        code = self.ue()
        return (code + 1) // 2 if code % 2 else -(code // 2)


# ---------------------------------------------------------------- parsers

REORDERED = "its stream shows pictures in another order than it sends them (B-frames)"
_MAX_BODY = 2**30  # what an mp4 and its readers take for one packet


class NoPicture(Refused):
    """A packet without any picture, which cannot be a video frame."""


class UnknownStructure(Refused):
    """It is unknown what frames refer to: they are decoded from the key frame on."""


@dataclass(frozen=True, slots=True)
class CodedPicture:
    """The one picture in a message's packet.

    Attributes:
        width: Columns shown.
        height: Rows shown.
        keyframe: Whether decoding can begin here, given the parameters of the stream.
        framing: What an mp4 does not keep of the packet.
    """

    width: int
    height: int
    keyframe: bool
    framing: str = ""


@dataclass(frozen=True, slots=True)
class CodedFrame:
    """One coded frame in an mp4's packet, and the frames a decoder needs before it.

    Frames are counted as coded, including those that are not shown or only show another one.

    Attributes:
        references: How many coded frames back each frame it needs is, 1 being the previous one;
            nearest first, without repetition. Empty for a key frame.
        shown: Whether a picture comes out.
    """

    references: tuple[int, ...]
    shown: bool


class StreamParser:
    """Parses the packets of one stream in order: a topic's by `picture`, an mp4's by `frames`.

    What is not overridden is right for a codec that has neither parameters nor framing, and whose
    frames are all key frames, such as PNG files.

    Args:
        configuration: Of the mp4's track: the payload of ``avcC``, ``hvcC`` or ``av1C``. None for
            the packets of a topic.

    Raises:
        UnknownStructure: The configuration is malformed.
    """

    def __init__(self, configuration: bytes | None = None) -> None:
        self._is_whole = False  # whether the pictures before the next one are in the video
        self._back = 0  # from the next frame to the one it refers to; 0: decoding has not begun
        if configuration is None:
            return
        try:
            for unit in self.units_of(bytes(configuration)):
                self._take_unit(unit)
        except Refused as error:
            raise UnknownStructure(str(error)) from None

    # -------- packets of messages

    @property
    def parameters(self) -> bytes:
        """What decoding needs first: parameter sets as Annex B, or an AV1 sequence header.

        Empty until they were seen.
        """
        return b""

    def picture(self, body: bytes | memoryview) -> CodedPicture:
        """Check that an mp4 can carry a message's packet, and find what is needed to restore it.

        A video that begins in the middle, or lacks a packet, decodes to garbage until the next key
        frame. So bodies are refused up to the first key frame whose parameters are known, and again
        after a refused picture.

        Raises:
            NoPicture: It holds none; parameters in it are kept in mind.
            Refused: No mp4 can carry it; says why.
        """
        if len(body) > _MAX_BODY:
            raise Refused(f"it has more than {_MAX_BODY} bytes")
        try:
            picture = self._picture(memoryview(body))
        except NoPicture:
            raise
        except Refused:
            self._is_whole = False
            raise
        if not self._is_whole and not picture.keyframe:
            raise Refused("it needs pictures before it that are not in the video")
        self._is_whole = True
        return picture

    def leave_out(self) -> None:
        """Take back the last picture: it does not go into the video after all."""
        self._is_whole = False

    def _picture(self, body: memoryview) -> CodedPicture:
        raise NotImplementedError  # of a codec that no message has

    # -------- packets of an mp4

    def frames(self, packet: bytes | memoryview, *, key: bool) -> list[CodedFrame]:
        """The coded frames of the next packet, in the order coded.

        It may begin at any key packet. After a refusal, packets are refused up to the next one.

        Args:
            packet: As the mp4 holds it.
            key: Whether the file says that decoding can begin here.

        Returns:
            At least one frame; see `spans` for where they are.

        Raises:
            UnknownStructure: The references cannot be determined, they reach across the key packet,
                or decoding cannot begin where `key` says it can.
        """
        try:
            return self._frames(memoryview(packet), key=key)
        except Refused as error:
            self._forget()
            raise UnknownStructure(str(error)) from None

    def _frames(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        return self._link(begins=True, key=key)  # of an image

    def _forget(self) -> None:
        """Wait for a key frame."""
        self._back = 0

    def _link(self, *, begins: bool, kept: bool = True, key: bool) -> list[CodedFrame]:
        """The only frame of a packet.

        Args:
            begins: Whether nothing from here on refers to anything earlier.
            kept: Whether later frames may need something of the packet.
            key: Whether the file says that decoding can begin here.
        """
        if key and not begins:
            raise UnknownStructure(
                "it is marked as a key frame, and later pictures refer to earlier ones"
            )
        if not begins and not self._back:
            raise UnknownStructure("it comes before the first key frame")
        references = () if begins else (self._back,)
        self._back = 1 if kept or begins else self._back + 1
        return [CodedFrame(references, shown=True)]

    @staticmethod
    def units_of(configuration: bytes) -> list[bytes]:
        """The parameter sets, or AV1 units, in a track's configuration.

        Raises:
            Refused: It is malformed.
        """
        return []

    def _take_unit(self, unit: bytes) -> None:
        """Look at one of `units_of`."""

    @staticmethod
    def spans(packet: bytes) -> list[tuple[int, int, int]]:
        """Where the coded frames of a packet are, of which `frames` knows what they need.

        Of AV1, what is in none (metadata, padding) is not needed to decode; of other codecs there
        is one frame, the whole packet.

        Returns:
            For each frame the start of the sequence header before it, its own where there is none,
            its own start, and its end. A key frame is decoded with its sequence header.

        Raises:
            Refused: The packet is malformed.
        """
        return [(0, 0, len(packet))]

    # -------- from one to the other

    @staticmethod
    def plain(body: bytes | memoryview) -> bytes:
        """A message's packet as passed to a muxer, with the framing that every muxer understands.

        Its length is that of the packet in the mp4: a start code of four bytes becomes a length of
        four bytes.

        Raises:
            Refused: It is not of the codec.
        """
        return bytes(body)

    @staticmethod
    def body(packet: bytes, framing: str | None) -> bytes:
        """The message's packet that an mp4 holds as a packet.

        Args:
            packet: As the mp4 holds it.
            framing: As in `CodedPicture`; None for that of `plain`.

        Raises:
            Refused: The framing does not belong to the packet.
        """
        if framing:
            raise Refused(f"{framing[:40]!r} is no framing of its codec")
        return packet

    @classmethod
    def stand_alone(cls, packet: bytes, units: list[bytes]) -> bytes:
        """A packet of an mp4 in the form that is decoded without the mp4.

        Args:
            packet: As the mp4 holds it.
            units: The track's, before a key frame; else none.

        Raises:
            Refused: It is damaged.
        """
        return packet

    @classmethod
    def has_parameters(cls, plain: bytes) -> bool:
        """Whether a key frame, as `plain` gives it, is decoded without `parameters` before it."""
        return True


class Jpeg(StreamParser):
    """JPEG files: all are key frames."""

    def _picture(self, body: memoryview) -> CodedPicture:
        width, height, _ = parse_jpeg(body)
        return CodedPicture(width, height, keyframe=True)


# ---------------------------------------------------------------- FFV1

_FFV1_KEY = 0x7F80


class Ffv1(StreamParser):
    """FFV1 keeps its context states from frame to frame."""

    def _frames(self, data: memoryview, *, key: bool) -> list[CodedFrame]:
        """Key frames are known by the first value that a frame codes, its `keyframe`.

        That is RFC 9043, 4.3. A range coder of even odds (3.8.1.1) gives 1 where the first 16 bits
        are in the upper half of its range, 0xFF00.
        """
        if len(data) < 2:
            raise UnknownStructure("it is not FFV1: it is too short")
        is_key = int.from_bytes(data[:2], "big") >= _FFV1_KEY
        return self._link(begins=is_key, key=key)


# ---------------------------------------------------------------- markers of JPEG (ITU-T T.81, B)

_SOI, _EOI, _SOS, _DHT, _JPG, _DAC = 0xD8, 0xD9, 0xDA, 0xC4, 0xC8, 0xCC
_RESTARTS = range(0xD0, 0xD8)
_FRAMES = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive
_OTHER_FRAMES = {
    0xC3: "lossless",
    **dict.fromkeys((0xC5, 0xC6, 0xC7), "hierarchical"),
    **dict.fromkeys((0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF, _DAC), "arithmetic-coded"),
}
# a marker inside coded data: not a stuffed 0xFF, a restart, or a fill byte
_FILL = re.compile(rb"\xff*")
_MAX_SEGMENTS = 2**16
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")

_OTHER_IMAGES = [
    (re.compile(start, re.DOTALL), name)
    for start, name in (
        (rb"\x89PNG\r\n\x1a\n", "a PNG image"),
        (rb"RIFF.{4}WEBP", "a WebP image"),
        (rb"BM.{4}\0{4}", "a BMP image"),
        (rb"II[*+]\0|MM\0[*+]", "a TIFF image"),
        (rb"GIF8[79]a", "a GIF image"),
        (rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51", "a JPEG 2000 image"),
        (rb"\0\0\0\x0cJXL |\xff\x0a", "a JPEG XL image"),
        (rb".{4}ftypavi[fs]", "an AVIF image"),
        (rb".{4}ftyp(?:hei|hev|mif1|msf1)", "a HEIF image"),
    )
]

# sampling factors of Y, Cb and Cr, horizontal then vertical, that decoders support
_SAMPLINGS = {
    *((factor, factor, factor) for factor in (0x11, 0x12, 0x21, 0x22)),  # 4:4:4
    *((0x12, 0x11, 0x11), (0x22, 0x21, 0x21)),  # 4:4:0
    *((0x21, 0x11, 0x11), (0x22, 0x12, 0x12)),  # 4:2:2
    (0x22, 0x11, 0x11),  # 4:2:0
    *((0x41, 0x11, 0x11), (0x42, 0x12, 0x12)),  # 4:1:1
}


def parse_jpeg(data: bytes | memoryview) -> tuple[int, int, int]:
    """Walk a JPEG's markers up to its end.

    Huffman tables may be absent, as with many USB cameras: motion JPEG decoders know the usual
    ones.

    Args:
        data: The whole JPEG, with whatever follows it.

    Returns:
        Width, height, and the number of colour components: 1 or 3.

    Raises:
        Refused: It is not a JPEG, is cut short, or is of a kind that video decoders do not support.
    """
    data = memoryview(data)
    if bytes(data[:2]) != b"\xff\xd8":
        name = next((name for start, name in _OTHER_IMAGES if start.match(data)), "")
        if name:
            raise Refused(f"it is {name}, not a JPEG")
        raise Refused("it is not a JPEG: it has no start-of-image marker")
    found: tuple[int, int, int] | None = None
    scans = 0
    offset = 2
    for _ in range(_MAX_SEGMENTS):
        marker, offset = _next_marker(data, offset)
        if marker == _EOI:
            break
        if marker in _RESTARTS or marker in (0x00, 0x01, _SOI):
            raise Refused(f"its JPEG has a marker 0xFF{marker:02X} where none may be")
        segment = _segment(data, offset)
        offset += 2 + len(segment)
        if marker in _FRAMES:
            if found is not None:
                raise Refused("its JPEG holds two pictures")
            found = _frame(segment)
        elif marker in _OTHER_FRAMES:
            raise Refused(f"its JPEG is {_OTHER_FRAMES[marker]}, which few decoders take")
        elif marker == _SOS:
            if found is None:
                raise Refused("its JPEG has a scan before its frame header")
            scans += 1
            coded = _MARKER.search(data, offset)
            if coded is None:
                raise Refused("its JPEG is cut short: it has no end-of-image marker")
            offset = coded.start()
    else:
        raise Refused(f"its JPEG has more than {_MAX_SEGMENTS} segments")
    if found is None or not scans:
        raise Refused("its JPEG holds no picture")
    return found


def _next_marker(data: memoryview, offset: int) -> tuple[int, int]:
    """The marker at an offset, past fill bytes, and where its content begins."""
    if offset >= len(data):
        raise Refused("its JPEG is cut short: it has no end-of-image marker")
    if data[offset] != 0xFF:
        raise Refused(f"its JPEG has no marker at byte {offset}, where one is due")
    fill = _FILL.match(data, offset)
    offset = fill.end() if fill else offset
    if offset == len(data):
        raise Refused("its JPEG is cut short: it has no end-of-image marker")
    return data[offset], offset + 1


def _segment(data: memoryview, offset: int) -> memoryview:
    """The content of a marker segment after its length."""
    length = int.from_bytes(data[offset : offset + 2], "big")
    if length < 2 or offset + length > len(data):
        raise Refused("its JPEG is cut short, or a length in it is wrong")
    return data[offset + 2 : offset + length]


def _frame(segment: memoryview) -> tuple[int, int, int]:
    if len(segment) < 6 or len(segment) != 6 + 3 * segment[5]:
        raise Refused("its JPEG has a frame header of a wrong length")
    precision, components = segment[0], segment[5]
    height, width = (int.from_bytes(segment[at : at + 2], "big") for at in (1, 3))
    if precision != 8:
        raise Refused(f"its JPEG has {precision} bits a sample, not 8")
    if components not in (1, 3):
        raise Refused(f"its JPEG has {components} colour components, not 1 or 3")
    check_size(width, height)
    factors = tuple(segment[at] for at in (7, 10, 13)) if components == 3 else ()
    if factors and factors not in _SAMPLINGS:
        raise Refused(
            "its JPEG has the chroma sampling "
            + " ".join(f"{factor >> 4}x{factor & 15}" for factor in factors)
            + ", which few decoders take"
        )
    return width, height, components
