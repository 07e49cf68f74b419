"""The manifest of what was packed, and the summary of a dataset for users."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mp4ds._version import __version__
from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.concat import contents
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import FormatError, SourceError, advising, counted
from mp4ds.files.sources import source_name, source_size
from mp4ds.files.urls import spelled
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.format.manifest import (
    About,
    EarlierDataset,
    LossEntry,
    Manifest,
    RedactionEntry,
    ReductionEntry,
    Source,
    TimeRange,
    Verbatim,
    static_transforms,
)
from mp4ds.format.models import StreamSidecar
from mp4ds.format.sidecars import (
    COPY_AGAIN,
    MANIFEST_NAME,
    FileNames,
    dump_document,
    load_manifest,
    verify_file,
)
from mp4ds.messages.serializations import is_camera
from mp4ds.messages.transforms import Transform
from mp4ds.packing.options import PackSummary, TopicSummary
from mp4ds.records import Channel, Loss, bounded
from mp4ds.video.codecs import LOSSLESS
from mp4ds.video.encoder import tool_versions

Digest = tuple[int, str]
"""Size in bytes and SHA-256 of a file."""


@dataclass
class PartRecord:
    """What was packed into a folder, except for the manifest.

    Attributes:
        folder: Where the files are.
        topics: What became of each topic, in the order of the recording.
        streams: Their sidecars, in the order in which they began.
        span: Log times of the first and last message, ns; None without messages.
        left_out: Topics left out on request.
        skipped: What the source holds and no dataset can: a phrase -> how many.
        transforms: Static transforms, the latest of each child frame.
        losses: What could not be read of a damaged recording.
        redactions: What was redacted, of each part.
    """

    folder: Path
    topics: dict[str, TopicSummary] = field(default_factory=dict)
    streams: list[StreamSidecar] = field(default_factory=list)
    span: tuple[int, int] | None = None
    left_out: dict[str, None] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    transforms: list[Transform] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    redactions: list[RedactionEntry] = field(default_factory=list)

    @property
    def messages_path(self) -> Path:
        """Its messages.mcap."""
        return self.folder / MESSAGES_NAME

    def topic(self, channel: Channel) -> TopicSummary:
        """The summary of a channel's topic."""
        if channel.topic not in self.topics:
            self.topics[channel.topic] = TopicSummary(channel.topic, channel.type_name)
        return self.topics[channel.topic]


# ---------------------------------------------------------------- manifest


def origin_of(
    reader: BagReader,
    part: PartRecord,
    digests: Mapping[str, Digest] | None = None,
    about: About | None = None,
) -> dict[str, Any]:
    """The fields of a manifest that tell where a dataset came from, and what is missing.

    Args:
        reader: What was read: recordings, or datasets that are repacked, the files of which begin
            with their manifests.
        part: What was packed of it.
        digests: Of the files that were hashed, by their paths; others were read in part. None for
            a part, which tells no sources.
        about: Description of the recording; None for that of the datasets, if it is one thing.

    Raises:
        FormatError: A file does not match its dataset's manifest.
    """
    folder = reader.path if reader.path.is_dir() else None
    sources: list[Source] = []
    manifests: dict[Path, Manifest] = {}
    earlier: list[EarlierDataset] = []
    for path in reader.files if digests is not None else ():
        size, sha256 = (digests or {}).get(spelled(path)) or (source_size(path), None)
        own = manifests.get(path.parent)
        if own and (entry := own.file(path.name)):
            # of a slice, only the frames of a lossless video were checked, by their digests
            if sha256 or own.profile != LOSSLESS or path.suffix != ".mp4":
                with advising(COPY_AGAIN):
                    verify_file(path, entry, found=(size, sha256) if sha256 else None)
        elif path.name == MANIFEST_NAME and sha256:
            manifests[path.parent] = own = load_manifest(path)
            sources += own.sources
            this = EarlierDataset(name=path.parent.name, profile=own.profile, sha256=sha256)
            earlier += [*own.derived_from, this]
        else:
            sources.append(Source(name=source_name(path, folder), size=size, sha256=sha256))
    abouts = [one.about for one in manifests.values()]
    if about is None and abouts and all(item == abouts[0] for item in abouts):
        about = abouts[0]
    losses = [entry.to_record() for one in manifests.values() for entry in one.losses]
    left_out = [topic for one in manifests.values() for topic in one.topics_left_out]
    reductions = [entry for one in manifests.values() for entry in one.reductions]
    if reader.reduction:
        reductions.append(ReductionEntry.model_validate(reader.reduction))
    before = [entry for one in manifests.values() for entry in one.redactions]
    redactions = [entry.proving() for entry in before]
    if part.redactions:
        redactions.append(RedactionEntry.joined(part.redactions))
    return {
        "about": about,
        "format": reader.format,
        "recording_profile": reader.profile,
        "library": reader.library,
        "sources": [source.within(reader.slice.span) for source in sources],
        "derived_from": earlier,
        "reductions": reductions,
        "redactions": redactions,
        "losses": list(map(LossEntry.from_record, bounded([*losses, *part.losses]))),
        "topics_left_out": list(dict.fromkeys([*left_out, *part.left_out])),
    }


def tools() -> dict[str, str]:
    """Versions of the software used."""
    return {"mp4ds": __version__, **tool_versions()}


def write_manifest(part: PartRecord, origin: Mapping[str, Any], profile: str) -> None:
    """Write the manifest of what was packed, which completes the dataset.

    Args:
        part: All that was packed.
        origin: Where it came from; see `origin_of`.
        profile: The requested profile.
    """
    sidecars = {f"{Path(one.seen.video.file).stem}.yaml": one for one in part.streams}
    manifest = Manifest(
        **contents(part.folder, sidecars),
        kind="dataset",
        profile=profile,
        messages=sum(topic.messages for topic in part.topics.values()),
        time_range=TimeRange(start=part.span[0], end=part.span[1]) if part.span else None,
        transforms=static_transforms(part.streams, part.transforms),
        verbatim=[
            Verbatim(topic=topic.topic, messages=count, first=first, reason=reason)
            for topic in part.topics.values()
            for reason, (count, first) in topic.verbatim.items()
        ],
        tools={**tools(), "zlib": zlib.ZLIB_RUNTIME_VERSION},
        **origin,
    )
    (part.folder / MANIFEST_NAME).write_bytes(dump_document(manifest))


def summarize(
    part: PartRecord,
    target: Path,
    source_bytes: int | None,
    *,
    is_copy: bool = False,
    too_large: Iterable[str] = (),
) -> PackSummary:
    """What is in a dataset that was made.

    Args:
        part: What is known of its making, and its folder.
        target: Its final name.
        source_bytes: Bytes of the source files; None if only a slice was packed. Then, and if
            topics were left out, the bytes of the packed messages are taken.
        is_copy: Whether its videos are those of another dataset.
        too_large: Latched topics whose messages from before a slice are too large.
    """
    if source_bytes is None or part.left_out:
        source_bytes = sum(topic.raw_bytes for topic in part.topics.values())
    with Dataset(part.folder) as made:
        return PackSummary(
            dataset=target,
            topics=_topics_in(made, part.topics),
            source_bytes=source_bytes,
            dataset_bytes=folder_size(part.folder),
            messages_bytes=part.messages_path.stat().st_size,
            left_out=list(part.left_out),
            skipped=dict(part.skipped),
            losses=part.losses,
            is_copy=is_copy,
            latched=dict(made.latched_before),
            latched_left_out=[topic for topic in too_large if topic not in part.left_out],
        )


def _topics_in(made: Dataset, known: Mapping[str, TopicSummary]) -> list[TopicSummary]:
    """What became of each topic, in the order of the known ones."""
    types = {channel.topic: channel.type_name for channel in made.channels}
    topics: dict[str, TopicSummary] = {}
    for name in dict.fromkeys((*filter(types.__contains__, known), *types)):
        old = known.get(name, TopicSummary(name, ""))
        topics[name] = TopicSummary(name, types[name], raw_bytes=old.raw_bytes, notes=[*old.notes])
    counts = made.counts()
    for channel in made.channels:
        topics[channel.topic].messages += counts.get(channel.id, 0)
    for stream in made.streams:
        topic, video = topics[stream.topic], stream.sidecar.video
        topic.frames += len(stream)
        topic.files.extend(own.file for own in reversed(stream.sidecar.videos))
        topic.packed_bytes += sum(path.stat().st_size for path in stream.files)
        if stream.infos:
            topics[stream.infos.channel.topic].frames += len(stream.infos)
        if video.quality is not None:
            topic.notes.append(str(video.quality))
        if stream.path.stem != FileNames().name_for(stream.topic):
            topic.notes.append(f"stored as {video.file}: its usual name was taken")
    for done in made.manifest.redactions[-1:] if made.manifest else ():
        found = {one.topic: one for one in done.topics}
        for channel in filter(is_camera, made.channels):
            own, notes = found.get(channel.topic), topics[channel.topic].notes
            note = f"{own.changed} of {counted(own.images, 'image')}" if own else "no image"
            if (note := f"{note} redacted") not in notes:
                notes.append(note)
    for entry in made.manifest.verbatim if made.manifest else ():
        topics[entry.topic].verbatim[entry.reason] = (entry.messages, entry.first)
    return list(topics.values())


def folder_size(folder: Path) -> int:
    """Bytes of the files in a folder."""
    return sum(path.stat().st_size for path in folder.iterdir())


def dataset_files(path: Path) -> set[str] | None:
    """Names of a dataset's files, from its manifest; None if that is missing or invalid."""
    try:
        manifest = load_manifest(path / MANIFEST_NAME)
    except (FormatError, SourceError, OSError):
        return None
    streams = {name for entry in manifest.streams for name in entry.files}
    return {MANIFEST_NAME, *streams, *(entry.name for entry in manifest.files)}
