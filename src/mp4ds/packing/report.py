"""What a pack is asked for, and what it tells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mp4ds.errors import OptionError
from mp4ds.importing.options import ImageFolder
from mp4ds.plan import parse_quality
from mp4ds.records import Loss
from mp4ds.video.codecs import GOPS, LOSSLESS_GOP, LOSSY_GOP

_MAX_REASONS = 10
_OTHER = "other reasons"


@dataclass(frozen=True)
class PackOptions:
    """How to pack.

    Attributes:
        topics: Globs of the topics to pack; empty for all.
        exclude: Globs of topics to leave out.
        quality: ``lossless``, ``visual``, ``crf=N``, or a score that the frames are to have:
            ``vmaf=99.5``, ``psnr=42`` or ``ssim=0.98``.
        codec: ``h264``, ``h265``, ``av1``, ``av1-10bit`` or ``ffv1``, or an encoder of the
            hardware, such as ``h264-nvenc``; None chooses by measurement.
        preset: The encoder's preset; None chooses.
        transcode: Encode JPEG topics anew, by `quality`, instead of copying their files.
        camera_info: Pairs ``IMAGE=INFO`` of topics that belong together, beyond what names tell.
        purpose: ``archive``: few key frames, for the smallest files; ``training``: many, for the
            fastest random access; None: in between.
        gop: Most frames from one key frame to the next; None: by `purpose`.
        window: Frames of the busiest camera in each part that is packed apart; None: 10 groups
            of `gop`.
        jobs: Processes at a time, of a recording that is packed in parts, else streams encoded
            side by side; None for as many as keep all cores busy.
        memory: Bytes that may be used; None for half of the machine's.
        cluster: Dask scheduler (``tcp://HOST:PORT``) or batch system (``slurm`` ...) whose
            workers run the parts; None for this machine.
        join: Only make the dataset of what `mp4ds.packing.pack_share` packed.
        keep_going: Go on with the other parts where one fails, and report all failures at the end.
        salvage: Pack what can be read of a damaged recording.
        restart: Start over where an unfinished pack was left.
        force: Replace an existing dataset.
        images: How a folder of images is read as a recording; None for recordings.
    """

    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    quality: str = "lossless"
    codec: str | None = None
    preset: str | None = None
    transcode: bool = False
    camera_info: Sequence[str] = ()
    purpose: str | None = None
    gop: int | None = None
    window: int | None = None
    jobs: int | None = None
    memory: int | None = None
    cluster: str | None = None
    join: bool = False
    keep_going: bool = False
    salvage: bool = False
    restart: bool = False
    force: bool = False
    images: ImageFolder | None = None

    @property
    def group_frames(self) -> int:
        """Most frames from one key frame to the next.

        Raises:
            OptionError: `quality` or `purpose` is none.
        """
        lossless = parse_quality(self.quality).lossless
        if self.purpose is not None and self.purpose not in GOPS:
            raise OptionError(f"--for {self.purpose!r} is not one of {', '.join(GOPS)}.")
        if self.purpose is not None and self.gop is not None:
            raise OptionError("--for chooses what --gop says. Give one of them.")
        if self.purpose is not None:
            return GOPS[self.purpose]
        return self.gop or (LOSSLESS_GOP if lossless else LOSSY_GOP)


@dataclass(frozen=True)
class PackProgress:
    """Where a pack stands.

    Attributes:
        dataset: What is being made.
        phase: ``planning``, ``packing``, ``joining`` or, for a URL, ``uploading``.
        done: Share of the work of this phase that is done, 0 to 1; None where nothing tells.
        bytes_read: Payload bytes of the messages packed so far.
        bytes_total: Bytes of the source files.
        bytes_written: Bytes of the dataset so far.
        topics: Messages packed so far and in all (None: not known), by topic of a camera.
        tasks_done: Parts that are done.
        tasks_total: Parts that there are; 0 for a recording packed in one go.
        tasks_before: Of those done, the ones that an earlier run did.
        failed: Parts that failed.
        note: What is being done now, if it is worth telling.
    """

    dataset: Path
    phase: str
    done: float | None
    bytes_read: int
    bytes_total: int
    bytes_written: int
    topics: Mapping[str, tuple[int, int | None]]
    tasks_done: int = 0
    tasks_total: int = 0
    tasks_before: int = 0
    failed: int = 0
    note: str = ""

    @property
    def frames(self) -> int:
        """Camera messages packed so far."""
        return sum(done for done, _ in self.topics.values())


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
            reason = _OTHER
        count, first = self.verbatim.get(reason, (0, number))
        self.verbatim[reason] = (count + 1, first)

    def extend(self, later: TopicSummary, before: int) -> None:
        """Add what became of later messages.

        Args:
            later: Of these messages alone.
            before: Messages of the topic before them.
        """
        self.messages += later.messages
        self.frames += later.frames
        self.raw_bytes += later.raw_bytes
        for reason, (count, number) in later.verbatim.items():
            if reason not in self.verbatim and len(self.verbatim) >= _MAX_REASONS:
                reason = _OTHER
            known, first = self.verbatim.get(reason, (0, before + number))
            self.verbatim[reason] = (known + count, first)
        self.notes.extend(note for note in later.notes if note not in self.notes)


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
        losses: What could not be read of a damaged recording.
        larger: Why the dataset is larger than its source, where it is by more than 5 %.
    """

    dataset: Path
    topics: list[TopicSummary]
    source_bytes: int
    dataset_bytes: int
    messages_bytes: int
    left_out: list[str]
    skipped: dict[str, int]
    losses: list[Loss] = field(default_factory=list)
    larger: str = ""
