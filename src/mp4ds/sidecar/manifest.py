"""The model of a manifest."""

from __future__ import annotations

from collections import Counter
from typing import Literal

from pydantic import Field, model_validator

from mp4ds.sidecar.models import Count, FileName, Model, Profile, Sha256, Size, Time, Version


class Source(Model):
    """A recording file that was packed."""

    name: str = Field(description="File name, for a rosbag2 folder with the folder's name.")
    size: Size = Field(description="Bytes.")
    sha256: Sha256


class StreamEntry(Model):
    """A stream of the dataset."""

    topic: str
    sidecar: FileName
    video: FileName
    frames: Count


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


class TimeRange(Model):
    """Log times of the first and the last message, ns, both included."""

    start: Time
    end: Time


class Manifest(Model):
    """A dataset: its sources, its files, and what is in them."""

    mp4ds: Version = Field(description="Version of the format.")
    kind: Literal["dataset"]
    profile: Profile = Field(description="What was asked for.")
    format: Literal["bag", "rosbag2", "mcap"] = Field(description="Format of the recording.")
    recording_profile: str = Field(description="MCAP profile of the recording: ros1, ros2 ...")
    library: str = Field("", description="The recording's own library string.")
    sources: list[Source]
    messages: Size = Field(description="Messages of the recording that were packed.")
    topics_left_out: list[str] = Field(
        default_factory=list, description="Topics that were left out on request."
    )
    time_range: TimeRange | None = Field(None, description="Absent without messages.")
    streams: list[StreamEntry]
    verbatim: list[Verbatim] = Field(default_factory=list)
    files: list[FileEntry]
    tools: dict[str, str] = Field(default_factory=dict, description="Versions that packed it.")

    @model_validator(mode="after")
    def _once(self) -> Manifest:
        for what, names in (
            ("file", [entry.name for entry in self.files]),
            ("sidecar", [entry.sidecar for entry in self.streams]),
            ("video", [entry.video for entry in self.streams]),
        ):
            twice = [name for name, count in Counter(names).items() if count > 1]
            if twice:
                raise ValueError(f"{what} {twice[0]} is listed twice")
        return self
