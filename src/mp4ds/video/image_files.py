"""Image files of others, read to the bit."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError

from mp4ds.errors import SourceError
from mp4ds.layouts import MAX_SIDE, Pixels
from mp4ds.video.stills import STILL_FORMATS

_HEAD = 64
_NETPBM = re.compile(rb"P([56])" + 3 * rb"(?:\s|#[^\n]*\n)+([0-9]{1,9})" + rb"\s")
_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF_BITS = 258
_CONVERT = "Convert it first, so that what becomes of its values is your choice."

# mode of Pillow -> the encoding of ROS
_ENCODINGS = {
    "L": "mono8",
    "LA": "8UC2",
    "RGB": "rgb8",
    "RGBA": "rgba8",
    **dict.fromkeys(("I;16", "I;16L", "I;16B", "I;16N"), "mono16"),
    "F": "32FC1",
}
# pixel format of ffmpeg -> the encoding of ROS, of what Pillow reads with 8 bits only
_DEEP = {
    **dict.fromkeys(("rgb48le", "rgb48be"), "rgb16"),
    **dict.fromkeys(("rgba64le", "rgba64be"), "rgba16"),
}


def read_image(path: Path) -> tuple[str, Pixels]:
    """The pixels of an image file, as they are in it.

    PNG, TIFF, BMP and PGM or PPM with 8 and 16 bits, TIFF with floats, too. One bit becomes 0 and
    255; a picture is not turned by what its metadata say.

    Returns:
        The ROS encoding, and pixels of shape (H, W) or (H, W, C), little-endian.

    Raises:
        SourceError: It is no image, or its values cannot be had as they are.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
        found = _netpbm(path) if head[:2] in (b"P5", b"P6") else _still(path, head)
    except SourceError:
        raise
    except (OSError, ValueError, SyntaxError, EOFError, FFmpegError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(path, f"cannot be read as an image: {reason}") from None
    encoding, pixels = found
    return encoding, np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, by its header.

    Raises:
        SourceError: It is no image.
    """
    return _header(path)[:2]


def image_kind(path: Path) -> str:
    """Size and kind of pixels of an image file, in words, by its header.

    Raises:
        SourceError: It is no image.
    """
    return "{}x{} {}".format(*_header(path))


def _header(path: Path) -> tuple[int, int, str]:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=STILL_FORMATS) as image:
                width, height = image.size
                return int(width), int(height), _ENCODINGS.get(image.mode, image.mode)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(path, f"cannot be read as an image: {reason}") from None


def _still(path: Path, head: bytes) -> tuple[str, Pixels]:
    from PIL import Image

    with warnings.catch_warnings():
        # the sides are bounded here
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            with Image.open(path, formats=STILL_FORMATS) as image:
                _check_size(path, *image.size)
                if getattr(image, "n_frames", 1) > 1:
                    raise SourceError(path, "holds several images", "Give each a file of its own.")
                if _is_deep_colour(image, head):
                    return _deep_colour(path, "png" if image.format == "PNG" else "tiff")
                if image.mode == "1":
                    return "mono8", np.asarray(image.convert("L"))
                if image.mode == "I" and image.format == "PNG":  # 16 bits, in older Pillow
                    return "mono16", np.asarray(image).astype(np.uint16)
                if image.mode not in _ENCODINGS:
                    raise SourceError(path, f"has pixels of the kind {image.mode}", _CONVERT)
                return _ENCODINGS[image.mode], np.asarray(image)
        except Image.DecompressionBombError as error:
            raise SourceError(path, f"is too large: {error}") from None


def _check_size(path: Path, width: int, height: int) -> None:
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise SourceError(path, f"has {width}x{height} pixels, which is beyond {MAX_SIDE} a side")


def _is_deep_colour(image: Any, head: bytes) -> bool:
    """Whether Pillow would cut the samples of several channels to 8 bits."""
    if image.format == "PNG":
        return head[:8] == _PNG and head[24] == 16 and head[25] != 0
    if image.format == "TIFF":
        bits = image.tag_v2.get(_TIFF_BITS, (8,))
        return len(bits) > 1 and max(bits) > 8
    return False


def _deep_colour(path: Path, codec: str) -> tuple[str, Pixels]:
    context: Any = av.CodecContext.create(codec, "r")
    packet = av.Packet(path.read_bytes())
    frames = [*context.decode(packet), *context.decode(None)]
    if len(frames) != 1 or frames[0].format.name not in _DEEP:
        raise SourceError(path, "has more than 8 bits in a form that is not known", _CONVERT)
    name = frames[0].format.name
    return _DEEP[name], frames[0].to_ndarray().astype(np.uint16, copy=False)


def _netpbm(path: Path) -> tuple[str, Pixels]:
    """A binary PGM or PPM, with its values as they are: Pillow scales them to 8 or 16 bits."""
    data = path.read_bytes()
    match = _NETPBM.match(data)
    if not match:
        raise SourceError(path, "cannot be read as an image: its header is damaged")
    width, height, highest = map(int, match.groups()[1:])
    _check_size(path, width, height)
    if not 1 <= highest < 2**16:
        raise SourceError(path, f"has values up to {highest}, which is beyond 16 bits")
    channels = 3 if match[1] == b"6" else 1
    dtype = np.dtype(">u2" if highest > 255 else "u1")
    start, count = match.end(), width * height * channels
    if len(data) - start != count * dtype.itemsize:
        raise SourceError(
            path, f"holds {len(data) - start} bytes of pixels, not {count * dtype.itemsize}"
        )
    shape = (height, width) if channels == 1 else (height, width, channels)
    pixels = np.frombuffer(data, dtype, count, start).reshape(shape)
    encoding = "mono" if channels == 1 else "rgb"
    return f"{encoding}{8 * dtype.itemsize}", pixels
