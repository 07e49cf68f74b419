"""A layout bound to an encoding and its parameters, and which images have one.

Exact layouts are bijections on the images that they do not refuse, so that a lossless codec
gives the pixels back; the others are for lossy codecs (spec/registry.md, "Layouts").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mp4ds.errors import OptionError
from mp4ds.layouts.arrangements import Arrangement, Picture
from mp4ds.layouts.encodings import ENCODINGS, MAX_ROW_PADDING, MAX_SIDE, Encoding, Pixels
from mp4ds.layouts.kinds import LAYOUTS
from mp4ds.layouts.values import NO_PARAMETERS, Parameters, Values, patterns


@dataclass(frozen=True, slots=True)
class Layout:
    """One way of laying the pixels of a stream out as pictures.

    Attributes:
        name: As the registry spells it.
        encoding: Of the images.
        parameters: Of the layout.
        is_exact: Whether the pixels return if the picture does.
        is_shown: Whether the picture looks like the image, so that its colours are to be told.
        pixel_format: ffmpeg's name of the picture's format.
    """

    name: str
    encoding: Encoding
    parameters: Parameters
    is_exact: bool
    is_shown: bool
    pixel_format: str
    _values: Values
    _arrangement: Arrangement

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the image -> of the picture."""
        return self._arrangement.picture_size(width, height)

    def refuses(self, pixels: Pixels) -> str | None:
        """Why the pixels of an image would not come back, or None if they do.

        Args:
            pixels: As `mp4ds.layouts.pixel_view` gives them.
        """
        return self._values.refuses(pixels)

    def to_picture(self, pixels: Pixels) -> Picture:
        """The picture of pixels that are not refused; may be a view of them.

        Args:
            pixels: As `mp4ds.layouts.pixel_view` gives them.

        Returns:
            One array of shape (rows, columns) or (rows, columns, channels), or one per plane.
        """
        return self._arrangement.arrange(self._values.encode(pixels))

    def to_pixels(self, picture: Picture, out: Pixels) -> None:
        """Write the pixels of a picture.

        Args:
            picture: Of the size and format of this layout.
            out: Shape `Encoding.shape`; its type is the encoding's, in any byte order.
        """
        if self._values.is_identity:
            self._arrangement.restore(picture, patterns(out))
            return
        samples = np.empty(self._values.shape(out), f"u{(self._values.bits + 7) // 8}")
        self._arrangement.restore(picture, samples)
        self._values.decode(samples, out)


def bind(name: str, encoding: Encoding, parameters: Parameters = NO_PARAMETERS) -> Layout:
    """The layout of that name for the images of a stream.

    Args:
        name: One that the encoding may have.
        encoding: Of the images.
        parameters: All that the layout needs and no other.

    Raises:
        ValueError: The encoding may not have it, or the parameters are not those it needs.
    """
    if name not in (*encoding.exact, encoding.lossy):
        raise ValueError(f"layout {name} does not carry {encoding.name} images")
    kind = LAYOUTS[name]
    if parameters.names != kind.parameters:
        needed = ", ".join(sorted(kind.parameters)) or "none"
        given = ", ".join(sorted(parameters.names)) or "none"
        raise ValueError(f"layout {name} needs the parameters {needed} and was given {given}")
    values = kind.values(encoding, parameters)
    arrangement = kind.arrangement(encoding, parameters)
    pixel_format = arrangement.pixel_format(values.bits)
    return Layout(
        name=name,
        encoding=encoding,
        parameters=parameters,
        is_exact=kind.is_exact,
        is_shown=kind.is_shown,
        pixel_format=pixel_format,
        _values=values,
        _arrangement=arrangement,
    )


def fit(name: str, encoding: Encoding, samples: Sequence[Pixels]) -> Layout | None:
    """The layout with the parameters that suit samples of a stream, or None if none do.

    Args:
        name: One that the encoding may have.
        encoding: Of the images.
        samples: Pixels of some of its images, at least one.

    Returns:
        A layout that refuses none of the samples.
    """
    parameters = LAYOUTS[name].fit(encoding, samples)
    return None if parameters is None else bind(name, encoding, parameters)


def layout_for(encoding: Encoding, *, lossless: bool) -> Layout:
    """The layout that carries every image of an encoding, for a lossless or lossy codec.

    Raises:
        OptionError: No lossy layout exists.
    """
    name = encoding.general if lossless else encoding.lossy
    if name is None:
        raise OptionError(f"{encoding.name} images are only stored losslessly")
    return bind(name, encoding)


def why_not(encoding_name: str, *, width: int, height: int, step: int, size: int) -> str | None:
    """Why no layout carries an image of this geometry, or None if one does.

    Args:
        encoding_name: As the message has it.
        width: Columns.
        height: Rows.
        step: Bytes per row.
        size: Bytes of all rows; the last one may end with its pixels.
    """
    encoding = ENCODINGS.get(encoding_name)
    if encoding is None:
        return f"no layout for encoding {encoding_name!r} yet"
    if width == 0 or height == 0:
        return f"an image of {width}x{height} pixels"
    if step < width * encoding.pixel_bytes:
        return f"step {step} is shorter than a row of {width} {encoding.name} pixels"
    if width % encoding.even[0] or height % encoding.even[1]:
        return f"an image of {width}x{height} pixels, where {encoding.name} needs even sides"
    due = encoding.size(step, height)
    if size not in (due, due - (step - width * encoding.pixel_bytes)):
        rows = "step x height" if encoding.rows == 1 else f"step x height x {encoding.rows}"
        return f"{size} bytes of pixels where {rows} says {due}"
    if width > MAX_SIDE or height > MAX_SIDE:
        return f"an image of {width}x{height} pixels, beyond {MAX_SIDE}"
    picture = layout_for(encoding, lossless=True).picture_size(width, height)
    if max(picture) > MAX_SIDE:
        return (
            f"an image of {width}x{height} pixels, whose picture of {picture[0]}x{picture[1]} "
            f"is beyond {MAX_SIDE}"
        )
    if step > width * encoding.pixel_bytes + MAX_ROW_PADDING:
        return f"more than {MAX_ROW_PADDING} bytes of padding in a row"
    return None
