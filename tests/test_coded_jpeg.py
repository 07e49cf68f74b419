"""JPEG: what is told of it, and what is refused."""

from __future__ import annotations

import pytest
from PIL import Image

from coded_tools import decodes, jpeg, mutations, refusal, scene
from mp4ds.video.coded import parse_jpeg

PICTURE = next(scene(1))
BASE = jpeg(PICTURE, subsampling=2)
FRAME_HEADER = BASE.index(b"\xff\xc0")


def patched(**changes: int) -> bytes:
    """The base with bytes of its frame header changed: marker at 1, precision at 4 ..."""
    data = bytearray(BASE)
    for name, value in changes.items():
        data[FRAME_HEADER + int(name[2:])] = value
    return bytes(data)


def exif() -> bytes:
    tags = Image.Exif()
    tags[0x010E] = "a wall " * 99
    return jpeg(PICTURE, exif=tags.tobytes())


KINDS = {
    "444": jpeg(PICTURE, subsampling=0),
    "422": jpeg(PICTURE, subsampling=1),
    "420": jpeg(PICTURE, subsampling=2),
    "grey": jpeg(PICTURE[..., 0]),
    "progressive": jpeg(PICTURE, progressive=True),
    "optimized": jpeg(PICTURE, optimize=True),
    "rgb": jpeg(PICTURE, keep_rgb=True),
    "restarts": jpeg(PICTURE, restart_marker_blocks=3),
    "exif": exif(),
    "comment": jpeg(PICTURE, comment=b"\xff\xd8 no image \xff\xd9"),
    "trailing": BASE + b"\0\xff\xd8 more",
    "extended": patched(at1=0xC1),
}


@pytest.mark.parametrize("kind", KINDS)
def test_headers_are_read(kind: str) -> None:
    data = KINDS[kind]
    assert parse_jpeg(memoryview(data)) == (64, 48, 1 if kind == "grey" else 3)
    assert decodes("mjpeg", [data]) == 1


FACTORS = [across << 4 | down for across in range(1, 5) for down in range(1, 5)]


@pytest.mark.parametrize("luma", FACTORS)
def test_every_sampling_taken_is_one_that_decodes(luma: int) -> None:
    taken = 0
    for chroma in FACTORS:
        for last in {chroma, 0x11}:
            data = patched(at11=luma, at14=chroma, at17=last)
            if refusal(parse_jpeg, data):
                continue
            taken += 1
            assert decodes("mjpeg", [data]) == 1
    assert taken or luma not in (0x11, 0x12, 0x21, 0x22, 0x41)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "not a JPEG"),
        (b"\x89PNG\r\n\x1a\n", "a PNG image, not a JPEG"),
        (b"RIFF\0\0\0\0WEBPVP8 ", "a WebP image"),
        (b"BMnothing of a picture", "not a JPEG: it has no start"),
        (b"\xff\xd8\xff\xd9", "no picture"),
        (BASE[:FRAME_HEADER] + BASE[FRAME_HEADER + 19 :], "before its frame header"),
        (BASE[: FRAME_HEADER + 19] + BASE[FRAME_HEADER:], "two pictures"),
        (BASE[:-2], "cut short"),
        (BASE[:2] + BASE, "marker 0xFFD8"),
        (patched(at1=0xC3), "lossless"),
        (patched(at1=0xC9), "arithmetic"),
        (patched(at4=12), "12 bits"),
        (patched(at5=0, at6=0), "64x0"),
        (patched(at7=0xFF), "pixels"),
        (patched(at9=4), "wrong length"),
        (patched(at11=0x33), "sampling 3x3 1x1 1x1"),
        (b"\xff\xd8" + b"\xff\xe0\0\2" * 70_000 + BASE[2:], "segments"),
        (b"\xff" * 10**7, "not a JPEG"),
        (b"\xff\xd8" + b"\xff" * 10**7, "cut short"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refusals(data: bytes, reason: str) -> None:
    assert reason in refusal(parse_jpeg, data)


@pytest.mark.parametrize("kind", ["420", "progressive", "exif", "restarts"])
def test_every_cut_is_refused(kind: str) -> None:
    data = KINDS[kind]
    for length in range(len(data)):
        assert refusal(parse_jpeg, data[:length])


@pytest.mark.parametrize("kind", ["420", "progressive", "exif"])
def test_damage_is_refused_or_read(kind: str) -> None:
    for damaged in mutations(KINDS[kind], 600):
        refusal(parse_jpeg, damaged)  # and raises nothing else
