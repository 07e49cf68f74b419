"""Pictures to video frames and back, with the colours tagged and converted as tagged.

Colour is BT.709, full range (spec/registry.md, "Colour"): what is not tagged is guessed by
every player in its own way.
"""

from __future__ import annotations

from typing import Any, cast

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.layouts import Pixels

BT709 = 1  # primaries, transfer and matrix have the same number in H.273
FULL_RANGE = 2

# libswscale's flags: bicubic, full chroma in and out, accurate rounding, the same everywhere.
# As numbers, since older PyAV has no names for them.
_BICUBIC, _FULL_CHROMA, _ACCURATE, _BITEXACT = 0x4, 0x2000 | 0x4000, 0x40000, 0x80000
_INTERPOLATION = _BICUBIC | _FULL_CHROMA | _ACCURATE | _BITEXACT
_YUV = ("yuv420p", "yuvj420p")
_MATRICES = {"bt709": Colorspace.ITU709, "smpte170m": Colorspace.ITU601}


class Converter:
    """Converts frames between pixel formats, to full range; not to be shared between threads.

    Args:
        matrix: Between RGB and YUV, by ffmpeg's name: ours is bt709, JPEG files have smpte170m.
        source_full_range: Whether the frames to convert use the full range.
    """

    def __init__(self, matrix: str = "bt709", *, source_full_range: bool = True) -> None:
        self._matrix = _MATRICES.get(matrix, Colorspace.ITU709)
        self._source_range = ColorRange.JPEG if source_full_range else ColorRange.MPEG
        self._reformatter = VideoReformatter()

    def convert(self, frame: av.VideoFrame, pixel_format: str) -> av.VideoFrame:
        """The frame in another pixel format, the colours kept."""
        return self._reformatter.reformat(
            frame,
            format=pixel_format,
            src_colorspace=self._matrix,
            dst_colorspace=self._matrix,
            src_color_range=self._source_range,
            dst_color_range=ColorRange.JPEG,
            interpolation=_INTERPOLATION,
            threads=1,  # a pool inherited over fork would never end
        )


def picture_to_frame(
    picture: Pixels, picture_format: str, pixel_format: str, converter: Converter
) -> av.VideoFrame:
    """A frame for the encoder; a view of the picture where the formats agree.

    Args:
        picture: Shape (H, W) or (H, W, C), rows contiguous.
        picture_format: Its pixel format.
        pixel_format: The encoder's.
        converter: The stream's own.
    """
    if pixel_format in _YUV and picture_format == "gray":
        return _gray_to_yuv(picture, pixel_format)
    if pixel_format in _YUV:
        picture = _pad_to_even(picture)
    frame = av.VideoFrame.from_numpy_buffer(picture, format=picture_format)
    if picture_format.startswith("bayer_"):
        frame = converter.convert(frame, "rgb24")
    if picture_format != pixel_format:
        frame = converter.convert(frame, pixel_format)
    return frame


def _pad_to_even(picture: Pixels) -> Pixels:
    """Repeat the last row and column where they are odd, for chroma planes of half size."""
    height, width = picture.shape[:2]
    pad = [(0, height % 2), (0, width % 2)] + [(0, 0)] * (picture.ndim - 2)
    if not pad[0][1] and not pad[1][1]:
        return picture
    padded: Any = np.pad(picture, pad, mode="edge")  # whose type forgets the dtype
    return cast("Pixels", padded)


def _gray_to_yuv(picture: Pixels, pixel_format: str) -> av.VideoFrame:
    picture = _pad_to_even(picture)
    height, width = picture.shape
    frame = av.VideoFrame(width, height, pixel_format)
    _rows(frame, 0)[:height, :width] = picture
    for index in (1, 2):
        _rows(frame, index)[...] = 128
    return frame


def frame_to_picture(
    frame: av.VideoFrame,
    picture_format: str,
    width: int,
    height: int,
    converter: Converter,
    place: str,
) -> Pixels:
    """The picture in a decoded frame; a view of it where possible.

    Args:
        frame: As decoded.
        picture_format: Of the picture wanted.
        width: Columns of the picture; padding of the video beyond is cut off.
        height: Rows of the picture.
        converter: The stream's own.
        place: The video, for errors.

    Raises:
        VideoError: The frame is smaller than the picture, or of another kind.
    """
    if frame.width < width or frame.height < height:
        raise VideoError(
            "geometry-mismatch",
            place,
            f"has frames of {frame.width}x{frame.height} where {width}x{height} are due",
        )
    if picture_format in ("gray", "gray16le"):
        return _plane(frame, picture_format, place)[:height, :width]
    if picture_format.startswith("bayer_"):
        return _sample_mosaic(_packed(frame, "rgb24", converter), picture_format, width, height)
    return _packed(frame, picture_format, converter)[:height, :width]


def _rows(frame: av.VideoFrame, index: int) -> NDArray[np.uint8]:
    """A plane as a view of shape (rows, bytes of a row), padding included."""
    plane: Any = frame.planes[index]  # a buffer, which its type does not tell
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)


def _plane(frame: av.VideoFrame, picture_format: str, place: str) -> Pixels:
    expected = ("gray16le",) if picture_format == "gray16le" else ("gray", *_YUV)
    if frame.format.name not in expected:
        raise VideoError(
            "codec-mismatch",
            place,
            f"decodes to {frame.format.name} where {' or '.join(expected)} is due",
        )
    rows = _rows(frame, 0)
    return rows.view("<u2") if picture_format == "gray16le" else rows


def _packed(frame: av.VideoFrame, pixel_format: str, converter: Converter) -> Pixels:
    rows = _rows(converter.convert(frame, pixel_format), 0)
    return rows[: frame.height, : 3 * frame.width].reshape(frame.height, frame.width, 3)


def _sample_mosaic(picture: Pixels, picture_format: str, width: int, height: int) -> Pixels:
    """The mosaic that a sensor with this pattern would have seen."""
    mosaic = picture_format.removeprefix("bayer_")[:4]
    pixels = np.empty((height, width), np.uint8)
    for index, color in enumerate(mosaic):
        row, column = divmod(index, 2)
        pixels[row::2, column::2] = picture[row:height:2, column:width:2, "rgb".index(color)]
    return pixels
