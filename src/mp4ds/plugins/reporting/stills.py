"""``frames``: a frame as an image."""

from __future__ import annotations

import re
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.views import size_after, view_of
from mp4ds.errors import FrameNotFoundError, OptionError, VideoError
from mp4ds.files.outputs import begins_with, staged
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.options import (
    Options,
    Parsed,
    Time,
    force,
    option,
    parse_resize,
    parse_time,
    what,
)
from mp4ds.video.images import ImageFile, encoding_as

_SUFFIXES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
_BEYOND_NS = 10**9  # how far a time may be before the first frame, or after the last
_QUALITY = 92


# ---------------------------------------------------------------- looks

Bytes = NDArray[np.uint8]

_SAMPLES = 9  # frames sampled for the range of values
_LOW, _HIGH = 1.0, 99.0  # percentiles mapped to the ends of the colour scale
_WHITE = 99.9  # percentile shown as white
_SIDE = 256  # maximum side of a sampled frame, pixels
# from near to far: violet, blue, green, yellow; missing values are black
_STOPS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
_COLOURS = np.rint(  # of 256 values
    [np.interp(range(256), np.linspace(0, 255, len(_STOPS)), one) for one in np.transpose(_STOPS)]
).T.astype(np.uint8)


class Look:
    """Makes displayable pictures of a stream's images; not to be shared between threads.

    Mosaics are interpolated; 16-bit images are scaled so that the brightest is white; depths and
    other measurements are shown in false colour, using the first of several channels.

    Args:
        topic: Its frames are sampled if their range is needed.
        size: Width and height of the pictures.

    Attributes:
        caption: How the pictures differ from the image; empty if they do not.
    """

    def __init__(self, topic: Topic, size: tuple[int, int]) -> None:
        encoding = ENCODINGS[topic.encoding]
        self._is_light = encoding_as(encoding, "rgb") is not None
        self._view = view_of(
            topic.topic,
            encoding,
            topic.image_size,
            format="rgb" if self._is_light else "native",
            resize=size,
            crop=None,
        )
        self.caption = ""
        self._low, self._high = 0.0, 255.0
        if not self._is_light:
            self._low, self._high = _range(topic, _LOW, _HIGH)
            first = "the first of its channels, " if encoding.channels > 1 else ""
            self.caption = f"in false colour: {first}{self._low:.4g} to {self._high:.4g}"
        elif self._view.dtype != np.uint8:
            self._high = _range(topic, _LOW, _WHITE)[1]
            self.caption = f"16 bits: white is {self._high:.0f}"

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
        picture: Bytes = _COLOURS[places]
        picture[~_is_value(numbers)] = 0
        return picture

    def _scaled(self, values: Pixels) -> NDArray[np.float64]:
        """Values scaled to 0 to 255, clipped to the range."""
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = (values.astype(np.float64) - self._low) * (255 / (self._high - self._low))
        places: NDArray[np.float64] = np.nan_to_num(np.clip(np.rint(scaled), 0, 255))
        return places


def _first(pixels: Pixels) -> Pixels:
    return pixels if pixels.ndim == 2 else pixels[..., 0]


def _is_value(numbers: Pixels) -> NDArray[np.bool_]:
    """Whether a value is valid: sensors report 0, infinity or NaN if they measured nothing."""
    is_value: NDArray[np.bool_] = np.isfinite(numbers) & (numbers != 0)
    return is_value


def _range(topic: Topic, low: float, high: float) -> tuple[float, float]:
    """Percentiles of the values of a few frames, subsampled."""
    values = [np.empty(0)]
    for number in spread(len(topic), _SAMPLES):
        with suppress(VideoError):
            frame = topic.get([number])[0].data
            rows, columns = (max(1, side // _SIDE) for side in frame.shape[:2])
            sample = _first(frame)[::rows, ::columns]
            values.append(sample[_is_value(sample)].astype(np.float64))
    known = np.concatenate(values)
    if not len(known):
        return 0.0, 1.0
    least, most = (float(value) for value in np.percentile(known, [low, high]))
    return (least, most) if most - least > 1e-12 * abs(most) else (least - 0.5, least + 0.5)


# ---------------------------------------------------------------- frames


def _parse_at(value: str | float | Time) -> Time | int:
    """A time, or the number of a frame as ``#N``."""
    if isinstance(value, str) and re.fullmatch(r"#[0-9]{1,9}", value):
        return int(value[1:])
    return value if isinstance(value, int) else parse_time(value)


@dataclass(frozen=True, kw_only=True)
class StillOptions(Options):
    """Which frame to save, and how."""

    topic: str = what("Camera topic, if there are several.", "", "-t")
    at: Parsed[Time | int] = what(
        "Seconds from the first frame or since 1970, nanoseconds since 1970, an ISO date, or #N "
        "for frame number N; default: the first frame.",
        0,
        metavar="TIME",
        parse=_parse_at,
    )
    resize: Parsed[float | tuple[int, int] | None] = option(
        "Size of the image.", metavar="0.5|WxH", parse=parse_resize
    )
    exact: bool = option(
        "Keep the pixel values as recorded, as export images --native does.", False
    )
    force: bool = force()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.exact and self.resize is not None:
            raise OptionError("`exact` cannot be combined with `resize`.")


@dataclass(frozen=True)
class StillSummary:
    """A saved frame.

    Attributes:
        output: The file.
        topic: Of the camera.
        index: Number of the frame.
        stamp_ns: Its header stamp, nanoseconds.
        log_time_ns: Its log time, nanoseconds.
        size: Width and height of the image, pixels.
    """

    output: Path
    topic: str
    index: int
    stamp_ns: int
    log_time_ns: int
    size: tuple[int, int]


def frames(dataset: Path | str, output: Path | str, options: StillOptions) -> StillSummary:
    """Save a frame.

    It is shown as it looks: mosaics are interpolated, 16-bit images are scaled so that the
    brightest is white, depths and other measurements are in false colour.

    Args:
        dataset: A dataset, or one video with its sidecar; or its URL.
        output: A ``.png`` or ``.jpg``.
        options: Which frame, and how.

    Raises:
        OptionError: An option is wrong, or the file cannot hold the image.
        FrameNotFoundError: The camera has no frame near the time.
        VideoError: A frame cannot be decoded.
        TargetError: The output cannot be written there.
        WriteError: The output could not be written.
    """
    target = Path(output)
    kind = _SUFFIXES.get(target.suffix.lower())
    if kind is None:
        raise OptionError(f"{target} is not a .png or .jpg: give a name with one of these endings.")
    with Dataset(dataset) as opened:
        topic = _chosen(opened, options.topic)
        has_more = any(ENCODINGS[part.encoding].bytes_per_sample > 1 for part in topic.parts)
        if options.exact or not has_more:  # a view has no more than 8 bits
            topic = topic.in_layer("exact" if options.exact else "view")
        index = number_at(topic, options.at)
        part, number = topic.place_of(index)
        with closing(Topic([part])) as alone:  # which has one size and encoding
            pixels, encoding = _still(alone, number, options)
        data = ImageFile(encoding, kind, quality=_QUALITY).encode(pixels)
        with staged(target.absolute(), force=options.force, owned=_image_names) as path:
            path.write_bytes(data)
        return StillSummary(
            output=target,
            topic=topic.topic,
            index=index,
            stamp_ns=int(topic.stamps[index]),
            log_time_ns=int(topic.log_times[index]),
            size=(pixels.shape[1], pixels.shape[0]),
        )


def _image_names(path: Path) -> set[str] | None:
    return {""} if begins_with(path, b"\x89PNG", b"\xff\xd8\xff") else None


def _chosen(dataset: Dataset, topic: str) -> Topic:
    if topic:
        try:
            return dataset[topic]
        except KeyError as error:
            raise OptionError(f"{error.args[0]}.") from None
    if len(dataset.topics) != 1:
        known = ", ".join(dataset.topics) or "none"
        raise OptionError(
            f"{dataset.path} does not have exactly one camera: give a `topic` of {known}."
        )
    return dataset[dataset.topics[0]]


# ---------------------------------------------------------------- which


def spread(count: int, wanted: int) -> list[int]:
    """Numbers of evenly spaced frames, each in the middle of its part.

    All, if there are no more than wanted.
    """
    if count <= wanted:
        return list(range(count))
    return [(2 * number + 1) * count // (2 * wanted) for number in range(wanted)]


def number_at(topic: Topic, at: Time | int) -> int:
    """Number of the frame nearest to a time, or given by number.

    Raises:
        OptionError: There is no frame with that number.
        FrameNotFoundError: The time is more than a second before the first frame, or after the
            last one.
    """
    if isinstance(at, int):
        if at >= len(topic):
            raise OptionError(f"`at` '#{at}': frames of {topic.topic} are #0 to #{len(topic) - 1}.")
        return at
    time = at.after(int(topic.stamps[0]))
    index = topic.index_at(time)
    nearest = int(topic.stamps[index])
    is_beyond = not int(topic.stamps.min()) <= time <= int(topic.stamps.max())
    if is_beyond and abs(nearest - time) > _BEYOND_NS:
        raise FrameNotFoundError(topic.topic, time, "near", nearest)
    return index


# ---------------------------------------------------------------- how


def _still(topic: Topic, number: int, options: StillOptions) -> tuple[Pixels, str]:
    """Pixels of one frame, and their encoding."""
    if options.exact:
        return topic.get([number])[0].data, topic.encoding
    size = topic.image_size
    if options.resize is not None:
        size = size_after(topic.topic, size, options.resize)
    look = Look(topic, size)
    return look.picture(topic.get([number])[0].data), "rgb8"
