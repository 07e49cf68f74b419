"""What the images of a stream look like, for the eye: RGB of 8 bits, in any size."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.layouts import ENCODINGS, Pixels
from mp4ds.streams import Frames, Stream
from mp4ds.streams.views import view_of
from mp4ds.video import encoding_as

Bytes = NDArray[np.uint8]

_SAMPLES = 9  # frames, of which the range of the values is taken
_LOW, _HIGH = 1.0, 99.0  # percentiles between which numbers get their colours
_WHITE = 99.9  # percentile of light that is white
_SIDE = 256  # pixels at most of a frame that is sampled
# from near to far: violet, blue, green, yellow; what has no value is black
_COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))


class Look:
    """Makes pictures of a stream's images; not to be shared between threads.

    Mosaics are interpolated; light of 16 bits is scaled so that the brightest is white; depths
    and other numbers get colours, their first channel that of several.

    Args:
        stream: Its frames are sampled, where their range must be known.
        size: Width and height of the pictures.

    Attributes:
        caption: What else than the image is shown; empty for plain light.
    """

    def __init__(self, stream: Frames, size: tuple[int, int]) -> None:
        encoding = ENCODINGS[stream.encoding]
        self._is_light = encoding_as(encoding, "rgb") is not None
        self._view = view_of(
            stream.topic,
            encoding,
            stream.image_size,
            format="rgb" if self._is_light else "native",
            resize=size,
            crop=None,
        )
        self.caption = ""
        self._low, self._high = 0.0, 255.0
        if not self._is_light:
            self._low, self._high = _range(_sampled(stream), _LOW, _HIGH)
            first = "the first of its channels, " if encoding.channels > 1 else ""
            self.caption = f"in colours: {first}{self._low:.4g} to {self._high:.4g}"
        elif self._view.dtype != np.uint8:
            self._high = _range(_sampled(stream), _LOW, _WHITE)[1]
            self.caption = f"of 16 bits: white is {self._high:.0f}"

    def picture(self, pixels: Pixels) -> Bytes:
        """A new picture, shape (H, W, 3).

        Args:
            pixels: Of an image, as recorded.
        """
        seen: Pixels = np.empty(self._view.shape, self._view.dtype)
        self._view.give(pixels, seen)
        if self._is_light:
            return seen if seen.dtype == np.uint8 else self._scaled(seen).astype(np.uint8)
        numbers = _first(seen)
        places = self._scaled(numbers).astype(np.uint8)
        picture: Bytes = _colour_table()[places]
        picture[~_is_value(numbers)] = 0
        return picture

    def _scaled(self, values: Pixels) -> NDArray[np.float64]:
        """Values as 0 to 255; those beyond the range at its ends."""
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = (values.astype(np.float64) - self._low) * (255 / (self._high - self._low))
        places: NDArray[np.float64] = np.nan_to_num(np.clip(np.rint(scaled), 0, 255))
        return places


def pictures_in_order(stream: Stream) -> Iterator[tuple[int, Pixels | None]]:
    """The pixels of all frames; None for a packet that does not decode by what was recorded.

    Raises:
        VideoError: The video is damaged.
    """
    make = stream.rebuilder.pixels
    with stream.open_video(sequential=True, fast_colour=True) as decoder:
        if stream.sidecar.body == "packet":
            for index, picture in decoder.decodable_pictures(range(len(stream))):
                yield index, None if picture is None else make(picture)
        else:
            for index, found in enumerate(decoder.pictures()):
                yield index, make(found)


def _sampled(stream: Frames) -> list[Pixels]:
    """Pixels of a few frames, of which a part stands for the whole."""
    numbers = sorted(set(np.linspace(0, len(stream) - 1, _SAMPLES).astype(int).tolist()))
    found = []
    for number in numbers:
        try:
            frame = stream.get([number])[0].data
        except VideoError:
            continue
        steps = [max(1, side // _SIDE) for side in frame.shape[:2]]
        found.append(_first(frame)[:: steps[0], :: steps[1]])
    return found


def _first(pixels: Pixels) -> Pixels:
    return pixels if pixels.ndim == 2 else pixels[..., 0]


def _is_value(numbers: Pixels) -> NDArray[np.bool_]:
    """Whether there is a number: sensors say 0, infinity or NaN where they measured nothing."""
    is_value: NDArray[np.bool_] = np.isfinite(numbers) & (numbers != 0)
    return is_value


def _range(samples: list[Pixels], low: float, high: float) -> tuple[float, float]:
    values = [sample[_is_value(sample)].astype(np.float64) for sample in samples]
    known = np.concatenate(values) if values else np.empty(0)
    if not len(known):
        return 0.0, 1.0
    least, most = (float(value) for value in np.percentile(known, [low, high]))
    return (least, most) if most - least > 1e-12 * abs(most) else (least - 0.5, least + 0.5)


def _colour_table() -> Bytes:
    places = np.linspace(0, 255, len(_COLOURS))
    channels = [
        np.interp(np.arange(256), places, channel) for channel in zip(*_COLOURS, strict=True)
    ]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)
