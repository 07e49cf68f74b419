"""Clips of cameras as encoder input, each in a file of its own."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xxhash
from numpy.typing import NDArray

from mp4ds.errors import Refused
from mp4ds.messages.encodings import ENCODINGS
from mp4ds.messages.layouts import Layout, layout_for
from mp4ds.plugins.evaluating.options import EvaluateOptions
from mp4ds.times import TIMESCALE, PresentationClock, nearest
from mp4ds.video.planes import PlaneMaker, Planes, PlaneSpool
from mp4ds.video.scores import SMALLEST

if TYPE_CHECKING:  # the processes of trials need no readers
    from mp4ds.plugins.evaluating.cameras import Camera, Shot

FRAMES, TICKS = "frames.yuv", "ticks.npy"
"""The files of a clip: its frames (see `PlaneSpool`), and when each is shown, as in a packed
video."""

_SECOND = 1_000_000_000
_DETAIL = (96, 128)  # rows and columns shown side by side


@dataclass(frozen=True)
class Clip:
    """Frames of a camera as encoder input.

    Attributes:
        encoding: ROS encoding of the images.
        picture_format: Pixel format of their pictures, which determines their tags.
        image_size: Width and height of an image.
        size: Columns and rows of a frame, even.
        rate: Frames per second of the camera, or of the clip if lower.
        frames: How many there are.
        seconds: Their duration, the last one as long as the others.
        digest: Of the frames, and when each is shown.
        detail: x, y, width and height of the detail shown.
        detail_frame: Number of the frame shown.
        start: Log time of the first frame, seconds from the camera's first one.
        source_frames: Total number of the camera's images.
        left_out: Images in between with another size or encoding, or unreadable.
    """

    encoding: str
    picture_format: str
    image_size: tuple[int, int]
    size: tuple[int, int]
    rate: float | None
    frames: int
    seconds: float
    digest: str
    detail: tuple[int, int, int, int]
    detail_frame: int
    start: float
    source_frames: int
    left_out: int

    def open(self, folder: Path) -> PlaneSpool:
        """Open the file of its frames."""
        return PlaneSpool(folder / FRAMES, *self.size, frames=self.frames)

    def detail_of(self, planes: Planes) -> Planes:
        """The detail of a frame, as views."""
        x, y, width, height = self.detail
        luma = planes[0][y : y + height, x : x + width]
        rows, columns = slice(y // 2, (y + height) // 2), slice(x // 2, (x + width) // 2)
        return luma, planes[1][rows, columns], planes[2][rows, columns]


def chosen(times: NDArray[np.int64], origin: int, options: EvaluateOptions) -> list[int]:
    """The images of a representative clip, or of the requested one.

    Args:
        times: Of a camera's images, nanoseconds, sorted.
        origin: Log time at which the source begins, nanoseconds.
        options: Of the evaluation.

    Raises:
        Refused: There are none.
    """
    first = max(0, (len(times) - options.frames) // 2)
    last = first + options.frames
    if options.start is not None or options.duration is not None:
        length = round((options.duration or 0) * _SECOND)
        begin = (int(times[0]) + int(times[-1]) - length) // 2
        if options.start is not None:
            begin = origin + round(options.start * _SECOND)
        first, end = (int(np.searchsorted(times, time)) for time in (begin, begin + length))
        last = first + options.frames if options.duration is None else end
    found = list(range(first, min(len(times), last)))
    if not found:
        raise Refused("has no images in the requested time")
    return found


def chosen_at_rate(times: NDArray[np.int64], rate: float, frames: int) -> list[int]:
    """Images from the middle of a camera's recording, at a lower rate.

    Args:
        times: Nanoseconds, sorted, at least one.
        rate: Per second.
        frames: Maximum number.
    """
    period = _SECOND / rate
    start, end = int(times[0]), int(times[-1])
    count = min(frames, int((end - start) / period) + 1)
    begin = (start + end - (count - 1) * period) / 2
    due = np.rint(begin + period * np.arange(count)).astype(np.int64)
    return [int(index) for index in np.unique(nearest(times, due))]


def make_clip(camera: Camera, indices: list[int], rate: float | None, folder: Path) -> Clip:
    """Write images to files as encoder input.

    Args:
        camera: The camera.
        indices: Numbers of the images, increasing.
        rate: Frames per second.
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
    layout = _layout_of(first)
    maker, clock, digest = PlaneMaker(layout.pixel_format), PresentationClock(), xxhash.xxh3_128()
    encoding, width, height = first.kind
    size = width + width % 2, height + height % 2
    ticks: list[int] = []
    with closing(PlaneSpool(folder / FRAMES, *size)) as spool:
        for shot in chain([first], shots):
            if shot.kind != first.kind:
                continue
            planes = maker.make(layout.to_picture(shot.pixels))
            spool.append(planes)
            for plane in planes:
                digest.update(plane.data)
            ticks.append(clock.tick(shot.stamp, shot.log_time))
        middle = (len(ticks) - 1) // 2
        detail = _detail(spool.frame(middle)[0])
    np.save(folder / TICKS, ticks)
    digest.update(json.dumps(ticks).encode())
    gap = (ticks[-1] - ticks[0]) / TIMESCALE / max(1, len(ticks) - 1)
    return Clip(
        encoding=encoding,
        picture_format=layout.pixel_format,
        image_size=(width, height),
        size=size,
        rate=rate,
        frames=len(ticks),
        seconds=len(ticks) * (gap or 1 / (rate or 1.0)),
        digest=digest.hexdigest(),
        detail=detail,
        detail_frame=middle,
        start=(int(camera.times[indices[0]]) - int(camera.times[0])) / _SECOND,
        source_frames=len(camera.times),
        left_out=len(indices) - len(ticks),
    )


def _layout_of(shot: Shot) -> Layout:
    name, width, height = shot.kind
    if ENCODINGS[name].lossy is None:
        raise Refused(
            f"has {name} images, which are not 8-bit images: `mp4ds pack` keeps them lossless"
        )
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
