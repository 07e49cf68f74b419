"""What an image becomes in another form: its encoding, format, size and bytes.

Formats of CompressedImage are those of compressed_image_transport, and depths become metres as
in compressed_depth_image_transport (ros-perception/image_transport_plugins, their publishers and
subscribers).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mp4ds.coded.depth import HEADER_BYTES
from mp4ds.errors import OptionError
from mp4ds.layouts import ENCODINGS, Pixels
from mp4ds.republish.packets import VideoFields
from mp4ds.sidecar import Header, StreamSidecar
from mp4ds.streams.views import view_of
from mp4ds.video import ImageFile
from mp4ds.wire import CodedFields, Fields, ImageFields

_COLOURS = ("rgb8", "bgr8", "rgba8", "bgra8", "rgb16", "bgr16", "rgba16", "bgra16")
_DEPTHS = ("16UC1", "mono16")
_INVERSE_DEPTHS = "32FC1"


class AsRecorded(ValueError):  # noqa: N818 - no failure: the messages stay as they are
    """Images that cannot be given in another form; the text says why."""


@dataclass(frozen=True, slots=True)
class Given:
    """An image in its new form.

    Attributes:
        fields: What its message says of it.
        body: Pixels, file or packet.
        is_key: For a packet, whether decoding can begin with it.
    """

    fields: Fields | VideoFields
    body: bytes | memoryview
    is_key: bool = False


@dataclass(frozen=True, slots=True)
class Kept:
    """A message that stays as recorded, since its picture does not decode.

    Attributes:
        payload: The message.
    """

    payload: bytes | bytearray


@dataclass(frozen=True, slots=True)
class Form:
    """What images are to be given as.

    Attributes:
        kind: One of `mp4ds.republish.KINDS`.
        ros1: Whether the messages are for ROS 1.
        jpeg_quality: Of new JPEG files, 1 to 100.
        size: Width and height in pixels; None for as recorded.
        keeps_format: Whether files are called what they were called, where they hold the same.
    """

    kind: str
    ros1: bool
    jpeg_quality: int
    size: tuple[int, int] | None = None
    keeps_format: bool = False


Maker = Callable[[Pixels], Given]


def maker(sidecar: StreamSidecar, header: Header, form: Form) -> Maker:
    """What makes the new form of an image that a header belongs to.

    Raises:
        AsRecorded: There is no such form of it; says why.
    """
    is_inverse = is_inverse_depth(sidecar, header)
    if is_inverse and len(header.prefix) != 2 * HEADER_BYTES:
        raise AsRecorded("the parameters of its quantised depths are missing")
    recorded = encoding_of(sidecar, header)
    stored = sidecar.image.encoding if is_inverse else recorded
    resize, resized = resizer(sidecar, stored, form.size)
    encoding = recorded if is_inverse else resized
    if form.kind == "raw":
        prefix = bytes.fromhex(header.prefix)
        as_metres = partial(_metres, parameters=prefix[4:]) if is_inverse else None
        return lambda pixels: _raw(resize(pixels), encoding=encoding, convert=as_metres)
    try:
        file = ImageFile(encoding, form.kind, quality=form.jpeg_quality)
    except OptionError:
        raise AsRecorded(f"{form.kind.upper()} files cannot hold {encoding} images") from None
    told = format_of(encoding, form, has_mosaic=form.kind == "png")
    if form.keeps_format and encoding == recorded:
        told = header.format or ""
    return lambda pixels: Given(CodedFields(told), file.encode(resize(pixels)))


def resizer(
    sidecar: StreamSidecar, encoding: str, size: tuple[int, int] | None
) -> tuple[Callable[[Pixels], Pixels], str]:
    """What makes pixels of a stream smaller, as its frames are, and their encoding after that.

    A Bayer mosaic and the YUV of cameras cannot be resized as they are, and become RGB.

    Args:
        sidecar: The stream's.
        encoding: Of the pixels.
        size: Width and height to make; None for as they are.
    """
    if size is None:
        return lambda pixels: pixels, encoding
    known = ENCODINGS[encoding]
    is_plain = not known.mosaic and known.rows == 1 and known.even == (1, 1)
    view = view_of(
        sidecar.channel.topic,
        known,
        (sidecar.image.width, sidecar.image.height),
        format="native" if is_plain else "rgb",
        resize=size,
        crop=None,
    )

    def resize(pixels: Pixels) -> Pixels:
        made: Pixels = np.empty(view.shape, view.dtype)
        view.give(np.ascontiguousarray(pixels, known.dtype), made)
        return made

    return resize, view.encoding.name


def encoding_of(sidecar: StreamSidecar, header: Header) -> str:
    """ROS image encoding of the images; their format tells a mosaic or depths from plain grey."""
    own, told = ENCODINGS[sidecar.image.encoding], _told(header)
    if sidecar.body == "pixels":
        return own.name
    if _is_depth(sidecar, header):
        if told not in (*_DEPTHS, _INVERSE_DEPTHS):
            raise AsRecorded(f"its format {header.format!r} does not tell the unit of its depths")
        return told
    known = ENCODINGS.get(told, own)
    is_alike = known.rows == 1 and known.channels == own.channels == 1
    return known.name if is_alike and known.dtype == own.dtype else own.name


def _told(header: Header) -> str:
    return (header.format or "").partition(";")[0].strip()


def _is_depth(sidecar: StreamSidecar, header: Header) -> bool:
    """Whether the messages are those of compressed_depth_image_transport."""
    is_coded = sidecar.body in ("png", "rvl") and sidecar.image.encoding == _DEPTHS[0]
    return is_coded and (bool(header.prefix) or "compressedDepth" in (header.format or ""))


def is_inverse_depth(sidecar: StreamSidecar, header: Header) -> bool:
    """Whether its depths are quantised inverse metres."""
    return _is_depth(sidecar, header) and _told(header) == _INVERSE_DEPTHS


def format_of(encoding: str, form: Form, *, has_mosaic: bool) -> str:
    """The field ``format``: the image's encoding, then that of the file.

    Args:
        encoding: Of the image.
        form: The form.
        has_mosaic: Whether the file shows a Bayer mosaic as it is, and not its colours.
    """
    known = ENCODINGS[encoding]
    if known.even != (1, 1) or known.rows != 1 or (known.mosaic and not has_mosaic):
        encoding = "rgb8"
    elif encoding == "8UC4" and form.kind == "jpeg":
        encoding = "8UC3"  # alpha is left out
    if encoding in _COLOURS:
        inner = "bgr16" if encoding.endswith("16") else "bgr8"
    else:
        is_grey = known.channels == 1 and form.kind == "jpeg"
        inner = "mono8" if is_grey and not form.ros1 else ""  # ROS 1 leaves it empty
    return f"{encoding}; {form.kind} compressed {inner}"


def _raw(
    pixels: Pixels, *, encoding: str, convert: Callable[[Pixels], Pixels] | None = None
) -> Given:
    if convert is not None:
        pixels = convert(pixels)
    height, width = pixels.shape[:2]
    step = width * ENCODINGS[encoding].pixel_bytes
    plain = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    return Given(ImageFields(encoding, width, height, step, 0), plain.tobytes())


def _metres(inverse: NDArray[np.uint16], *, parameters: bytes) -> NDArray[np.float32]:
    """Depths of inverse ones, as compressed_depth_image_transport computes them."""
    a, b = np.frombuffer(parameters, "<f4")
    with np.errstate(all="ignore"):
        metres = a / (inverse.astype(np.float32) - b)
    metres[inverse == 0] = np.nan
    found: NDArray[np.float32] = metres.astype(np.float32, copy=False)
    return found
