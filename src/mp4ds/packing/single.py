"""Packs a recording in one pass: a short one, or one without an index."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from mp4ds.bags import BagReader, SourceHasher
from mp4ds.packing.cameras import Exact
from mp4ds.packing.job import Job
from mp4ds.packing.manifest import folder_size, summarize, write_manifest
from mp4ds.packing.packer import Packer
from mp4ds.packing.part import Part
from mp4ds.packing.report import PackProgress, PackSummary
from mp4ds.source_files import source_size, unchanged
from mp4ds.wire import is_camera

_REPORT_SECONDS = 0.1


def pack_in_one_pass(
    reader: BagReader,
    job: Job,
    folder: Path,
    target: Path,
    report: Callable[[PackProgress], None] | None,
    exact: Exact,
) -> PackSummary:
    """Pack a whole recording; its files are hashed while they are read.

    Args:
        reader: The recording.
        job: Of one task.
        folder: The folder to fill, empty.
        target: Its final name.
        report: Told of progress several times a second.
        exact: Streams that are made lossless, since a score is out of their reach.

    Raises:
        SourceError: The recording is damaged, or changed while it was read.
        OutOfReachError: A stream cannot have the score that was asked for.
        OSError: The disk refused.
    """
    total = sum(map(source_size, reader.files))
    stats = reader.stats()
    counts: dict[str, int | None] = {}
    for channel in filter(is_camera, reader.channels):
        count = stats[channel.id].count if channel.id in stats else None
        known = counts.get(channel.topic, 0)
        counts[channel.topic] = None if count is None or known is None else known + count
    next_report = 0.0

    def progress(part: Part, *, done: bool = False) -> None:
        nonlocal next_report
        hasher.advance(reader.position)
        now = time.monotonic()
        if report is None or (now < next_report and not done):
            return
        next_report = now + _REPORT_SECONDS
        report(
            PackProgress(
                dataset=target,
                phase="packing",
                done=1.0 if done else min(1.0, reader.position / max(1, total)),
                bytes_read=sum(topic.raw_bytes for topic in part.topics.values()),
                bytes_total=total,
                bytes_written=folder_size(folder),
                topics={
                    name: (topic.messages, counts[name])
                    for name, topic in part.topics.items()
                    if name in counts
                },
            )
        )

    (task,) = (task for task in job.tasks if task.whole)
    with unchanged(job.sources), SourceHasher(reader.path, reader.files) as hasher:
        part = Packer(reader, folder, job.settings(task, exact), progress).run()
        hasher.advance(None)
    write_manifest(part, reader, hasher.digests, job.options["quality"])
    progress(part, done=True)
    return summarize(part, target, total)
