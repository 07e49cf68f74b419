"""What completes a dataset: the channels that had no messages, and the manifest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from mp4ds._version import __version__
from mp4ds.bags import BagReader, BagWriter
from mp4ds.bags.protocols import Format
from mp4ds.coded import zlib_build
from mp4ds.errors import FormatError, SourceError
from mp4ds.outputs import digest_file
from mp4ds.packing.part import Part
from mp4ds.packing.report import PackSummary
from mp4ds.sidecar import (
    FORMAT_VERSION,
    MANIFEST_NAME,
    MESSAGES_NAME,
    ChannelModel,
    FileEntry,
    LossEntry,
    Manifest,
    Source,
    StaticTransform,
    StreamEntry,
    TimeRange,
    Verbatim,
    dump_document,
    load_manifest,
)
from mp4ds.video import tool_versions
from mp4ds.wire.transforms import TransformCollector

_LARGER = 1.05  # than its source: more is to be explained


class Recorded(Protocol):
    """What a manifest tells of a recording. See `BagReader`."""

    @property
    def format(self) -> Format:
        """``bag``, ``rosbag2`` or ``mcap``."""
        ...

    @property
    def profile(self) -> str:
        """``ros1``, ``ros2`` or any other MCAP profile; empty for none."""
        ...

    @property
    def library(self) -> str:
        """The MCAP header's library string; empty for other formats."""
        ...


def declare_rest(
    part: Part, reader: BagReader, selected: Callable[[str], bool], writer: BagWriter
) -> None:
    """Keep what the recording declares beside its messages.

    Args:
        part: All that was packed; gets the topics without messages.
        reader: The recording, read.
        selected: Whether a topic is packed.
        writer: Of messages.mcap.
    """
    in_videos = _channels_of(part)
    for channel in reader.channels:
        if not selected(channel.topic):
            part.left_out[channel.topic] = None
        elif channel.identity not in in_videos:
            part.topic(channel)
            writer.add_channel(channel)
    for schema in reader.unused_schemas:
        writer.add_schema(schema)


def _channels_of(part: Part) -> set[tuple[object, ...]]:
    """Identities of the channels that sidecars describe."""
    models: list[ChannelModel] = []
    for stream in part.streams:
        models.append(stream.sidecar.channel)
        if stream.sidecar.camera_info:
            models.append(stream.sidecar.camera_info.channel)
    return {model.to_record(0).identity for model in models}


def write_manifest(
    part: Part, recording: Recorded, sources: Sequence[tuple[str, int, str]], profile: str
) -> None:
    """Write the manifest of a whole recording: the dataset is complete then.

    Args:
        part: All that was packed.
        recording: The recording.
        sources: Name, size in bytes and SHA-256 of its files.
        profile: What was asked for.
    """
    digests = {
        stream.sidecar.video.file: (
            stream.sidecar.video.size or 0,
            stream.sidecar.video.sha256 or "",
        )
        for stream in part.streams
    }
    for name in (MESSAGES_NAME, *(f"{stream.stem}.yaml" for stream in part.streams)):
        digests[name] = digest_file(part.folder / name)
    manifest = Manifest(
        mp4ds=FORMAT_VERSION,
        kind="dataset",
        profile=profile,
        format=recording.format,
        recording_profile=recording.profile,
        library=recording.library,
        sources=[Source(name=name, size=size, sha256=sha256) for name, size, sha256 in sources],
        messages=sum(topic.messages for topic in part.topics.values()),
        losses=[LossEntry.from_record(loss) for loss in part.losses],
        topics_left_out=list(part.left_out),
        time_range=TimeRange(start=part.span[0], end=part.span[1]) if part.span else None,
        streams=[
            StreamEntry(
                topic=stream.sidecar.channel.topic,
                sidecar=f"{stream.stem}.yaml",
                video=stream.sidecar.video.file,
                frames=stream.sidecar.frames,
            )
            for stream in part.streams
        ],
        transforms=_static_transforms(part),
        verbatim=[
            Verbatim(topic=topic.topic, messages=count, first=first, reason=reason)
            for topic in part.topics.values()
            for reason, (count, first) in topic.verbatim.items()
        ],
        files=[
            FileEntry(name=name, size=size, sha256=sha256)
            for name, (size, sha256) in sorted(digests.items())
        ],
        tools={"mp4ds": __version__, **tool_versions(), "zlib": zlib_build()},
    )
    (part.folder / MANIFEST_NAME).write_bytes(dump_document(manifest))


def _static_transforms(part: Part) -> list[StaticTransform]:
    """The transforms between the coordinate frames of all images and calibrations."""
    frame_ids: set[str] = set()
    for stream in part.streams:
        frame_ids.update(header.frame_id for header in stream.sidecar.headers)
        if stream.sidecar.camera_info:
            frame_ids.update(item.frame_id for item in stream.sidecar.camera_info.calibrations)
    collector = TransformCollector(part.transforms)
    return [StaticTransform.from_record(item) for item in collector.between(frame_ids)]


def summarize(part: Part, target: Path, source_bytes: int) -> PackSummary:
    """What a pack did.

    Args:
        part: All that was packed.
        target: The dataset's final name.
        source_bytes: Bytes of the source files.
    """
    for stream in part.streams:
        video = stream.sidecar.video
        topic = part.topics[stream.sidecar.channel.topic]
        topic.files.append(video.file)
        topic.packed_bytes += (video.size or 0) + (
            part.folder / f"{stream.stem}.yaml"
        ).stat().st_size
        if video.quality is not None:
            topic.notes.append(str(video.quality))
        if stream.is_renamed:
            topic.notes.append(f"stored as {video.file}: the plain name was taken")
    dataset_bytes, messages_bytes = folder_size(part.folder), part.messages_path.stat().st_size
    return PackSummary(
        dataset=target,
        topics=list(part.topics.values()),
        source_bytes=source_bytes,
        dataset_bytes=dataset_bytes,
        messages_bytes=messages_bytes,
        left_out=list(part.left_out),
        skipped=dict(part.skipped),
        losses=part.losses,
        larger=_why_larger(part, source_bytes, dataset_bytes, messages_bytes),
    )


def _why_larger(part: Part, source_bytes: int, dataset_bytes: int, messages_bytes: int) -> str:
    """A sentence where a dataset takes more than its source by more than 5 %; else empty."""
    if dataset_bytes <= _LARGER * source_bytes:
        return ""
    raw = sum(topic.raw_bytes for topic in part.topics.values())
    if raw <= source_bytes:
        return "a recording this small takes less than the index, definitions and sidecars"
    if 2 * messages_bytes > dataset_bytes:
        return "the source's own compression (bz2, say) packs small messages closer than zstd does"
    if any(stream.sidecar.body == "packet" for stream in part.streams):
        return (
            "JPEG files and video packets are kept as they are, those that repeat, too, which the "
            "source's own compression stores once"
        )
    return "the source's own compression packs its images closer than a video does"


def folder_size(folder: Path) -> int:
    """Bytes of the files in a folder."""
    return sum(path.stat().st_size for path in folder.iterdir())


def dataset_files(path: Path) -> set[str] | None:
    """Names of a dataset's files, by its manifest; None where that is none, or not understood."""
    try:
        manifest = load_manifest(path / MANIFEST_NAME)
    except (FormatError, SourceError, OSError):
        return None
    streams = {name for entry in manifest.streams for name in (entry.sidecar, entry.video)}
    return {MANIFEST_NAME, *streams, *(entry.name for entry in manifest.files)}
