"""Packs one part of a recording: images into videos, all the rest verbatim."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from mp4ds.bags import BagReader, BagWriter
from mp4ds.bags.mcap_write import McapWriter
from mp4ds.bags.salvage import losses_of
from mp4ds.engine import Workers
from mp4ds.packing.calibrations import Calibrations
from mp4ds.packing.cameras import Cameras, Exact
from mp4ds.packing.manifest import declare_rest
from mp4ds.packing.part import Part
from mp4ds.packing.survey import Survey
from mp4ds.plan import Selection
from mp4ds.records import EVERYTHING, Attachment, Excerpt, Message, Record
from mp4ds.streams import OutOfReachError, StreamKey, StreamSettings
from mp4ds.wire import is_calibration, is_camera
from mp4ds.wire.transforms import TransformCollector

_Made = TypeVar("_Made")


@dataclass(frozen=True)
class PartSettings:
    """How a part is packed.

    Attributes:
        streams: How its streams are encoded.
        selected: Whether a topic is packed.
        excerpt: What of the recording it is made from.
        survey: What all parts agree on; None where there is but one part.
        camera_info: Pairs of topics that the user names, ``IMAGE=INFO``.
        workers: Streams that are encoded side by side.
        compression: Of messages.mcap.
        is_whole: Whether there are no other parts.
        exact: Streams that are made lossless, since a score is out of their reach, and why.
    """

    streams: StreamSettings
    selected: Selection
    excerpt: Excerpt = EVERYTHING
    survey: Survey | None = None
    camera_info: tuple[str, ...] = ()
    workers: int = 1
    compression: str = "zstd"
    is_whole: bool = True
    exact: Exact = field(default_factory=dict)


def until_in_reach(make: Callable[[Exact], _Made]) -> _Made:
    """Pack; and again, with other streams lossless, while one cannot have the score asked for.

    Args:
        make: Packs, beginning anew each time; given the streams that are to be lossless.
    """
    exact: dict[tuple[int, StreamKey], str] = {}
    while True:
        try:
            return make(exact)
        except OutOfReachError as error:
            if error.stream in exact:
                raise
            exact = {**exact, error.stream: error.reason}


class Packer:
    """Packs an excerpt of a recording into a folder.

    Args:
        reader: The recording, open.
        folder: The folder to fill, empty.
        settings: How.
        progress: Called after each record with what was packed so far.
    """

    _verbatim: BagWriter  # messages.mcap, open while `run` reads

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        settings: PartSettings,
        progress: Callable[[Part], None] | None = None,
    ) -> None:
        self._reader = reader
        self._settings = settings
        self._progress = progress
        self._transforms = TransformCollector()
        self._part = Part(folder)
        survey = settings.survey
        self._calibrations = Calibrations(
            [channel for channel in reader.channels if settings.selected(channel.topic)],
            settings.camera_info,
            survey.pairs if survey else None,
            topic_of=self._part.topic,
            keep=self._keep,
        )
        self._cameras = Cameras(
            reader,
            folder,
            settings.streams,
            self._calibrations,
            survey,
            topic_of=self._part.topic,
            keep=self._keep,
            exact=settings.exact,
        )

    def run(self) -> Part:
        """Pack everything of the excerpt.

        Raises:
            SourceError: The recording is damaged.
            OutOfReachError: A stream cannot have the score that was asked for.
            OSError: The disk refused.
        """
        part = self._part
        try:
            with McapWriter(
                part.messages_path,
                profile=self._reader.profile,
                compression=self._settings.compression,
            ) as self._verbatim:
                self._read()
                part.streams = self._cameras.finish()
                if self._settings.is_whole:
                    declare_rest(part, self._reader, self._settings.selected, self._verbatim)
        except BaseException:
            self._cameras.abandon()
            raise
        part.transforms = self._transforms.transforms
        return part

    def _read(self) -> None:
        excerpt, count = self._settings.excerpt, self._settings.workers
        with Workers(count if count > 1 else 0) as workers:
            for record in self._reader.records(excerpt):
                self._take(record, workers)
                if self._progress is not None:
                    self._progress(self._part)
            self._cameras.settle(workers)
        self._calibrations.finish()
        if excerpt.others:
            self._part.skipped = dict(self._reader.skipped)
            self._part.losses = list(losses_of(self._reader))

    def _take(self, record: Record, workers: Workers) -> None:
        part = self._part
        if isinstance(record, Attachment):
            self._verbatim.add_attachment(record)
            return
        if not isinstance(record, Message):
            self._verbatim.add_metadata(record)
            return
        channel = record.channel
        if not self._settings.selected(channel.topic):
            part.left_out[channel.topic] = None
            return
        part.counts[channel.id] = part.counts.get(channel.id, 0) + 1
        topic = part.topic(channel)
        topic.messages += 1
        topic.raw_bytes += len(record.data)
        part.saw([record.log_time])
        self._transforms.add(channel, record.data)
        if is_camera(channel):
            self._cameras.take(record, workers)
        elif is_calibration(channel):
            self._calibrations.take(record)
        else:
            self._keep(record)

    def _keep(self, message: Message) -> None:
        self._verbatim.add_channel(message.channel)
        self._verbatim.write(message)
