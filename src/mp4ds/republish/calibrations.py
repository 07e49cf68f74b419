"""CameraInfo messages that belong to smaller or fewer images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import FormatError
from mp4ds.records import Channel, Message
from mp4ds.republish.forms import AsRecorded
from mp4ds.streams import CameraInfoRebuilder, Stream
from mp4ds.streams.calibrations import Placement
from mp4ds.streams.choices import Choice, marked


@dataclass(frozen=True)
class CalibrationSource:
    """Gives the calibration messages of a stream.

    Attributes:
        rebuilder: Makes them.
        is_kept: Which are given, shape (messages,).
    """

    rebuilder: CameraInfoRebuilder
    is_kept: NDArray[np.bool_]

    @property
    def left_out(self) -> int:
        """How many are not given."""
        return int((~self.is_kept).sum())

    def messages(self, channel: Channel, choice: Choice) -> Iterator[tuple[int, Message]]:
        """Those that are wanted, each with its place among the channel's messages."""
        chosen = choice if self.is_kept.all() else marked(self.is_kept, choice)
        return self.rebuilder.messages(channel, chosen(self.rebuilder.columns))


def calibration_source(
    stream: Stream, size: tuple[int, int] | None, is_kept: NDArray[np.bool_] | None
) -> CalibrationSource | None:
    """What gives the calibration messages of a stream whose images are reduced.

    Where images are left out, so are the calibrations that have the stamps of these alone. Those
    whose stamps no image has stay.

    Args:
        stream: The stream; has such messages.
        size: Width and height that its images get; None for as recorded.
        is_kept: Which of its images are given; None for all.

    Returns:
        None where they stay as recorded.

    Raises:
        AsRecorded: There are no such messages of another size; says why.
    """
    info = stream.sidecar.camera_info
    if info is None or (size is None and is_kept is None):
        return None
    if size is not None:
        placement = Placement((0, 0, *stream.image_size), size)
        made = [placement.calibration(calibration) for calibration in info.calibrations]
        info = info.model_copy(update={"calibrations": made})
    try:
        rebuilder = CameraInfoRebuilder(info, str(stream.path))
    except FormatError:
        if size is None:
            raise
        raise AsRecorded("calibrations of this type are not made for another size") from None
    stamps = rebuilder.columns.stamp
    is_wanted = np.ones(len(stamps), np.bool_)
    if is_kept is not None:
        frames = stream.stamps
        is_wanted = ~np.isin(stamps, frames) | np.isin(stamps, frames[is_kept])
    return CalibrationSource(rebuilder, is_wanted)
