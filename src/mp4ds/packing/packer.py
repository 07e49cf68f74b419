"""One pack: every record of the recording to its place, then the manifest."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from mp4ds._version import __version__
from mp4ds.bags import BagReader, BagWriter, SourceHasher, open_writer
from mp4ds.coded import zlib_build
from mp4ds.engine import Workers
from mp4ds.outputs import digest_file
from mp4ds.packing.calibrations import Calibrations
from mp4ds.packing.cameras import Cameras
from mp4ds.packing.report import PackOptions, PackProgress, PackSummary, TopicSummary
from mp4ds.plan import Quality, Selection
from mp4ds.records import Attachment, Channel, Message, Record
from mp4ds.sidecar import (
    FORMAT_VERSION,
    MANIFEST_NAME,
    MESSAGES_NAME,
    FileEntry,
    Manifest,
    Source,
    StaticTransform,
    StreamEntry,
    StreamSidecar,
    TimeRange,
    Verbatim,
    dump_document,
)
from mp4ds.streams import StreamSettings, StreamWriter
from mp4ds.video import tool_versions
from mp4ds.wire import is_calibration, is_camera
from mp4ds.wire.transforms import TransformCollector

_REPORT_SECONDS = 0.1


class Packer:
    """Packs one recording into a folder.

    Args:
        reader: The recording, open.
        folder: The folder to fill, empty.
        options: How.
        quality: The options' quality, parsed.
        progress: Called several times a second, if given.
    """

    _verbatim: BagWriter  # messages.mcap, open while `run` reads

    def __init__(
        self,
        reader: BagReader,
        folder: Path,
        options: PackOptions,
        quality: Quality,
        progress: Callable[[PackProgress], None] | None,
    ) -> None:
        self._reader = reader
        self._folder = folder
        self._options = options
        self._progress = progress
        self._next_report = 0.0
        self._selected = Selection(options.topics, options.exclude)
        self._topics: dict[str, TopicSummary] = {}
        self._left_out: dict[str, None] = {}
        self._declared: set[int] = set()
        self._span: tuple[int, int] | None = None
        self._transforms = TransformCollector()
        self._total = sum(path.stat().st_size for path in reader.files)
        cores = options.jobs or os.cpu_count() or 1
        cameras = sum(map(is_camera, reader.channels)) or 1
        self._jobs = min(cores, cameras)
        self._calibrations = Calibrations(
            [channel for channel in reader.channels if self._selected(channel.topic)],
            options.camera_info,
            topic_of=self._topic,
            keep=self._keep,
        )
        self._cameras = Cameras(
            reader,
            folder,
            StreamSettings(
                quality=quality,
                codec=options.codec,
                preset=options.preset,
                gop=options.gop,
                threads=max(1, -(-cores // self._jobs)),
                transcode=options.transcode,
            ),
            self._calibrations,
            topic_of=self._topic,
            keep=self._keep,
        )

    def run(self, target: Path) -> PackSummary:
        """Pack everything; the manifest is written last.

        Args:
            target: The folder's final name, for the summary.
        """
        self._selected.check(channel.topic for channel in self._reader.channels)
        hasher = SourceHasher(self._reader.path, self._reader.files)
        messages_path = self._folder / MESSAGES_NAME
        try:
            with open_writer(
                messages_path,
                "mcap",
                name=MESSAGES_NAME,
                profile=self._reader.profile,
                library="",
                storage="",
            ) as self._verbatim:
                self._read(hasher)
            streams = self._cameras.finish(digest_file)
        except BaseException:
            self._cameras.abandon()
            raise
        hasher.advance(None)
        manifest = self._manifest(hasher, streams)
        (self._folder / MANIFEST_NAME).write_bytes(dump_document(manifest))
        self._report(done=True)
        return PackSummary(
            dataset=target,
            topics=list(self._topics.values()),
            source_bytes=self._total,
            dataset_bytes=_folder_size(self._folder),
            messages_bytes=messages_path.stat().st_size,
            left_out=list(self._left_out),
            skipped=dict(self._reader.skipped),
        )

    def _read(self, hasher: SourceHasher) -> None:
        with Workers(self._jobs if self._jobs > 1 else 0) as workers:
            for record in self._reader.records():
                self._take(record, workers)
                hasher.advance(self._reader.position)
                self._report()
            self._cameras.settle(workers)
        self._calibrations.finish()
        # channels without any message are part of the recording too
        in_videos = self._cameras.in_videos() | self._calibrations.in_sidecars()
        for channel in self._reader.channels:
            if not self._selected(channel.topic):
                self._left_out[channel.topic] = None
            elif channel.identity not in in_videos:
                self._topic(channel)
                self._declare(channel)
        for schema in self._reader.unused_schemas:
            self._verbatim.add_schema(schema)

    def _take(self, record: Record, workers: Workers) -> None:
        if isinstance(record, Attachment):
            self._verbatim.add_attachment(record)
            return
        if not isinstance(record, Message):
            self._verbatim.add_metadata(record)
            return
        channel = record.channel
        if not self._selected(channel.topic):
            self._left_out[channel.topic] = None
            return
        topic = self._topic(channel)
        topic.messages += 1
        topic.raw_bytes += len(record.data)
        start, end = self._span or (record.log_time, record.log_time)
        self._span = (min(start, record.log_time), max(end, record.log_time))
        self._transforms.add(channel, record.data)
        if is_camera(channel):
            self._cameras.take(record, workers)
        elif is_calibration(channel):
            self._calibrations.take(record)
        else:
            self._keep(record)

    def _topic(self, channel: Channel) -> TopicSummary:
        if channel.topic not in self._topics:
            self._topics[channel.topic] = TopicSummary(channel.topic, channel.type_name)
        return self._topics[channel.topic]

    def _keep(self, message: Message) -> None:
        self._declare(message.channel)
        self._verbatim.write(message)

    def _declare(self, channel: Channel) -> None:
        if channel.id not in self._declared:
            self._declared.add(channel.id)
            self._verbatim.add_channel(channel)

    def _manifest(
        self, hasher: SourceHasher, streams: list[tuple[StreamWriter, StreamSidecar]]
    ) -> Manifest:
        digests = {
            sidecar.video.file: (sidecar.video.size or 0, sidecar.video.sha256 or "")
            for _, sidecar in streams
        }
        for name in (MESSAGES_NAME, *(stream.sidecar_path.name for stream, _ in streams)):
            digests[name] = digest_file(self._folder / name)
        return Manifest(
            mp4ds=FORMAT_VERSION,
            kind="dataset",
            profile=self._options.quality,
            format=self._reader.format,
            recording_profile=self._reader.profile,
            library=self._reader.library,
            sources=[
                Source(name=name, size=size, sha256=sha256) for name, size, sha256 in hasher.digests
            ],
            messages=sum(topic.messages for topic in self._topics.values()),
            topics_left_out=list(self._left_out),
            time_range=TimeRange(start=self._span[0], end=self._span[1]) if self._span else None,
            streams=[
                StreamEntry(
                    topic=stream.channel.topic,
                    sidecar=stream.sidecar_path.name,
                    video=sidecar.video.file,
                    frames=sidecar.frames,
                )
                for stream, sidecar in streams
            ],
            transforms=[
                StaticTransform.from_record(transform)
                for transform in self._transforms.between(_frame_ids(streams))
            ],
            verbatim=[
                Verbatim(topic=topic.topic, messages=count, first=first, reason=reason)
                for topic in self._topics.values()
                for reason, (count, first) in topic.verbatim.items()
            ],
            files=[
                FileEntry(name=name, size=size, sha256=sha256)
                for name, (size, sha256) in sorted(digests.items())
            ],
            tools={"mp4ds": __version__, **tool_versions(), "zlib": zlib_build()},
        )

    def _report(self, *, done: bool = False) -> None:
        now = time.monotonic()
        if self._progress is None or (now < self._next_report and not done):
            return
        self._next_report = now + _REPORT_SECONDS
        self._progress(
            PackProgress(
                bytes_read=self._total if done else min(self._reader.position, self._total),
                bytes_total=self._total,
                bytes_written=_folder_size(self._folder),
                frames=self._cameras.frames,
            )
        )


def _frame_ids(streams: list[tuple[StreamWriter, StreamSidecar]]) -> set[str]:
    """Coordinate frames of all images and calibrations."""
    found: set[str] = set()
    for _, sidecar in streams:
        found.update(header.frame_id for header in sidecar.headers)
        if sidecar.camera_info:
            found.update(item.frame_id for item in sidecar.camera_info.calibrations)
    return found


def _folder_size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.iterdir())
