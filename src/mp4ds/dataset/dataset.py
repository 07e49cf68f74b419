"""An open dataset: its streams, and every message of the recording; where datasets are."""

from __future__ import annotations

import glob
import shlex
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mp4ds.bags.formats import RECORDING_SUFFIXES
from mp4ds.dataset.images import Images, VerbatimImages, VideoImages, verbatim_images
from mp4ds.dataset.messages import (
    ChannelGroup,
    MessagesFile,
    MessageSource,
    Part,
    RecordedMessage,
    as_recorded,
    by_time,
    channel_groups,
)
from mp4ds.dataset.stream import Layer, Stream, open_stream
from mp4ds.dataset.topic import Topic
from mp4ds.errors import (
    FormatError,
    OptionError,
    SourceError,
    SourceNotFoundError,
    counted,
    size_text,
)
from mp4ds.files.sources import HOW_TO_OPEN, is_folder, is_video, refuse_unfinished
from mp4ds.files.urls import RemotePath, location
from mp4ds.format.fields import MESSAGES_NAME, Choice, everything, within
from mp4ds.format.manifest import Manifest
from mp4ds.format.models import EXACT_SUFFIX
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest, sidecar_of, verify_file
from mp4ds.messages.serializations import is_camera
from mp4ds.records import Channel, Excerpt, Message, Record
from mp4ds.times import Sync, synchronize

_VIDEOS = (".mp4", ".m4v", ".mov")
_MOST_TOPICS = 4  # named in a repr

Ahead = Callable[[Iterator[Any]], Iterator[Any]]
"""Fetches the items of an iterator in advance, for example in a thread."""


class Dataset:
    """A folder made by `mp4ds pack`, or one video.

    ``dataset["/topic"]`` returns the frames of a topic, ``"/topic" in dataset`` tells whether it
    has any, and iteration yields the `Topic` of each of the `topics`. The frames of one stream
    alone can also be looked up by its file name without extension.

    Attributes:
        path: The folder, or the video or sidecar.
        manifest: Of the folder; None for one video.
        streams: Its streams; none for a video without a sidecar, see `mp4ds.open`.
        messages_file: Its messages.mcap; without contents where there is none.
        is_salvaged: Whether messages may be missing; see `mp4ds.dataset.recording`.
        damage: Which damaged file was left out, as no selected topic needs it; empty if none was.

    Args:
        path: The folder, a manifest, a sidecar, or a video next to its sidecar; or its URL.
        layer: ``exact`` for the frames as recorded, ``view`` for those that the views of lossless
            cameras show, which decode much faster; None for the exact ones where they are here.
        jpeg_quality: Quality of the JPEG files in messages of transcoded streams, 1 to 100.

    Raises:
        SourceNotFoundError: The path does not exist.
        SourceError: It is not a dataset.
        FormatError: A file breaks a rule of the format.
    """

    is_salvaged = False
    damage = ""

    def __init__(
        self, path: Path | str, *, layer: Layer | None = None, jpeg_quality: int = 95
    ) -> None:
        self.path = location(path)
        if not self.path.exists():
            raise SourceNotFoundError(self.path)
        if self.path.name == MANIFEST_NAME:
            self.path = self.path.parent
        self.manifest: Manifest | None = None
        is_one = self.path.suffix in (".yaml", ".yml", ".mp4")
        if not is_one and not (self.path / MANIFEST_NAME).exists():
            problem = "is not a dataset"
            remedy = "Give a folder made by `mp4ds pack`, or a sidecar next to its video."
            if is_video(self.path):
                problem, remedy = "is a video, not a dataset", HOW_TO_OPEN
            elif self.path.suffix in RECORDING_SUFFIXES or (self.path / "metadata.yaml").exists():
                problem = "is a recording, not a dataset"
                remedy = f"Make a dataset of it first: mp4ds pack {shlex.quote(str(self.path))}"
            elif is_folder(self.path) and (inside := sorted(self.path.glob(f"*/{MANIFEST_NAME}"))):
                problem = f"is a folder of {counted(len(inside), 'dataset')}, not a dataset"
                remedy = f"Open one of them, such as {inside[0].parent}."
            raise SourceError(self.path, problem, remedy)
        self._video: VideoImages | None = None
        if self.path.is_dir():
            self.manifest = load_manifest(self.path / MANIFEST_NAME)
            sidecars = [self.path / entry.sidecar for entry in self.manifest.streams]
        else:
            sidecar = sidecar_of(self.path) if self.path.suffix == ".mp4" else self.path
            if sidecar != self.path and self.path.exists() and not sidecar.exists():
                problem = f"is a video without its sidecar, {sidecar.name}"
                raise FormatError("file-missing", self.path, problem)
            sidecars = [sidecar]
        self.streams = [open_stream(sidecar, layer) for sidecar in sidecars]
        self.jpeg_quality = jpeg_quality
        self.messages_file = MessagesFile(self.path / MESSAGES_NAME if self.manifest else None)

    @classmethod
    def of(
        cls,
        path: Path,
        manifest: Manifest | None,
        streams: Sequence[Stream],
        file: MessagesFile,
        video: VideoImages | None = None,
    ) -> Dataset:
        """A folder whose sidecars have already been read, or a video without a sidecar."""
        dataset = cls.__new__(cls)
        dataset.path, dataset.manifest, dataset.streams = path, manifest, list(streams)
        dataset.messages_file, dataset._video = file, video
        return dataset

    def __repr__(self) -> str:
        topics = ", ".join(self.topics[:_MOST_TOPICS]) or "no camera"
        if len(self.topics) > _MOST_TOPICS:
            topics += f" and {len(self.topics) - _MOST_TOPICS} more"
        parts = [topics, f"{sum(map(len, self.parts))} frames"]
        if manifest := self.manifest:
            parts.append(f"{manifest.messages} messages")
            if span := manifest.time_range:
                parts.append(f"{(span.end - span.start) / 1e9:.1f} s")
            parts.append(f"{sum(file.size for file in manifest.files) / 1e6:.1f} MB")
        return f"<Dataset {str(self.path)!r}: {'; '.join(parts)}>"

    @property
    def jpeg_quality(self) -> int:
        """Quality of the JPEG files in messages of transcoded streams, 1 to 100; may be set."""
        return self.streams[0].jpeg_quality if self.streams else Stream.jpeg_quality

    @jpeg_quality.setter
    def jpeg_quality(self, quality: int) -> None:
        for stream in self.streams:
            stream.jpeg_quality = quality

    @property
    def parts(self) -> Sequence[Images]:
        """Its streams; of a video without a sidecar, its images."""
        return [self._video] if self._video else self.streams

    def absence(self, selected: Callable[[str], bool] = lambda _: True) -> str:
        """Which files that make lossless images exact are not here; empty if all are.

        Args:
            selected: Of which topics.
        """
        streams = (stream for stream in self.streams if selected(stream.topic))
        absent = [video for stream in streams if (video := stream.absent)]
        if not absent:
            return ""
        size = sum(video.size or 0 for video in absent)
        found = f"exact layer not here: {counted(len(absent), 'file')}, {size_text(size)}"
        if len(absent) == sum(stream.exact_path is not None for stream in self.streams):
            return found
        return f"{found}: {', '.join(video.file for video in absent)}"

    def require_exact(self, selected: Callable[[str], bool] = lambda _: True) -> None:
        """Refuse to take the images of views for those recorded.

        Args:
            selected: Of which topics.

        Raises:
            SourceError: Some exact images are not here.
        """
        if absence := self.absence(selected):
            raise SourceError(
                self.path,
                f"has views only ({absence}), whose pixels differ from those recorded",
                "Copy the missing *.exact.mp4 files next to them, or give `quality` visual to go "
                "on with the views.",
            )

    @property
    def topics(self) -> list[str]:
        """Topics with frames in videos."""
        return list(dict.fromkeys(part.topic for part in self.parts))

    @cached_property
    def _looked_up(self) -> dict[str, Topic | None]:
        return {}

    def _topic(self, name: str) -> Topic | None:
        """The frames of a topic, or of the stream with a file name; None if there are none."""
        if name not in self._looked_up:
            parts: list[Images] = [
                stream for stream in self.streams if stream.topic == name and not stream.is_lost
            ]
            parts += self.verbatim(name)[0]
            named = (one for one in self.parts if name in (one.path.stem, one.topic))
            found = parts or list(islice(named, 1))
            known = (topic for topic in self._looked_up.values() if topic and topic.parts == found)
            self._looked_up[name] = next(known, Topic(found)) if found else None
        return self._looked_up[name]

    def verbatim(self, topic: str) -> tuple[list[VerbatimImages], Counter[str]]:
        """A topic's frames that are stored verbatim in messages.mcap; they are read once.

        Returns:
            Those of each size and encoding, and how many messages have no picture, by reason.

        Raises:
            FormatError: messages.mcap is damaged.
        """
        if topic not in self._verbatim:
            frames: list[VerbatimImages] = []
            without = Counter[str]()
            for channel in self._verbatim_cameras(topic):
                found, others = self._verbatim_of(channel)
                frames += found
                without += others
            self._verbatim[topic] = frames, without
        return self._verbatim[topic]

    @cached_property
    def _verbatim(self) -> dict[str, tuple[list[VerbatimImages], Counter[str]]]:
        return {}

    def _verbatim_cameras(self, topic: str) -> list[Channel]:
        """The channels of a topic with images in messages.mcap, which need not be opened."""
        listed = self.manifest.verbatim if self.manifest else []
        if not any(entry.topic == topic for entry in listed):
            return []
        return [item for item in self.channels if item.topic == topic and is_camera(item)]

    def _verbatim_of(self, channel: Channel) -> tuple[list[VerbatimImages], Counter[str]]:
        group = next((item for item in self._groups if item.channel.id == channel.id), None)
        ids = group.recorded_ids if group else {channel.id}

        def recorded(excerpt: Excerpt) -> Iterator[Message]:
            return (item for item in self.messages_file.in_time(excerpt) if item.channel.id in ids)

        messages = recorded(Excerpt(topics=frozenset([channel.topic]), others=False))
        numbers: Iterable[int] = count()
        if group is not None:
            taken = group.places
            everyone = np.arange(len(taken) + group.recorded_count)
            numbers = np.setdiff1d(everyone, taken).tolist()
            if not group.is_in_time:
                messages = group.recorded()
        own = (item for item in self.streams if item.topic == channel.topic and item.calibrations)
        path = self.messages_file.path or self.path
        numbered = zip(numbers, messages, strict=False)
        return verbatim_images(path, channel, numbered, recorded, next(own, None))

    def __getitem__(self, topic: str) -> Topic:
        found = self._topic(topic)
        if found is None:
            known = ", ".join(self.topics) or "none"
            raise KeyError(f"{self.path} has no topic {topic!r}; there are: {known}")
        return found

    def __contains__(self, topic: object) -> bool:
        return isinstance(topic, str) and self._topic(topic) is not None

    def __iter__(self) -> Iterator[Topic]:
        return (self[topic] for topic in self.topics)

    def __len__(self) -> int:
        return len(self.topics)

    @property
    def profile(self) -> str:
        """MCAP profile of the recording: ``ros1``, ``ros2`` or another; empty if there is none."""
        if self.manifest:
            return self.manifest.recording_profile
        if not self.streams:
            return ""
        return "ros1" if self.streams[0].sidecar.wire == "ros1" else "ros2"

    @cached_property
    def channels(self) -> list[Channel]:
        """All channels of the recording."""
        return [*self._verbatim_channels, *(group.channel for group in self._groups)]

    @property
    def all_topics(self) -> list[str]:
        """The topics of all channels, and of streams of which a sidecar is lost."""
        topics = (channel.topic for channel in self.channels)
        listed = [entry.topic for entry in self.manifest.streams] if self.manifest else []
        return list(dict.fromkeys([*topics, *listed]))

    def verify_messages(self) -> None:
        """Check messages.mcap against its SHA-256: not all of its contents have their own checksum.

        Raises:
            FormatError: See `verify_file`.
        """
        path = self.messages_file.path
        if self.manifest and path and not self.is_salvaged:
            verify_file(path, self.manifest.file(path.name))

    def verify_sidecars(self, selected: Callable[[str], bool] = lambda _: True) -> None:
        """Check sidecars against their SHA-256: an edited one may look valid.

        Args:
            selected: Of which topics.

        Raises:
            FormatError: See `verify_file`.
        """
        if self.manifest is None:
            return
        for stream in self.streams:
            info = stream.sidecar.camera_info
            if selected(stream.topic) or (info and selected(info.channel.topic)):
                verify_file(stream.path, self.manifest.file(stream.path.name))

    def verify_lossy_videos(self, selected: Callable[[str], bool] = lambda _: True) -> None:
        """Check the videos without digests of messages: in a part of one, nothing else would show.

        Args:
            selected: Of which topics.

        Raises:
            FormatError: ``file-missing`` or ``hash-mismatch``.
        """
        for stream in () if self.is_salvaged else self.streams:
            if stream.sidecar.digests is None and selected(stream.topic):
                stream.verify_video()

    @cached_property
    def _groups(self) -> list[ChannelGroup]:
        return channel_groups(self.streams, self.messages_file)

    @cached_property
    def _verbatim_channels(self) -> list[Channel]:
        split = {channel_id for group in self._groups for channel_id in group.recorded_ids}
        return [channel for channel in self.messages_file.channels if channel.id not in split]

    def image_channels(self) -> list[ChannelGroup]:
        """The channels with images in videos."""
        return [group for group in self._groups if group.streams]

    def messages(self, topics: Sequence[str] | None = None) -> Iterator[RecordedMessage]:
        """The messages that are not frames, by log time, decoded on request.

        This includes calibrations, and, if their topic is requested, images that no video could
        hold.

        Args:
            topics: Only these topics; None for all.

        Raises:
            OptionError: There is no such topic.
            FormatError: The dataset breaks a rule of the format.
        """
        if isinstance(topics, str):
            raise OptionError(f"topics is a list of topics, such as [{topics!r}]")
        known = list(dict.fromkeys(channel.topic for channel in self.channels))
        unknown = [topic for topic in topics or () if topic not in known]
        if unknown:
            raise OptionError(
                f"{self.path} has no topic {unknown[0]!r}; there are: {', '.join(known) or 'none'}"
            )
        wanted = None if topics is None else frozenset(topics)
        ids = {channel.id for channel in self._verbatim_channels}
        calibrations = []
        for group in self._groups:
            if wanted is not None and group.channel.topic not in wanted:
                continue
            if not group.streams:
                calibrations.append(group.merged(group.sources(), group.recorded(), self._whole))
            elif wanted is not None:
                ids |= group.recorded_ids
        found = self.messages_file.in_time(Excerpt(topics=wanted))
        recorded = (message for message in found if message.channel.id in ids)
        messages = by_time(recorded, *calibrations)
        return as_recorded(messages, self.messages_file.path or self.path)

    @property
    def _whole(self) -> str | None:
        """The dataset, for errors, if it must have all messages; a pair on its own has its own."""
        return str(self.path) if self.manifest is not None and not self.is_salvaged else None

    def sync(
        self,
        topics: Sequence[str] | None = None,
        *,
        tolerance_ns: int,
        reference: str | None = None,
    ) -> Sync:
        """Match frames of several topics taken at the same time, by header stamp.

        Args:
            topics: Topics, or names of streams; None: all topics. Frame numbers are those of
                ``dataset[topic]``.
            tolerance_ns: Maximum nanoseconds between a frame and the reference frame.
            reference: One of the topics, to whose frames the others are matched;
                None: the one with the fewest frames, or the first of several.

        Raises:
            OptionError: There is no such topic, or the tolerance is negative.
        """
        if isinstance(topics, str):
            raise OptionError(f"topics is a list of topics, such as [{topics!r}]")
        if topics is None:
            topics = self.topics
        try:
            stamps = {topic: self[topic].stamps for topic in topics}
        except KeyError as error:
            raise OptionError(str(error.args[0])) from None
        if len(stamps) < len(topics):
            raise OptionError(f"a topic is given twice: {', '.join(topics)}")
        return synchronize(stamps, tolerance_ns=tolerance_ns, reference=reference)

    def records(
        self,
        sources: Mapping[Part, MessageSource] | None = None,
        *,
        start: int | None = None,
        end: int | None = None,
        choose: Choice = everything,
        topics: Collection[str] | None = None,
        ahead: Ahead = iter,
    ) -> Iterator[Record]:
        """Everything recorded, merged by log time; each channel in its own order.

        Messages of equal times come channel by channel, in the same order whether all are read or
        a span. For a span, a channel's messages in messages.mcap are merged with those of its
        videos by log time. Only messages are yielded then, and nothing before the key frame of a
        video's first message is decoded. If some messages are left out, videos are not checked
        against their SHA-256, but messages still are against their digests.

        Args:
            sources: Replacement sources for the messages of a video or its calibrations; all others
                are as recorded.
            start: The first log time, nanoseconds; None for the beginning.
            end: The log time before which all messages are, nanoseconds; None for no end.
            choose: Which messages of videos, and of their calibrations, are wanted. Packets between
                wanted ones are included if others refer to them.
            topics: Only these topics; None for all.
            ahead: Wraps the iterators over each video, calibration and messages.mcap, so that each
                can be read in its own thread. A dataset must not be read twice at once by such
                threads.

        Raises:
            FormatError: A frame cannot be decoded, or a message does not match its digest.
        """
        is_span = start is not None or end is not None
        span = Excerpt(start, end, None if topics is None else frozenset(topics))
        choice = within(span, choose) if is_span else choose

        def messages(group: ChannelGroup) -> Iterator[Message]:
            own = [*map(ahead, group.sources(choice, sources or {}))]
            recorded = group.recorded(span if is_span else None)
            if group.recorded_ids:  # else a thread would be begun for nothing
                recorded = ahead(recorded)
            if not is_span:
                return group.merged(own, recorded, self._whole)
            return by_time(recorded, *((item for _, item in source) for source in own))

        groups = (item for item in self._groups if topics is None or item.channel.topic in topics)
        found = self.messages_file.in_time(span) if is_span else self.messages_file.in_file_order()
        others = self._verbatim_channels
        ids = {item.id for item in others if topics is None or item.topic in topics}
        verbatim = (
            record
            for record in found
            if not isinstance(record, Message) or record.channel.id in ids
        )
        return by_time(ahead(verbatim), *map(messages, groups))

    def times(self, topics: Collection[str] | None = None) -> dict[int, NDArray[np.int64]]:
        """Sorted log times of every message, nanoseconds, by channel id; decodes no frame.

        Args:
            topics: Only of these topics; None for all.
        """
        found = {}
        for group in self._groups:
            if topics is None or group.channel.topic in topics:
                own = [part.columns.log_time for part in group.parts]
                found[group.channel.id] = np.sort(np.concatenate([group.recorded_times, *own]))
        times = self.messages_file.times
        for channel in self._verbatim_channels:
            if channel.id in times and (topics is None or channel.topic in topics):
                found[channel.id] = times[channel.id]
        return found

    @property
    def slice_start(self) -> int | None:
        """Where the slice begins that it holds, as a log time; None if it holds no slice.

        Earlier messages are latched ones, which late subscribers would have got.
        """
        excerpts = [source.excerpt for source in self.manifest.sources] if self.manifest else []
        starts = [item.start for item in excerpts if item and item.start is not None]
        return min(starts) if starts and len(starts) == len(excerpts) else None

    @cached_property
    def latched_before(self) -> Mapping[str, int]:
        """Number of latched messages from before the slice that it holds, by topic."""
        found: Counter[str] = Counter()
        begin = self.slice_start
        if begin is None:
            return found
        times = self.times()
        for channel in self.channels:
            found[channel.topic] += int(np.searchsorted(times.get(channel.id, []), begin))
        return +found

    def counts(self) -> dict[int, int]:
        """Number of messages by channel id; decodes nothing."""
        counts = self.messages_file.counts
        found = {item.id: counts.get(item.id, 0) for item in self._verbatim_channels}
        for group in self._groups:
            found[group.channel.id] = group.recorded_count + sum(map(len, group.parts))
        return found

    @property
    def is_in_time(self) -> bool:
        """Whether the messages of a time span are consecutive in each channel."""
        return all(group.is_in_time for group in self._groups)

    def gaps(self) -> list[tuple[str, str]]:
        """Topics with missing messages according to the columns, and what is missing."""
        return [(group.channel.topic, gap) for group in self._groups if (gap := group.gap)]

    def recorded_messages(self, excerpt: Excerpt) -> Iterator[Message]:
        """Messages in messages.mcap, by log time, on their channels."""
        owners = {key: group.channel for group in self._groups for key in group.recorded_ids}
        for message in self.messages_file.in_time(excerpt):
            owner = owners.get(message.channel.id)
            yield replace(message, channel=owner) if owner else message

    def close(self) -> None:
        """Close all videos."""
        for topic in filter(None, self._looked_up.values()):
            topic.close()

    def __enter__(self) -> Dataset:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_dataset(path: Path | str, *, layer: Layer | None = None) -> Dataset:
    """Open a dataset, or one video with its sidecar. See `Dataset`.

    A video without a sidecar or dataset can be opened, too: its topic is the file name without
    extension, its frames are ``rgb8``, converted by the video's colour tags and in coded
    orientation, and their stamps are presentation times, the first usually 0.

    Args:
        path: See `Dataset`.
        layer: See `Dataset`.

    Raises:
        Mp4dsError: See `Dataset`.
    """
    place = location(path)
    is_half = place.name.endswith(EXACT_SUFFIX)  # of two videos: differences show nothing
    if place.suffix.lower() in _VIDEOS and not is_half and place.is_file():
        beside = (sidecar_of(place), place.parent / MANIFEST_NAME)
        if not any(path.exists() for path in beside):
            return Dataset.of(place, None, [], MessagesFile(None), VideoImages(place))
    return Dataset(place, layer=layer)


# ---------------------------------------------------------------- many datasets

Paths = str | Path | Sequence[str | Path]
"""A path or several."""


def datasets_in(paths: Paths) -> list[Path]:
    """The datasets given by paths, in the same order.

    Args:
        paths: Datasets, sidecars, videos; folders of datasets, at any depth; patterns such as
            ``drives/*``; or URLs, but not URL patterns.

    Raises:
        SourceNotFoundError: A path does not exist, or a pattern matches nothing.
        SourceError: A folder has no dataset in it or below it.
    """
    several = [paths] if isinstance(paths, (str, Path, RemotePath)) else paths
    return [dataset for path in several for dataset in _datasets_at(location(path))]


def _datasets_at(path: Path) -> list[Path]:
    if path.exists():
        return _below(path)
    # Path.glob takes no absolute patterns
    matches = sorted(glob.glob(str(path))) if glob.has_magic(str(path)) else []  # noqa: PTH207
    folders = [Path(match) for match in matches if Path(match).is_dir()]
    if not folders:
        raise SourceNotFoundError(path)
    found: list[Path] = []
    for folder in folders:
        with suppress(SourceError):  # a pattern matches other folders, too
            found += _below(folder)
    if not found:
        raise SourceError(path, "matches no dataset", "Give folders made by `mp4ds pack`.")
    return found


def _below(path: Path) -> list[Path]:
    if path.name == MANIFEST_NAME:
        return [path.parent]
    if not path.is_dir() or (path / MANIFEST_NAME).is_file():
        return [path]
    refuse_unfinished(path)
    found = sorted(manifest.parent for manifest in path.rglob(MANIFEST_NAME))
    if not isinstance(path, RemotePath):  # names that begin with a dot are being made
        below = {one: one.relative_to(path).parts for one in found}
        found = [one for one in found if not any(part.startswith(".") for part in below[one])]
    if not found:
        raise SourceError(
            path,
            f"holds no dataset: there is no {MANIFEST_NAME} in it or below it",
            "Give a folder made by `mp4ds pack`.",
        )
    return found
