"""Streams of datasets that follow one another, joined to one: packets, columns, digests."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

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
    Header,
    Quality,
    StreamSidecar,
    video_facts,
)
from mp4ds.times import PresentationClock
from mp4ds.video.mp4 import read_sample_entry
from mp4ds.video.packets import cut_segment, join_segments

Integers = NDArray[np.int64]
_BLOCK = 2**20


@dataclass(frozen=True)
class Segment:
    """What is copied of a stream.

    Attributes:
        dataset: Which it is of.
        stream: Of the dataset.
        images: Numbers of the frames.
        infos: Numbers of the calibrations.
        offsets: What is added to the ordinals of images, and of calibrations.
    """

    dataset: Dataset
    stream: Stream
    images: Integers
    infos: Integers
    offsets: tuple[int, int] = (0, 0)

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


class JoinedStream:
    """A stream of the new dataset: segments, in order."""

    def __init__(self, first: Segment) -> None:
        self.segments: list[Segment] = []
        self._identity = _common(first.stream.sidecar)
        self._entry = read_sample_entry(first.stream.video_path)
        # by their text, in which 0.0 and -0.0 differ, and NaNs are equal
        self._headers: dict[str, Header] = {}
        self._calibrations: dict[str, Calibration] = {}
        self._frames = self._infos = 0
        self._info: CameraInfo | None = None
        self.add(first)

    @property
    def first(self) -> Stream:
        """The stream that it begins with."""
        return self.segments[0].stream

    def takes(self, segment: Segment) -> bool:
        """Whether a segment continues this stream.

        Raises:
            VideoError: Its video is damaged.
        """
        stream, sidecar = segment.stream, segment.stream.sidecar
        if sidecar.channel != self.first.sidecar.channel:
            return False  # most often: the rest takes longer to compare
        if segment.dataset is self.segments[-1].dataset or _common(sidecar) != self._identity:
            return False
        if stream.hidden_frames or self.first.hidden_frames:
            return False  # what a slice hides refers to nothing in another segment
        headers = [*self._headers.values(), *segment.headers]
        if exceeds_padding(head.padding for head in headers):
            return False
        if not _has_room(self._headers, segment.headers):
            return False
        if self._frames + len(segment.images) > MAX_FRAMES:
            return False
        if self._entry.differences(read_sample_entry(stream.video_path)):
            return False  # JPEG files may differ in chroma subsampling
        info = sidecar.camera_info
        if info is None or self._info is None:
            return True
        return (
            info.channel == self._info.channel
            and info.wire == self._info.wire
            and _has_room(self._calibrations, segment.calibrations)
            and self._infos + len(segment.infos) <= MAX_CAMERA_INFOS
        )

    def add(self, segment: Segment) -> None:
        """Add the first segment, or one that it `takes`."""
        self.segments.append(segment)
        self._frames += len(segment.images)
        for header in segment.headers:
            self._headers.setdefault(repr(header), header)
        info = segment.stream.sidecar.camera_info
        if info is not None and (not info.messages or len(segment.infos)):
            self._info = self._info or info
            self._infos += len(segment.infos)
            for calibration in segment.calibrations:
                self._calibrations.setdefault(repr(calibration), calibration)

    @cached_property
    def _columns(self) -> dict[str, Integers]:
        return _joined(
            [
                (part.stream.columns, part.images, part.stream.sidecar.headers, part.offsets[0])
                for part in self.segments
            ],
            self._headers,
        )

    def write(self, stem: str, folder: Path) -> StreamSidecar:
        """Write the video; the sidecar is returned.

        Raises:
            VideoError: A segment is damaged.
            OSError: It cannot be written.
        """
        first = self.first
        codec = first.sidecar.video.codec
        path = folder / f"{stem}.mp4"
        self._write_video(path)
        facts = video_facts(path, codec)
        is_copy = len(self.segments) == 1 and self.segments[0].has_all
        if is_copy and first.sidecar.video.sha256 not in (None, facts["sha256"]):
            raise VideoError(
                "hash-mismatch", first.video_path, "does not match the SHA-256 in its sidecar"
            )
        qualities = [
            (quality.of(part.images, len(part.stream)), len(part.images))
            for part in self.segments
            if (quality := part.stream.sidecar.video.quality) is not None
        ]
        if qualities:
            alone = len(qualities) == 1
            facts["quality"] = qualities[0][0] if alone else Quality.joined(qualities)
        digests = [
            own.decode(len(part.stream))[part.images]
            for part in self.segments
            if (own := part.stream.sidecar.digests) is not None
        ]
        return first.sidecar.model_copy(
            update={
                "mp4ds": FORMAT_VERSION,
                "frames": self._frames,
                "headers": list(self._headers.values()),
                "video": first.sidecar.video.model_copy(update=facts),
                "camera_info": self._camera_info(),
                "columns": columns_model(self._columns),
                "digests": digests_model(np.concatenate(digests).tolist()) if digests else None,
            }
        )

    def _write_video(self, path: Path) -> None:
        if len(self.segments) > 1:
            for part in self.segments:
                part.stream.verify_video()
            join_segments([part.stream.video_path for part in self.segments], self._ticks(), path)
            return
        (part,) = self.segments
        if part.has_all:
            copy_file(part.stream.video_path, path)
        else:
            frames = range(int(part.images[0]), int(part.images[-1]) + 1)
            cut_segment(part.stream.video_path, frames, self._ticks(), path)

    def _ticks(self) -> list[int]:
        """When each frame is shown."""
        clock = PresentationClock()
        stamps, log_times = self._columns["stamp"], self._columns["log_time"]
        return list(map(clock.tick, stamps.tolist(), log_times.tolist()))

    def _camera_info(self) -> CameraInfo | None:
        if self._info is None or not self._infos:
            return self._info  # with calibrations that no message told
        columns = _joined(
            [
                (infos.columns, part.infos, infos.info.calibrations, part.offsets[1])
                for part in self.segments
                if (infos := part.stream.infos) is not None
            ],
            self._calibrations,
        )
        return self._info.model_copy(
            update={
                "messages": self._infos,
                "calibrations": list(self._calibrations.values()),
                "columns": columns_model(columns),
            }
        )


def _has_room(known: Mapping[str, object], models: Iterable[object]) -> bool:
    """Whether there would not be too many with some more."""
    return len(known.keys() | set(map(repr, models))) <= MAX_VARIANTS


_Rows = tuple[DecodedColumns, Integers, Sequence[object], int]
"""Columns of a segment, the rows copied, its models, and what is added to the ordinals."""


def _joined(segments: Sequence[_Rows], models: Mapping[str, object]) -> dict[str, Integers]:
    """The columns of segments, one after another, whose variants are numbers of the models."""
    numbers = {key: number for number, key in enumerate(models)}
    columns: dict[str, list[Integers]] = {}
    for own, rows, variants, offset in segments:
        for name in Columns.model_fields:
            if (array := getattr(own, name)) is not None:
                columns.setdefault(name, []).append(array[rows])
        # those that are not used have no number
        kinds = np.array([numbers.get(repr(model), 0) for model in variants], np.int64)
        columns["variant"][-1] = kinds[columns["variant"][-1]]
        columns["ordinal"][-1] = columns["ordinal"][-1] + offset
    return {name: np.concatenate(arrays) for name, arrays in columns.items()}


def _common(sidecar: StreamSidecar) -> tuple[object, ...]:
    """What all segments of a stream have in common."""
    video, info = sidecar.video.model_dump(exclude={*FACTS, "quality"}), sidecar.camera_info
    return (
        info if info and not info.messages else None,  # nothing tells when one applied
        *(sidecar.profile, sidecar.stamps, sidecar.channel, sidecar.wire, sidecar.body),
        *(sidecar.image, video, sidecar.digests is None, sidecar.video.quality is None),
        *(name in sidecar.columns.names() for name in ("seq", "pts")),
    )


def copy_file(path: Path, to: Path) -> None:
    """Copy a file, which may be at a URL."""
    with path.open("rb") as source, to.open("wb") as target:
        shutil.copyfileobj(source, target, _BLOCK)
