"""Parses JPEG markers and checks completeness (ITU-T T.81, annex B)."""

from __future__ import annotations

import re
from dataclasses import dataclass

from mp4ds.errors import Refused
from mp4ds.messages.encodings import check_size

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


@dataclass(frozen=True, slots=True)
class JpegInfo:
    """What is needed of a JPEG's header.

    Attributes:
        width: Columns.
        height: Rows.
        components: 1 or 3.
    """

    width: int
    height: int
    components: int


def parse(data: bytes | memoryview) -> JpegInfo:
    """Walk a JPEG's markers up to its end.

    Huffman tables may be absent, as with many USB cameras: motion JPEG decoders know the usual
    ones.

    Args:
        data: The whole JPEG, with whatever follows it.

    Raises:
        Refused: It is not a JPEG, is cut short, or is of a kind that video decoders do not support.
    """
    data = memoryview(data)
    if bytes(data[:2]) != b"\xff\xd8":
        name = next((name for start, name in _OTHER_IMAGES if start.match(data)), "")
        if name:
            raise Refused(f"it is {name}, not a JPEG")
        raise Refused("it is not a JPEG: it has no start-of-image marker")
    info: JpegInfo | None = None
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
            if info is not None:
                raise Refused("its JPEG holds two pictures")
            info = _frame(segment)
        elif marker in _OTHER_FRAMES:
            raise Refused(f"its JPEG is {_OTHER_FRAMES[marker]}, which few decoders take")
        elif marker == _SOS:
            if info is None:
                raise Refused("its JPEG has a scan before its frame header")
            scans += 1
            offset = _skip_coded_data(data, offset)
    else:
        raise Refused(f"its JPEG has more than {_MAX_SEGMENTS} segments")
    if info is None or not scans:
        raise Refused("its JPEG holds no picture")
    return info


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


def _skip_coded_data(data: memoryview, offset: int) -> int:
    found = _MARKER.search(data, offset)
    if found is None:
        raise Refused("its JPEG is cut short: it has no end-of-image marker")
    return found.start()


def _frame(segment: memoryview) -> JpegInfo:
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
    return JpegInfo(width, height, components)
