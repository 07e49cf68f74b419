"""The model of a manifest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from mp4ds import records
from mp4ds.format.fields import Count, FileName, Model, Profile, Sha256, Size, Time, Version
from mp4ds.format.models import StreamSidecar
from mp4ds.messages.encodings import MAX_SIDE
from mp4ds.messages.transforms import MAX_TRANSFORMS, Transform, TransformCollector
from mp4ds.records import MAX_LOSSES, MAX_LOST_TOPICS, Loss


class Excerpt(Model):
    """A span of log time, ns."""

    start: Time | None = Field(None, description="The first time in it; absent: no bound.")
    end: Time | None = Field(None, description="The first time after it; absent: no bound.")


class Source(Model):
    """A recording file that was packed."""

    name: str = Field(description="File name, for a rosbag2 folder with the folder's name.")
    size: Size = Field(description="Bytes.")
    sha256: Sha256 | None = Field(
        None, description="Absent where only a part was packed, and so only that was read."
    )
    excerpt: Excerpt | None = Field(
        None, description="What of it was packed; absent where all was, but topics left out."
    )

    def within(self, span: records.Excerpt) -> Source:
        """The same, of which only what lies in the span of an excerpt is packed."""
        if span.start is None and span.end is None:
            return self
        own = self.excerpt or Excerpt()
        span = span.within(records.Excerpt(own.start, own.end))
        return self.model_copy(update={"excerpt": Excerpt(start=span.start, end=span.end)})


class EarlierDataset(Model):
    """A dataset that was packed again."""

    name: str = Field(description="Of its folder.")
    profile: Profile = Field(description="What was asked for when it was packed.")
    sha256: Sha256 = Field(description="Of its manifest, which has those of all its files.")


_Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
_Place = Annotated[int, Field(ge=0, le=MAX_SIDE)]


class ReducedImages(Model):
    """What the images of a topic were before a reduction."""

    topic: str
    type: str = Field(description="Of their messages.")
    encoding: str = Field(description="ROS image encoding of the first, decoded.")
    width: _Side = Field(description="Columns of the first.")
    height: _Side = Field(description="Rows of the first.")


class ReductionEntry(Model):
    """How images were made smaller, or fewer, before they were packed."""

    crop: Annotated[list[_Place], Field(min_length=4, max_length=4)] | None = Field(
        None, description="x, y, width and height of the part that was kept, pixels."
    )
    factor: Annotated[FiniteFloat, Field(gt=0)] | None = Field(
        None, description="By which width and height were multiplied, after the crop."
    )
    size: Annotated[list[_Side], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Width and height to which images were resized, after the crop."
    )
    nearest: list[str] = Field(
        default_factory=list, description="Patterns of topics of which no values were mixed."
    )
    every: Annotated[int, Field(ge=2)] | None = Field(
        None, description="Only every Nth image of each channel was kept, from the first on."
    )
    max_rate: Annotated[FiniteFloat, Field(gt=0)] | None = Field(
        None, description="Most images of each channel in a second, by their stamps."
    )
    images: list[ReducedImages] = Field(
        default_factory=list, description="Those that were cropped, resized or decoded."
    )

    @property
    def text(self) -> str:
        """All of it in words."""
        told = [
            f"cropped to {self.crop[2]}x{self.crop[3]} at {self.crop[:2]}" if self.crop else "",
            f"resized by {self.factor:g}" if self.factor else "",
            f"resized to {self.size[0]}x{self.size[1]}" if self.size else "",
            f"without mixing values of {', '.join(self.nearest)}" if self.nearest else "",
            f"one image in {self.every}" if self.every else "",
            f"at most {self.max_rate:g} images a second" if self.max_rate else "",
        ]
        return ", ".join(filter(None, told))


class UntouchedPart(Model):
    """Proof of what a redaction left as it was."""

    values: Annotated[str, Field(pattern=r"^([1-9][0-9]{0,7} ([0-9a-f]{2})+ [0-9a-f]{64}\n)+$")] = (
        Field(description="A line for each span of images.")
    )


class RedactedTopic(Model):
    """What a redaction did to the images of a topic."""

    topic: str
    type: str = Field(description="Of their messages before.")
    images: Size = Field(description="Messages of images that were looked at.")
    changed: Size = Field(description="Images of these that were changed.")
    untouched: UntouchedPart | None = Field(
        None, description="Digests of the blocks without any change; absent: none were made."
    )


class RedactionEntry(Model):
    """How images were redacted before they were packed."""

    rules_sha256: Sha256 | None = Field(None, description="Of the file of rules.")
    rules_text: str | None = Field(
        None, description="The file itself, with its boxes; absent: it does not say `keep_rules`."
    )
    function: str | None = Field(
        None, description="Module and name of the function that found what to change."
    )
    rules: list[Size] = Field(
        default_factory=list, description="Images that each rule of the file changed."
    )
    topics: list[RedactedTopic] = Field(
        default_factory=list, description="Those of which images were looked at."
    )

    @property
    def text(self) -> str:
        """All of it in words."""
        told = (f"{one.changed} of {one.images} of {one.topic}" for one in self.topics)
        return ", ".join(told) or "none"

    @property
    def told(self) -> dict[str, str]:
        """What was done, by the file of rules or the function."""
        values = {"rules_sha256": self.rules_sha256, "function": self.function}
        return {key: value for key, value in values.items() if value}

    def proving(self, is_proven: Callable[[str], bool] = lambda _: False) -> RedactionEntry:
        """The same, with digests of the topics of which all images are as they were."""
        topics = [
            one if is_proven(one.topic) else one.model_copy(update={"untouched": None})
            for one in self.topics
        ]
        return self.model_copy(update={"topics": topics})

    @classmethod
    def joined(cls, parts: Sequence[RedactionEntry]) -> RedactionEntry:
        """That of a recording, of those of its parts, at least one."""
        topics: dict[str, RedactedTopic] = {}
        for own in (topic for part in parts for topic in part.topics):
            if before := topics.get(own.topic):
                values = [one.untouched.values for one in (before, own) if one.untouched]
                own = before.model_copy(
                    update={
                        "images": before.images + own.images,
                        "changed": before.changed + own.changed,
                        "untouched": UntouchedPart(values="".join(values)) if values else None,
                    }
                )
            topics[own.topic] = own
        rules = [sum(counts) for counts in zip(*(part.rules for part in parts), strict=True)]
        return parts[0].model_copy(update={"rules": rules, "topics": list(topics.values())})


class StreamEntry(Model):
    """A stream of the dataset."""

    topic: str
    sidecar: FileName
    video: FileName
    view: FileName | None = Field(None, description="Of a stream that has one.")
    frames: Count

    @classmethod
    def of(cls, name: str, stream: StreamSidecar) -> StreamEntry:
        """The entry of a stream, whose sidecar has this name."""
        return cls(
            topic=stream.channel.topic,
            sidecar=name,
            video=stream.video.file,
            view=stream.view.file if stream.view else None,
            frames=stream.frames,
        )

    @property
    def files(self) -> list[str]:
        """Names of its files."""
        return [name for name in (self.sidecar, self.video, self.view) if name]


class FileEntry(Model):
    """A file of the dataset."""

    name: FileName
    size: Size = Field(description="Bytes.")
    sha256: Sha256


class Verbatim(Model):
    """Camera messages that are in messages.mcap as they were, and why."""

    topic: str
    messages: Size
    first: Size = Field(description="Number of the first of them among the topic's messages.")
    reason: str


class StaticTransform(Model):
    """Pose of a coordinate frame in another, which holds for the whole recording.

    A point p of the child frame is rotation * p + translation in the parent frame.
    """

    parent: str = Field(description="Frame in which the child is placed, as recorded.")
    child: str = Field(description="Frame that is placed, as recorded.")
    translation: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)] = Field(
        description="x, y, z of the child's origin, metres."
    )
    rotation: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)] = Field(
        description="x, y, z, w of a unit quaternion."
    )

    @classmethod
    def from_record(cls, transform: Transform) -> StaticTransform:
        """The model of a transform."""
        return cls(
            parent=transform.parent,
            child=transform.child,
            translation=list(transform.translation),
            rotation=list(transform.rotation),
        )

    def to_record(self) -> Transform:
        """The transform."""
        (x, y, z), (qx, qy, qz, qw) = self.translation, self.rotation
        return Transform(self.parent, self.child, (x, y, z), (qx, qy, qz, qw))


class LossEntry(Model):
    """Something of the recording that could not be read when it was packed."""

    file: str = Field(description="Name of the recording's file.")
    offset: Size | None = Field(None, description="Byte where it begins; absent without a place.")
    size: Size | None = Field(
        None, description="Bytes, of which some may have been read; absent where not known."
    )
    problem: str = Field(description="What is wrong, in words.")
    messages: Size | None = Field(
        None, description="Messages that are lost; absent where nothing tells."
    )
    topics: Annotated[list[str], Field(max_length=MAX_LOST_TOPICS)] = Field(
        default_factory=list, description="Of the messages that are lost, as far as known."
    )
    start: Time | None = Field(
        None, description="Log time of the last message read before it, ns; absent if not known."
    )
    end: Time | None = Field(
        None, description="Log time of the first message read after it, ns; absent if not known."
    )

    @classmethod
    def from_record(cls, loss: Loss) -> LossEntry:
        """The model of a loss."""
        values = {name: getattr(loss, name) for name in cls.model_fields}
        return cls.model_validate({**values, "topics": list(loss.topics)})

    def to_record(self) -> Loss:
        """The loss."""
        return Loss(**{**self.model_dump(), "topics": tuple(self.topics)})


class TimeRange(Model):
    """Log times of the first and the last message, ns, both included."""

    start: Time
    end: Time


_Text = Annotated[str, Field(min_length=1, max_length=10_000)]


_Link = Annotated[str, Field(pattern=r"^https?://[^\s]+$")]


class Author(Model):
    """Who made a recording."""

    name: _Text = Field(description="Of the person or group.")
    affiliation: _Text | None = Field(None, description="Where they work.")
    orcid: str | None = Field(
        None, pattern=r"^[0-9]{4}-[0-9]{4}-[0-9]{4}-[0-9]{3}[0-9X]$", description="Their ORCID iD."
    )


class About(Model):
    """What the recording is, who made it, and how it may be used."""

    title: _Text | None = Field(None, description="A line.")
    description: _Text | None = Field(None, description="Plain text.")
    authors: Annotated[list[Author], Field(max_length=1000)] = Field(
        default_factory=list, description="In their order."
    )
    license: _Text | None = Field(
        None, description="An identifier of SPDX such as CC-BY-4.0, or what else names it."
    )
    doi: str | None = Field(
        None, pattern=r"^10\.[0-9]{4,9}/[^\s]+$", description="Without a resolver's address."
    )
    links: Annotated[list[_Link], Field(max_length=100)] = Field(
        default_factory=list, description="Pages, papers, code."
    )
    keywords: Annotated[list[_Text], Field(max_length=100)] = Field(default_factory=list)

    @property
    def lines(self) -> list[str]:
        """A line for each key that is given."""
        authors = (
            ", ".join(filter(None, (author.name, author.affiliation, author.orcid)))
            for author in self.authors
        )
        told = {
            "title": self.title,
            "authors": "; ".join(authors),
            "license": self.license,
            "doi": self.doi,
            "links": " ".join(self.links),
            "keywords": ", ".join(self.keywords),
            "description": self.description,
        }
        return [f"{key}: {' '.join(text.split())}" for key, text in told.items() if text]


class Manifest(Model):
    """A dataset: its sources, its files, and what is in them."""

    mp4ds: Version = Field(description="Version of the format.")
    kind: Literal["dataset"]
    about: About | None = Field(None, description="Told by whoever packed it.")
    profile: Profile = Field(description="What was asked for.")
    format: Literal["bag", "rosbag2", "mcap"] = Field(description="Format of the recording.")
    recording_profile: str = Field(description="MCAP profile of the recording: ros1, ros2 ...")
    library: str = Field("", description="The recording's own library string.")
    sources: list[Source]
    derived_from: list[EarlierDataset] = Field(
        default_factory=list, description="Datasets that were packed again, the oldest first."
    )
    reductions: list[ReductionEntry] = Field(
        default_factory=list,
        description="What was done to the images before they were packed, the oldest first.",
    )
    redactions: list[RedactionEntry] = Field(
        default_factory=list,
        description="What was redacted before they were packed, the oldest first.",
    )
    messages: Size = Field(description="Messages of the recording that were packed.")
    losses: Annotated[list[LossEntry], Field(max_length=MAX_LOSSES)] = Field(
        default_factory=list, description="What of the recording could not be read."
    )
    topics_left_out: list[str] = Field(
        default_factory=list, description="Topics that were left out on request."
    )
    time_range: TimeRange | None = Field(None, description="Absent without messages.")
    streams: list[StreamEntry]
    transforms: Annotated[list[StaticTransform], Field(max_length=MAX_TRANSFORMS)] = Field(
        default_factory=list,
        description="Static transforms that connect the cameras: a copy of what /tf_static says.",
    )
    verbatim: list[Verbatim] = Field(default_factory=list)
    files: list[FileEntry]
    tools: dict[str, str] = Field(default_factory=dict, description="Versions that packed it.")

    def file(self, name: str) -> FileEntry | None:
        """The entry of a file; None if it is not listed."""
        return next((entry for entry in self.files if entry.name == name), None)

    @property
    def reduced(self) -> str:
        """What was done to the images before they were packed, in words; empty for nothing."""
        redacted, reduced = (
            "; then ".join(entry.text for entry in entries)
            for entries in (self.redactions, self.reductions)
        )
        told = {"redacted": redacted, "reduced": reduced}
        return "; ".join(
            f"images were {what} before they were packed: {text}"
            for what, text in told.items()
            if text
        )

    @model_validator(mode="after")
    def _once(self) -> Manifest:
        for what, names in (
            ("file", [entry.name for entry in self.files]),
            ("sidecar", [entry.sidecar for entry in self.streams]),
            ("video", [name for one in self.streams for name in (one.video, one.view) if name]),
        ):
            twice = [name for name, count in Counter(names).items() if count > 1]
            if twice:
                raise ValueError(f"{what} {twice[0]} is listed twice")
        return self


def static_transforms(
    sidecars: Iterable[StreamSidecar], known: Iterable[Transform]
) -> list[StaticTransform]:
    """The transforms between the coordinate frames of all images and calibrations."""
    frame_ids: set[str] = set()
    for sidecar in sidecars:
        frame_ids.update(header.frame_id for header in sidecar.headers)
        if sidecar.camera_info:
            frame_ids.update(item.frame_id for item in sidecar.camera_info.calibrations)
    found = TransformCollector(known).between(frame_ids)
    return list(map(StaticTransform.from_record, found))
