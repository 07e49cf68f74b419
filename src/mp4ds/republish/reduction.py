"""How much smaller and fewer images are given than they were recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.intervals import intervals, usual_interval
from mp4ds.layouts import MAX_SIDE
from mp4ds.streams import Stream
from mp4ds.streams.choices import Choice, everything, marked
from mp4ds.streams.rebuild import DecodedColumns
from mp4ds.streams.views import size_after

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Reduction:
    """Smaller images, and fewer of them. Every stream is reduced by itself.

    Attributes:
        resize: A factor, or width and height in pixels; None for as recorded.
        every: Only each frame of which the number in its stream is a multiple of this.
        max_rate: Most frames in a second, on the average; see `at_most`. None for all.

    Raises:
        OptionError: There is no such size, number or rate.
    """

    resize: float | tuple[int, int] | None = None
    every: int = 1
    max_rate: float | None = None

    def __post_init__(self) -> None:
        if self.resize is not None:
            _check_size(self.resize)
        if isinstance(self.every, bool) or not isinstance(self.every, int) or self.every < 1:
            raise OptionError(f"--every {self.every!r} is no number of frames: use 1 or more.")
        rate = self.max_rate
        if rate is not None and not (
            isinstance(rate, int | float)
            and not isinstance(rate, bool)
            and math.isfinite(rate)
            and 0 < rate <= _NS
        ):
            raise OptionError(f"--max-rate {rate!r} is no rate: use Hz, such as 10.")

    def size_of(self, stream: Stream) -> tuple[int, int] | None:
        """Width and height that images of a stream get; None where they have them already.

        Raises:
            OptionError: They are beyond what an image can have.
        """
        if self.resize is None:
            return None
        size = size_after(stream.topic, stream.image_size, self.resize)
        return size if size != stream.image_size else None

    def choice_of(self, stream: Stream, choice: Choice = everything) -> Choice:
        """Of the frames of a stream that are wanted those that are given."""
        return marked(self.kept(stream.rebuilder.columns), choice) if self.leaves_out else choice

    @property
    def leaves_out(self) -> bool:
        """Whether there may be fewer images."""
        return self.every > 1 or self.max_rate is not None

    def kept(self, columns: DecodedColumns) -> NDArray[np.bool_]:
        """Which frames of a stream are given, shape (frames,)."""
        is_kept = np.zeros(len(columns.stamp), np.bool_)
        is_kept[:: self.every] = True
        if self.max_rate is not None:
            chosen = np.flatnonzero(is_kept)
            is_kept[chosen] = at_most(self.max_rate, times_of(columns)[chosen])
        return is_kept


def _check_size(resize: Any) -> None:
    sides = [*resize] if isinstance(resize, tuple | list) else [resize]
    kinds = (int,) if len(sides) == 2 else (int, float)
    is_known = isinstance(resize, tuple | list) == (len(sides) == 2)
    for side in sides:
        is_number = isinstance(side, kinds) and not isinstance(side, bool)
        is_known = is_known and is_number and 0 < side <= MAX_SIDE
    if not is_known:
        raise OptionError(
            f"--resize {resize!r} is no size: use a factor such as 0.5, or width and height of 1 "
            f"to {MAX_SIDE} pixels."
        )


def times_of(columns: DecodedColumns) -> NDArray[np.int64]:
    """When the frames were taken, nanoseconds: by their stamps, or by their log times.

    The latter where most stamps do not increase, as those of cameras that leave them zero.
    """
    steps = np.diff(columns.stamp)
    is_sound = 2 * int((steps > 0).sum()) >= len(steps)
    return columns.stamp if is_sound else columns.log_time


def at_most(rate: float, times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which frames are kept of a camera that is to have no more than a rate.

    A grid of points, 1 / rate apart, begins at the first frame. For each point the first frame
    is kept that comes less than half of the camera's usual interval before it (and less than half
    of the grid's), or after it. So a camera of 30 Hz loses nothing at 30 Hz, though its frames
    come a little too early or too late, and two of three frames remain of it at 20 Hz. After a
    gap, or where the time goes backward, the grid begins anew.

    Args:
        rate: Hz.
        times: Nanoseconds, shape (frames,).
    """
    period = max(1, round(_NS / rate))
    usual = usual_interval(intervals(times))
    early = min(period, int(usual or period)) // 2
    is_kept = np.zeros(len(times), np.bool_)
    due: int | None = None
    for index, time in enumerate(times.tolist()):
        if due is None or time >= due + period or time < due - period - early:
            due = time
        elif time < due - early:
            continue
        is_kept[index] = True
        due += period
    return is_kept
