"""The encodings of ROS images, and steps on the values of their pixels; numpy only."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from mp4ds.errors import Refused
from mp4ds.messages.wire import ImageFields

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
_SOURCES = ("from_mosaic8", "from_yuv420", "from_yuv422")
_METRES = ("metres16", "metres_fold", "table", "palette")
_LOSSY = {"mono8": "gray8", "8UC1": "gray8", "8UC3": "bgr24"}
_LOSSY.update(dict.fromkeys(("mono16", "rgb16", "bgr16"), "tone"))
_KINDS = {"u": "U", "i": "S", "f": "F"}  # of numpy, and in the names of encodings


def _of_samples(name: str, channels: int, dtype: str) -> Encoding:
    """One to four channels, without a defined meaning in OpenCV's matrices."""
    general = {"1": _OF_BYTES, "2": _OF_WORDS}.get(dtype[1], {}).get(channels, "bytes")
    more = _METRES if name == "32FC1" else _MORE.get(general, ())
    if name == "8UC4":
        more = ("opaque",)
    return Encoding(name, channels, dtype, general, (general, *more), _LOSSY.get(name))


def _encodings() -> list[Encoding]:
    bayer = ("rggb", "bggr", "gbrg", "grbg")
    tall = Fraction(3, 2), (2, 2)
    bayer16 = ("mosaic16", "mosaic_bits", "mosaic_fold")
    return [
        _of_samples("mono8", 1, "u1"),
        _of_samples("mono16", 1, "u2"),
        Encoding("rgb8", 3, "u1", "rgb24", (*_SOURCES, "rgb24"), "rgb24"),
        Encoding("bgr8", 3, "u1", "bgr24", (*_SOURCES, "bgr24"), "bgr24"),
        Encoding("rgba8", 4, "u1", "rgba", ("rgba", "opaque"), "opaque"),
        Encoding("bgra8", 4, "u1", "bgra", ("bgra", "opaque"), "opaque"),
        *(_of_samples(f"{order}16", 3, "u2") for order in ("rgb", "bgr")),
        *(_of_samples(f"{order}16", 4, "u2") for order in ("rgba", "bgra")),
        *(
            Encoding(f"bayer_{mosaic}8", 1, "u1", "mosaic8", ("mosaic8",), "demosaic8", mosaic)
            for mosaic in bayer
        ),
        *(
            Encoding(f"bayer_{mosaic}16", 1, "u2", "mosaic16", bayer16, "tone", mosaic)
            for mosaic in bayer
        ),
        *(
            _of_samples(f"{8 * int(dtype[1])}{_KINDS[dtype[0]]}C{channels}", channels, dtype)
            for dtype in ("u1", "i1", "u2", "i2", "i4", "f4", "f8")
            for channels in range(1, 5)
        ),
        *(
            Encoding(name, 2, "u1", "planar422", ("planar422",), "halved420", even=(2, 1))
            for name in ("yuv422", "uyvy", "yuyv", "yuv422_yuy2")
        ),
        *(
            Encoding(name, 1, "u1", "planar420", ("planar420",), "planar420", "", *tall)
            for name in ("nv12", "nv21")
        ),
        Encoding("nv24", 1, "u1", "planar444", ("planar444",), "halved420", rows=Fraction(3)),
    ]  # fmt: skip


ENCODINGS: dict[str, Encoding] = {encoding.name: encoding for encoding in _encodings()}


def pixel_view(data: memoryview | bytearray, image: ImageFields) -> Pixels:
    """The pixels of an image message, without a copy.

    Args:
        data: At least step * height * rows of its encoding, in bytes.
        image: Of one of `ENCODINGS`; its step is at least width * pixel bytes.

    Returns:
        Array of `Encoding.shape`, of the encoding's type in the message's byte order; writable
        where the data is. ``yuv422`` and the like give (height, width, 2); ``nv12`` and ``nv21``
        (height * 3 / 2, width), luma over interleaved chroma; ``nv24`` (height * 3, width), where
        two rows hold the chroma of one.
    """
    encoding = ENCODINGS[image.encoding]
    code = np.dtype(encoding.dtype).newbyteorder(">" if image.is_bigendian else "<")
    shape = encoding.shape(image.width, image.height)
    strides = (image.step, encoding.pixel_bytes, encoding.bytes_per_sample)[: len(shape)]
    pixels: Pixels = np.ndarray(shape, code, buffer=data, strides=strides)
    return pixels


def row_padding(data: memoryview, image: ImageFields) -> bytes | None:
    """The bytes after the pixels of each row; None if all rows have them, and all are zero.

    Args:
        data: Of an image that `why_not` accepts.
        image: Its fields.
    """
    encoding, step = ENCODINGS[image.encoding], image.step
    row_bytes = image.width * encoding.pixel_bytes
    if step == row_bytes:
        return None
    count = encoding.shape(image.width, image.height)[0]
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


# ---------------------------------------------------------------- predictions


Prediction = tuple[Pixels, int]
"""Pixels that those of an image are differences to, in native byte order; bits of a difference."""


def difference(pixels: Pixels, prediction: Pixels, bits: int) -> Pixels:
    """What an image differs by from its prediction, as an image of the same encoding.

    Args:
        pixels: Of samples below 2^bits, unsigned.
        prediction: Of the same shape and type, in native byte order.
        bits: At most those of a sample.

    Returns:
        The differences modulo 2^bits, with half of that added: none is in the middle of the range.
    """
    found = native(pixels) - prediction
    found += found.dtype.type(1 << (bits - 1))
    if bits < 8 * found.itemsize:
        found &= found.dtype.type((1 << bits) - 1)
    return found


def add_prediction(out: Pixels, prediction: Pixels, bits: int) -> None:
    """Make an image of its `difference`, in place.

    Args:
        out: The difference, in any byte order.
        prediction: As for `difference`.
        bits: As for `difference`.
    """
    kind = prediction.dtype.type
    out += prediction
    out -= kind(1 << (bits - 1))  # both wrap around, as intended
    if bits < 8 * prediction.itemsize:
        out &= kind((1 << bits) - 1)


# ---------------------------------------------------------------- values

Samples = NDArray[Any]
"""Unsigned integers in native byte order, shape of the pixels."""

Picture = tuple[Samples, ...]
"""What the video holds: one array (rows, columns[, channels]), or one per plane."""

MAX_TABLE = 4096
"""Maximum number of values in a table; bounds a sidecar's size."""

_Uint64 = Annotated[int, Field(ge=0, le=2**64 - 1)]

DEPTHS = (8, 10, 12, 14)
"""Bits per sample of pictures, other than 16."""


class LayoutParameters(BaseModel):
    """What a layout needs to know of a stream."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    bits: Annotated[int, Field(ge=1, le=16)] | None = Field(
        None, description="Bits of a value that are kept."
    )
    shift: Annotated[int, Field(ge=0, le=15)] | None = Field(
        None, description="Zero bits below them in each sample of the image."
    )
    low: Annotated[int, Field(ge=1, le=8)] | None = Field(
        None, description="How many of the bits are low ones, folded and stored apart."
    )
    table: Annotated[tuple[_Uint64, ...], Field(max_length=MAX_TABLE, strict=False)] | None = Field(
        None, description="The bit patterns that occur, or that levels show; increasing."
    )
    entries: Annotated[int, Field(ge=1, le=MAX_TABLE)] | None = Field(
        None, description="Length of the list of values in each picture."
    )
    hole: Annotated[int, Field(ge=0, le=2**32 - 1)] | None = Field(
        None, description="Bit pattern of the float that stands for no measurement."
    )
    scale: str | None = Field(None, description="product or quotient: of metres.")
    alpha: Annotated[int, Field(ge=0, le=255)] | None = Field(
        None, description="Alpha of every pixel."
    )
    mosaic: str | None = Field(
        None, description="Colours of its 2 x 2 block, by rows: rggb, bggr, gbrg or grbg."
    )
    rule: str | None = Field(
        None, description="How colours were made of YUV (registry, Colours of YUV)."
    )

    @property
    def values(self) -> dict[str, Any]:
        """As JSON values, without those that are not set."""
        return self.model_dump(mode="json", exclude_none=True)


NO_PARAMETERS = LayoutParameters()


def patterns(pixels: Pixels) -> Samples:
    """The bit patterns of pixels as a view, in their byte order."""
    return pixels.view(pixels.dtype.str.replace(pixels.dtype.kind, "u"))


def native(pixels: Pixels) -> Samples:
    """The bit patterns of pixels in native byte order; a view where possible."""
    found = patterns(pixels)
    return found.astype(found.dtype.newbyteorder("="), copy=False)


class Values(ABC):
    """A bijection between the samples of an image and those of its picture.

    Args:
        encoding: Of the images.
        given: The parameters that it needs.

    Attributes:
        parameters: Their names.
        bits: Bits per sample of the picture.
        is_identity: Whether the picture's samples have the bit patterns of the image's.
        is_source: Whether they are what the colours of the image were made of.

    Raises:
        ValueError: The parameters contradict themselves, or the encoding.
    """

    parameters: ClassVar[frozenset[str]] = frozenset()
    is_identity = False
    is_source = False

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        self.encoding, self.given = encoding, given
        self.bits = 8 * encoding.bytes_per_sample

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """Parameters that suit samples of a stream, at least one; None if there are none."""
        return NO_PARAMETERS

    @classmethod
    def first_fitting(
        cls, encoding: Encoding, samples: Sequence[Pixels], *candidates: LayoutParameters
    ) -> LayoutParameters | None:
        """The first of some parameters with which no sample is refused; None if there are none."""
        for given in candidates:
            if not any(map(cls(encoding, given).refuses, samples)):
                return given
        return None

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """Shape of the samples of pixels."""
        return pixels.shape

    def prove(self, pixels: Pixels) -> Samples | None:
        """Prove that pixels would be restored.

        Returns:
            New samples, where that takes making them; else None.

        Raises:
            Refused: They would not be.
        """
        return None

    def refuses(self, pixels: Pixels) -> str | None:
        """What `prove` says against pixels; None if they would be restored."""
        try:
            self.prove(pixels)
        except Refused as reason:
            return str(reason)
        return None

    @abstractmethod
    def encode(self, pixels: Pixels) -> Samples:
        """Samples of accepted pixels; may be a view."""

    def predicted(self, prediction: Pixels) -> Samples:
        """What stands for the samples of an image, in one that predicts its pixels."""
        return self.encode(prediction)

    @abstractmethod
    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels of samples into ``out``, in its byte order."""


class Arrangement(ABC):
    """A bijection between an array of samples and a picture, which is grey and of its size."""

    def pixel_format(self, bits: int) -> str:
        """FFmpeg's name of the picture's format, for samples of that many bits."""
        return "gray" if bits == 8 else f"gray{bits}le"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the image -> of the picture."""
        return width, height

    @abstractmethod
    def arrange(self, samples: Samples) -> Picture:
        """The picture; may be a view."""

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Write the samples of a picture of the right size; here, where `arrange` gives views."""
        for plane, target in zip(picture, self.arrange(samples), strict=True):
            target[...] = plane


class Whole(Values):
    """Samples as they are; signed integers have their top bit inverted, which keeps their order."""

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        self.is_identity = not encoding.is_signed

    def encode(self, pixels: Pixels) -> Samples:
        """A view where possible."""
        samples = native(pixels)
        return samples if self.is_identity else samples ^ samples.dtype.type(1 << (self.bits - 1))

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        patterns(out)[...] = samples ^ samples.dtype.type(1 << (self.bits - 1))


def refuse_beyond(samples: Samples, bits: int, shift: int) -> None:
    """Refuse samples with other bits than so many above so many zero bits.

    Raises:
        Refused: They have.
    """
    used = int(np.bitwise_or.reduce(samples, axis=None))
    if used & ~(((1 << bits) - 1) << shift):
        below = f" above {shift} zero bits" if shift else ""
        raise Refused(f"a value does not fit into {bits} bits{below}")


class Narrow(Values):
    """The bits in use of 16-bit samples.

    Attributes:
        bits: Bits per sample, one of `depths`.
        shift: Zero bits below them.
    """

    parameters = frozenset({"bits", "shift"})
    depths: ClassVar[tuple[int, ...]] = DEPTHS

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        self.bits, self.shift = given.bits or 0, given.shift or 0
        if self.bits not in self.depths or self.bits + self.shift > 16:
            raise ValueError(f"no layout has {self.bits} bits above {self.shift} zero bits")
        # whether only the picture's format differs
        self.is_identity = self.bits > 8 and not self.shift and not encoding.is_signed
        # half of the range is added to signed samples
        self._half = 1 << (self.bits + self.shift - 1) if encoding.is_signed else 0

    def _shifted(self, pixels: Pixels) -> Samples:
        samples = native(pixels)
        # wraps around, as intended
        return samples + np.uint16(self._half) if self._half else samples

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
        patterns(out)[...] = wide - np.uint16(self._half) if self._half else wide

    def prove(self, pixels: Pixels) -> None:
        """Prove that no bit is outside the kept ones."""
        refuse_beyond(self._shifted(pixels), self.bits, self.shift)

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The bits in use; of colours at least 10, as FFmpeg's planar formats have."""
        found = cls.used_bits(encoding, samples)
        if found is None or found.bits != 8 or encoding.channels == 1:
            return found
        return LayoutParameters(bits=10, shift=max((found.shift or 0) - 2, 0))

    @staticmethod
    def used_bits(encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
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
            return LayoutParameters(bits=bits, shift=zeros)
        candidates = []
        # top bit of the values, and minimum zero bits below
        for top, least in ((16, 4), (12, 0), (16, 2)):
            bits = next((depth for depth in DEPTHS if depth >= top - zeros), 16)
            if zeros >= least and bits < 16:
                candidates.append(LayoutParameters(bits=bits, shift=top - bits))
        return Narrow.first_fitting(encoding, samples, *candidates)


_MOST_HIGH = 10  # bits that a plane of folded samples may have
_LOW_BITS = {12: 3, 14: 5, 16: 8}  # by measurement: the bits that are mostly noise


class NarrowFolded(Narrow):
    """Those of samples to be folded, whose low bits are stored separately."""

    parameters = frozenset({"bits", "shift", "low"})
    depths = (*DEPTHS, 16)

    def __init__(self, encoding: Encoding, given: LayoutParameters) -> None:
        super().__init__(encoding, given)
        low = given.low or 0
        if not 1 <= self.bits - low <= _MOST_HIGH:
            raise ValueError(f"no layout has {low} low bits of {self.bits}")

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """All bits, or those in use if there are enough of them to separate noise from the rest."""
        found = cls.used_bits(encoding, samples) or LayoutParameters(bits=16, shift=0)
        low = _LOW_BITS.get(found.bits or 0)
        return found.model_copy(update={"low": low}) if low else None


class Opaque(Values):
    """The colours of 8-bit pixels that all have the same alpha."""

    parameters = frozenset({"alpha"})

    def shape(self, pixels: Pixels) -> tuple[int, ...]:
        """Three channels."""
        return (*pixels.shape[:2], 3)

    def encode(self, pixels: Pixels) -> Samples:
        """A copy, since a frame has no gaps between its pixels."""
        return np.ascontiguousarray(pixels[..., :3])

    def decode(self, samples: Samples, out: Pixels) -> None:
        """Write the pixels."""
        out[..., :3] = samples
        out[..., 3] = self.given.alpha

    def prove(self, pixels: Pixels) -> None:
        """Prove that no pixel has a different alpha."""
        if (pixels[..., 3] != self.given.alpha).any():
            raise Refused(f"an alpha that is not the stream's, {self.given.alpha}")

    @classmethod
    def fit(cls, encoding: Encoding, samples: Sequence[Pixels]) -> LayoutParameters | None:
        """The alpha of the first pixel, if all have it."""
        alpha = int(samples[0][0, 0, 3])
        return cls.first_fitting(encoding, samples, LayoutParameters(alpha=alpha))
