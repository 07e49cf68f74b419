"""Segments of a stream, packed apart, into one video and its sidecar, without encoding."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.sidecar import (
    Calibration,
    CameraInfo,
    Columns,
    Digests,
    Header,
    Quality,
    StreamSidecar,
)
from mp4ds.sidecar.fields import MAX_CAMERA_INFOS, MAX_FRAMES, MAX_VARIANTS, exceeds_padding
from mp4ds.stamps import PresentationClock
from mp4ds.streams.columns import columns_model, digests_model
from mp4ds.streams.facts import FACTS, video_facts
from mp4ds.video import join_segments, read_sample_entry

_ModelT = TypeVar("_ModelT")


class StreamJoin:
    """Collects the segments of one stream, in order.

    Args:
        sidecar: Of the first segment; `add` is still to be called for it.
        video: Its video.
    """

    def __init__(self, sidecar: StreamSidecar, video: Path) -> None:
        self._first = sidecar
        self._entry = read_sample_entry(video)
        self._identity = _identity(sidecar)
        self._videos: list[Path] = []
        self._digests: list[NDArray[np.uint64]] = []
        self._columns = _JoinedColumns()
        self._headers = _Numbered[Header]()
        self._infos = _JoinedColumns()
        self._calibrations = _Numbered[Calibration]()
        self._info: CameraInfo | None = None
        self._qualities: list[tuple[Quality, int]] = []

    def takes(self, sidecar: StreamSidecar, video: Path) -> bool:
        """Whether a segment continues this stream.

        Raises:
            VideoError: Its video is damaged.
        """
        info = sidecar.camera_info
        if _identity(sidecar) != self._identity or not self._headers.has_room(sidecar.headers):
            return False
        if exceeds_padding(head.padding for head in (*self._headers.items, *sidecar.headers)):
            return False
        if len(self._columns) + sidecar.frames > MAX_FRAMES:
            return False
        if self._entry.differences(read_sample_entry(video)):
            return False  # files of JPEG may differ in how their colours are sampled
        if info is None or self._info is None:
            return True
        return (
            info.channel == self._info.channel
            and info.wire == self._info.wire
            and self._calibrations.has_room(info.calibrations)
            and len(self._infos) + info.messages <= MAX_CAMERA_INFOS
        )

    def add(
        self, sidecar: StreamSidecar, video: Path, *, ordinal: int, info_ordinal: int = 0
    ) -> None:
        """Take a segment that `takes` did not refuse.

        Args:
            sidecar: Of the segment.
            video: Its video.
            ordinal: Messages of the channel before those that the segment was made from.
            info_ordinal: The same of the calibration channel.
        """
        self._videos.append(video)
        variants = self._headers.add(sidecar.headers)
        self._columns.add(sidecar.columns, sidecar.frames, variants, ordinal)
        if sidecar.digests is not None:
            self._digests.append(sidecar.digests.decode(sidecar.frames))
        if sidecar.video.quality is not None:
            self._qualities.append((sidecar.video.quality, sidecar.frames))
        info = sidecar.camera_info
        if info is not None and info.columns is not None:
            self._info = self._info or info
            variants = self._calibrations.add(info.calibrations)
            self._infos.add(info.columns, info.messages, variants, info_ordinal)

    def finish(self, stem: str, folder: Path) -> StreamSidecar:
        """Write the video.

        Args:
            stem: Its file name, without ending.
            folder: Where.

        Returns:
            The sidecar, not written yet.

        Raises:
            VideoError: A segment is damaged.
            OSError: The disk refused.
        """
        path = folder / f"{stem}.mp4"
        columns = self._columns.to_model()
        join_segments(self._videos, self._columns.ticks(), path)
        made = video_facts(path, self._first.video.codec)
        if self._qualities:
            made["quality"] = Quality.joined(self._qualities)
        return self._first.model_copy(
            update={
                "frames": len(self._columns),
                "headers": self._headers.items,
                "video": self._first.video.model_copy(update=made),
                "camera_info": self._camera_info(),
                "columns": columns,
                "digests": self._digests_model(),
            }
        )

    def _camera_info(self) -> CameraInfo | None:
        if self._info is None:
            return None
        return self._info.model_copy(
            update={
                "messages": len(self._infos),
                "calibrations": self._calibrations.items,
                "columns": self._infos.to_model(),
            }
        )

    def _digests_model(self) -> Digests | None:
        if not self._digests:
            return None
        return digests_model(np.concatenate(self._digests).tolist())


def _identity(sidecar: StreamSidecar) -> tuple[object, ...]:
    """What all segments of a stream have in common."""
    video = sidecar.video.model_dump(exclude={*FACTS, "quality"})
    return (
        *(sidecar.profile, sidecar.stamps, sidecar.channel, sidecar.wire, sidecar.body),
        *(sidecar.image, video, sidecar.digests is None, sidecar.video.quality is None),
        *(name in sidecar.columns.names() for name in ("seq", "pts")),
    )


class _Numbered(Generic[_ModelT]):
    """Distinct models, by the number of their first appearance."""

    def __init__(self) -> None:
        self.items: list[_ModelT] = []
        self._numbers: dict[str, int] = {}

    def has_room(self, models: Sequence[_ModelT]) -> bool:
        new = {key for key in map(_key, models) if key not in self._numbers}
        return len(self.items) + len(new) <= MAX_VARIANTS

    def add(self, models: Sequence[_ModelT]) -> NDArray[np.int64]:
        """The number of each here, shape (len(models),)."""
        numbers = np.empty(len(models), np.int64)
        for place, model in enumerate(models):
            key = _key(model)
            if key not in self._numbers:
                self._numbers[key] = len(self.items)
                self.items.append(model)
            numbers[place] = self._numbers[key]
        return numbers


def _key(model: object) -> str:
    # by its text, in which 0.0 and -0.0 differ, and a NaN is like another
    return repr(model)


class _JoinedColumns:
    """Columns of segments, one after the other."""

    def __init__(self) -> None:
        self._columns: dict[str, list[NDArray[np.int64]]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, columns: Columns, count: int, variants: NDArray[np.int64], ordinal: int) -> None:
        values = {name: getattr(columns, name).decode(count) for name in columns.names()}
        values.setdefault("publish_time", values["log_time"])
        values.setdefault("sequence", np.zeros(count, np.int64))
        values["variant"] = variants[values.get("variant", np.zeros(count, np.int64))]
        values["ordinal"] = values.get("ordinal", np.arange(count)) + ordinal
        for name, array in values.items():
            self._columns.setdefault(name, []).append(array)
        self._count += count

    def _joined(self) -> dict[str, NDArray[np.int64]]:
        return {name: np.concatenate(arrays) for name, arrays in self._columns.items()}

    def to_model(self) -> Columns:
        return columns_model(self._joined())

    def ticks(self) -> list[int]:
        clock = PresentationClock()
        joined = self._joined()
        return list(map(clock.tick, joined["stamp"].tolist(), joined["log_time"].tolist()))
