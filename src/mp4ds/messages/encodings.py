"""The encodings of ROS images, and steps on the values of their pixels; numpy only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from fractions import Fraction
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import Refused

MAX_SIDE = 16384
"""Largest width and height of a picture in a video: what its codecs and decoders take."""

MAX_IMAGE_BYTES = 2**28
"""Maximum bytes of pixels unpacked from one coded picture."""


def check_size(width: int, height: int) -> None:
    """Refuse a size that no video can have.

    Raises:
        Refused: A side is zero or beyond `MAX_SIDE`.
    """
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise Refused(f"its picture has {width}x{height} pixels")


MAX_ROW_PADDING = 4096
"""Most bytes between two rows; bounds what a sidecar can make a reader allocate."""

Pixels = NDArray[Any]
"""Pixels of an image, shape (rows, columns) or (rows, columns, channels)."""


@dataclass(frozen=True, slots=True)
class Encoding:
    """A ROS image encoding that a layout carries.

    Attributes:
        name: As `sensor_msgs/image_encodings` spells it.
        channels: Samples per pixel of the array; 2 for the packed YUV, 1 for the semi-planar.
        dtype: numpy's kind and bytes of a sample: u1, i1, u2, i2, i4, f4 or f8.
        general: The exact layout without parameters that carries every image.
        exact: Exact layouts worth a try, in order of preference; `general` is among them.
        lossy: Layout for lossy codecs; None if a lossy codec would harm the meaning.
        mosaic: For Bayer, the colours of the 2 x 2 block by rows, such as ``rggb``.
        rows: Rows of the array per row of the image: more than 1 for the semi-planar YUV.
        even: Numbers that divide width and height, for chroma of half the resolution.
    """

    name: str
    channels: int
    dtype: str
    general: str
    exact: tuple[str, ...]
    lossy: str | None = None
    mosaic: str = ""
    rows: Fraction = Fraction(1)
    even: tuple[int, int] = (1, 1)

    @property
    def is_plain(self) -> bool:
        """Whether it can be shown, and resized, as it is: neither a mosaic nor YUV."""
        return not self.mosaic and self.rows == 1 and self.even == (1, 1)

    @property
    def bytes_per_sample(self) -> int:
        """Bytes of a sample."""
        return int(self.dtype[1])

    @property
    def pixel_bytes(self) -> int:
        """Bytes per column of a row."""
        return self.channels * self.bytes_per_sample

    @property
    def is_signed(self) -> bool:
        """Whether samples are integers with a sign."""
        return self.dtype[0] == "i"

    @property
    def is_float(self) -> bool:
        """Whether samples are floats."""
        return self.dtype[0] == "f"

    def shape(self, width: int, height: int) -> tuple[int, ...]:
        """Shape of the pixels of an image whose sides `even` divides."""
        rows = int(height * self.rows)
        return (rows, width) if self.channels == 1 else (rows, width, self.channels)

    def size(self, step: int, height: int) -> int:
        """Bytes of all rows of an image, padding included."""
        return int(step * height * self.rows)


# general layouts by the number of channels, and what further ones may be beside them
_OF_BYTES = {1: "gray8", 2: "stack8", 3: "bgr24", 4: "bgra"}
_OF_WORDS = {1: "gray16", 2: "stack16", 3: "gbr16", 4: "gbra16"}
_MORE = {
    "gray16": ("gray_bits", "fold", "table", "palette"),
    "gbr16": ("gbr_bits",),
    "gbra16": ("gbra_bits",),
}
_METRES = ("metres16", "metres_fold", "table", "palette")


def _of_samples(name: str, channels: int, dtype: str, lossy: str | None = None) -> Encoding:
    """One to four channels without a defined meaning, as in OpenCV's matrices."""
    general = {"1": _OF_BYTES, "2": _OF_WORDS}.get(dtype[1], {}).get(channels, "bytes")
    more = _METRES if name == "32FC1" else _MORE.get(general, ())
    if name == "8UC4":
        more = ("opaque",)
    return Encoding(name, channels, dtype, general, (general, *more), lossy)


def _bayer16(mosaic: str) -> Encoding:
    exact = ("mosaic16", "mosaic_bits", "mosaic_fold")
    return Encoding(f"bayer_{mosaic}16", 1, "u2", "mosaic16", exact, None, mosaic)


def _encodings() -> list[Encoding]:
    bayer = ("rggb", "bggr", "gbrg", "grbg")
    sizes = {
        "8U": "u1",
        "8S": "i1",
        "16U": "u2",
        "16S": "i2",
        "32S": "i4",
        "32F": "f4",
        "64F": "f8",
    }
    lossy = {"8UC1": "gray8", "8UC3": "bgr24"}
    return [
        _of_samples("mono8", 1, "u1", "gray8"),
        _of_samples("mono16", 1, "u2"),
        Encoding("rgb8", 3, "u1", "rgb24", ("rgb24",), "rgb24"),
        Encoding("bgr8", 3, "u1", "bgr24", ("bgr24",), "bgr24"),
        Encoding("rgba8", 4, "u1", "rgba", ("rgba", "opaque")),
        Encoding("bgra8", 4, "u1", "bgra", ("bgra", "opaque")),
        *(_of_samples(f"{order}16", len(order), "u2") for order in ("rgb", "bgr", "rgba", "bgra")),
        *(
            Encoding(f"bayer_{mosaic}8", 1, "u1", "mosaic8", ("mosaic8",), "demosaic8", mosaic)
            for mosaic in bayer
        ),
        *(
            _bayer16(mosaic)
            for mosaic in bayer
        ),
        *(
            _of_samples(f"{size}C{channels}", channels, dtype, lossy.get(f"{size}C{channels}"))
            for size, dtype in sizes.items()
            for channels in range(1, 5)
        ),
        *(
            Encoding(name, 2, "u1", "planar422", ("planar422",), "halved420", even=(2, 1))
            for name in ("yuv422", "uyvy", "yuyv", "yuv422_yuy2")
        ),
        *(
            Encoding(
                name, 1, "u1", "planar420", ("planar420",), "planar420",
                rows=Fraction(3, 2), even=(2, 2),
            )
            for name in ("nv12", "nv21")
        ),
        Encoding("nv24", 1, "u1", "planar444", ("planar444",), "halved420", rows=Fraction(3)),
    ]  # fmt: skip


ENCODINGS: dict[str, Encoding] = {encoding.name: encoding for encoding in _encodings()}


def pixel_view(
    data: memoryview | bytearray,
    encoding: Encoding,
    *,
    width: int,
    height: int,
    step: int,
    is_bigendian: bool,
) -> Pixels:
    """The pixels of an image message, without a copy.

    Args:
        data: At least step * height * encoding.rows bytes.
        encoding: The image's encoding.
        width: Columns.
        height: Rows.
        step: Bytes per row, at least width * pixel bytes.
        is_bigendian: Byte order of samples of more than one byte.

    Returns:
        Array of `Encoding.shape`, of the encoding's type in the message's byte order; writable
        where the data is. ``yuv422`` and the like give (height, width, 2); ``nv12`` and ``nv21``
        (height * 3 / 2, width), luma over interleaved chroma; ``nv24`` (height * 3, width), where
        two rows hold the chroma of one.
    """
    size = encoding.bytes_per_sample
    code = np.dtype(encoding.dtype).newbyteorder(">" if is_bigendian else "<")
    shape = encoding.shape(width, height)
    strides = (step, encoding.pixel_bytes, size)[: len(shape)]
    pixels: Pixels = np.ndarray(shape, code, buffer=data, strides=strides)
    return pixels


def row_padding(
    data: memoryview, encoding: Encoding, *, width: int, height: int, step: int
) -> bytes | None:
    """The bytes after the pixels of each row; None if all rows have them, and all are zero.

    Args:
        data: Of an image that `why_not` accepts.
        encoding: The image's encoding.
        width: Columns.
        height: Rows of the image.
        step: Bytes per row.
    """
    row_bytes = width * encoding.pixel_bytes
    if step == row_bytes:
        return None
    count = encoding.shape(width, height)[0]
    whole = len(data) // step  # the last row may have none
    rows = np.frombuffer(data, np.uint8, count=step * whole).reshape(whole, step)[:, row_bytes:]
    return rows.tobytes() if whole < count or rows.any() else None


def put_padding(data: bytearray | memoryview, padding: bytes, *, row_bytes: int, step: int) -> None:
    """Write what `row_padding` gave after the pixels of each row.

    Args:
        data: All rows, to be changed.
        padding: Of all rows, or of all except the last.
        row_bytes: Of the pixels of a row.
        step: Bytes per row.
    """
    whole = len(padding) // (step - row_bytes)
    rows = np.frombuffer(data, np.uint8, count=step * whole).reshape(whole, step)
    rows[:, row_bytes:] = np.frombuffer(padding, np.uint8).reshape(whole, step - row_bytes)


# ---------------------------------------------------------------- values

Samples = NDArray[Any]
"""Unsigned integers in native byte order, shape of the pixels."""

DEPTHS = (8, 10, 12, 14)
"""Bits per sample of pictures, other than 16."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of a layout for a stream; a layout has exactly the ones it needs.

    Attributes:
        bits: Bits per sample of the picture.
        shift: Zero bits below them in each sample of the image.
        low: Number of low bits, folded and stored separately.
        table: The bit patterns that occur, in increasing order.
        entries: Length of the list of values in each picture.
        hole: Bit pattern of the float that stands for no measurement.
        scale: One of `mp4ds.messages.encodings.SCALES`.
        alpha: Bit pattern of every pixel's alpha.
    """

    bits: int | None = None
    shift: int | None = None
    low: int | None = None
    table: tuple[int, ...] | None = None
    entries: int | None = None
    hole: int | None = None
    scale: str | None = None
    alpha: int | None = None

    @property
    def names(self) -> frozenset[str]:
        """Names of those that are set."""
        return frozenset(f.name for f in fields(self) if getattr(self, f.name) is not None)

    def to_values(self) -> dict[str, Any]:
        """As JSON values, without those that are not set."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name in self.names}
        return values | ({"table": list(self.table)} if self.table is not None else {})

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Parameters:
        """The inverse of `to_values`; `mp4ds.messages.layouts.bind` checks the values.

        Raises:
            ValueError: A name is unknown.
        """
        known = {f.name for f in fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown layout parameter {unknown[0]!r}")
        given = dict(values)
        if isinstance(given.get("table"), list):
            given["table"] = tuple(given["table"])
        return cls(**given)


NO_PARAMETERS = Parameters()


class Values(Protocol):
    """A bijection between the samples of an image and those of its picture."""

    @property
    def bits(self) -> int:
        """Bits per sample of the picture."""

    @property
    def is_identity(self) -> bool:
        """Whether the picture's samples have the bit patterns of the image's."""

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """Shape of the samples of pixels."""

    def encode(self, pixels: Pixels) -> Samples:
        """Samples of accepted pixels; may be a view."""

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels of samples into ``out``, in its byte order."""

    def refuses(self, pixels: Pixels) -> str | None:
        """Why these pixels would not be restored, or None if they would."""


def patterns(pixels: Pixels) -> Samples:
    """The bit patterns of pixels as a view, in their byte order."""
    return pixels.view(pixels.dtype.str.replace(pixels.dtype.kind, "u"))


def native(pixels: Pixels) -> Samples:
    """The bit patterns of pixels in native byte order; a view where possible."""
    found = patterns(pixels)
    return found.astype(found.dtype.newbyteorder("="), copy=False)


@dataclass(frozen=True, slots=True)
class Whole:
    """Samples as they are; signed integers have their top bit inverted, which keeps their order.

    Attributes:
        encoding: The image's.
    """

    encoding: Encoding

    @property
    def bits(self) -> int:
        """All of the sample's."""
        return 8 * self.encoding.bytes_per_sample

    @property
    def is_identity(self) -> bool:
        """Unless there are signs."""
        return not self.encoding.is_signed

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """A view where possible."""
        samples = native(pixels)
        return samples if self.is_identity else samples ^ samples.dtype.type(1 << (self.bits - 1))

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        top = 0 if self.is_identity else 1 << (self.bits - 1)
        patterns(out)[...] = samples ^ samples.dtype.type(top) if top else samples

    def refuses(self, pixels: Pixels) -> str | None:
        """Never."""
        return None


@dataclass(frozen=True, slots=True)
class Narrow:
    """The bits in use of 16-bit samples.

    Attributes:
        bits: Bits per sample, one of `DEPTHS` or 16.
        shift: Zero bits below them.
        signed: Whether half of the range is added first.
    """

    bits: int
    shift: int
    signed: bool

    @property
    def is_identity(self) -> bool:
        """If only the picture's format differs."""
        return self.bits > 8 and not self.shift and not self.signed

    @property
    def _half(self) -> int:
        return 1 << (self.bits + self.shift - 1) if self.signed else 0

    def _shifted(self, pixels: Pixels) -> Samples:
        samples = native(pixels)
        # wraps around, as intended
        return samples + np.uint16(self._half) if self.signed else samples

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """A view where possible."""
        samples = self._shifted(pixels)
        if self.shift:
            samples = samples >> np.uint16(self.shift)
        return samples.astype(np.uint8) if self.bits == 8 else samples

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        wide = samples.astype(np.uint16, copy=False)
        if self.shift:
            wide = wide << np.uint16(self.shift)
        patterns(out)[...] = wide - np.uint16(self._half) if self.signed else wide

    def refuses(self, pixels: Pixels) -> str | None:
        """A bit outside the kept ones."""
        used = int(np.bitwise_or.reduce(self._shifted(pixels), axis=None))
        kept = ((1 << self.bits) - 1) << self.shift
        if used & ~kept:
            below = f" above {self.shift} zero bits" if self.shift else ""
            return f"a value does not fit into {self.bits} bits{below}"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The fewest bits for values that end at the highest bit, or at the twelfth.

        At the highest bit, the zeros below show the sensor's depth. Elsewhere a scene may just be
        dark, so fewer than 12 bits are assumed only if a value uses them all.
        """
        used = most = 0
        for pixels in samples:
            used |= int(np.bitwise_or.reduce(native(pixels), axis=None))
            most = max(most, int(native(pixels).max()))
        if not used:
            return None
        zeros = (used & -used).bit_length() - 1
        bits = (used >> zeros).bit_length()
        if not encoding.is_signed and bits in DEPTHS and most >> zeros == (1 << bits) - 1:
            return Parameters(bits=bits, shift=zeros)
        # top bit of the values, and minimum zero bits below
        for top, least in ((16, 4), (12, 0), (16, 2)):
            bits = next((depth for depth in DEPTHS if depth >= top - zeros), 16)
            narrow = cls(bits, top - bits, encoding.is_signed)
            if zeros >= least and bits < 16 and not any(map(narrow.refuses, samples)):
                return Parameters(bits=bits, shift=top - bits)
        return None


@dataclass(frozen=True, slots=True)
class Opaque:
    """The colours of 8-bit pixels that all have the same alpha.

    Attributes:
        alpha: Of every pixel.
    """

    alpha: int

    @property
    def bits(self) -> int:
        """Always 8."""
        return 8

    @property
    def is_identity(self) -> bool:
        """Never."""
        return False

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """Three channels."""
        return (*pixels.shape[:2], 3)

    def encode(self, pixels: Pixels) -> Samples:
        """A copy, since a frame has no gaps between its pixels."""
        return np.ascontiguousarray(pixels[..., :3])

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        out[..., :3] = samples
        out[..., 3] = self.alpha

    def refuses(self, pixels: Pixels) -> str | None:
        """A different alpha."""
        if (pixels[..., 3] != self.alpha).any():
            return f"an alpha that is not the stream's, {self.alpha}"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The alpha of the first pixel, if all have it."""
        alpha = int(samples[0][0, 0, 3])
        if any(cls(alpha).refuses(pixels) for pixels in samples):
            return None
        return Parameters(alpha=alpha)


# ---------------------------------------------------------------- numbers

MAX_TABLE = 4096
"""Maximum number of values in a table; bounds a sidecar's size."""

SCALES = ("product", "quotient")
"""How metres were made from millimetres: ``k * 0.001f`` or ``k / 1000``."""


@dataclass(frozen=True, slots=True)
class PatternTable:
    """The index of each bit pattern in a list of those that occur.

    Attributes:
        table: The patterns, increasing, uint16 or uint32.
    """

    table: Samples

    @property
    def bits(self) -> int:
        """As many as its indices need, in whole bytes."""
        return 8 if len(self.table) <= 256 else 16

    @property
    def is_identity(self) -> bool:
        """Never."""
        return False

    def _numbers(self, samples: Samples) -> Samples:
        """For each sample the index of the last pattern that is not greater, or 0."""
        if samples.dtype.itemsize == 2:
            every = np.arange(65536, dtype=np.uint16)
            numbers = np.searchsorted(self.table, every, side="right")
            return (np.maximum(numbers, 1) - 1).astype(np.uint16)[samples]
        numbers = np.searchsorted(self.table, samples, side="right")
        return (np.maximum(numbers, 1) - 1).astype(np.uint16)

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        numbers = self._numbers(native(pixels))
        return numbers.astype(np.uint8) if self.bits == 8 else numbers

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels; indices beyond the table, from a damaged video, mean the last entry."""
        patterns(out)[...] = np.take(self.table, samples, mode="clip")

    def refuses(self, pixels: Pixels) -> str | None:
        """A pattern that is not in the table."""
        samples = native(pixels)
        unknown = self.table[self._numbers(samples)] != samples
        if unknown.any():
            value = np.ascontiguousarray(pixels[unknown][:1]).item()
            return f"value {value} is not one of the {len(self.table)} in the stream's table"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The patterns of the samples, if they are few; integers must also be sparse.

        If the second half of the samples has patterns missing in the first, later images would have
        yet others.
        """
        half = (len(samples) + 1) // 2
        found: Samples = np.empty(0, f"u{encoding.bytes_per_sample}")
        for number, pixels in enumerate(samples):
            patterns_here, before = native(pixels), len(found)
            for part in (patterns_here[::16, ::16], patterns_here):  # makes most refusals cheap
                found = np.union1d(found, part)
                if len(found) > MAX_TABLE or (number >= half and len(found) > before):
                    return None
        values = found.tolist()
        if not encoding.is_float and values[-1] - values[0] + 1 < 2 * len(values):
            return None  # a plain picture has hardly more values
        return Parameters(table=tuple(values))


_EXPONENT = 0x7F800000  # all ones in NaN and infinity


@cache
def _metres(scale: str) -> Samples:
    """Bit patterns of 0 to 65535 millimetres in metres, as float32; read-only."""
    counts = np.arange(65536, dtype=np.float32)
    thousand = np.float32(1000)
    metres = counts * np.float32(0.001) if scale == "product" else counts / thousand
    found: Samples = metres.astype(np.float32).view(np.uint32)
    found.flags.writeable = False
    return found


@dataclass(frozen=True, slots=True)
class Metres:
    """Whole millimetres, from floats in metres; 0 is the hole.

    Attributes:
        hole: Bit pattern of a float32: 0, a NaN or an infinity.
        scale: One of `SCALES`.
    """

    hole: int
    scale: str

    @property
    def bits(self) -> int:
        """Always 16."""
        return 16

    @property
    def is_identity(self) -> bool:
        """Never."""
        return False

    def _table(self) -> Samples:
        table: Samples = _metres(self.scale).copy()
        table[0] = self.hole
        return table

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """That of the pixels."""
        return pixels.shape

    def encode(self, pixels: Pixels) -> Samples:
        """New samples."""
        with np.errstate(invalid="ignore", over="ignore"):
            metres = pixels.astype(np.float32, copy=False)
            counts = np.rint(metres * np.float32(1000))
            counts[~((counts >= 0) & (counts < 65536))] = 0  # NaN compares as false
        found: Samples = counts.astype(np.uint16)
        return found

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        patterns(out)[...] = self._table()[samples]

    def refuses(self, pixels: Pixels) -> str | None:
        """A float that is neither the hole nor a whole number of millimetres."""
        other = self._table()[self.encode(pixels)] != native(pixels)
        if other.any():
            value = np.ascontiguousarray(pixels[other][:1]).item()
            return f"value {value} is neither whole millimetres nor the stream's mark of a hole"
        return None

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> Parameters | None:
        """The scale, and the hole that occurs."""
        hole = 0
        for pixels in samples:
            found = native(pixels)
            holes = found[(found == 0) | (found & _EXPONENT == _EXPONENT)]
            if holes.size:
                hole = int(holes[0])
                break
        for scale in SCALES:
            metres = cls(hole, scale)
            if not any(metres.refuses(pixels[::16, ::16]) for pixels in samples) and not any(
                metres.refuses(pixels) for pixels in samples
            ):
                return Parameters(hole=hole, scale=scale)
        return None
