"""Frames by number and by stamp: what streams, videos of others and whole topics have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np
from numpy.typing import NDArray

from mp4ds.layouts import ENCODINGS, Encoding, Pixels
from mp4ds.sidecar import Calibration
from mp4ds.streams.lookup import StampIndex
from mp4ds.streams.views import Crop, Resize


@dataclass(frozen=True)
class Frame:
    """One image of a stream.

    Attributes:
        data: Pixels in the encoding, shape as `mp4ds.layouts.Encoding.shape`, native byte order.
        index: Number of the frame in its stream.
        stamp_ns: Header stamp, nanoseconds.
        log_time_ns: When it was recorded, nanoseconds.
        frame_id: Coordinate frame.
        encoding: ROS image encoding of `data`.
        intrinsics: The calibration of `data`, or None where the recording has none.
    """

    data: Pixels
    index: int
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    encoding: str
    intrinsics: Calibration | None


Indices = Sequence[int] | NDArray[np.int64]


class Frames(ABC):
    """A sequence of frames, decoded when asked for.

    ``len(frames)``, ``frames[i]``, ``frames[-1]``, ``frames[a:b]`` and iteration work as on a
    list. Not to be shared between threads or over a fork.

    Where frames can be given otherwise than recorded:

    * ``format``: ``"native"`` in their ROS encoding; ``"rgb"`` and ``"bgr"``, shape (H, W, 3);
      ``"gray"``, shape (H, W). 16 bits stay 16 bits, a Bayer mosaic is interpolated, alpha is
      left out. Depths and other numbers are only given as ``"native"``.
    * ``crop``: x, y, width and height in pixels of the image, cut out first.
    * ``resize``: a factor, or width and height. Sizes are reduced by area and enlarged by bicubic
      interpolation; depths and other numbers take the nearest pixel. The frame's `intrinsics`
      are those of the picture given.
    """

    # ------------------------------------------------------------ what they are

    @property
    @abstractmethod
    def topic(self) -> str:
        """Topic of the images."""

    @property
    @abstractmethod
    def stamps(self) -> NDArray[np.int64]:
        """Header stamps, nanoseconds, shape (frames,)."""

    @property
    @abstractmethod
    def log_times(self) -> NDArray[np.int64]:
        """Log times, nanoseconds, shape (frames,)."""

    @property
    @abstractmethod
    def encoding(self) -> str:
        """ROS image encoding of the frames as recorded."""

    @property
    @abstractmethod
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame's pixels as recorded: (H, W), or (H, W, channels)."""
        return self._known_encoding.shape(*self.image_size)

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """Type of a frame's samples as recorded, native byte order."""
        return np.dtype(self._known_encoding.dtype)

    @property
    def _known_encoding(self) -> Encoding:
        return ENCODINGS[self.encoding]

    @property
    def calibrations(self) -> Sequence[Calibration]:
        """All calibrations, in the order in which they were first seen; none where not known."""
        return []

    @abstractmethod
    def intrinsics_at(self, index: int) -> Calibration | None:
        """The calibration that held when a frame was recorded.

        Args:
            index: 0 <= index < frames.
        """

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def close(self) -> None:
        """Close what is open of videos."""

    # ------------------------------------------------------------ by number

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        if isinstance(index, slice):
            return self.get(range(*index.indices(len(self))))
        return self.get((index,))[0]

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]: ...

    @abstractmethod
    def get(
        self,
        indices: Indices,
        *,
        format: str = "native",  # noqa: A002 - as users write it
        resize: Resize = None,
        crop: Crop = None,
    ) -> list[Frame]:
        """Frames by number, decoded in the order that costs least.

        Args:
            indices: In any order, also several times; negative ones count from the end.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Returns:
            One frame for each index, whose pixels are its own.

        Raises:
            IndexError: There is no such frame.
            OptionError: There is no such format, part or size, or not of these frames.
            VideoError: A frame cannot be decoded.
        """

    @abstractmethod
    def read(
        self,
        indices: Indices,
        *,
        format: str = "rgb",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
        out: Pixels | None = None,
    ) -> Pixels:
        """Pixels of frames by number, in one array.

        Args:
            indices: As for `get`.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.
            out: Where to write them, or None for a new array. Shape and type as returned.

        Returns:
            Shape (indices, H, W) or (indices, H, W, channels); `out`, if it was given.

        Raises:
            IndexError: There is no such frame.
            OptionError: As for `get`; or `out` has another shape or type.
            VideoError: A frame cannot be decoded.
        """

    # ------------------------------------------------------------ by stamp

    @cached_property
    def _by_stamp(self) -> StampIndex:
        return StampIndex(self.topic, self.stamps)

    def index_at(
        self, stamp_ns: int, *, mode: str = "nearest", tolerance_ns: int | None = None
    ) -> int:
        """Number of the frame that belongs to a time.

        Stamps need not be sorted. Of several frames with the same stamp it is the first in
        order, and of two that are equally near the earlier one.

        Args:
            stamp_ns: Nanoseconds.
            mode: ``nearest``; ``before``: the last at or before the time; ``after``: the first
                at or after it; ``exact``.
            tolerance_ns: Most nanoseconds between the frame and the time; None for any number.

        Raises:
            FrameNotFoundError: There is no such frame.
            OptionError: There is no such mode or tolerance.
        """
        return self._by_stamp.find(stamp_ns, mode=mode, tolerance_ns=tolerance_ns)

    def at(
        self,
        stamp_ns: int,
        *,
        mode: str = "nearest",
        tolerance_ns: int | None = None,
        format: str = "native",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> Frame:
        """The frame that belongs to a time.

        Args:
            stamp_ns: See `index_at`.
            mode: See `index_at`.
            tolerance_ns: See `index_at`.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Raises:
            FrameNotFoundError: There is no such frame.
            OptionError: An option is wrong; see `get` and `index_at`.
            VideoError: The frame cannot be decoded.
        """
        index = self.index_at(stamp_ns, mode=mode, tolerance_ns=tolerance_ns)
        return self.get((index,), format=format, resize=resize, crop=crop)[0]

    @abstractmethod
    def between(
        self,
        start_ns: int,
        end_ns: int,
        *,
        format: str = "native",  # noqa: A002
        resize: Resize = None,
        crop: Crop = None,
    ) -> Iterator[Frame]:
        """The frames with ``start_ns <= stamp < end_ns``, by stamp, decoded one by one.

        Args:
            start_ns: Nanoseconds.
            end_ns: Nanoseconds.
            format: See `Frames`.
            resize: See `Frames`.
            crop: See `Frames`.

        Raises:
            OptionError: An option is wrong; see `get`.
            VideoError: A frame cannot be decoded.
        """
