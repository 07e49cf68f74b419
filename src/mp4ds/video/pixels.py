"""Pictures and planes to video frames and back, their colours tagged and converted as tagged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.messages.encodings import Picture
from mp4ds.messages.layouts import CHROMA_SHIFTS
from mp4ds.video import colour
from mp4ds.video.codecs import AV_VERSION, TEN_BITS, Recipe
from mp4ds.video.colour import samples
from mp4ds.video.media import Media, raise_if_scarce

PLANES_FORMAT = "yuv420p"
"""Pixel format of planes."""

_FULL_RANGE = 2  # in a frame's tags (H.273; ffmpeg's AVColorRange)


def _tables(full_range: bool) -> tuple[list[NDArray[np.uint16]], list[NDArray[np.uint8]]]:
    """Tables from levels of 8 bits to 10 and back, each for luma and chroma."""
    eight, ten = np.arange(256), np.arange(1024)
    factor = 1023 / 255 if full_range else 4  # the limited range is 16 to 235, and 64 to 940
    there, back = [], []
    for middle in (0, 128):  # chroma is around the middle
        wide = np.rint(4 * middle + (eight - middle) * factor).clip(0, 1023)
        narrow = np.rint(middle + (ten - 4 * middle) / factor).clip(0, 255)
        there.append(wide.astype(np.uint16))
        back.append(narrow.astype(np.uint8))
    return there, back


_WIDER, _NARROWER = zip(*(_tables(full_range) for full_range in (False, True)), strict=True)


def with_bits(frame: av.VideoFrame, pixel_format: str, *, full_range: bool) -> av.VideoFrame:
    """A 4:2:0 picture of 8 bits, converted to 10, or one of 10 bits, rounded to 8.

    Args:
        frame: Of ``yuv420p`` or ``yuv420p10le``.
        pixel_format: The other one.
        full_range: Whether its samples use their full range.
    """
    tables = (_WIDER if pixel_format == TEN_BITS else _NARROWER)[full_range]
    made = av.VideoFrame(frame.width, frame.height, pixel_format)
    for index in range(3):
        samples(made, index)[...] = tables[min(index, 1)][samples(frame, index)]
    made.colorspace, made.color_range = frame.colorspace, frame.color_range
    return made


def rounded(frame: av.VideoFrame, pixel_format: str) -> av.VideoFrame:
    """Full-range 4:2:0 of 16 bits, rounded to 8 or 10; the frame is overwritten.

    libswscale puts the middle of full-range chroma between two values. In 8 bits, that makes all
    chroma half a level low, a tint of -0.8 levels of red, 0.3 of green, -0.9 of blue; in 16 bits it
    is negligible.

    Args:
        frame: Of ``yuv420p16le``.
        pixel_format: ``yuv420p`` or ``yuv420p10le``.
    """
    made = av.VideoFrame(frame.width, frame.height, pixel_format)
    for index in range(3):
        wide = samples(frame, index)
        if pixel_format == TEN_BITS:  # 65535 / 1023 is 64 * 1024 / 1023, to a millionth
            half = 64 if index else 32  # chroma's middle is 32767.5, and 512
            wide -= wide >> 10
            np.minimum(wide, 65535 - half, out=wide)
            wide += half
            wide >>= 6
        else:
            half = 257 if index else 128  # 257 are a level; chroma's middle is 128
            np.minimum(wide, 65535 - half, out=wide)
            wide += half
            wide //= 257
        samples(made, index)[...] = wide
    made.colorspace, made.color_range = frame.colorspace, frame.color_range
    return made


# ---------------------------------------------------------------- convert

_BT709 = 1

# libswscale's flags: bicubic, full chroma in and out, accurate rounding, the same everywhere.
# As numbers, since older PyAV has no names for them.
_BICUBIC, _FULL_CHROMA, _ACCURATE, _BITEXACT = 0x4, 0x2000 | 0x4000, 0x40000, 0x80000
_BY_AREA = 0x20
_CARE = _FULL_CHROMA | _ACCURATE | _BITEXACT
_INTERPOLATION = _BICUBIC | _CARE
_MATRICES = {"bt709": Colorspace.ITU709, "smpte170m": Colorspace.ITU601}

ONE_THREAD: dict[str, Any] = {"threads": 1} if AV_VERSION >= (17,) else {}
"""For libswscale: a pool inherited over fork would never end. Older PyAV has no pools."""

_PACKED = ("rgb24", "bgr24", "rgba", "bgra")
_VIA_PLANES = ("rgb24", "bgr24")
_ROUNDED = ("yuv420p", TEN_BITS)
_VIEWED = ("gray", "gray16le", *_PACKED)  # PyAV makes frames of their arrays without a copy
# x264 codes grey with neutral chroma; full range has a name of its own in some decoders
_DECODED_AS = {"gray": ("gray", "yuv420p", "yuvj420p"), "gray10le": ("gray10le", "yuv420p10le")}


@dataclass(frozen=True, slots=True)
class Scale:
    """Colours and size of pictures made directly from the video's samples.

    Attributes:
        pixel_format: ``rgb24`` or ``bgr24``.
        width: Columns of the result.
        height: Rows of the result.
    """

    pixel_format: str
    width: int
    height: int


def shows_colours(
    picture_format: str, picture_size: tuple[int, int], coded_size: tuple[int, int]
) -> bool:
    """Whether the video shows the images in colours of 8 bits, or what their mosaic saw of them."""
    is_coloured = picture_format in _PACKED or picture_format.startswith("bayer_")
    return is_coloured and picture_size == coded_size


def scaling(size: tuple[int, int], made: tuple[int, int]) -> int:
    """Flags of libswscale for scaling: by area to reduce, bicubic to enlarge."""
    is_smaller = made[0] * made[1] < size[0] * size[1]
    return (_BY_AREA if is_smaller else _BICUBIC) | _CARE


def reformat(
    reformatter: VideoReformatter,
    frame: av.VideoFrame,
    pixel_format: str,
    *,
    matrix: Colorspace,
    ranges: tuple[ColorRange, ColorRange],
    size: tuple[int, int] | None = None,
    interpolation: int = _INTERPOLATION,
) -> av.VideoFrame:
    """A frame in another pixel format or size, by libswscale.

    Args:
        reformatter: PyAV's, of which each thread needs its own.
        frame: What to convert.
        pixel_format: To which.
        matrix: Between RGB and YUV.
        ranges: Of the samples of the frame and of the result; that of RGB does not matter.
        size: Columns and rows of the result; None: those of the frame.
        interpolation: libswscale's flags.
    """
    given, made = ranges
    is_rgb = frame.format.is_rgb, av.VideoFormat(pixel_format).is_rgb
    if AV_VERSION < (17,) and given == made and any(is_rgb) and not all(is_rgb):
        # which takes note of matrix and ranges only where one of them changes
        other = ColorRange.MPEG if given == ColorRange.JPEG else ColorRange.JPEG
        given, made = (other, made) if is_rgb[0] else (given, other)
    width, height = size or (None, None)
    return reformatter.reformat(
        frame,
        width=width,
        height=height,
        format=pixel_format,
        src_colorspace=matrix,
        dst_colorspace=matrix,
        src_color_range=given,
        dst_color_range=made,
        interpolation=interpolation,
        **ONE_THREAD,
    )


class PictureConverter:
    """Converts frames between pixel formats; not to be shared between threads.

    Args:
        matrix: Between RGB and YUV, by ffmpeg's name: ours is bt709, JPEG files have smpte170m.
            None: what each frame is tagged with.
        source_full_range: Whether the frames to convert use the full range.
        full_range: Whether the YUV it makes uses it.
    """

    def __init__(
        self,
        matrix: str | None = "bt709",
        *,
        source_full_range: bool = True,
        full_range: bool = True,
    ) -> None:
        self._is_tagged = matrix is None
        self._matrix = matrix if matrix in _MATRICES else "bt709"
        self._source_range = ColorRange.JPEG if source_full_range else ColorRange.MPEG
        self._range = ColorRange.JPEG if full_range else ColorRange.MPEG
        self._reformatter = VideoReformatter()
        self._to_planes = VideoReformatter()

    def convert(self, frame: av.VideoFrame, pixel_format: str) -> av.VideoFrame:
        """The frame in another pixel format, with the same colours."""
        self._look_at_tags(frame)
        if pixel_format in _VIA_PLANES and self._is_defined(frame):
            pixels = self._rgb(frame, pixel_format)
            return av.VideoFrame.from_numpy_buffer(pixels, format=pixel_format)
        if pixel_format in _VIA_PLANES and not frame.format.is_rgb:
            # the same samples in a third of the time: libswscale makes planes with SIMD
            planes = self._reformat(self._to_planes, frame, "gbrp")
            return self._reformat(self._reformatter, planes, pixel_format)
        is_kept = not frame.format.is_rgb and self._source_range == self._range
        if pixel_format in _ROUNDED and self._range == ColorRange.JPEG and not is_kept:
            return rounded(self._reformat(self._to_planes, frame, "yuv420p16le"), pixel_format)
        return self._reformat(self._reformatter, frame, pixel_format)

    def scale(
        self, frame: av.VideoFrame, scale: Scale, out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """The frame in another size, or in its own.

        Args:
            frame: As decoded.
            scale: What to make.
            out: Where to write it, of shape (H, W, 3); a new array if None.
        """
        self._look_at_tags(frame)
        if (frame.width, frame.height) != (scale.width, scale.height):
            made = self._reformat(self._reformatter, frame, "gbrp", scale)  # as in `convert`
            order = (2, 0, 1) if scale.pixel_format == "rgb24" else (1, 0, 2)
            return np.stack([samples(made, index) for index in order], axis=-1, out=out)
        if self._is_defined(frame):
            return self._rgb(frame, scale.pixel_format, out)
        pixels = samples(self.convert(frame, scale.pixel_format))
        if out is None and frame.format.name != scale.pixel_format and pixels.flags.c_contiguous:
            return pixels  # new already; a copy would cost as much again in page faults
        out = np.empty(pixels.shape, np.uint8) if out is None else out
        np.copyto(out, pixels)
        return out

    def _is_defined(self, frame: av.VideoFrame) -> bool:
        """Whether spec/index.md, "Colours", says how the frame's colours are made.

        If third-party videos are tagged with a chroma location, libswscale uses it.
        """
        return frame.format.name in colour.BITS and not self._is_tagged

    def _rgb(
        self, frame: av.VideoFrame, pixel_format: str, out: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        return colour.rgb(
            frame,
            self._matrix,
            full_range=self._source_range == ColorRange.JPEG,
            is_bgr=pixel_format == "bgr24",
            out=out,
        )

    def _look_at_tags(self, frame: av.VideoFrame) -> None:
        if self._is_tagged:
            # untagged video is BT.601, limited, for ffmpeg and most players
            self._matrix = "bt709" if frame.colorspace == _BT709 else "smpte170m"
            is_full = frame.color_range == _FULL_RANGE or frame.format.name.startswith("yuvj")
            self._source_range = ColorRange.JPEG if is_full else ColorRange.MPEG

    def _reformat(
        self,
        reformatter: VideoReformatter,
        frame: av.VideoFrame,
        pixel_format: str,
        scale: Scale | None = None,
    ) -> av.VideoFrame:
        size = (scale.width, scale.height) if scale else None
        return reformat(
            reformatter,
            frame,
            pixel_format,
            matrix=_MATRICES[self._matrix],
            ranges=(self._source_range, self._range),
            size=size,
            interpolation=scaling((frame.width, frame.height), size) if size else _INTERPOLATION,
        )


def picture_to_frame(
    picture: Picture,
    picture_format: str,
    pixel_format: str,
    converter: PictureConverter,
    *,
    full_range: bool = True,
) -> av.VideoFrame:
    """A frame for the encoder; a view of the picture if formats and rows allow.

    Args:
        picture: One array of shape (H, W) or (H, W, C), or one per plane.
        picture_format: Its pixel format.
        pixel_format: The encoder's.
        converter: The stream's own.
        full_range: Whether the samples of the video use their full range.
    """
    if picture_format.startswith("bayer_") and pixel_format in ("yuv420p", TEN_BITS):
        pattern = picture_format.removeprefix("bayer_")[:4]
        picture, picture_format = colour.mosaic_planes(picture[0], pattern), "yuv420p"
    if pixel_format == TEN_BITS and (picture_format == "gray" or picture_format in CHROMA_SHIFTS):
        frame = picture_to_frame(picture, picture_format, "yuv420p", converter)
        return with_bits(frame, TEN_BITS, full_range=full_range)
    if pixel_format == "yuv420p" and picture_format == "gray":
        return plain_frame(_grey_planes(picture[0]), pixel_format)
    if pixel_format in ("yuv420p", TEN_BITS) and picture_format not in CHROMA_SHIFTS:
        picture = (_pad_to_even(picture[0]),)
    frame = plain_frame(picture, picture_format)
    if picture_format != pixel_format:
        frame = converter.convert(frame, pixel_format)
    return frame


def plain_frame(picture: Picture, picture_format: str) -> av.VideoFrame:
    """A frame of the picture's own format; a view of it if PyAV can make one."""
    if picture_format in _VIEWED or picture_format.startswith("bayer_"):
        array = picture[0]
        row = np.empty_like(array[:1], order="C")  # where samples follow each other
        if array.strides[1:] != row.strides[1:]:
            array = array.copy(order="C")
        return av.VideoFrame.from_numpy_buffer(array, format=picture_format)
    height, width = picture[0].shape
    frame = av.VideoFrame(width, height, picture_format)
    for index, plane in enumerate(picture):
        samples(frame, index)[: plane.shape[0], : plane.shape[1]] = plane
    return frame


def _pad_to_even(picture: NDArray[Any]) -> NDArray[Any]:
    """Repeat the last row and column where they are odd, for chroma planes of half size."""
    height, width = picture.shape[:2]
    pad = [(0, height % 2), (0, width % 2)] + [(0, 0)] * (picture.ndim - 2)
    if not pad[0][1] and not pad[1][1]:
        return picture
    return np.pad(picture, pad, mode="edge")


def _grey_planes(picture: NDArray[Any]) -> Picture:
    """With neutral chroma."""
    luma = _pad_to_even(picture)
    chroma = np.full_like(luma[::2, ::2], 128)
    return luma, chroma, chroma


# ---------------------------------------------------------------- pictures


class PictureMaker:
    """Makes pictures from decoded frames; not thread-safe.

    Args:
        path: The video, for errors.
        coded_size: Width and height of its frames.
        picture_format: Pixel format of the pictures wanted.
        picture_size: Width and height of the pictures wanted, at most those of the frames.
        matrix: Matrix coefficients of the video's colours; None to use the video's own tags.
        full_range: Whether its samples use their full range, unless the video is tagged.
        is_view: Whether film grain is refused, which decoders may leave out.
    """

    def __init__(
        self,
        path: Path,
        *,
        coded_size: tuple[int, int],
        picture_format: str,
        picture_size: tuple[int, int],
        matrix: str | None = "bt709",
        full_range: bool = True,
        is_view: bool = False,
    ) -> None:
        self._path = path
        self.coded_size, self.is_view = coded_size, is_view
        self._picture_format = picture_format
        self._picture_size = picture_size
        self._is_tagged, self._full_range = matrix is None, full_range
        self._converter = PictureConverter(matrix, source_full_range=full_range)

    def make(
        self,
        frame: av.VideoFrame,
        number: int,
        scale: Scale | None = None,
        out: NDArray[np.uint8] | None = None,
    ) -> Picture:
        """The picture in a frame; views of it where possible.

        Args:
            frame: As decoded.
            number: Of the frame, for errors.
            scale: Convert it so, into a new array; only if `shows_colours`.
            out: That array; a new one if None.

        Raises:
            VideoError: ``decode-failed``: the decoder found damage; ``geometry-mismatch`` or
                ``codec-mismatch``: the frame is not what was promised.
        """
        if frame.is_corrupt:
            raise_if_scarce()
            raise VideoError("decode-failed", self._path, "is marked as corrupt", frame=number)
        if (frame.width, frame.height) != self.coded_size:
            width, height = self.coded_size
            problem = f"has {frame.width}x{frame.height} pixels, others have {width}x{height}"
            raise VideoError("geometry-mismatch", self._path, problem, frame=number)
        if self.is_view and "FILM_GRAIN_PARAMS" in frame.side_data:
            problem = "has film grain, which decoders may leave out; a view must have none"
            raise VideoError("codec-mismatch", self._path, problem)
        if scale is not None:
            return (self._converter.scale(frame, scale, out),)
        is_mosaic = self._picture_format.startswith("bayer_")
        is_coloured, found = is_mosaic or self._picture_format in _PACKED, frame.format
        if is_coloured and not (self._is_tagged or found.is_rgb or found.name in colour.BITS):
            # colours that the format does not define depend on libswscale's version
            problem = f"decodes to {found.name}, not {PLANES_FORMAT} or {TEN_BITS}"
            raise VideoError("codec-mismatch", self._path, problem)
        if is_mosaic:
            return (self._mosaic(samples(self._converter.convert(frame, "rgb24"))),)
        if is_coloured:
            width, height = self._picture_size
            colours = samples(self._converter.convert(frame, self._picture_format))
            return (colours[:height, :width],)
        return self._planes(frame)

    def _planes(self, frame: av.VideoFrame) -> Picture:
        wanted, (width, height) = self._picture_format, self._picture_size
        if frame.format.name == TEN_BITS and wanted in ("gray", *CHROMA_SHIFTS):
            frame = with_bits(frame, PLANES_FORMAT, full_range=self._full_range)
        expected = _DECODED_AS.get(wanted, (wanted,))
        if frame.format.name not in expected:
            problem = f"decodes to {frame.format.name}, not {' or '.join(expected)}"
            raise VideoError("codec-mismatch", self._path, problem)
        sizes = [(height, width)]
        if not wanted.startswith("gray"):
            across, down = CHROMA_SHIFTS.get(wanted, (0, 0))
            chroma = (-(-height >> down), -(-width >> across))
            sizes += [chroma] * (len(frame.planes) - 1)
        return tuple(
            samples(frame, index)[:rows, :columns] for index, (rows, columns) in enumerate(sizes)
        )

    def _mosaic(self, colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The mosaic that a sensor with this pattern would have seen."""
        width, height = self._picture_size
        pixels = np.empty((height, width), np.uint8)
        for index, color in enumerate(self._picture_format.removeprefix("bayer_")[:4]):
            row, column = divmod(index, 2)
            pixels[row::2, column::2] = colours[row:height:2, column:width:2, "rgb".index(color)]
        return pixels


# ---------------------------------------------------------------- planes, for lossy encoders

Planes = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]
"""Luma, and chroma of half the width and height."""


def to_planes(picture: Picture, picture_format: str, converter: PictureConverter) -> Planes:
    """The planes of a picture for a lossy encoder, in new memory; odd sides are padded.

    Args:
        picture: As a layout gives it.
        picture_format: Its pixel format.
        converter: See `picture_to_frame`.
    """
    frame = picture_to_frame(picture, picture_format, PLANES_FORMAT, converter)
    y, u, v = (plane.copy() for plane in planes_of(frame))
    return _pad_to_even(y), u, v


def planes_of(frame: av.VideoFrame) -> Planes:
    """The planes of a frame of `PLANES_FORMAT`, as views of it."""
    y, u, v = (samples(frame, index) for index in range(3))
    return y, u, v


def decoded_planes(path: Path) -> Iterator[Planes]:
    """The frames of a video in order, decoded by one thread.

    Args:
        path: A video with halved chroma, of 8 bits, or of 10, which are rounded.

    Yields:
        Views that are valid until the next one is requested.

    Raises:
        VideoError: It cannot be decoded, or has another format.
    """
    media = Media(path)
    try:
        media.track.thread_count = 1
        for frame in media.container.decode(media.track):
            if frame.format.name == TEN_BITS:
                is_full = frame.color_range == _FULL_RANGE
                frame = with_bits(frame, PLANES_FORMAT, full_range=is_full)
            if frame.format.name not in (PLANES_FORMAT, f"yuvj{PLANES_FORMAT[3:]}"):
                raise VideoError(
                    "codec-mismatch", path, f"decodes to {frame.format.name}, not {PLANES_FORMAT}"
                )
            yield planes_of(frame)
    except FFmpegError as error:
        raise_if_scarce(error)
        raise VideoError("decode-failed", path, f"cannot be decoded: {error}") from None
    finally:
        media.close()


def rgb_of(planes: Planes, recipe: Recipe) -> NDArray[np.uint8]:
    """The colours in which planes are displayed, shape (H, W, 3).

    Args:
        planes: Of a picture, or of a part of it that begins at an even place.
        recipe: States how its colours are coded.
    """
    rows, columns = planes[0].shape
    frame = av.VideoFrame(columns, rows, PLANES_FORMAT)
    for target, plane in zip(planes_of(frame), planes, strict=True):
        np.copyto(target, plane)
    converter = PictureConverter(recipe.matrix, source_full_range=recipe.full_range)
    return np.asarray(converter.convert(frame, "rgb24").to_ndarray(), np.uint8)


class PlaneSpool:
    """The planes of a few frames, in a file; only one is in memory at a time.

    Args:
        path: The file to make; the caller removes it.
        width: Columns of a frame, even.
        height: Rows of a frame, even.
        frames: How many frames an existing file has, to read it again; None: make a new one.
    """

    def __init__(self, path: Path, width: int, height: int, *, frames: int | None = None) -> None:
        self.width, self.height = width, height
        self._size = width * height * 3 // 2
        self._count = frames or 0
        self._file = path.open("w+b" if frames is None else "rb")

    def __len__(self) -> int:
        return self._count

    def append(self, planes: Planes) -> None:
        """Add a frame.

        Raises:
            OSError: It cannot be written.
        """
        self._file.seek(self._count * self._size)
        for plane in planes:
            self._file.write(np.ascontiguousarray(plane).data)
        self._count += 1

    def __iter__(self) -> Iterator[Planes]:
        return map(self.frame, range(self._count))

    def frame(self, number: int) -> Planes:
        """The planes of one frame, in new memory.

        Raises:
            OSError: The file cannot be read.
        """
        self._file.seek(number * self._size)  # which also writes what is buffered
        data = np.frombuffer(self._file.read(self._size), np.uint8)
        if len(data) != self._size:
            raise OSError("frames kept on disk were truncated")
        luma, half = data[: self.width * self.height], (self.height // 2, self.width // 2)
        u, v = data[len(luma) :].reshape(2, *half)
        return luma.reshape(self.height, self.width), u, v

    def clear(self) -> None:
        """Drop all frames."""
        self._count = 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
