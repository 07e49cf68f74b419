"""The cameras of a source, and clips of them as encoder input."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.formats import open_reader
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.dataset import open_dataset
from mp4ds.dataset.recording import DatasetReader
from mp4ds.errors import Refused
from mp4ds.format.sidecars import names_dataset
from mp4ds.messages.encodings import ENCODINGS, Pixels
from mp4ds.messages.layouts import LAYOUTS, Layout, layout_for
from mp4ds.messages.serializations import is_camera, kind_of
from mp4ds.messages.wire import CodedFields
from mp4ds.packing.inspection import MessageInspector, depends_on_others
from mp4ds.packing.options import ImportOptions
from mp4ds.plugins.evaluating.trials import FRAMES, TICKS, Clip
from mp4ds.plugins.importing.layouts import open_images
from mp4ds.records import Channel, Excerpt, Message
from mp4ds.times import TIMESCALE, PresentationClock
from mp4ds.video.codecs import LOSSLESS
from mp4ds.video.pixels import PlaneMaker, PlaneSpool
from mp4ds.video.scores import SMALLEST

_JPEG = "JPEG files, which `mp4ds pack` re-encodes only with --transcode"

_SECOND = 1_000_000_000
_DETAIL = (96, 128)  # rows and columns shown side by side


_Kind = tuple[str, int, int]
Shot = tuple[_Kind, Pixels, int, int]
"""One image of a camera: its ROS encoding, width and height; pixels of the encoding; header stamp,
and when it was recorded, nanoseconds."""


@dataclass(frozen=True)
class Camera:
    """One camera of a source.

    Attributes:
        topic: Its topic, or the name of a video.
        times: Log times of all its images, nanoseconds, sorted, at least one.
        read: Yields images by increasing number, without messages that hold none.
        lossy: The lossy encoding they already went through; empty if none is known.
    """

    topic: str
    times: NDArray[np.int64]
    read: Callable[[Sequence[int]], Iterator[Shot]]
    lossy: str = ""

    @property
    def rate(self) -> float | None:
        """Images per second; None below two, or without a time span."""
        span = int(self.times[-1] - self.times[0])
        return (len(self.times) - 1) * 1e9 / span if span > 0 else None


@contextmanager
def open_cameras(place: Path) -> Iterator[tuple[list[Camera], dict[str, str]]]:
    """Open a recording, a dataset, or a video.

    Yields:
        Its cameras, and the topics of those whose images no encoder takes, with the reason.

    Raises:
        SourceError: It is not a recording, a dataset or a video.
        FormatError: It is a dataset, and breaks a rule of the format.
    """
    lossy = ""
    with ExitStack() as stack:
        if not names_dataset(place):
            reader = stack.enter_context(open_reader(place))
        elif (dataset := stack.enter_context(open_dataset(place))).channels:
            reader = DatasetReader(dataset)
            lossy = next(
                (
                    one.profile
                    for one in (stream.sidecar for stream in dataset.streams)
                    if one.profile != LOSSLESS
                ),
                "",
            )
        else:  # a video of any other program
            reader = stack.enter_context(open_images(place, ImportOptions(decode=True)))
        yield _of_recording(reader, lossy and f"a dataset of {lossy}")


def _of_recording(reader: BagReader, lossy: str = "") -> tuple[list[Camera], dict[str, str]]:
    times = reader.times()
    cameras: list[Camera] = []
    left_out: dict[str, str] = {}
    for channel in filter(is_camera, reader.channels):
        own = times.get(channel.id, np.empty(0, np.int64))
        first = reader.first(channel)
        if first is None or not len(own):
            left_out[channel.topic] = "has no images"
        elif kind_of(channel) is CodedFields and depends_on_others(channel, first):
            left_out[channel.topic] = "has video packets, which `mp4ds pack` copies"
        else:
            known = lossy or (_JPEG if _is_jpeg(first) else "")
            cameras.append(_of_channel(reader, channel, own, known))
    return cameras, left_out


def _is_jpeg(message: Message) -> bool:
    with suppress(Refused):
        return MessageInspector(message.channel).inspect(message).key.codec == "mjpeg"
    return False


def _of_channel(
    reader: BagReader, channel: Channel, times: NDArray[np.int64], lossy: str
) -> Camera:
    def read(indices: Sequence[int]) -> Iterator[Shot]:
        wanted = set(indices)
        first, last = int(times[indices[0]]), int(times[indices[-1]])
        number = int(np.searchsorted(times, first))
        excerpt = Excerpt(first, last + 1, frozenset([channel.topic]), others=False)
        inspector = MessageInspector(channel, transcode=True)
        for record in reader.records(excerpt):
            if not isinstance(record, Message) or record.channel.id != channel.id:
                continue
            if number in wanted:
                with suppress(Refused):
                    seen = inspector.inspect(record)
                    if seen.pixels is not None:
                        kind = seen.key.encoding, seen.key.width, seen.key.height
                        yield kind, seen.pixels, seen.parts.stamp, record.log_time
            number += 1

    return Camera(channel.topic, times, read, lossy)


# ---------------------------------------------------------------- clips


def chosen(
    times: NDArray[np.int64], origin: int, frames: int, start: float | None = None
) -> list[int]:
    """The images of a clip.

    Args:
        times: Of a camera's images, nanoseconds, sorted.
        origin: Log time at which the source begins, nanoseconds.
        frames: Maximum number.
        start: Where the clip begins, seconds from the origin; None: it is in the middle.

    Raises:
        Refused: There are none.
    """
    first = max(0, (len(times) - frames) // 2)
    if start is not None:
        first = int(np.searchsorted(times, origin + round(start * _SECOND)))
    if first >= len(times):
        raise Refused("has no images in the requested time")
    return list(range(first, min(len(times), first + frames)))


def make_clip(camera: Camera, indices: list[int], folder: Path) -> Clip:
    """Write images to files as encoder input.

    Args:
        camera: The camera.
        indices: Numbers of the images, increasing.
        folder: Where to make the files.

    Raises:
        Refused: The camera's images are not usable.
        SourceError: The source is damaged.
        OSError: It cannot be written.
    """
    shots = camera.read(indices)
    first = next(shots, None)
    if first is None:
        raise Refused("has no readable images in its clip")
    layout = _layout_of(first[0])
    maker, clock = PlaneMaker(layout.pixel_format), PresentationClock()
    encoding, width, height = first[0]
    size = width + width % 2, height + height % 2
    ticks: list[int] = []
    with closing(PlaneSpool(folder / FRAMES, *size)) as spool:
        for kind, pixels, stamp, log_time in chain([first], shots):
            if kind != first[0]:
                continue
            spool.append(maker.make(layout.to_picture(pixels)))
            ticks.append(clock.tick(stamp, log_time))
        middle = (len(ticks) - 1) // 2
        detail = _detail(spool.frame(middle)[0])
    np.save(folder / TICKS, ticks)
    gap = (ticks[-1] - ticks[0]) / TIMESCALE / max(1, len(ticks) - 1)
    return Clip(
        encoding=encoding,
        picture_format=layout.pixel_format,
        image_size=(width, height),
        size=size,
        rate=camera.rate,
        frames=len(ticks),
        seconds=len(ticks) * (gap or 1 / (camera.rate or 1.0)),
        detail=detail,
        detail_frame=middle,
        start=(int(camera.times[indices[0]]) - int(camera.times[0])) / _SECOND,
        source_frames=len(camera.times),
        left_out=len(indices) - len(ticks),
    )


def _layout_of(kind: _Kind) -> Layout:
    name, width, height = kind
    lossy = ENCODINGS[name].lossy
    if lossy is None or LAYOUTS[lossy].parameters:
        raise Refused(f"has {name} images; scores are of images of 8 bits without alpha")
    if min(width, height) < SMALLEST:
        raise Refused(f"has images of {width}x{height}, too small to score")
    return layout_for(ENCODINGS[name], lossless=False)


def _detail(luma: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """The part of a frame with the most detail, at even coordinates."""
    height, width = (min(sides) for sides in zip(_DETAIL, luma.shape, strict=True))
    # roots of the gradients: a broad texture counts more than one sharp edge
    down, across = (np.sqrt(np.abs(np.diff(luma.astype(np.float32), axis=n))) for n in (0, 1))

    def texture(place: tuple[int, int]) -> float:
        y, x = place
        rows = down[y : y + height - 1, x : x + width]
        columns = across[y : y + height, x : x + width - 1]
        return float(rows.mean() + columns.mean())

    tops, lefts = (
        range(0, whole - part + 1, max(2, part // 4 * 2))
        for whole, part in zip(luma.shape, (height, width), strict=True)
    )
    y, x = max(product(tops, lefts), key=texture)
    return x, y, width // 2 * 2, height // 2 * 2
