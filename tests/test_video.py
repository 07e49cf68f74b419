"""Pictures through the codecs: exact where promised, near where not, and found by number."""

from __future__ import annotations

import io
import itertools
import os
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from coded_tools import jpeg
from commands import ffprobe
from mp4ds.errors import EncoderRefusedError, OptionError, Refused, VideoError
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import CHROMA_SHIFTS, bind, fit, layout_for
from mp4ds.video.codecs import Recipe, recipe_for
from mp4ds.video.decoder import VideoDecoder, jpeg_pixels
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.images import ImageFile
from mp4ds.video.pixels import PictureConverter, PictureMaker, to_planes
from pictures import picture
from pixel_kinds import rounded
from republished import psnr

Pixels = NDArray[Any]

CODECS = ["h264", "h265", "av1", "ffv1"]
GRAYS = {"gray": 8, "gray10le": 10, "gray12le": 12, "gray14le": 14, "gray16le": 16}
PACKED = {"rgb24": 3, "bgr24": 3, "rgba": 4, "bgra": 4}
PLANAR = {f"gbr{a}p{bits}le": (bits, 3 + len(a)) for a in ("", "a") for bits in (10, 12, 14, 16)}
YUV = [name for name in ENCODINGS if name.startswith(("yuv", "uyvy", "yuyv", "nv"))]
FORMATS = [*GRAYS, *PACKED, *PLANAR, *CHROMA_SHIFTS]
SIZES = [(1, 1), (2, 2), (3, 5), (4, 4), (7, 4), (16, 16), (33, 31), (1, 63), (301, 4), (64, 48)]


def exists(codec: str, picture_format: str, lossless: bool) -> bool:
    try:
        recipe_for(picture_format, lossless=lossless, codec=codec, crf=20)
    except OptionError:
        return False
    return True


LOSSLESS = [pair for pair in itertools.product(CODECS, FORMATS) if exists(*pair, lossless=True)]
LOSSY = [codec for codec in (*CODECS, "av1-10bit") if exists(codec, "rgb24", lossless=False)]


def noise(picture_format: str, width: int, height: int, frames: int) -> list[Any]:
    """Pictures of zeros, of the largest value, of both, and of any; planes as tuples."""
    bits = GRAYS.get(picture_format) or PLANAR.get(picture_format, (8, 0))[0]
    dtype = np.dtype("<u2" if bits > 8 else np.uint8)
    shapes: list[tuple[int, ...]] = [(height, width)]
    if picture_format in PACKED:
        shapes = [(height, width, PACKED[picture_format])]
    elif picture_format in PLANAR:
        shapes *= PLANAR[picture_format][1]
    elif picture_format in CHROMA_SHIFTS:
        across, down = CHROMA_SHIFTS[picture_format]
        shapes += [(-(-height >> down), -(-width >> across))] * 2
    rng = np.random.default_rng([width, height])
    top = 2**bits - 1
    made: list[Any] = []
    for number in range(frames):
        kinds = (lambda s: np.zeros(s, dtype), lambda s: np.full(s, top, dtype),
                 lambda s: (rng.integers(0, 2, s) * top).astype(dtype),
                 lambda s: rng.integers(0, top, s, dtype, endpoint=True))  # fmt: skip
        planes = tuple(kinds[min(number, 3)](shape) for shape in shapes)
        made.append(planes if len(planes) > 1 else planes[0])
    return made


def same(a: Any, b: Any) -> bool:
    planes = [x if isinstance(x, tuple) else (x,) for x in (a, b)]
    return len(planes[0]) == len(planes[1]) and all(map(np.array_equal, *planes))


def scene_pictures(encoding: str, width: int, height: int, frames: int) -> list[Pixels]:
    return [
        np.ascontiguousarray(picture(encoding, frame=n, width=width, height=height, rng=None))
        for n in range(frames)
    ]


def encode(
    path: Path,
    recipe: Recipe,
    pictures: Sequence[Any],
    picture_format: str,
    *,
    ticks: Sequence[int] | None = None,
    gop: int = 60,
    threads: int = 1,
) -> dict[str, Any]:
    """Make a video; returns what its decoder is to be told."""
    planes = [p if isinstance(p, tuple) else (p,) for p in pictures]
    height, width = planes[0][0].shape[:2]
    encoder = VideoEncoder(
        path, recipe, picture_format=picture_format, width=width, height=height,
        gop=gop, threads=threads, rate=30.0,
    )  # fmt: skip
    for number, pixels in enumerate(planes):
        encoder.write(pixels, ticks[number] if ticks else number * 33_333)
    encoder.close()
    assert encoder.frames == len(pictures)
    return {
        "codec": recipe.codec,
        "coded_size": (encoder.width, encoder.height),
        "frames": len(pictures),
        "picture_format": picture_format,
        "picture_size": (width, height),
    }


def copied(planes: tuple[Pixels, ...]) -> Any:
    copies = tuple(plane.copy() for plane in planes)
    return copies if len(copies) > 1 else copies[0]


def video_decoder(
    path: Path, *, codec: str, frames: int, sequential: bool = True, **promised: Any
) -> VideoDecoder:
    """A decoder of a video whose size and pictures are promised as `PictureMaker` has them."""
    maker = PictureMaker(path, **promised)
    return VideoDecoder(path, codec=codec, frames=frames, maker=maker, sequential=sequential)


def decode(path: Path, told: dict[str, Any]) -> list[Any]:
    """Pictures: arrays, or tuples of planes."""
    with video_decoder(path, **told) as decoder:
        assert decoder.coded_frames == told["frames"]
        return [copied(planes) for _, planes in decoder.pictures_at(range(told["frames"]))]


# ---------------------------------------------------------------- lossless


EVEN = {name: (1 << across, 1 << down) for name, (across, down) in CHROMA_SHIFTS.items()}


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("codec", "picture_format"), LOSSLESS)
def test_lossless_is_exact(codec: str, picture_format: str, tmp_path: Path) -> None:
    recipe = recipe_for(picture_format, lossless=True, codec=codec)
    assert recipe.lossless
    path = tmp_path / "video.mp4"
    across, down = EVEN.get(picture_format, (1, 1))
    refused = set()
    for width, height in SIZES:
        width, height = width + -width % across, height + -height % down
        pictures = noise(picture_format, width, height, 7)
        try:
            told = encode(path, recipe, pictures, picture_format, gop=4)
        except EncoderRefusedError:
            refused.add((width, height))
            continue
        decoded = decode(path, told)
        assert all(map(same, decoded, pictures))
        first = decoded[0][0] if isinstance(decoded[0], tuple) else decoded[0]
        assert first.dtype.itemsize == (2 if picture_format.endswith("le") else 1)
        with video_decoder(path, **told, sequential=False) as decoder:
            assert same(copied(next(decoder.pictures_at([5]))[1]), pictures[5])
    # the smallest pictures are refused by some, and then another codec has them
    if codec == "h265":
        assert refused == {size for size in SIZES if size[0] < 64 or size[1] < 16}
    assert codec == "h265" or all(min(size) < 4 for size in refused)


@pytest.mark.slow
def test_a_large_picture_is_exact(tmp_path: Path) -> None:
    large = np.zeros((3648, 4096, 4), np.uint8)
    large[::7, ::5] = np.arange(4096 // 5 + 1, dtype=np.uint8)[:, None]
    recipe = recipe_for("rgba", lossless=True)
    told = encode(tmp_path / "v.mp4", recipe, [large], "rgba", threads=2)
    assert same(decode(tmp_path / "v.mp4", told)[0], large)


# ---------------------------------------------------------------- colour

TAGS = ("color_range", "color_space", "color_transfer", "color_primaries")


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("codec", "picture_format"), LOSSLESS)
def test_lossless_files_are_tagged_too(codec: str, picture_format: str, tmp_path: Path) -> None:
    recipe = recipe_for(picture_format, lossless=True, codec=codec)
    encode(tmp_path / "v.mp4", recipe, noise(picture_format, 64, 16, 3), picture_format)
    found = ffprobe(tmp_path / "v.mp4", "-show_streams")["streams"][0]
    matrix: str | None = "bt709" if picture_format in GRAYS else "gbr"
    if picture_format in CHROMA_SHIFTS:
        matrix = "smpte170m"
    if codec == "h264" and picture_format in GRAYS:
        matrix = None  # x264 leaves it out of a stream without chroma
    full = "tv" if picture_format in CHROMA_SHIFTS else "pc"
    assert [found.get(tag) for tag in TAGS] == [full, matrix, "bt709", "bt709"]


def test_colours_are_rounded_to_the_nearest() -> None:
    """None is preferred: chroma that is half a level low tints every image a little."""
    colours = np.random.default_rng(0).integers(0, 256, (400, 3), np.uint8)
    picture = colours.reshape(20, 20, 3).repeat(16, axis=0).repeat(16, axis=1)
    red, green, blue = colours.astype(float).T
    y = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    exact = (y, 128 + (blue - y) / 1.8556, 128 + (red - y) / 1.5748)
    for found, due in zip(to_planes((picture,), "rgb24", PictureConverter()), exact, strict=True):
        side = found.shape[0] // 20
        errors = found[side // 2 :: side, side // 2 :: side].ravel() - np.minimum(due, 255)
        assert np.abs(errors).max() < 0.6
        assert abs(errors.mean()) < 0.06


@pytest.mark.one_in(4)
@pytest.mark.parametrize("codec", LOSSY)
@pytest.mark.parametrize("encoding", YUV)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (66, 47), (65, 47)])
def test_yuv_is_coded_as_it_is(
    codec: str, encoding: str, width: int, height: int, tmp_path: Path
) -> None:
    """Not by way of RGB; tagged as what ROS takes it for, chroma where decoders take it to be."""
    known = ENCODINGS[encoding]
    width, height = rounded(known, width, height)
    layout = layout_for(known, lossless=False)
    assert layout.pixel_format == "yuv420p"
    images = [picture(encoding, frame=n, width=width, height=height, rng=None) for n in range(4)]
    recipe = recipe_for("yuv420p", lossless=False, codec=codec, crf=8)
    assert (recipe.matrix, recipe.full_range) == ("smpte170m", False)
    assert "chromaloc" not in str(recipe.options)
    pictures = [layout.to_picture(pixels) for pixels in images]
    told = encode(tmp_path / "v.mp4", recipe, pictures, "yuv420p")
    found = ffprobe(tmp_path / "v.mp4", "-show_streams")["streams"][0]
    assert [found.get(tag) for tag in TAGS] == ["tv", "smpte170m", "bt709", "bt709"]
    full = bind(known.general, known)
    for planes, pixels in zip(decode(tmp_path / "v.mp4", told), images, strict=True):
        out = np.empty_like(pixels)
        layout.to_pixels(planes, out)
        luma, *chroma = zip(full.to_picture(out), full.to_picture(pixels), strict=True)
        assert psnr(*luma) > 40
        assert min(psnr(*both) for both in chroma) > 25  # of half the resolution now
    before = layout.to_picture(images[0])  # within 4:2:0, the codec alone matters
    assert min(map(psnr, before, decode(tmp_path / "v.mp4", told)[0])) > 38


@pytest.mark.parametrize("codec", LOSSY)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (65, 47)])
def test_grey_is_the_luma_itself(codec: str, width: int, height: int, tmp_path: Path) -> None:
    pictures = scene_pictures("mono8", width, height, 6)
    recipe = recipe_for("gray", lossless=False, codec=codec, crf=12)
    told = encode(tmp_path / "v.mp4", recipe, pictures, "gray")
    decoded = decode(tmp_path / "v.mp4", told)
    assert min(map(psnr, pictures, decoded)) > 38
    with av.open(str(tmp_path / "v.mp4")) as container:
        lumas = [plane_samples(frame, 0) for frame in container.decode(video=0)]
    if lumas[0].dtype == np.uint16:
        lumas = [np.rint(luma * (255 / 1023)) for luma in lumas]
    assert all(np.array_equal(a, b[:height, :width]) for a, b in zip(decoded, lumas, strict=True))


def plane_samples(frame: av.VideoFrame, index: int) -> Pixels:
    plane = frame.planes[index]
    dtype = np.uint16 if frame.format.name.endswith("le") else np.uint8
    return np.frombuffer(bytes(plane), dtype).reshape(plane.height, -1)[:, : plane.width]


# ---------------------------------------------------------------- random access


@pytest.mark.parametrize("codec", [*LOSSY, "h264 lossless", "ffv1 lossless"])
def test_times_in_the_file_are_the_ticks(codec: str, tmp_path: Path) -> None:
    """Strictly increasing from 0, in the order of coding, the last with a duration."""
    name, _, lossless = codec.partition(" ")
    recipe = recipe_for("gray", lossless=bool(lossless), codec=name, crf=30)
    ticks = [0, 1, 2, 33_335, 1_000_033_335, 1_000_033_336]
    encode(tmp_path / "v.mp4", recipe, scene_pictures("mono8", 64, 48, 6), "gray", ticks=ticks)
    with av.open(str(tmp_path / "v.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.time_base is not None
        assert stream.time_base.denominator == 1_000_000
        packets = [packet for packet in container.demux(stream) if packet.size]
    assert [packet.pts for packet in packets] == ticks
    assert [packet.dts for packet in packets] == ticks
    assert all(packet.duration for packet in packets)
    assert packets[0].is_keyframe


def scheduling() -> list[int]:
    """The scheduling classes of the threads of this process."""
    return [os.sched_getscheduler(int(p.name)) for p in Path("/proc/self/task").iterdir()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="a matter of Linux")
def test_encoders_leave_the_machine_to_others(tmp_path: Path) -> None:
    before = scheduling()
    assert set(before) == {os.SCHED_OTHER}
    encoder = VideoEncoder(
        tmp_path / "v.mp4", recipe_for("gray", lossless=False, codec="av1", crf=30),
        picture_format="gray", width=320, height=240, gop=60, threads=2, rate=30.0,
    )  # fmt: skip
    assert len(scheduling()) > len(before)
    assert set(scheduling()) == {os.SCHED_OTHER}
    encoder.write((np.zeros((240, 320), np.uint8),), 0)
    encoder.close()
    assert set(scheduling()) == {os.SCHED_OTHER}


# ---------------------------------------------------------------- what is refused


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], list[Pixels]]:
    path = tmp_path_factory.mktemp("video") / "plain.mp4"
    pictures = scene_pictures("mono8", 32, 24, 8)
    recipe = recipe_for("gray", lossless=True)
    return path, encode(path, recipe, pictures, "gray", gop=4), pictures


def read_all(path: Path, told: dict[str, Any]) -> list[Pixels] | VideoError:
    try:
        with video_decoder(path, **told) as decoder:
            numbers = range(told["frames"])
            pictures = [copied(planes) for _, planes in decoder.pictures_at(numbers)]
            for number in numbers:
                list(decoder.pictures_at([number]))
            return pictures
    except VideoError as error:
        return error


def damage(raw: bytes, rng: random.Random) -> bytes:
    """The file cut short, or with a few bytes changed, mostly of its index."""
    damaged = bytearray(raw)
    if rng.random() < 0.2:
        del damaged[rng.randrange(len(damaged)) :]
        return bytes(damaged)
    first = raw.index(b"moov") if rng.random() < 0.6 else 0
    for _ in range(rng.randint(1, 4)):
        value = rng.choice([0, 0x7F, 0x80, 0xFF, rng.randrange(256)])
        damaged[rng.randrange(first, len(damaged))] = value
    return bytes(damaged)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("codec", ["h264 lossless", "ffv1 lossless", "av1", "h265"])
def test_a_damaged_video_is_a_clear_error_at_worst(codec: str, tmp_path: Path) -> None:
    """That its samples are the right ones is for the digests to say."""
    name, _, lossless = codec.partition(" ")
    recipe = recipe_for("gray", lossless=bool(lossless), codec=name, crf=30)
    path, damaged = tmp_path / "v.mp4", tmp_path / "damaged.mp4"
    told = encode(path, recipe, scene_pictures("mono8", 64, 48, 8), "gray", gop=4)
    raw = path.read_bytes()
    unclear = []
    for seed in range(150):
        damaged.write_bytes(damage(raw, random.Random(seed)))
        try:
            found = read_all(damaged, told)
        except Exception as error:
            unclear.append(f"{seed}: {type(error).__name__}: {error}")
            continue
        if isinstance(found, VideoError) and ("\n" in str(found) or str(damaged) not in str(found)):
            unclear.append(f"{seed}: {found}")
    assert unclear == []


# ---------------------------------------------------------------- single images


@pytest.mark.parametrize("encoding", YUV)
@pytest.mark.parametrize("image_format", ["png", "jpeg"])
def test_yuv_becomes_the_colours_that_ros_takes_it_for(encoding: str, image_format: str) -> None:
    """BT.601, limited range, as OpenCV converts it."""
    known = ENCODINGS[encoding]
    colours = {(16, 128, 128): (0, 0, 0), (235, 128, 128): (255, 255, 255),
               (81, 90, 240): (254, 0, 0), (145, 54, 34): (0, 255, 1),
               (126, 128, 128): (128, 128, 128)}  # fmt: skip
    for (y, u, v), rgb in colours.items():
        shapes = {"yuv420p": (4, 6), "yuv422p": (8, 6), "yuv444p": (8, 12)}
        layout = fit(known.general, known, [])
        assert layout is not None
        chroma = shapes[layout.pixel_format]
        planes = [np.full(s, n, np.uint8) for s, n in (((8, 12), y), (chroma, u), (chroma, v))]
        pixels = np.empty(known.shape(12, 8), np.uint8)
        layout.to_pixels(tuple(planes), pixels)
        image = Image.open(io.BytesIO(ImageFile(encoding, image_format).encode(pixels)))
        assert image.format == image_format.upper()
        shown = np.asarray(image.convert("RGB")).astype(int)
        assert shown.shape == (8, 12, 3)
        assert np.abs(shown - rgb).max() <= 3


# ---------------------------------------------------------------- JPEG


def test_jpeg_files_that_do_not_decode_are_refused() -> None:
    pixels = np.arange(48 * 64 * 3, dtype=np.uint8).reshape(48, 64, 3)
    good = jpeg(pixels)
    assert jpeg_pixels(good, (64, 48))[1].shape == (48, 64, 3)
    at = good.index(b"\xff\xc0") + 5
    huge = good[:at] + b"\xff\xdc\xff\xdc" + good[at + 4 :]
    for data, reason in [
        (huge, "has 65500x65500 pixels"),  # before 13 GB are asked for
        (good[: len(good) // 2], "does not decode: image file is truncated"),
        (b"\xff\xd8\xff\xd9", "does not decode"),
        (b"", "does not decode"),
        (jpeg(np.zeros((48, 64, 4), np.uint8), "CMYK"), "colours of another kind"),
    ]:
        with pytest.raises(Refused, match=reason):
            jpeg_pixels(data, (64, 48))
