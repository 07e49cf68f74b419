"""How the pixels of a ROS image become the picture in a video, and back.

A picture is the encoder's input, in one of FFmpeg's pixel formats; the codec is not chosen here. A
layout is a step on the values (`mp4ds.messages.encodings`) and one on their places
(`mp4ds.messages.arrangements`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from mp4ds.errors import OptionError
from mp4ds.messages.arrangements import (
    FEWEST_ENTRIES,
    MOST_ENTRIES,
    Arrangement,
    Bytes,
    Few,
    Fold,
    Halved,
    Mosaic,
    Packed,
    Packed422,
    Palette,
    Picture,
    PlanarRgb,
    SemiPlanar,
    Stack,
)
from mp4ds.messages.encodings import (
    DEPTHS,
    ENCODINGS,
    MAX_ROW_PADDING,
    MAX_SIDE,
    MAX_TABLE,
    NO_PARAMETERS,
    SCALES,
    Encoding,
    Metres,
    Narrow,
    Opaque,
    Parameters,
    PatternTable,
    Pixels,
    Values,
    Whole,
    patterns,
)

_MOST_LOW, _MOST_HIGH = 8, 10  # bits that a plane of `Fold` may have
_LOW_BITS = {12: 3, 14: 5, 16: 8}  # by measurement: the bits that are mostly noise
_OF_COLOURS = {"rgba": "rgb24", "bgra": "bgr24"}


@dataclass(frozen=True, slots=True)
class LayoutKind:
    """A layout of the registry.

    Attributes:
        name: Its name in the registry.
        is_exact: Whether the pixels are restored if the picture is.
        is_shown: Whether the picture looks like the image, so that its colours are tagged.
        parameters: Names of all the parameters it needs.
        values: Makes the values of the picture.
        arrangement: Makes their placement.
        fit: Finds parameters that suit samples of a stream, if any.
    """

    name: str
    is_exact: bool
    is_shown: bool
    parameters: frozenset[str]
    values: Callable[[Encoding, Parameters], Values]
    arrangement: Callable[[Encoding, Parameters], Arrangement]
    fit: Callable[[Encoding, Sequence[Pixels]], Parameters | None]


def _whole(encoding: Encoding, _: Parameters) -> Values:
    return Whole(encoding)


def _fit_any(_: Encoding, __: Sequence[Pixels]) -> Parameters:
    return NO_PARAMETERS


def _narrow(encoding: Encoding, parameters: Parameters) -> Narrow:
    bits, shift = parameters.bits, parameters.shift
    known = DEPTHS if parameters.low is None else (*DEPTHS, 16)
    if (
        bits is None
        or not _is_integer(bits, 16)
        or bits not in known
        or not _is_integer(shift, 16 - bits)
    ):
        raise ValueError(f"no layout has {bits} bits above {shift} zero bits")
    return Narrow(bits, shift or 0, encoding.is_signed)


def _narrow_planes(encoding: Encoding, parameters: Parameters) -> Narrow:
    """Colour planes have more than 8 bits in FFmpeg's formats."""
    if parameters.bits == 8:
        raise ValueError("no layout has colour planes of 8 bits")
    return _narrow(encoding, parameters)


def _fit_planes(encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
    found = Narrow.fit(encoding, samples)
    if found is None or found.bits != 8:
        return found
    return replace(found, bits=10, shift=max((found.shift or 0) - 2, 0))


def _folded(encoding: Encoding, parameters: Parameters) -> Narrow:
    values, low = _narrow(encoding, parameters), parameters.low
    if not low or not _is_integer(low, _MOST_LOW) or not 1 <= values.bits - low <= _MOST_HIGH:
        raise ValueError(f"no layout has {low} low bits of {values.bits}")
    return values


def _fit_folded(encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
    """All bits, or those in use if there are enough of them to separate noise from the rest."""
    found = Narrow.fit(encoding, samples) or Parameters(bits=16, shift=0)
    low = _LOW_BITS.get(found.bits or 0)
    return None if low is None else replace(found, low=low)


def _opaque(_: Encoding, parameters: Parameters) -> Values:
    if not _is_integer(parameters.alpha, 255):
        raise ValueError(f"an alpha of {parameters.alpha}, which is no byte")
    return Opaque(parameters.alpha or 0)


def _table(encoding: Encoding, parameters: Parameters) -> Values:
    table = parameters.table or ()
    if not 1 <= len(table) <= MAX_TABLE:
        raise ValueError(f"a table of {len(table)} values, not of 1 to {MAX_TABLE}")
    top = 256**encoding.bytes_per_sample - 1
    if not all(_is_integer(value, top) for value in table):
        raise ValueError(f"a table with values beyond 0 to {top}")
    patterns = np.array(table, f"u{encoding.bytes_per_sample}")
    if (patterns[1:] <= patterns[:-1]).any():
        raise ValueError("a table that does not increase")
    return PatternTable(patterns)


def _metres(_: Encoding, parameters: Parameters) -> Values:
    hole, scale = parameters.hole, parameters.scale
    if not _is_integer(hole, 2**32 - 1):
        raise ValueError(f"a hole of {hole}, which is no pattern of 32 bits")
    if scale not in SCALES:
        raise ValueError(f"scale {scale!r} is not one of {', '.join(SCALES)}")
    return Metres(hole or 0, scale)


def _few(encoding: Encoding, parameters: Parameters) -> Values:
    entries = parameters.entries
    if not entries or not _is_integer(entries, MOST_ENTRIES) or entries & (entries - 1):
        raise ValueError(
            f"a list of {entries} values, which is no power of two up to {MOST_ENTRIES}"
        )
    if entries < FEWEST_ENTRIES:
        raise ValueError(f"a list of {entries} values, less than {FEWEST_ENTRIES}")
    return Few(Whole(encoding), entries)


def _is_integer(value: Any, top: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= top


def _rgb_order(encoding: Encoding) -> str:
    """Unnamed channels are blue, green, red and alpha, as in OpenCV."""
    return encoding.name.rstrip("1680") if encoding.name[0] in "rb" else "bgra"[: encoding.channels]


def _planar(encoding: Encoding, _: Parameters) -> Arrangement:
    return PlanarRgb(_rgb_order(encoding))


def _packed(pixel_format: str = "") -> Callable[[Encoding, Parameters], Arrangement]:
    return lambda _, __: Packed(pixel_format)


def _mosaic(_: Encoding, __: Parameters) -> Arrangement:
    return Mosaic()


def _stack(encoding: Encoding, _: Parameters) -> Arrangement:
    return Stack(encoding.channels)


def _fold(_: Encoding, parameters: Parameters) -> Arrangement:
    return Fold(parameters.bits or 16, parameters.low or 8)


def _fold_mosaic(_: Encoding, parameters: Parameters) -> Arrangement:
    return Fold(parameters.bits or 16, parameters.low or 8, Mosaic())


def _numbers(_: Encoding, parameters: Parameters) -> Arrangement:
    """Numbers of more than a byte are folded."""
    return Packed() if len(parameters.table or ()) <= 256 else Fold(16, 8)


def _palette(encoding: Encoding, parameters: Parameters) -> Arrangement:
    return Palette(parameters.entries or FEWEST_ENTRIES, encoding.bytes_per_sample)


def _planes(encoding: Encoding, _: Parameters) -> Arrangement:
    return _yuv(encoding)


def _yuv(encoding: Encoding) -> Packed422 | SemiPlanar:
    if encoding.name.startswith("nv"):
        return SemiPlanar(encoding.even[1] == 2, "v" if encoding.name == "nv21" else "u")
    return Packed422(1 if encoding.name in ("yuv422", "uyvy") else 0)


_Step = tuple[
    frozenset[str],
    Callable[[Encoding, Parameters], Values],
    Callable[[Encoding, Sequence[Pixels]], Parameters | None],
]
_WHOLE: _Step = (frozenset(), _whole, _fit_any)
_BITS: _Step = (frozenset({"bits", "shift"}), _narrow, Narrow.fit)
_PLANE_BITS: _Step = (frozenset({"bits", "shift"}), _narrow_planes, _fit_planes)
_FOLDED: _Step = (frozenset({"bits", "shift", "low"}), _folded, _fit_folded)
_TABLE: _Step = (frozenset({"table"}), _table, PatternTable.fit)
_FEW: _Step = (frozenset({"entries"}), _few, Few.fit)
_MILLIMETRES: _Step = (frozenset({"hole", "scale"}), _metres, Metres.fit)
_OPAQUE: _Step = (frozenset({"alpha"}), _opaque, Opaque.fit)


def _kind(
    name: str,
    step: _Step,
    arrangement: Callable[[Encoding, Parameters], Arrangement],
    *,
    exact: bool = True,
    shown: bool = False,
) -> LayoutKind:
    parameters, values, fit = step
    return LayoutKind(name, exact, shown, parameters, values, arrangement, fit)


LAYOUTS: dict[str, LayoutKind] = {
    kind.name: kind
    for kind in (
        _kind("gray8", _WHOLE, _packed(), shown=True),
        _kind("gray16", _WHOLE, _packed()),
        _kind("gray_bits", _BITS, _packed()),
        _kind("fold", _FOLDED, _fold),
        _kind("rgb24", _WHOLE, _packed("rgb24"), shown=True),
        _kind("bgr24", _WHOLE, _packed("bgr24"), shown=True),
        _kind("rgba", _WHOLE, _packed("rgba"), shown=True),
        _kind("bgra", _WHOLE, _packed("bgra"), shown=True),
        _kind("opaque", _OPAQUE, lambda e, _: Packed(_OF_COLOURS[_rgb_order(e)]), shown=True),
        _kind("gbr16", _WHOLE, _planar, shown=True),
        _kind("gbr_bits", _PLANE_BITS, _planar, shown=True),
        _kind("gbra16", _WHOLE, _planar, shown=True),
        _kind("gbra_bits", _PLANE_BITS, _planar, shown=True),
        _kind("mosaic8", _WHOLE, _mosaic),
        _kind("mosaic16", _WHOLE, _mosaic),
        _kind("mosaic_bits", _BITS, _mosaic),
        _kind("mosaic_fold", _FOLDED, _fold_mosaic),
        # demosaicing is done by the video's converter; resampling restores the mosaic
        _kind(
            "demosaic8", _WHOLE, lambda e, _: Packed(f"bayer_{e.mosaic}8"), exact=False, shown=True
        ),
        _kind("planar422", _WHOLE, _planes, shown=True),
        _kind("planar420", _WHOLE, _planes, shown=True),
        _kind("planar444", _WHOLE, _planes, shown=True),
        _kind("halved420", _WHOLE, lambda e, _: Halved(_yuv(e)), exact=False, shown=True),
        _kind("stack8", _WHOLE, _stack),
        _kind("stack16", _WHOLE, _stack),
        _kind("table", _TABLE, _numbers),
        _kind("palette", _FEW, _palette),
        _kind("metres16", _MILLIMETRES, _packed()),
        _kind("metres_fold", _MILLIMETRES, lambda _, __: Fold(16, 8)),
        _kind("bytes", _WHOLE, lambda e, _: Bytes(e.bytes_per_sample, e.channels)),
    )
}


# ---------------------------------------------------------------- layouts bound to encodings


@dataclass(frozen=True, slots=True)
class Layout:
    """A way of arranging a stream's pixels as pictures.

    Attributes:
        name: Its name in the registry.
        encoding: Of the images.
        parameters: Of the layout.
        is_exact: Whether the pixels are restored if the picture is.
        is_shown: Whether the picture looks like the image, so that its colours are tagged.
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
        """Why an image's pixels would not be restored, or None if they would.

        Args:
            pixels: As `mp4ds.messages.encodings.pixel_view` gives them.
        """
        return self._values.refuses(pixels)

    def to_picture(self, pixels: Pixels) -> Picture:
        """The picture of accepted pixels; may be a view of them.

        Args:
            pixels: As `mp4ds.messages.encodings.pixel_view` gives them.

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
    """The layout with that name for the images of a stream.

    Args:
        name: One allowed for the encoding.
        encoding: Of the images.
        parameters: Exactly those that the layout needs.

    Raises:
        ValueError: The encoding does not allow it, or the parameters are not those it needs.
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
    """The layout with parameters that suit samples of a stream, or None if there are none.

    Args:
        name: One allowed for the encoding.
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
        OptionError: There is no lossy layout.
    """
    name = encoding.general if lossless else encoding.lossy
    if name is None:
        raise OptionError(f"{encoding.name} images are only stored losslessly")
    return bind(name, encoding)


@lru_cache(maxsize=256)  # the images of a stream share one geometry
def why_not(encoding_name: str, *, width: int, height: int, step: int, size: int) -> str | None:
    """Why no layout carries an image of this geometry, or None if one does.

    Args:
        encoding_name: As in the message.
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
