"""Which frames a sample has before and after its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mp4ds.errors import OptionError
from mp4ds.torch.recordings import Recording

Unit = Literal["frames", "seconds"]
_MOST_SECONDS = 10**9


class Timeline(Protocol):
    """The stamps of a camera."""

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, by frame."""
        ...

    @property
    def period_ns(self) -> int:
        """Median time between frames, nanoseconds."""
        ...

    def nearest(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames whose stamps are nearest to times, of the same shape."""
        ...


@dataclass(frozen=True, slots=True)
class Offsets:
    """Offsets of the frames of a sample from its own, in rows or in nanoseconds.

    Attributes:
        steps: The offsets.
        timed: Whether they are nanoseconds.
        tolerance_ns: How far a frame may be from its time; None: half a period of the camera.
    """

    steps: tuple[int, ...] = (0,)
    timed: bool = False
    tolerance_ns: int | None = None

    def frames(
        self, recording: Recording, camera: int, timeline: Timeline, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Frame numbers of samples, and which of them only stand in for what is not there.

        Args:
            recording: Of the samples.
            camera: Number of the camera.
            timeline: The camera's stamps; not used unless offsets are times.
            rows: The samples, shape (N,).

        Returns:
            Two arrays of shape (N, offsets).
        """
        steps = np.array(self.steps, np.int64)
        if not self.timed:
            wanted = rows[:, None] + steps
            there = np.clip(wanted, 0, recording.rows - 1)
            return recording.frames(there, camera), there != wanted
        own = recording.frames(rows, camera)[:, None]
        stamps = timeline.stamps
        times = stamps[own] + steps
        # with equal stamps, the nearest to its own time may be another frame
        found = np.where(steps == 0, own, timeline.nearest(times))
        tolerance = timeline.period_ns // 2 if self.tolerance_ns is None else self.tolerance_ns
        return found, np.abs(stamps[found] - times) > tolerance


def offsets_from(values: Sequence[float], unit: Unit, tolerance_ns: int | None) -> Offsets:
    """The offsets that a user gave.

    Raises:
        OptionError: They are none, or no numbers of that unit.
    """
    given = tuple(values)
    if not given:
        raise OptionError("offsets is empty; (0,) is the sample's own frame alone.")
    if unit == "frames":
        if any(isinstance(value, bool) or value != int(value) for value in given):
            raise OptionError(f"offsets are {given}, and those in frames are whole numbers.")
        if tolerance_ns is not None:
            raise OptionError('tolerance_ns belongs to offsets_in="seconds".')
        return Offsets(tuple(int(value) for value in given))
    if unit != "seconds":
        raise OptionError(f"offsets_in is {unit!r}, and not one of frames, seconds.")
    if not all(abs(value) <= _MOST_SECONDS for value in given):
        raise OptionError(f"offsets are {given}, and those in seconds are at most 1e9.")
    if tolerance_ns is not None and tolerance_ns < 0:
        raise OptionError(f"tolerance_ns is {tolerance_ns}, and must not be negative.")
    return Offsets(tuple(round(value * 10**9) for value in given), True, tolerance_ns)
