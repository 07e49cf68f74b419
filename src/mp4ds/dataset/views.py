"""How frames are returned: their format, crop, size, and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import index as as_integer

import numpy as np

from mp4ds.errors import OptionError
from mp4ds.format.models import Calibration
from mp4ds.messages.depth import DEPTHS
from mp4ds.messages.encodings import ENCODINGS, MAX_SIDE, Encoding, Pixels
from mp4ds.options import ENCODING, Options, Parsed, option, parse_number, parse_resize, what
from mp4ds.video.images import Renderer, encoding_as, shown_format
from mp4ds.video.pixels import Scale

_Part = tuple[int, int, int, int]
_Size = tuple[int, int]


# names of lens models by ROS and other drivers, in lower case with underscores
_POLYNOMIAL = {"plumb_bob", "rational_polynomial", "radtan", "brown_conrady", "brown"}
_FISHEYE = {"equidistant", "fisheye", "kannala_brandt", "kannala_brandt4"}
_WITHOUT = {"", "none", "inverse_brown_conrady", "modified_brown_conrady"} | _POLYNOMIAL


def lens_of(calibration: Calibration) -> tuple[str, list[float]]:
    """Distortion model and coefficients, in ROS's terms where it has them.

    Returns:
        ``none`` without coefficients, for a lens that does not distort; ``plumb_bob`` with 5,
        ``rational_polynomial`` with 8, 12 or 14, ``equidistant`` with 4; else what was recorded.
    """
    name = calibration.distortion_model.strip().lower().replace(" ", "_")
    d = list(calibration.d)
    while d and not d[-1]:  # a longer model whose further coefficients are zero is the shorter one
        d.pop()
    if name in _WITHOUT and not d:
        return "none", []
    sizes: tuple[tuple[str, int], ...] = ()
    if name in _POLYNOMIAL:
        sizes = (("plumb_bob", 5), *(("rational_polynomial", size) for size in (8, 12, 14)))
    elif name in _FISHEYE:
        sizes = (("equidistant", 4),)
    for model, size in sizes:
        if len(d) <= size:
            return model, d + [0.0] * (size - len(d))
    return calibration.distortion_model, list(calibration.d)


def adapted(calibration: Calibration, crop: _Part, size: _Size) -> Calibration:
    """The calibration of a picture; without binning, and without a region of interest.

    Pixel centres have integer coordinates, so a picture scaled by s has its principal point at
    ``(cx + 0.5) * s - 0.5``.

    Args:
        calibration: That of the image which the picture shows, as recorded.
        crop: x, y, width and height in pixels of the image.
        size: Width and height of the picture.
    """
    x, y, width, height = crop
    recorded = calibration.fields
    k, p = (np.array(values).reshape(3, -1) for values in (recorded.k, recorded.p))
    for matrix in (k, p):  # of the full resolution: as in REP 104, first the region, then binning
        matrix[:2, 2] -= recorded.roi[:2]
        matrix[:2] /= np.maximum(1, [[recorded.binning_x], [recorded.binning_y]])
    for row, offset, scale in ((0, x, size[0] / width), (1, y, size[1] / height)):
        for matrix in (k, p):
            # by the third row, which is 0 in the matrices of an uncalibrated camera
            matrix[row] = scale * (matrix[row] - offset * matrix[2])
            matrix[row] += (0.5 * scale - 0.5) * matrix[2]
    roi = None
    if calibration.roi and calibration.roi.do_rectify:
        whole = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        roi = calibration.roi.model_copy(update=whole)
    return calibration.model_copy(
        update={
            "width": size[0],
            "height": size[1],
            "k": k.ravel().tolist(),
            "p": p.ravel().tolist(),
            "binning_x": 0,
            "binning_y": 0,
            "roi": roi,
            "template": None,  # the recorded message differs
        }
    )


# ---------------------------------------------------------------- views

Resize = float | tuple[int, int] | None
"""A factor, or width and height in pixels."""

Crop = tuple[int, int, int, int] | None
"""x, y, width and height in pixels of the image, applied first."""

_MOST_TIMES = 16  # a larger factor was meant as pixels

FORMATS = ("native", "rgb", "bgr", "gray", "depth_m")
"""As recorded; (H, W, 3); (H, W, 3); (H, W); (H, W) of float32, metres."""

_OF_VIDEOS = ("rgb8", "bgr8", "rgba8", "bgra8")
"""Encodings stored in videos as colour pictures; alpha is dropped when they are shown."""


@dataclass(frozen=True, slots=True)
class View:
    """One way of returning the frames of a stream; one thread at a time may use it.

    Attributes:
        encoding: ROS image encoding of the result.
        shape: Of one frame.
        dtype: Of its pixels.
        is_plain: Whether the pixels are returned as recorded.
        in_metres: Whether they are converted to depths in metres first.
        scale: What the decoder makes directly, instead of pictures as recorded.
    """

    encoding: Encoding
    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    is_plain: bool
    in_metres: bool = False
    scale: Scale | None = None
    _placement: tuple[_Part, _Size] | None = None  # the crop, and its size after resizing
    _renderer: Renderer | None = None

    def give(self, pixels: Pixels, out: Pixels) -> None:
        """Write the view of an image's pixels.

        Args:
            pixels: As recorded, native byte order; depths in metres if `in_metres`.
            out: Of the view's shape and type.
        """
        if self._renderer is not None:
            self._renderer.render(pixels, out)
        elif self._placement is not None:
            np.copyto(out, _nearest(pixels, *self._placement))
        else:
            np.copyto(out, pixels)

    def calibration(self, image: Calibration | None) -> Calibration | None:
        """The calibration of the result, from that of the image."""
        if image is None or self._placement is None:
            return image
        return adapted(image, *self._placement)


def view_of(
    topic: str,
    encoding: Encoding,
    image_size: _Size,
    *,
    format: str,  # noqa: A002 - as users write it
    resize: Resize,
    crop: Crop,
    shows_colours: bool = False,
    nearest: bool = False,
) -> View:
    """The requested view.

    Args:
        topic: For errors.
        encoding: Of the images.
        image_size: Their width and height.
        format: One of `FORMATS`.
        resize: A factor, or width and height.
        crop: x, y, width, height.
        shows_colours: See `mp4ds.video.pixels.shows_colours`.
        nearest: Never interpolate native values, as of masks and labels.

    Raises:
        OptionError: The format, crop or size is invalid, or not available for these images.
    """
    if format not in FORMATS:
        raise OptionError(f"format {format!r} is not known: use {', '.join(FORMATS)}")
    width, height = image_size
    part = _part(topic, image_size, crop) if crop is not None else (0, 0, width, height)
    cut = part[2:]
    size = size_after(topic, cut, resize) if resize is not None else cut
    is_whole = cut == size == (width, height)
    given = encoding
    if format == "depth_m":
        if encoding.name not in DEPTHS:
            raise OptionError(
                f"{topic} has {encoding.name} images, which are not depths: format='depth_m' is "
                f"for {', '.join(DEPTHS)}"
            )
        given = ENCODINGS["32FC1"]
    elif format != "native" or not is_whole:
        given = _given(topic, encoding, format, part, is_resized=size != cut)
    shape, dtype = given.shape(*size), np.dtype(given.dtype)
    in_metres = format == "depth_m"
    made = shown_format(given)
    is_coloured = encoding.name in _OF_VIDEOS or bool(encoding.mosaic)
    can_scale = shows_colours and is_coloured and cut == (width, height)
    scale = Scale(made, *size) if can_scale and made in ("rgb24", "bgr24") else None
    if is_whole and given is encoding and not in_metres:
        return View(given, shape, dtype, is_plain=True, scale=scale)
    placement = None if is_whole else (part, size)
    is_rendered = not in_metres and (
        format != "native" or (size != cut and _is_interpolated(encoding) and not nearest)
    )
    renderer = (
        Renderer(encoding, given.name, crop=part if crop is not None else None, size=size)
        if is_rendered
        else None
    )
    return View(given, shape, dtype, False, in_metres, scale, placement, renderer)


# ---------------------------------------------------------------- fewer, and smaller


def _parse_rate(value: str | float) -> float:
    rate = parse_number(value)
    if not 0 < rate <= 1e9:
        raise OptionError(f"{value} is not a rate. Use Hz, such as 10.")
    return rate


def _parse_size(value: str | float | tuple[int, int]) -> float | tuple[int, int]:
    size = parse_resize(value)
    sides = size if isinstance(size, tuple) else (size,)
    with suppress(OptionError):
        size_after("", (1, 1), size)
        if not any(isinstance(side, bool) for side in sides):
            return size
    known = f"width and height of 1 to {MAX_SIDE} pixels"
    raise OptionError(f"{value} is not a size. Use a factor such as 0.5, or {known}.")


@dataclass(frozen=True, kw_only=True)
class Reduction(Options):
    """How to leave out images, and make them smaller."""

    every: int = what(
        "Keep only every Nth frame, starting with the first.",
        1,
        metavar="N",
        least=1,
        changes=ENCODING,
    )
    max_rate: float | None = what(
        "Maximum frames per second.", metavar="HZ", parse=_parse_rate, changes=ENCODING
    )
    resize: Parsed[float | tuple[int, int] | None] = option(
        "Scale images down, and the calibrations with them.",
        metavar="0.5|WxH",
        parse=_parse_size,
        changes=ENCODING,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if type(self.every) is not int:  # nor a bool
            raise OptionError(f"`every` {self.every!r} is not a number of frames: use 1 or more.")

    @property
    def leaves_out(self) -> bool:
        """Whether there may be fewer images."""
        return self.every > 1 or self.max_rate is not None

    @property
    def reduces(self) -> bool:
        """Whether there may be fewer images, or smaller ones."""
        return self.leaves_out or self.resize is not None

    def size_of(self, topic: str, image_size: _Size) -> _Size | None:
        """New width and height for images of one size; None if unchanged.

        Raises:
            OptionError: They are too large for an image.
        """
        if self.resize is None:
            return None
        size = size_after(topic, image_size, self.resize)
        return size if size != image_size else None


# ---------------------------------------------------------------- one view


def _part(topic: str, image_size: _Size, crop: Sequence[int]) -> _Part:
    width, height = image_size
    try:
        x, y, columns, rows = (as_integer(value) for value in crop)
    except (TypeError, ValueError):
        raise OptionError(f"crop must be (x, y, width, height) in pixels, not {crop!r}") from None
    if min(x, y) < 0 or min(columns, rows) < 1 or x + columns > width or y + rows > height:
        raise OptionError(
            f"crop {tuple(crop)} is not inside the {width}x{height} images of {topic}"
        )
    return x, y, columns, rows


def size_after(topic: str, cut: _Size, resize: float | Sequence[int]) -> _Size:
    """Width and height of resized frames.

    Args:
        topic: For errors.
        cut: Their width and height before.
        resize: A factor, or width and height.

    Raises:
        OptionError: There is no such size.
    """
    problem = f"frames of {topic} cannot be resized to {resize!r}"
    advice = "use a factor such as 0.5, or (width, height) in pixels"
    if isinstance(resize, bool):
        raise OptionError(f"{problem}: {advice}")
    try:
        if isinstance(resize, Sequence):
            width, height = (as_integer(side) for side in resize)
        else:
            factor = float(resize)
            if _MOST_TIMES < factor <= MAX_SIDE:
                advice = f"one number is a factor; for pixels, use ({factor:.0f}, {factor:.0f})"
            if not 0 < factor <= _MOST_TIMES:
                raise ValueError
            width, height = (max(1, round(side * factor)) for side in cut)
    except (TypeError, ValueError):
        raise OptionError(f"{problem}: {advice}") from None
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise OptionError(f"{problem}: sides are 1 to {MAX_SIDE} pixels")
    return width, height


def _given(
    topic: str, encoding: Encoding, colours: str, part: _Part, *, is_resized: bool
) -> Encoding:
    """The encoding of the result."""
    if colours != "native":
        name = encoding_as(encoding, colours)
        if name is None:
            raise OptionError(
                f"{topic} has {encoding.name} images, which are measurements, not colour: use "
                f"format='native', not {colours!r}"
            )
        return ENCODINGS[name]
    is_yuv = encoding.even != (1, 1) or encoding.rows != 1
    if is_yuv or (encoding.mosaic and is_resized):
        raise OptionError(
            f"{topic} has {encoding.name} images, which can only be cropped and resized as rgb, "
            "bgr or gray: give format="
        )
    if not encoding.mosaic:
        return encoding
    x, y = part[0] % 2, part[1] % 2  # the pattern begins at a different colour
    rows = encoding.mosaic[:2], encoding.mosaic[2:]
    mosaic = "".join(rows[(row + y) % 2][(column + x) % 2] for row in (0, 1) for column in (0, 1))
    return ENCODINGS[f"bayer_{mosaic}{8 * encoding.bytes_per_sample}"]


def _is_interpolated(encoding: Encoding) -> bool:
    """Whether interpolating values makes sense: not for depths, labels and other measurements."""
    return shown_format(encoding) is not None and not encoding.name[0].isdigit()


def _nearest(pixels: Pixels, crop: _Part, size: _Size) -> Pixels:
    """The crop of an image, resized by nearest neighbour."""
    x, y, width, height = crop
    part = pixels[y : y + height, x : x + width]
    if size == (width, height):
        return part
    columns, rows = (
        (2 * np.arange(made) + 1) * side // (2 * made)
        for made, side in zip(size, (width, height), strict=True)
    )
    found: Pixels = part[rows[:, None], columns]
    return found


def output(out: Pixels | None, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> Pixels:
    """The array to write into.

    Raises:
        OptionError: It has the wrong shape or type.
    """
    if out is None:
        return np.empty(shape, dtype)
    if not isinstance(out, np.ndarray) or (out.shape, out.dtype) != (shape, dtype):
        found = f"{out.dtype} {out.shape}" if isinstance(out, np.ndarray) else type(out).__name__
        raise OptionError(f"out is {found}, not an array of {dtype} {shape}")
    if not out.flags.writeable:
        raise OptionError("out is not writeable")
    return out
