"""A pack divided into tasks: what each has to do, on whatever machine it runs."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mp4ds._version import __version__
from mp4ds.bags.formats import RECORDING_SUFFIXES, open_reader, open_sources
from mp4ds.bags.latched import take_slice
from mp4ds.bags.protocols import BagReader
from mp4ds.errors import OptionError, SourceError
from mp4ds.files.sources import SourceState, source_digest, source_name, source_size
from mp4ds.files.urls import location, spelled
from mp4ds.format.fields import document_of
from mp4ds.format.manifest import About
from mp4ds.format.sidecars import MANIFEST_NAME, load_about
from mp4ds.options import CONTENT, ENCODING, WHOLE, Slice
from mp4ds.packing.manifest import dump_kept, load_kept
from mp4ds.packing.options import ImageFolder, PackOptions, PackSummary
from mp4ds.packing.packer import Exact, PartSettings
from mp4ds.packing.survey import Survey
from mp4ds.packing.tracks import StreamSettings
from mp4ds.plan import Selection, parse_purpose, parse_quality
from mp4ds.records import Excerpt
from mp4ds.registry import plugin
from mp4ds.video.encoder import tool_versions

TASK_NAME = r"source-[0-9]{1,9}|whole-[0-9]{1,9}|[0-9]{5,9}-[0-9]{1,9}|all"
"""Pattern of task names, which are also folder names."""

_MOST_THREADS = 4096


@dataclass(frozen=True, slots=True)
class Task:
    """One part of a job.

    Attributes:
        name: Of the folder of its result.
        start: First log time it takes, ns; None: from the beginning.
        end: Log time it stops before; None: to the end.
        topics: It takes these topics; None: all except `without`.
        without: Topics that others take.
        others: Whether it takes attachments and metadata.
        source: Number of the file to hash, for tasks that do only that; None for others.
        solo: Whether it takes its topics for the whole recording.
        whole: Whether it takes the whole recording, so that there is nothing to join.
    """

    name: str
    start: int | None = None
    end: int | None = None
    topics: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    others: bool = False
    source: int | None = None
    solo: bool = False
    whole: bool = False

    def __post_init__(self) -> None:
        if not re.fullmatch(TASK_NAME, self.name):
            raise ValueError(f"{self.name!r} is not the name of a task")

    @property
    def excerpt(self) -> Excerpt:
        """What it reads."""
        topics = None if self.topics is None else frozenset(self.topics)
        return Excerpt(
            start=self.start,
            end=self.end,
            topics=topics,
            without=frozenset(self.without),
            others=self.others,
        )


@dataclass(frozen=True)
class Job:
    """A pack, planned.

    Attributes:
        paths: The recordings, absolute or URLs, as they were given.
        sources: The state of all their files.
        options: Those that determine the result.
        threads: Of each encoder.
        workers: Streams that a task encodes in parallel.
        survey: What all tasks agree on.
        tasks: In the order of their time.
        work: By topic, its messages and the cost of one, in any unit.
        cameras: The topics of images.
        tools: Versions of what packs.
        place: Inode of the folder in which it was started; 0 before.
    """

    paths: list[str]
    sources: list[SourceState]
    options: dict[str, Any]
    threads: int
    workers: int
    survey: Survey
    tasks: list[Task]
    work: dict[str, tuple[int, float]]
    cameras: list[str]
    tools: dict[str, str]
    place: int = 0

    def to_json(self) -> bytes:
        """The job's file."""
        values = {
            "paths": self.paths,
            "sources": [asdict(source) for source in self.sources],
            "options": self.options,
            "threads": self.threads,
            "workers": self.workers,
            "survey": self.survey.to_values(),
            "tasks": [asdict(task) for task in self.tasks],
            "work": self.work,
            "cameras": self.cameras,
            "tools": self.tools,
            "place": self.place,
        }
        return dump_kept(values)

    @classmethod
    def from_json(cls, data: bytes) -> Job:
        """The job of a file.

        Raises:
            ValueError: It is damaged, or another version's.
        """
        values = load_kept(data)
        try:
            job = cls(
                **{
                    **values,
                    "sources": [SourceState(**item) for item in values["sources"]],
                    "survey": Survey.from_values(values["survey"]),
                    "tasks": [_task(item) for item in values["tasks"]],
                    "work": {
                        topic: (int(count), float(cost))
                        for topic, (count, cost) in values["work"].items()
                    },
                }
            )
            job._check()
        except (TypeError, LookupError, AttributeError, ValueError) as error:
            raise ValueError(f"not a job of this version: {error}") from None
        return job

    def _check(self) -> None:
        """Refuse what is never planned.

        Raises:
            ValueError: Says what.
        """
        names = {task.name for task in self.tasks}
        numbers = (self.threads, self.workers)
        if len(names) != len(self.tasks):
            raise ValueError("two tasks with the same name")
        paths = [*self.paths, *(source.path for source in self.sources)]
        if not all(isinstance(path, str) and "\0" not in path for path in paths):
            raise ValueError("a file with an invalid name")
        if any(not 0 <= (task.source or 0) < len(self.sources) for task in self.tasks):
            raise ValueError("a task of a file that is not in the recording")
        if not all(isinstance(number, int) and number > 0 for number in numbers):
            raise ValueError("not a number of threads")
        if max(self.threads, self.workers) > _MOST_THREADS:
            raise ValueError("too many threads")
        if set(self.options) != set(outcome_options(PackOptions())):
            raise ValueError("different options")
        self.about  # noqa: B018 - refuses what cannot be told

    @property
    def is_single(self) -> bool:
        """Whether one task packs everything."""
        return any(task.whole for task in self.tasks)

    def task(self, name: str) -> Task:
        """The task of a name.

        Raises:
            LookupError: There is none.
        """
        return {task.name: task for task in self.tasks}[name]

    @property
    def about(self) -> About | None:
        """The description of the recording, if there is one."""
        told = self.options["about"]
        return None if told is None else About.model_validate(told)

    def open(self) -> BagReader:
        """The recording."""
        paths = [location(path) for path in self.paths]
        images = self.options["images"]
        return open_recording(
            paths,
            salvage=bool(self.options["salvage"]),
            images=None if images is None else ImageFolder(**images),
            asked=self.slice,
        )

    @property
    def slice(self) -> Slice:
        """The slice of the recording to pack; false for all."""
        names = ("start", "end", "duration", "latched")
        return PackOptions(**{name: self.options[name] for name in names}).slice

    def digests(
        self, reader: BagReader, digest_of: Callable[[int], tuple[int, str]]
    ) -> list[tuple[str, int, str | None]]:
        """Name, size in bytes and SHA-256 of each file of the recording.

        Files read only in part are not hashed.

        Args:
            reader: The recording.
            digest_of: Returns size and SHA-256 of a file by its number.
        """
        folder = reader.path if reader.path.is_dir() else None
        found: list[tuple[str, int, str | None]] = []
        for number, path in enumerate(reader.files):
            is_read = is_hashed(path, self.slice)
            size, sha256 = digest_of(number) if is_read else (source_size(path), None)
            found.append((source_name(path, folder), size, sha256))
        return found

    def check_sources(self, files: Sequence[Path] | None = None) -> None:
        """Refuse a recording that has changed since the job was planned.

        Args:
            files: Its current files, if known.

        Raises:
            SourceError: Names the file that changed.
        """
        if files is not None and absolute(files) != [source.path for source in self.sources]:
            raise SourceError(
                location(self.paths[0]),
                "consists of different files than when packing began",
                "Start over with `restart`.",
            )
        for source in self.sources:
            source.check()

    def settings(self, task: Task, exact: Exact) -> PartSettings:
        """How a task packs.

        Args:
            task: One of the job's.
            exact: Streams made lossless because they cannot reach the score.
        """
        options = self.options
        return PartSettings(
            streams=StreamSettings(
                quality=parse_quality(options["quality"]),
                codec=options["codec"],
                preset=options["preset"],
                gop=options["gop"],
                threads=self.threads,
                transcode=options["transcode"],
                purpose=options["purpose"] and parse_purpose(options["purpose"]),
            ),
            selected=Selection(options["topics"], options["exclude"]),
            excerpt=task.excerpt,
            survey=self._survey_for(task),
            camera_info=tuple(options["camera_info"]),
            workers=self.workers,
            compression="zstd" if task.whole else "lz4",  # that is read once, in the joining
            exact=exact,
        )

    def _survey_for(self, task: Task) -> Survey | None:
        if task.whole:
            return None
        return Survey(pairs=self.survey.pairs) if task.solo else self.survey


def open_recording(
    paths: Sequence[Path],
    *,
    salvage: bool = False,
    images: ImageFolder | None = None,
    asked: Slice = WHOLE,
) -> BagReader:
    """Open the source to pack.

    Args:
        paths: Recordings and datasets that belong together, or a folder of images.
        salvage: Read what can be read of damaged recordings.
        images: How to read the folder of images; None for recordings.
        asked: The slice to pack.

    Raises:
        SourceError: It cannot be read.
        OptionError: The options do not apply to it.
    """
    reader = _open_whole(paths, salvage, images)
    if asked:
        try:
            take_slice(reader, asked)
        except BaseException:
            reader.close()
            raise
    return reader


def _open_whole(paths: Sequence[Path], salvage: bool, images: ImageFolder | None) -> BagReader:
    if salvage and any(map(dataset_at, paths)):
        raise OptionError("`salvage` works with recordings, not with a dataset.")
    if images is None:
        return open_sources(paths, salvage=salvage, opener=_open_one)
    if salvage:
        raise OptionError("`salvage` works with recordings, not with a folder of images.")
    if len(paths) != 1:
        raise OptionError(
            f"Only one folder of images can be imported at a time, but {len(paths)} were given."
        )
    reader: BagReader = plugin("images")(paths[0], images)
    return reader


def dataset_at(path: Path) -> Path | None:
    """The folder of a dataset that is to be repacked; None for a recording."""
    folder = path.parent if path.name == MANIFEST_NAME else path
    if folder.suffix in RECORDING_SUFFIXES:  # saves a request for URLs
        return None
    try:
        return folder if (folder / MANIFEST_NAME).is_file() else None
    except OSError:
        return None  # opening it will say why


def _open_one(path: Path) -> BagReader:
    folder = dataset_at(path)
    if folder is None:
        return open_reader(path)
    from mp4ds.dataset.recording import DatasetReader

    return DatasetReader(folder)


def _task(item: Mapping[str, Any]) -> Task:
    topics = item["topics"]
    return Task(
        **{
            **item,
            "topics": None if topics is None else tuple(topics),
            "without": tuple(item["without"]),
        }
    )


def outcome_options(options: PackOptions) -> dict[str, Any]:
    """The options that determine the result, as JSON values."""
    values = options.changing(CONTENT, ENCODING)
    values["gop"] = options.group_frames
    values["about"] = None if options.about is None else document_of(load_about(options.about))
    values["images"] = None if options.images is None else asdict(options.images)
    for name in ("quality", "purpose", "start", "end", "duration"):
        values[name] = None if values[name] is None else str(values[name])
    return {
        name: list(value) if isinstance(value, (list, tuple)) else value
        for name, value in values.items()
    }


def tools() -> dict[str, str]:
    """Versions of the software used: parts made by different versions may not fit together."""
    return {"mp4ds": __version__, **tool_versions()}


def absolute(paths: Sequence[Path]) -> list[str]:
    """Paths of recordings as stored in a job."""
    return [spelled(path) for path in paths]


def is_hashed(path: Path, asked: Slice) -> bool:
    """Whether a recording's file is hashed: not if only a slice of it is read."""
    return not asked or path.name == MANIFEST_NAME


def with_latched(summary: PackSummary, reader: BagReader) -> PackSummary:
    """The summary of what was read, with the latched messages from before a slice."""
    too_large = [topic for topic in reader.slice.left_out if topic not in summary.left_out]
    latched = Counter(message.channel.topic for message in reader.slice.latched)
    packed = {topic: n for topic, n in latched.items() if topic not in summary.left_out}
    return replace(summary, latched=packed, latched_left_out=too_large)


def digest_source(source: SourceState) -> Sequence[object]:
    """Size and SHA-256 of a recording's file.

    Raises:
        SourceError: It cannot be read.
    """
    path = location(source.path)
    try:
        return source_digest(path)
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
