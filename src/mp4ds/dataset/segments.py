"""Streams of datasets that follow one another, joined to one: packets, columns, digests."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.columns import DecodedColumns, columns_model, digests_model
from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.stream import Stream
from mp4ds.errors import VideoError
from mp4ds.format.fields import (
    FORMAT_VERSION,
    MAX_CAMERA_INFOS,
    MAX_FRAMES,
    MAX_VARIANTS,
    Columns,
    exceeds_padding,
)
from mp4ds.format.models import (
    FACTS,
    Calibration,
    CameraInfo,
    ChannelModel,
    Header,
    Quality,
    StreamSidecar,
    video_facts,
)
from mp4ds.times import PresentationClock
from mp4ds.video.mp4 import read_sample_entry
from mp4ds.video.packets import cut_segment, join_segments

Integers = NDArray[np.int64]
_ModelT = TypeVar("_ModelT")
_BLOCK = 2**20


@dataclass(frozen=True)
class Cut:
    """What is copied of a stream.

    Attributes:
        dataset: Which it is of.
        stream: Of the dataset.
        images: Numbers of the frames.
        infos: Numbers of the calibrations.
    """

    dataset: Dataset
    stream: Stream
    images: Integers
    infos: Integers

    @property
    def has_all(self) -> bool:
        """Whether the whole video is copied."""
        return len(self.images) == len(self.stream)

    @cached_property
    def headers(self) -> list[Header]:
        """Those of its frames."""
        kinds = np.unique(self.stream.columns.variant[self.images])
        return [self.stream.sidecar.headers[kind] for kind in kinds.tolist()]

    @cached_property
    def calibrations(self) -> list[Calibration]:
        """Those of its camera."""
        infos = self.stream.infos
        if infos is None:
            return []
        kinds = np.unique(infos.columns.variant[self.infos])
        return [infos.info.calibrations[kind] for kind in kinds.tolist()]


class _Distinct(Generic[_ModelT]):
    """Distinct models, numbered in the order of their first appearance."""

    def __init__(self) -> None:
        # by their text, in which 0.0 and -0.0 differ, and NaNs are equal
        self._models: dict[str, _ModelT] = {}

    @property
    def items(self) -> list[_ModelT]:
        """All of them."""
        return list(self._models.values())

    def has_room(self, models: Iterable[_ModelT]) -> bool:
        """Whether they would not be too many with some more."""
        return len(self._models.keys() | set(map(repr, models))) <= MAX_VARIANTS

    def add(self, models: Iterable[_ModelT], of: Sequence[_ModelT]) -> list[int]:
        """Add models.

        Args:
            models: Those that are used.
            of: All that a file lists.

        Returns:
            The number here of each of the latter; 0 for those that are not used.
        """
        for model in models:
            self._models.setdefault(repr(model), model)
        numbers = {key: number for number, key in enumerate(self._models)}
        return [numbers.get(repr(model), 0) for model in of]


class _Columns:
    """Columns of segments, one after another."""

    def __init__(self) -> None:
        self._columns: dict[str, list[Integers]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(
        self, columns: DecodedColumns, rows: Integers, kinds: Sequence[int], ordinal: int
    ) -> None:
        """Add some rows.

        Args:
            columns: Of a segment.
            rows: Numbers of its rows.
            kinds: The new variant for each of its variants.
            ordinal: What is added to its ordinals.
        """
        for name in Columns.model_fields:
            array = getattr(columns, name)
            if array is not None:
                self._columns.setdefault(name, []).append(array[rows])
        self._columns["variant"][-1] = np.array(kinds, np.int64)[columns.variant[rows]]
        self._columns["ordinal"][-1] = columns.ordinal[rows] + ordinal
        self._count += len(rows)

    @cached_property
    def joined(self) -> dict[str, Integers]:
        """All rows, by column."""
        return {name: np.concatenate(arrays) for name, arrays in self._columns.items()}

    def ticks(self) -> list[int]:
        """When each frame is shown."""
        clock = PresentationClock()
        times = self.joined["log_time"].tolist()
        return list(map(clock.tick, self.joined["stamp"].tolist(), times))


class JoinedStream:
    """A stream of the new dataset: segments, in order."""

    def __init__(self, first: Cut) -> None:
        self.cuts: list[Cut] = []
        self._identity = _common(first.stream.sidecar)
        self._entry = read_sample_entry(first.stream.video_path)
        self._headers = _Distinct[Header]()
        self._columns = _Columns()
        self._info: CameraInfo | None = None
        self._calibrations = _Distinct[Calibration]()
        self._infos = _Columns()

    def takes(self, cut: Cut) -> bool:
        """Whether a segment continues this stream.

        Raises:
            VideoError: Its video is damaged.
        """
        sidecar, info = cut.stream.sidecar, cut.stream.sidecar.camera_info
        if sidecar.channel != self.cuts[0].stream.sidecar.channel:
            return False  # most often: the rest takes longer to compare
        if cut.dataset is self.cuts[-1].dataset or _common(sidecar) != self._identity:
            return False
        if cut.stream.hidden_frames or self.cuts[0].stream.hidden_frames:
            return False  # what a slice hides refers to nothing in another segment
        if exceeds_padding(head.padding for head in (*self._headers.items, *cut.headers)):
            return False
        if not self._headers.has_room(cut.headers):
            return False
        if len(self._columns) + len(cut.images) > MAX_FRAMES:
            return False
        if self._entry.differences(read_sample_entry(cut.stream.video_path)):
            return False  # JPEG files may differ in chroma subsampling
        if info is None or self._info is None:
            return True
        return (
            info.channel == self._info.channel
            and info.wire == self._info.wire
            and self._calibrations.has_room(cut.calibrations)
            and len(self._infos) + len(cut.infos) <= MAX_CAMERA_INFOS
        )

    def add(self, cut: Cut, offset: Callable[[ChannelModel], int]) -> None:
        """Add a segment that `takes` accepts.

        Args:
            cut: The segment.
            offset: What to add to the ordinals of a channel's messages.
        """
        self.cuts.append(cut)
        stream, sidecar = cut.stream, cut.stream.sidecar
        kinds = self._headers.add(cut.headers, sidecar.headers)
        self._columns.add(stream.columns, cut.images, kinds, offset(sidecar.channel))
        infos = stream.infos
        if infos is not None and len(cut.infos):
            self._info = self._info or infos.info
            kinds = self._calibrations.add(cut.calibrations, infos.info.calibrations)
            self._infos.add(infos.columns, cut.infos, kinds, offset(infos.info.channel))

    def write(self, stem: str, folder: Path) -> StreamSidecar:
        """Write the video; the sidecar is returned.

        Raises:
            VideoError: A segment is damaged.
            OSError: It cannot be written.
        """
        first = self.cuts[0].stream
        codec = first.sidecar.video.codec
        path = folder / f"{stem}.mp4"
        self._write_video(path)
        facts = video_facts(path, codec)
        is_copy = len(self.cuts) == 1 and self.cuts[0].has_all
        if is_copy and first.sidecar.video.sha256 not in (None, facts["sha256"]):
            raise VideoError(
                "hash-mismatch", first.video_path, "does not match the SHA-256 in its sidecar"
            )
        qualities = [
            (quality.of(cut.images, len(cut.stream)), len(cut.images))
            for cut in self.cuts
            if (quality := cut.stream.sidecar.video.quality) is not None
        ]
        if qualities:
            alone = len(qualities) == 1
            facts["quality"] = qualities[0][0] if alone else Quality.joined(qualities)
        digests = [
            own.decode(len(cut.stream))[cut.images]
            for cut in self.cuts
            if (own := cut.stream.sidecar.digests) is not None
        ]
        return first.sidecar.model_copy(
            update={
                "mp4ds": FORMAT_VERSION,
                "frames": len(self._columns),
                "headers": self._headers.items,
                "video": first.sidecar.video.model_copy(update=facts),
                "camera_info": self._camera_info(),
                "columns": columns_model(self._columns.joined),
                "digests": digests_model(np.concatenate(digests).tolist()) if digests else None,
            }
        )

    def _write_video(self, path: Path) -> None:
        if len(self.cuts) > 1:
            for cut in self.cuts:
                cut.stream.verify_video()
            join_segments([cut.stream.video_path for cut in self.cuts], self._columns.ticks(), path)
            return
        (cut,) = self.cuts
        if cut.has_all:
            copy_file(cut.stream.video_path, path)
        else:
            frames = range(int(cut.images[0]), int(cut.images[-1]) + 1)
            codec = cut.stream.sidecar.video.codec
            cut_segment(cut.stream.video_path, codec, frames, self._columns.ticks(), path)

    def _camera_info(self) -> CameraInfo | None:
        if self._info is None:
            return None
        return self._info.model_copy(
            update={
                "messages": len(self._infos),
                "calibrations": self._calibrations.items,
                "columns": columns_model(self._infos.joined),
            }
        )


def _common(sidecar: StreamSidecar) -> tuple[object, ...]:
    """What all segments of a stream have in common."""
    video = sidecar.video.model_dump(exclude={*FACTS, "quality"})
    return (
        *(sidecar.profile, sidecar.stamps, sidecar.channel, sidecar.wire, sidecar.body),
        *(sidecar.image, video, sidecar.digests is None, sidecar.video.quality is None),
        *(name in sidecar.columns.names() for name in ("seq", "pts")),
    )


def copy_file(path: Path, to: Path) -> None:
    """Copy a file, which may be at a URL."""
    with path.open("rb") as source, to.open("wb") as target:
        shutil.copyfileobj(source, target, _BLOCK)
