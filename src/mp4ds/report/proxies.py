"""Small videos in the place of those that no browser shows as they are to be seen."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import VideoError
from mp4ds.report.looks import Look, pictures_in_order
from mp4ds.streams import Stream
from mp4ds.video import VideoEncoder, recipe_for
from mp4ds.video.samples import Unindexed, read_sample_table

_VERSION = 1  # of how proxies are made
_CRF, _PRESET = 26, "veryfast"
_GOP = 24  # a step back decodes as many frames at most
_LEAST_SIDE = 32
_MOST_THREADS = 8
_TELL_EVERY = 32  # frames
_MICROSECONDS = 1_000_000


def presentation_times(stream: Stream) -> NDArray[np.int64]:
    """When a player shows each frame of a stream's video, microseconds, as its mp4 says.

    Raises:
        VideoError: It cannot be read, or has another number of frames than its sidecar says.
    """
    path = stream.video_path
    if not path.is_file():
        raise VideoError("file-missing", path, "does not exist")
    try:
        with path.open("rb") as file:
            table = read_sample_table(file, path.stat().st_size, str(path))
    except Unindexed as reason:
        raise VideoError("video-unreadable", path, f"has no plain index: {reason}") from None
    except OSError as error:
        raise VideoError("video-unreadable", path, f"cannot be read: {error}") from None
    ticks = table.presentation[table.order]
    if len(ticks) != len(stream):
        raise VideoError(
            "frame-count", path, f"has {len(ticks)} frames where its sidecar says {len(stream)}"
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
    return f"its picture is not the image (layout {stream.sidecar.video.layout})"


def proxy_size(image_size: tuple[int, int], width: int) -> tuple[int, int]:
    """Width and height of a proxy: even, and no larger than the images, but for tiny ones.

    Args:
        image_size: Of the images.
        width: Most columns.
    """
    factor = min(1.0, width / image_size[0])
    sides = [max(_LEAST_SIDE, 2 * round(side * factor / 2)) for side in image_size]
    return sides[0], sides[1]


def proxy_key(stream: Stream, size: tuple[int, int]) -> str:
    """What tells whether a proxy would be made in the same way again; empty if nothing does."""
    digest = stream.sidecar.video.sha256
    return (
        f"{_VERSION} {digest} {size[0]}x{size[1]} crf={_CRF} {_PRESET} g={_GOP}" if digest else ""
    )


def make_proxy(
    stream: Stream,
    path: Path,
    *,
    size: tuple[int, int],
    times: NDArray[np.int64],
    progress: Callable[[str], None],
) -> str:
    """Encode all frames of a stream, each at its own time, as H.264 that every browser plays.

    Args:
        stream: The stream.
        path: The file to make.
        size: Width and height, even.
        times: See `presentation_times`.
        progress: Called with a phrase now and then.

    Returns:
        What its pictures show besides the image; see `Look`.

    Raises:
        VideoError: The stream's video cannot be decoded.
        OSError: The disk refused.
    """
    look = Look(stream, size)
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
    picture = np.zeros((size[1], size[0], 3), np.uint8)
    try:
        for number, pixels in pictures_in_order(stream):
            if pixels is not None:  # else the one before stays
                picture = look.picture(pixels)
            encoder.write((picture,), int(times[number]))
            if number % _TELL_EVERY == 0:
                progress(f"{stream.topic}: frame {number} of {len(stream)} for the page")
    except BaseException:
        encoder.abandon()
        path.unlink(missing_ok=True)
        raise
    encoder.close()
    return look.caption
