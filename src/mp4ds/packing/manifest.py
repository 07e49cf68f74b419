"""The record of a packed part, and the manifest made from these records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from mp4ds._version import __version__
from mp4ds.bags.protocols import BagReader, BagWriter, Format
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import FormatError, SourceError, advising
from mp4ds.files.outputs import digest_file
from mp4ds.format.fields import FORMAT_VERSION, MESSAGES_NAME
from mp4ds.format.manifest import (
    About,
    EarlierDataset,
    FileEntry,
    LossEntry,
    Manifest,
    Source,
    StreamEntry,
    TimeRange,
    Verbatim,
    static_transforms,
)
from mp4ds.format.models import ChannelModel, StreamSidecar
from mp4ds.format.sidecars import (
    COPY_AGAIN,
    MANIFEST_NAME,
    dump_document,
    load_manifest,
    verify_file,
)
from mp4ds.messages.png import zlib_build
from mp4ds.messages.transforms import Transform
from mp4ds.packing.options import PackSummary, TopicSummary
from mp4ds.plan import LOSSLESS
from mp4ds.records import EVERYTHING, Channel, Excerpt, Loss, bounded
from mp4ds.video.encoder import tool_versions


@dataclass(frozen=True, slots=True)
class PartStream:
    """A stream of a part, or of a whole recording.

    Attributes:
        stem: File name of its video and sidecar, without extension.
        sidecar: Its sidecar.
        is_renamed: Whether another stream had taken its plain name.
    """

    stem: str
    sidecar: StreamSidecar
    is_renamed: bool = False


@dataclass
class PartRecord:
    """What was packed into a folder, except for the manifest.

    Attributes:
        folder: Where the files are.
        topics: What became of each topic, in the order of the recording.
        streams: In the order in which they began.
        span: Log times of the first and last message, ns; None without messages.
        left_out: Topics left out on request.
        skipped: What the source holds and no dataset can: a phrase -> how many.
        transforms: Static transforms, the latest of each child frame.
        losses: What could not be read of a damaged recording.
    """

    folder: Path
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    streams: list[PartStream] = field(default_factory=list)
    span: tuple[int, int] | None = None
    left_out: dict[str, None] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    transforms: list[Transform] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)

    @property
    def messages_path(self) -> Path:
        """Its messages.mcap."""
        return self.folder / MESSAGES_NAME

    def topic(self, channel: Channel) -> TopicSummary:
        """The summary of a channel's topic."""
        if channel.topic not in self.topics:
            self.topics[channel.topic] = TopicSummary(channel.topic, channel.type_name)
        return self.topics[channel.topic]

    def saw(self, times: Iterable[int]) -> None:
        """Widen the span to hold log times."""
        for time in times:
            start, end = self.span or (time, time)
            self.span = (min(start, time), max(end, time))


# ---------------------------------------------------------------- manifest

_LARGER = 1.05  # times its source: anything larger is explained


class Recorded(Protocol):
    """What a manifest needs of a recording. See `BagReader`."""

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


@dataclass(frozen=True)
class Origin:
    """The origin of a dataset.

    Attributes:
        sources: The files of the original recording.
        derived_from: Datasets that were repacked, the oldest first.
        losses: What these could not read of the recording.
        left_out: Topics that they left out.
        about: Description of the recording.
    """

    sources: list[Source] = field(default_factory=list)
    derived_from: list[EarlierDataset] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    about: About | None = None

    @classmethod
    def of(
        cls,
        files: Sequence[Path],
        digests: Iterable[tuple[str, int, str | None]],
        about: About | None = None,
        span: Excerpt = EVERYTHING,
    ) -> Origin:
        """The origin of the source that was read.

        Args:
            files: The files of recordings, and of datasets that are repacked, each of which
                begins with its manifest.
            digests: Name, size in bytes and SHA-256 of each; None for those read in part.
            about: Description of the recording; None for that of the datasets, if it is one
                thing.
            span: What was packed of them.

        Raises:
            FormatError: A file does not match its dataset's manifest.
        """
        origin = cls()
        told: list[About | None] = []
        expected: dict[Path, FileEntry] = {}
        is_lossy = False
        for path, (name, size, sha256) in zip(files, digests, strict=True):
            entry = expected.get(path)
            if entry is not None:
                # of a slice, only the frames of a lossless video were checked, by their digests
                if sha256 is not None or is_lossy or path.suffix != ".mp4":
                    with advising(COPY_AGAIN):
                        verify_file(path, entry, found=(size, sha256) if sha256 else None)
            elif path.name == MANIFEST_NAME and sha256 is not None:
                manifest = load_manifest(path)
                is_lossy = manifest.profile != LOSSLESS
                origin._add_dataset(manifest, path, sha256)
                told.append(manifest.about)
                expected.update((path.with_name(item.name), item) for item in manifest.files)
            else:
                origin.sources.append(Source(name=name, size=size, sha256=sha256))
        if about is None and told and all(item == told[0] for item in told):
            about = told[0]
        return replace(origin, sources=[it.within(span) for it in origin.sources], about=about)

    def fields(
        self, recording: Recorded, losses: Iterable[Loss], left_out: Iterable[str]
    ) -> dict[str, Any]:
        """The fields of a manifest that tell where a dataset came from.

        Args:
            recording: What was read.
            losses: What could not be read of it.
            left_out: Topics that were left out on request.
        """
        return {
            "about": self.about,
            "format": recording.format,
            "recording_profile": recording.profile,
            "library": recording.library,
            "sources": self.sources,
            "derived_from": self.derived_from,
            "losses": list(map(LossEntry.from_record, bounded([*self.losses, *losses]))),
            "topics_left_out": list(dict.fromkeys([*self.left_out, *left_out])),
        }

    def _add_dataset(self, manifest: Manifest, path: Path, sha256: str) -> None:
        self.sources.extend(manifest.sources)
        self.derived_from.extend(manifest.derived_from)
        self.derived_from.append(
            EarlierDataset(name=path.parent.name, profile=manifest.profile, sha256=sha256)
        )
        self.losses.extend(entry.to_record() for entry in manifest.losses)
        self.left_out.extend(manifest.topics_left_out)


def declare_rest(
    part: PartRecord, reader: BagReader, selected: Callable[[str], bool], writer: BagWriter
) -> None:
    """Keep what the recording declares besides its messages.

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


def _channels_of(part: PartRecord) -> set[tuple[object, ...]]:
    """Identities of the channels that sidecars describe."""
    models: list[ChannelModel] = []
    for stream in part.streams:
        models.append(stream.sidecar.channel)
        if stream.sidecar.camera_info:
            models.append(stream.sidecar.camera_info.channel)
    return {model.to_record(0).identity for model in models}


def write_manifest(part: PartRecord, recording: Recorded, origin: Origin, profile: str) -> None:
    """Write the manifest of a whole recording, which completes the dataset.

    Args:
        part: All that was packed.
        recording: The recording.
        origin: What it was read from.
        profile: The requested profile.
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
        messages=sum(topic.messages for topic in part.topics.values()),
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
        transforms=static_transforms([stream.sidecar for stream in part.streams], part.transforms),
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
        **origin.fields(recording, part.losses, part.left_out),
    )
    (part.folder / MANIFEST_NAME).write_bytes(dump_document(manifest))


def summarize(
    part: PartRecord, target: Path, source_bytes: int | None, origin: Origin
) -> PackSummary:
    """What a pack did.

    Args:
        part: All that was packed.
        target: The dataset's final name.
        source_bytes: Bytes of the source files; None if only a slice was packed. Then, and if
            topics were left out, the bytes of the packed messages are taken.
        origin: What it was read from.
    """
    if source_bytes is None or part.left_out:
        source_bytes = sum(topic.raw_bytes for topic in part.topics.values())
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
            topic.notes.append(f"stored as {video.file}: its usual name was taken")
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
        larger=_why_larger(part, source_bytes, dataset_bytes, messages_bytes, origin),
    )


def with_latched(summary: PackSummary, reader: BagReader) -> PackSummary:
    """The summary of what was read, with the latched messages from before a slice."""
    too_large = [topic for topic in reader.slice.left_out if topic not in summary.left_out]
    latched = Counter(message.channel.topic for message in reader.slice.latched)
    packed = {topic: n for topic, n in latched.items() if topic not in summary.left_out}
    return replace(summary, latched=packed, latched_left_out=too_large)


def _why_larger(
    part: PartRecord, source_bytes: int, dataset_bytes: int, messages_bytes: int, origin: Origin
) -> str:
    """Why a dataset is more than 5 % larger than its source; else empty."""
    if dataset_bytes <= _LARGER * source_bytes:
        return ""
    if any(earlier.profile != LOSSLESS for earlier in origin.derived_from):
        return "re-encoding the videos of a lossy dataset does not make them as small as they were"
    if origin.derived_from:
        return "the source dataset was stored in a smaller form"
    raw = sum(topic.raw_bytes for topic in part.topics.values())
    if raw <= source_bytes:
        return "a recording this small takes less space than the index, definitions and sidecars"
    if 2 * messages_bytes > dataset_bytes:
        return (
            "the source's own compression (such as bz2) stores small messages more compactly "
            "than zstd"
        )
    if any(stream.sidecar.body == "packet" for stream in part.streams):
        return (
            "JPEG files and video packets are kept as they are, including repeated ones, which "
            "the source's own compression stores only once"
        )
    return "the source's own compression stores its images more compactly than a video"


def folder_size(folder: Path) -> int:
    """Bytes of the files in a folder."""
    return sum(path.stat().st_size for path in folder.iterdir())


def dataset_files(path: Path) -> set[str] | None:
    """Names of a dataset's files, from its manifest; None if that is missing or invalid."""
    try:
        manifest = load_manifest(path / MANIFEST_NAME)
    except (FormatError, SourceError, OSError):
        return None
    streams = {name for entry in manifest.streams for name in (entry.sidecar, entry.video)}
    return {MANIFEST_NAME, *streams, *(entry.name for entry in manifest.files)}


# ---------------------------------------------------------------- of datasets


def topic_summaries(dataset: Dataset) -> list[TopicSummary]:
    """What is in a dataset, by topic; the bytes of the recorded messages are not known."""
    times = dataset.times()
    found: dict[str, TopicSummary] = {}
    for channel in dataset.channels:
        topic = found.setdefault(channel.topic, TopicSummary(channel.topic, channel.type_name))
        topic.messages += len(times.get(channel.id, ()))
    for stream in dataset.streams:
        topic = found[stream.topic]
        topic.frames += len(stream)
        topic.files.append(stream.video_path.name)
        topic.packed_bytes += stream.video_path.stat().st_size + stream.path.stat().st_size
        if stream.infos:
            found[stream.infos.channel.topic].frames += len(stream.infos)
    return list(found.values())


def summary_of(path: Path) -> PackSummary:
    """What is in the dataset of a recording; the bytes of what was recorded are not known."""
    with Dataset(path) as dataset:
        topics = {topic.topic: topic for topic in topic_summaries(dataset)}
        manifest = dataset.manifest
    for item in manifest.verbatim if manifest else ():
        topics[item.topic].verbatim[item.reason] = (item.messages, item.first)
    return PackSummary(
        dataset=path,
        topics=list(topics.values()),
        source_bytes=0,
        dataset_bytes=folder_size(path),
        messages_bytes=(path / MESSAGES_NAME).stat().st_size,
        left_out=[],
        skipped={},
        losses=[entry.to_record() for entry in manifest.losses] if manifest else [],
        is_copy=True,
    )
