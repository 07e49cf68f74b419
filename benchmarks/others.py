"""What else pictures are stored as: PNG files, FFV1 and x264 as ffmpeg sets them, RVL.

Each is given the family's plain picture: what the array looks like to a program that knows
ffmpeg's pixel formats and nothing of mp4ds. A mosaic is grey as it stands; 16SC1 is offset by
32768; packed and semi-planar YUV are planes; a float's four bytes are four grey pictures in
one, the highest first. x264 is given 16-bit samples as 10 bits where they fit.

Every video and every file is decoded again and compared.
"""

from __future__ import annotations

import io
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.frame import VideoFrame
from numpy.typing import NDArray
from PIL import Image

from mp4ds.messages import depth
from mp4ds.messages.arrangements import Picture
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import bind
from mp4ds.video.pixels import PictureConverter, frame_to_picture, picture_to_frame

_TIME_BASE = Fraction(1, 30)
_GOOD_PNG = {"pred": "mixed"}  # a filter chosen for each row, as libpng does


@dataclass
class Way:
    """One way of storing one clip.

    Attributes:
        name: Of the way.
        size: Bytes of all files.
        encode: Frames per CPU second.
        decode: Frames per CPU second.
    """

    name: str
    size: int
    encode: float | None = None
    decode: float | None = None


@dataclass(frozen=True, slots=True)
class Plain:
    """A clip as plain pictures.

    Attributes:
        pictures: Planes of each frame.
        pixel_format: Of all.
    """

    pictures: Sequence[Picture]
    pixel_format: str


def plain(clip: NDArray[Any], encoding_name: str) -> Plain:
    """The plain pictures of a clip."""
    encoding = ENCODINGS[encoding_name]
    if encoding.mosaic:
        encoding = ENCODINGS["mono8" if encoding.bytes_per_sample == 1 else "mono16"]
    layout = bind(encoding.general, encoding)
    pictures = [
        tuple(np.ascontiguousarray(p) for p in layout.to_picture(frame.copy())) for frame in clip
    ]
    return Plain(pictures, layout.pixel_format)


def png(clip: Plain) -> Way:
    """PNG files: Pillow's default settings (zlib level 6); rgb of 16 bits with ffmpeg's."""
    if clip.pixel_format.startswith("gbrp"):
        return _png_rgb16(clip)
    files = [[io.BytesIO() for _ in picture] for picture in clip.pictures]
    start = time.process_time()
    for picture, parts in zip(clip.pictures, files, strict=True):
        for plane, file in zip(picture, parts, strict=True):
            Image.fromarray(plane).save(file, "PNG")
    encoded = time.process_time()
    images = [[Image.open(file) for file in parts] for parts in files]
    for parts_read in images:
        for image in parts_read:
            image.load()
    decoded = time.process_time()
    for picture, parts_read in zip(clip.pictures, images, strict=True):
        for plane, image in zip(picture, parts_read, strict=True):
            _check("PNG", plane, np.asarray(image))
    size = sum(len(file.getbuffer()) for parts in files for file in parts)
    return _way("PNG", size, len(files), encoded - start, decoded - encoded)


def _png_rgb16(clip: Plain) -> Way:
    """Pillow writes no such PNG."""
    frames = []
    for green, blue, red in clip.pictures:
        array = np.stack([red, green, blue], axis=-1)
        frames.append(VideoFrame.from_ndarray(array, format="rgb48be"))
    context: Any = av.CodecContext.create("png", "w")
    context.options = dict(_GOOD_PNG)
    context.width, context.height = frames[0].width, frames[0].height
    context.pix_fmt, context.time_base = "rgb48be", _TIME_BASE
    start = time.process_time()
    packets = [packet for frame in (*frames, None) for packet in context.encode(frame)]
    encoded = time.process_time()
    reader: Any = av.CodecContext.create("png", "r")
    found = [frame for packet in (*packets, None) for frame in reader.decode(packet)]
    decoded = time.process_time()
    for frame, back in zip(frames, found, strict=True):
        _check("PNG", frame.to_ndarray(), back.to_ndarray())
    size = sum(packet.size for packet in packets)
    return _way("PNG", size, len(frames), encoded - start, decoded - encoded)


def ffv1(clip: Plain, folder: Path) -> Way:
    """FFV1 with no option given."""
    wanted = {"rgb24": "bgr0", "rgba": "bgra"}.get(clip.pixel_format, clip.pixel_format)
    return _video("FFV1", clip, folder, "ffv1", wanted, {})


def x264(clip: Plain, folder: Path) -> Way | None:
    """x264 with ``qp`` 0 and nothing else; None where it has no such pixels."""
    if clip.pixel_format == "rgb24":
        return _video("x264", clip, folder, "libx264rgb", "rgb24", {"qp": "0"})
    if clip.pixel_format == "gray16le":
        if max(int(picture[0].max()) for picture in clip.pictures) >= 1 << 10:
            return None
        clip = Plain(clip.pictures, "gray10le")
    if clip.pixel_format not in ("gray", "gray10le", "yuv420p", "yuv422p"):
        return None
    return _video("x264", clip, folder, "libx264", clip.pixel_format, {"qp": "0"})


def _video(
    name: str, clip: Plain, folder: Path, encoder: str, pixel_format: str, options: dict[str, str]
) -> Way:
    """An mp4 of a lossless encoder."""
    path = folder / f"{name}.mp4"
    converter = PictureConverter()
    frames = [
        picture_to_frame(picture, clip.pixel_format, pixel_format, converter)
        for picture in clip.pictures
    ]
    start = time.process_time()
    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = container.add_stream(encoder, rate=30, options=options)
        stream.width, stream.height = frames[0].width, frames[0].height
        stream.pix_fmt, stream.thread_count = pixel_format, os.cpu_count()
        tag = 1 if pixel_format.startswith("yuv") else 2
        stream.codec_context.color_range = tag
        for number, frame in enumerate(frames):
            frame.pts, frame.time_base, frame.color_range = number, _TIME_BASE, tag
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    encoded = time.process_time()
    height, width = clip.pictures[0][0].shape[:2]
    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "AUTO"
        found = list(container.decode(video=0))
    decoded = time.process_time()
    for picture, back in zip(clip.pictures, found, strict=True):
        again = frame_to_picture(back, clip.pixel_format, width, height, converter, str(path))
        for plane, other in zip(picture, again, strict=True):
            _check(name, plane, other)
    return _way(name, path.stat().st_size, len(frames), encoded - start, decoded - encoded)


def rvl_files(clip: NDArray[Any]) -> Way:
    """Each frame as an RVL file; numpy's speed says nothing of RVL's."""
    files = [depth.encode_rvl(np.ascontiguousarray(frame)) for frame in clip]
    for frame, file in zip(clip, files, strict=True):
        _check("RVL", frame, depth.decode_rvl(file))
    return Way("RVL", sum(map(len, files)))


def _way(name: str, size: int, frames: int, encoding: float, decoding: float) -> Way:
    return Way(name, size, frames / encoding, frames / decoding)


def _check(name: str, expected: NDArray[Any], found: NDArray[Any]) -> None:
    if not np.array_equal(expected, found):
        raise SystemExit(f"{name}: pixels do not come back exactly.")
