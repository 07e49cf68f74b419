"""Single images: reading and writing files exactly, and pixels as RGB, BGR or grey in any size."""

from __future__ import annotations

import io
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from mp4ds.errors import OptionError, Refused, SourceError
from mp4ds.messages import png
from mp4ds.messages.encodings import ENCODINGS, MAX_SIDE, Encoding, Pixels, check_size
from mp4ds.messages.layouts import CHROMA_SHIFTS, Layout, bind, layout_for
from mp4ds.video.colour import samples
from mp4ds.video.pixels import PictureConverter, plain_frame, reformat, scaling

STILL_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".pgm", ".webp")
"""Suffixes of the image files that are read."""

STILL_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM", "WEBP")
"""Pillow's names of the formats allowed: some of its others run programs."""

_GREY = ("1", "L", "LA")


def png_file(rgb: NDArray[np.uint8]) -> bytes:
    """A PNG file.

    Args:
        rgb: Shape (H, W, 3).
    """
    return _file(rgb, "PNG", optimize=True)


def _file(pixels: NDArray[np.uint8], kind: str, **options: int) -> bytes:
    from PIL import Image

    save: Callable[..., None] = Image.fromarray(pixels).save
    file = io.BytesIO()
    save(file, kind, **options)
    return file.getvalue()


# ---------------------------------------------------------------- image files

_HEAD = 64
_NETPBM = re.compile(rb"P([56])" + 3 * rb"(?:\s|#[^\n]*\n)+([0-9]{1,9})" + rb"\s")
_TIFF_BITS = 258
_CONVERT = "Convert it first, so that you decide how its values are mapped."

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


@contextmanager
def _opened(source: Path | BinaryIO) -> Iterator[Any]:
    """An image as Pillow opens it; whoever reads it bounds its sides."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            with Image.open(source, formats=STILL_FORMATS) as image:
                yield image
        except Image.DecompressionBombError as error:
            raise ValueError(str(error)) from None


def read_image(path: Path) -> tuple[str, Pixels]:
    """The pixels of an image file, exactly as stored.

    PNG, TIFF, BMP and PGM or PPM with 8 and 16 bits, TIFF with floats, too. One bit becomes 0 and
    255; a picture is not turned by what its metadata say.

    Returns:
        The ROS encoding, and pixels of shape (H, W) or (H, W, C), little-endian.

    Raises:
        SourceError: It is not an image, or its exact values cannot be read.
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


def coded_pixels(data: bytes | memoryview) -> tuple[str, Pixels]:
    """The pixels of an image file in a message.

    Returns:
        The ROS encoding, and pixels of shape (H, W) or (H, W, C), native byte order.

    Raises:
        Refused: It cannot be decoded.
    """
    from PIL import UnidentifiedImageError

    is_png = bytes(data[:8]) == png.SIGNATURE
    if is_png:
        with suppress(Refused):  # of a kind that Pillow may read
            pixels = png.pixels_of(data)
            channels = 1 if pixels.ndim == 2 else pixels.shape[2]
            return png.PNG_ENCODINGS[pixels.itemsize, channels], pixels
    try:
        with _opened(io.BytesIO(data)) as image:
            check_size(*image.size)
            if is_png and data[24] > 8:
                raise Refused("its PNG has 16 bits, of which Pillow would read only 8")
            is_grey = image.mode in _GREY
            pixels = np.asarray(image.convert("L" if is_grey else "RGB"))
            return ("mono8" if is_grey else "rgb8"), pixels
    except Refused:
        raise
    except UnidentifiedImageError:
        raise Refused("it is no image of a known format") from None
    except (OSError, ValueError, SyntaxError, EOFError, LookupError, struct.error):
        raise Refused("its picture is damaged, or cut short") from None


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, from its header.

    Raises:
        SourceError: It is not an image.
    """
    try:
        with _opened(path) as image:
            width, height = image.size
            return int(width), int(height)
    except (OSError, ValueError, SyntaxError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(path, f"cannot be read as an image: {reason}") from None


def _still(path: Path, head: bytes) -> tuple[str, Pixels]:
    with _opened(path) as image:
        _check_size(path, *image.size)
        if getattr(image, "n_frames", 1) > 1:
            raise SourceError(path, "holds several images", "Save each to a file of its own.")
        if _is_deep_colour(image, head):
            return _deep_colour(path, "png" if image.format == "PNG" else "tiff")
        if image.mode == "1":
            return "mono8", np.asarray(image.convert("L"))
        if image.mode == "I" and image.format == "PNG":  # 16 bits, in older Pillow
            return "mono16", np.asarray(image).astype(np.uint16)
        if image.mode not in _ENCODINGS:
            raise SourceError(path, f"has pixels of mode {image.mode}", _CONVERT)
        return _ENCODINGS[image.mode], np.asarray(image)


def _check_size(path: Path, width: int, height: int) -> None:
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE:
        raise SourceError(path, f"has {width}x{height} pixels, more than {MAX_SIDE} a side")


def _is_deep_colour(image: Any, head: bytes) -> bool:
    """Whether Pillow would cut the samples of several channels to 8 bits."""
    if image.format == "PNG":
        return head[:8] == png.SIGNATURE and head[24] == 16 and head[25] != 0
    if image.format == "TIFF":
        bits = image.tag_v2.get(_TIFF_BITS, (8,))
        return len(bits) > 1 and max(bits) > 8
    return False


def _deep_colour(path: Path, codec: str) -> tuple[str, Pixels]:
    context: Any = av.CodecContext.create(codec, "r")
    packet = av.Packet(path.read_bytes())
    frames = [*context.decode(packet), *context.decode(None)]
    if len(frames) != 1 or frames[0].format.name not in _DEEP:
        raise SourceError(path, "has more than 8 bits per sample in an unsupported form", _CONVERT)
    name = frames[0].format.name
    return _DEEP[name], frames[0].to_ndarray().astype(np.uint16, copy=False)


def _netpbm(path: Path) -> tuple[str, Pixels]:
    """A binary PGM or PPM with its exact values: Pillow scales them to 8 or 16 bits."""
    data = path.read_bytes()
    match = _NETPBM.match(data)
    if not match:
        raise SourceError(path, "cannot be read as an image: its header is damaged")
    width, height, highest = map(int, match.groups()[1:])
    _check_size(path, width, height)
    if not 1 <= highest < 2**16:
        raise SourceError(path, f"has values up to {highest}, which exceeds 16 bits")
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


# ---------------------------------------------------------------- images

_PNG_FORMATS = {
    "gray": "gray",
    "gray16le": "gray16be",
    "rgb24": "rgb24",
    "bgr24": "rgb24",
    "rgba": "rgba",
    "bgra": "rgba",
    "gbrp16le": "rgb48be",
    "gbrap16le": "rgba64be",
    **dict.fromkeys(CHROMA_SHIFTS, "rgb24"),
}


class ImageFile:
    """Encodes images of one ROS encoding.

    PNG keeps every sample, but YUV becomes RGB: a Bayer mosaic stays a mosaic in grey, 16 bits
    stay 16 bits. JPEG is for looking at: Bayer is demosaiced, alpha is left out; grey images
    have one component, as decoders expect of them.

    Args:
        encoding: ROS image encoding.
        image_format: ``png`` or ``jpeg``.
        quality: Of JPEG, 1 to 100, libjpeg's scale.

    Raises:
        OptionError: The format cannot hold the encoding, or the quality is out of range.
    """

    def __init__(self, encoding: str, image_format: str, *, quality: int = 95) -> None:
        known = ENCODINGS[encoding]
        self._jpeg = image_format == "jpeg"
        if known.dtype not in ("u1", "u2") or known.general.startswith("stack"):
            raise OptionError(
                f"{image_format.upper()} cannot hold {encoding} images: it supports no signed, "
                "float or two-channel samples."
            )
        if self._jpeg and known.bytes_per_sample == 2:
            raise OptionError(f"JPEG cannot hold {encoding} images, but PNG can.")
        if not 1 <= quality <= 100:
            raise OptionError(f"JPEG quality is {quality}: use 1 to 100")
        self._quality = quality
        self._layout = _layout(known, demosaic=self._jpeg)
        self._is_yuv = self._layout.pixel_format in CHROMA_SHIFTS
        self._from_yuv = PictureConverter("smpte170m", source_full_range=False)
        self._converter = PictureConverter("smpte170m")
        self._pixel_format = _PNG_FORMATS.get(self._layout.pixel_format, "rgb24")
        if self._jpeg and self._pixel_format != "gray":
            self._pixel_format = "rgb24"  # libjpeg knows no alpha

    def encode(self, pixels: Pixels) -> bytes:
        """The file's bytes for an image as `mp4ds.messages.encodings.pixel_view` gives it."""
        frame = plain_frame(self._layout.to_picture(pixels), self._layout.pixel_format)
        if self._is_yuv:
            frame = self._from_yuv.convert(frame, "rgb24")
        elif frame.format.name.startswith("bayer_"):
            frame = self._converter.convert(frame, "rgb24")
        if frame.format.name != self._pixel_format:
            frame = self._converter.convert(frame, self._pixel_format)
        if self._jpeg:
            # full chroma: what is published as colour was often demosaiced, and is sharp in it
            return _file(samples(frame), "JPEG", quality=self._quality, subsampling=0)
        return _png_file(frame)


def _png_file(frame: av.VideoFrame) -> bytes:
    frame.pts = 0
    context: Any = av.CodecContext.create("png", "w")
    context.width, context.height = frame.width, frame.height
    context.pix_fmt = frame.format.name
    context.time_base = Fraction(1, 25)
    return b"".join(map(bytes, [*context.encode(frame), *context.encode(None)]))


def _layout(encoding: Encoding, *, demosaic: bool) -> Layout:
    """A layout whose pictures look like the images, or their mosaic."""
    if not encoding.mosaic:
        return bind(encoding.general, encoding)
    if demosaic and encoding.bytes_per_sample == 1:
        return layout_for(encoding, lossless=False)
    plain = ENCODINGS["mono8" if encoding.bytes_per_sample == 1 else "mono16"]
    return bind(plain.general, plain)


# ---------------------------------------------------------------- rendering

# numbers of channels that are colours by the registry: blue, green, red and alpha
_NAMED = {"mono8": "gray", "mono16": "gray16le", "8UC1": "gray", "8UC3": "bgr24", "8UC4": "bgra",
          "16UC3": "bgr48le", "16UC4": "bgra64le"}  # fmt: skip


def shown_format(encoding: Encoding) -> str | None:
    """The pixel format for display, in ffmpeg; None if the pixels cannot be displayed.

    Depths, signed numbers, floats, and pairs of channels are data. A Bayer mosaic is its own
    format, and YUV its planes.
    """
    if encoding.mosaic:
        return f"bayer_{encoding.name[6:10]}" + ("8" if encoding.bytes_per_sample == 1 else "16le")
    if encoding.even != (1, 1) or encoding.rows != 1:
        return bind(encoding.general, encoding).pixel_format
    if encoding.name in _NAMED:
        return _NAMED[encoding.name]
    found = re.fullmatch("(rgba?|bgra?)(8|16)", encoding.name)
    if found is None:
        return None
    order, bits = found.groups()
    if bits == "8":
        return order if len(order) == 4 else f"{order}24"
    return f"{order}{16 * len(order)}le"


def encoding_as(encoding: Encoding, colours: str) -> str | None:
    """The ROS encoding of pixels converted to ``rgb``, ``bgr`` or ``gray``; 16 bits stay 16 bits.

    Returns:
        None if the pixels cannot be displayed.
    """
    if shown_format(encoding) is None:
        return None
    return f"{'mono' if colours == 'gray' else colours}{8 * encoding.bytes_per_sample}"


class Renderer:
    """Converts pixels to another encoding and size; not thread-safe.

    Mosaics are interpolated, camera YUV is BT.601 of limited range, alpha is left out, and grey is
    the luma of BT.601. Sizes are reduced by area and enlarged by bicubic interpolation.

    Args:
        encoding: Of the pixels; one that `shown_format` knows.
        target: ROS encoding to make: one of `encoding_as`, or the same encoding where it is
            neither a mosaic nor YUV.
        crop: x, y, width and height of the part to take first, or None for all of it.
        size: Width and height of the result.
    """

    def __init__(
        self,
        encoding: Encoding,
        target: str,
        *,
        crop: tuple[int, int, int, int] | None,
        size: tuple[int, int],
    ) -> None:
        shown = shown_format(encoding)
        if shown is None:
            raise ValueError(f"{encoding.name} images cannot be displayed")
        self._encoding = encoding
        self._source = shown
        self._target = shown_format(ENCODINGS[target]) or shown
        self._crop = crop
        self._size = size
        self._layout = bind(encoding.general, encoding) if shown in CHROMA_SHIFTS else None
        self._camera = PictureConverter("smpte170m", source_full_range=False)
        self._colours = PictureConverter("smpte170m")
        self._reformatter = VideoReformatter()

    def render(self, pixels: Pixels, out: Pixels) -> None:
        """Write the converted pixels.

        Args:
            pixels: Of the encoding, native byte order.
            out: Of the target's shape and type.
        """
        array, pixel_format = self._packed(pixels)
        if self._crop is not None:
            x, y, width, height = self._crop
            array = array[y : y + height, x : x + width]
        height, width = array.shape[:2]
        if pixel_format == self._target and (width, height) == self._size:
            np.copyto(out, array)
            return
        frame = reformat(
            self._reformatter,
            _frame(array, pixel_format),
            self._target,
            matrix=Colorspace.ITU601,
            ranges=(ColorRange.JPEG, ColorRange.JPEG),
            size=self._size,
            interpolation=scaling((width, height), self._size),
        )
        np.copyto(out, samples(frame))

    def _packed(self, pixels: Pixels) -> tuple[NDArray[Any], str]:
        """The image in one array, and ffmpeg's name of its format; YUV and mosaics as RGB."""
        if self._layout is not None:
            frame = plain_frame(self._layout.to_picture(pixels), self._source)
            return samples(self._camera.convert(frame, "rgb24")), "rgb24"
        if self._encoding.mosaic:
            height, width = pixels.shape
            frame = plain_frame((_even_mosaic(pixels),), self._source)
            made = "rgb24" if self._encoding.bytes_per_sample == 1 else "rgb48le"
            return samples(self._colours.convert(frame, made))[:height, :width], made
        return pixels, self._source


def _even_mosaic(pixels: Pixels) -> Pixels:
    """Whole blocks of the pattern: what is missing repeats the same colour's last row or column."""
    pad = [(0, side % 2) for side in pixels.shape]
    if not any(after for _, after in pad):
        return pixels
    return np.pad(pixels, pad, mode="reflect" if min(pixels.shape) > 1 else "edge")


def _frame(array: NDArray[Any], pixel_format: str) -> av.VideoFrame:
    if array.dtype == np.uint8 or array.ndim == 2:
        return plain_frame((array,), pixel_format)
    frame = av.VideoFrame(array.shape[1], array.shape[0], pixel_format)
    samples(frame)[...] = array
    return frame
