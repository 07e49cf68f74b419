"""What a pack is asked for, and what it tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.video.codecs import DEFAULT_GOP

_MAX_REASONS = 10


@dataclass(frozen=True)
class PackOptions:
    """How to pack.

    Attributes:
        topics: Globs of the topics to pack; empty for all.
        exclude: Globs of topics to leave out.
        quality: ``lossless``, ``visual`` or ``crf=N``.
        codec: ``h264``, ``h265``, ``av1`` or ``ffv1``; None chooses by measurement.
        preset: The encoder's preset; None chooses.
        transcode: Encode JPEG topics anew, by `quality`, instead of copying their files.
        camera_info: Pairs ``IMAGE=INFO`` of topics that belong together, beyond what names tell.
        gop: Most frames from one key frame to the next.
        jobs: Streams encoded side by side; None for one per core.
        force: Replace an existing dataset.
    """

    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    quality: str = "lossless"
    codec: str | None = None
    preset: str | None = None
    transcode: bool = False
    camera_info: Sequence[str] = ()
    gop: int = DEFAULT_GOP
    jobs: int | None = None
    force: bool = False


@dataclass(frozen=True)
class PackProgress:
    """Where a pack stands.

    Attributes:
        bytes_read: Bytes of the source consumed.
        bytes_total: Bytes of the source.
        bytes_written: Bytes of the dataset so far.
        frames: Frames accepted so far.
    """

    bytes_read: int
    bytes_total: int
    bytes_written: int
    frames: int


@dataclass
class TopicSummary:
    """What became of a topic.

    Attributes:
        topic: Its name.
        type_name: Its message type.
        messages: Messages packed.
        frames: Messages of these that are frames of a video or entries of its camera_info.
        raw_bytes: Payload bytes of all messages.
        packed_bytes: Bytes of its videos and sidecars; 0 for one that is in messages.mcap.
        files: Its videos.
        verbatim: Reason -> (messages, number of the first) for camera messages stored verbatim.
        notes: What else is worth knowing.
    """

    topic: str
    type_name: str
    messages: int = 0
    frames: int = 0
    raw_bytes: int = 0
    packed_bytes: int = 0
    files: list[str] = field(default_factory=list)
    verbatim: dict[str, tuple[int, int]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def count_verbatim(self, reason: str, number: int) -> None:
        """Count one more message stored verbatim, the topic's message of that number."""
        if reason not in self.verbatim and len(self.verbatim) >= _MAX_REASONS:
            reason = "other reasons"
        count, first = self.verbatim.get(reason, (0, number))
        self.verbatim[reason] = (count + 1, first)


@dataclass(frozen=True)
class PackSummary:
    """What a pack did.

    Attributes:
        dataset: The folder made.
        topics: One entry per topic, in the recording's order.
        source_bytes: Bytes of the source files.
        dataset_bytes: Bytes of the dataset.
        messages_bytes: Bytes of messages.mcap.
        left_out: Topics left out on request.
        skipped: What the source holds and no dataset can: a phrase -> how many.
    """

    dataset: Path
    topics: list[TopicSummary]
    source_bytes: int
    dataset_bytes: int
    messages_bytes: int
    left_out: list[str]
    skipped: dict[str, int]
