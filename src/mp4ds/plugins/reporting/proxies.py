"""What browsers can show of a stream: its own video, or a small replacement."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import xxhash
from numpy.typing import NDArray

from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.views import view_of
from mp4ds.errors import Refused, VideoError
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.video.codecs import recipe_for
from mp4ds.video.encoder import VideoEncoder
from mp4ds.video.images import encoding_as
from mp4ds.video.media import Media, pixel_format_of
from mp4ds.video.mp4 import read_sample_table

_8BIT = frozenset({"yuv420p", "yuv422p", "yuv444p", "gbrp"})
_PLAYED = {
    "h264": _8BIT
    | {"yuvj420p", "yuvj422p", "yuvj444p", "gray"}
    | {"yuv420p10le", "yuv422p10le", "yuv444p10le", "gray10le"},
    "av1": frozenset({"yuv420p", "yuvj420p", "gray", "yuv420p10le", "gray10le"}),
    "vp9": _8BIT,
}
"""What Chromium plays directly, by test; other browsers play less."""

_FEW = ("hevc",)  # if the system or the GPU decodes it


def why_not_in_browsers(path: Path) -> str:
    """Why browsers do not play a video; empty if Chromium-based ones do.

    Args:
        path: An mp4.

    Raises:
        VideoError: It cannot be read.
    """
    with closing(Media(path)) as media:
        context = media.track.codec_context
        name, pixel_format = context.codec.canonical_name, pixel_format_of(context)
    if name not in _PLAYED:
        return f"{'few browsers play' if name in _FEW else 'no browser plays'} {name}"
    if pixel_format not in _PLAYED[name]:
        return f"no browser plays {name} in the pixel format {pixel_format}"
    return ""


# ---------------------------------------------------------------- looks

Bytes = NDArray[np.uint8]

_SAMPLES = 9  # frames sampled for the range of values
_LOW, _HIGH = 1.0, 99.0  # percentiles mapped to the ends of the colour scale
_WHITE = 99.9  # percentile shown as white
_SIDE = 256  # maximum side of a sampled frame, pixels
# from near to far: violet, blue, green, yellow; missing values are black
_COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))


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
            self._low, self._high = _range(_sampled(topic), _LOW, _HIGH)
            first = "the first of its channels, " if encoding.channels > 1 else ""
            self.caption = f"in false colour: {first}{self._low:.4g} to {self._high:.4g}"
        elif self._view.dtype != np.uint8:
            self._high = _range(_sampled(topic), _LOW, _WHITE)[1]
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
        picture: Bytes = _colour_table()[places]
        picture[~_is_value(numbers)] = 0
        return picture

    def _scaled(self, values: Pixels) -> NDArray[np.float64]:
        """Values scaled to 0 to 255, clipped to the range."""
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = (values.astype(np.float64) - self._low) * (255 / (self._high - self._low))
        places: NDArray[np.float64] = np.nan_to_num(np.clip(np.rint(scaled), 0, 255))
        return places


def _sampled(topic: Topic) -> list[Pixels]:
    """Pixels of a few frames, subsampled."""
    numbers = sorted(set(np.linspace(0, len(topic) - 1, _SAMPLES).astype(int).tolist()))
    found = []
    for number in numbers:
        try:
            frame = topic.get([number])[0].data
        except VideoError:
            continue
        steps = [max(1, side // _SIDE) for side in frame.shape[:2]]
        found.append(_first(frame)[:: steps[0], :: steps[1]])
    return found


def _first(pixels: Pixels) -> Pixels:
    return pixels if pixels.ndim == 2 else pixels[..., 0]


def _is_value(numbers: Pixels) -> NDArray[np.bool_]:
    """Whether a value is valid: sensors report 0, infinity or NaN if they measured nothing."""
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
    table: Bytes = np.rint(np.stack(channels, axis=1)).astype(np.uint8)
    return table


# ---------------------------------------------------------------- proxies

_VERSION = 1  # of the way proxies are made
_CRF, _PRESET = 26, "veryfast"
_GOP = 24  # a step back decodes at most that many frames
_LEAST_SIDE = 32
_MOST_THREADS = 8
_TELL_EVERY = 32  # frames
_MICROSECONDS = 1_000_000


def presentation_times(stream: Stream) -> NDArray[np.int64]:
    """When a player shows each frame of a stream's video, microseconds, as its mp4 says.

    Raises:
        VideoError: It cannot be read, or its number of frames differs from its sidecar.
    """
    path = stream.video_path
    if not path.is_file():
        raise VideoError("file-missing", path, "does not exist")
    try:
        with path.open("rb") as file:
            table = read_sample_table(file, path.stat().st_size, str(path))
    except Refused as reason:
        raise VideoError("video-unreadable", path, f"has no plain index: {reason}") from None
    except OSError as error:
        raise VideoError("video-unreadable", path, f"cannot be read: {error}") from None
    ticks = table.presentation[table.order]
    if len(ticks) != len(stream):
        raise VideoError(
            "frame-count", path, f"has {len(ticks)} frames, but its sidecar says {len(stream)}"
        )
    whole, part = np.divmod(ticks, table.timescale)
    times: NDArray[np.int64] = whole * _MICROSECONDS + part * _MICROSECONDS // table.timescale
    if (np.diff(times) <= 0).any():
        raise VideoError("video-unreadable", path, "has presentation times that do not increase")
    return times


def why_not_seen(stream: Stream) -> str:
    """Why a stream's video does not look like its images; empty if it does."""
    if stream.sidecar.body == "packet" or stream.sidecar.layout.is_shown:
        return ""
    return f"the video stores {stream.encoding} and does not look like the image"


def proxy_size(image_size: tuple[int, int], width: int) -> tuple[int, int]:
    """Width and height of a proxy: even, and no larger than the images, except for tiny ones.

    Args:
        image_size: Of the images.
        width: Maximum width.
    """
    factor = min(1.0, width / image_size[0])
    sides = [max(_LEAST_SIDE, 2 * round(side * factor / 2)) for side in image_size]
    return sides[0], sides[1]


def proxy_name(stream: Stream, size: tuple[int, int]) -> str:
    """Name of a proxy's file, the same only if it would be made in the same way again."""
    how = f"{_VERSION} {stream.sidecar.video.sha256} {size[0]}x{size[1]} {_CRF} {_PRESET} {_GOP}"
    return f"{stream.path.stem}-{xxhash.xxh64(how.encode()).hexdigest()}.mp4"


def make_proxy(
    stream: Stream,
    path: Path,
    look: Look,
    *,
    size: tuple[int, int],
    times: NDArray[np.int64],
    progress: Callable[[str], None],
) -> None:
    """Encode all frames of a stream, each at its own time, as H.264 that every browser plays.

    Args:
        stream: The stream.
        path: The file to make.
        look: Makes its pictures.
        size: Width and height, even.
        times: See `presentation_times`.
        progress: Called with a phrase now and then.

    Raises:
        VideoError: The stream's video cannot be decoded.
        OSError: It cannot be written.
    """
    recipe = recipe_for("rgb24", lossless=False, codec="h264", crf=_CRF, preset=_PRESET)
    span = int(times[-1] - times[0])
    encoder = VideoEncoder(
        path,
        recipe,
        picture_format="rgb24",
        width=size[0],
        height=size[1],
        gop=_GOP,
        threads=min(os.cpu_count() or 1, _MOST_THREADS),
        rate=(len(times) - 1) * _MICROSECONDS / span if span else None,
    )
    picture: Bytes = np.zeros((size[1], size[0], 3), np.uint8)
    try:
        with encoder:
            for number, found in stream.pictures(is_strict=stream.sidecar.body != "packet"):
                if found is not None:  # otherwise the previous one stays
                    picture = look.picture(stream.recorded_pixels(found))
                encoder.write((picture,), int(times[number]))
                if number % _TELL_EVERY == 0:
                    progress(f"{stream.topic}: frame {number} of {len(stream)} for the page")
    except BaseException:
        path.unlink(missing_ok=True)
        raise
