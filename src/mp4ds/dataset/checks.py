"""``validate``: every problem of a sidecar, a dataset, or a folder of datasets.

Three tiers: schema (the released JSON Schema), model (types and rules of one file), checks
(rules over several files). Codes are listed in spec/registry.md, "Problem codes".
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from mp4ds.bags.formats import writer_of
from mp4ds.dataset.dataset import Dataset, datasets_in
from mp4ds.dataset.images import shown_by
from mp4ds.dataset.messages import MessagesFile, Part, recorded_storage
from mp4ds.dataset.redaction import differences, holds_pixels
from mp4ds.dataset.stream import Stream
from mp4ds.errors import (
    ConversionError,
    FormatError,
    Refused,
    SourceError,
    SourceNotFoundError,
    VideoError,
)
from mp4ds.files.urls import location
from mp4ds.format.fields import MESSAGES_NAME
from mp4ds.format.manifest import Manifest, StreamEntry, TimeRange
from mp4ds.format.models import StreamSidecar, VideoModel
from mp4ds.format.sidecars import (
    MANIFEST_NAME,
    THE_TOP,
    cut_short,
    load_document,
    model_problems,
    schema_text,
    sidecar_of,
    verify_file,
)
from mp4ds.messages.encodings import ENCODINGS, Encoding, Pixels
from mp4ds.messages.serializations import MessageSplitter, is_camera
from mp4ds.records import Message, Record
from mp4ds.video.access import Structures, digest_video, packets_of_groups
from mp4ds.video.mp4 import sample_table_of

_Report = Callable[[str, float | None], None]
_TELL_EVERY = 16  # frames
_Checked = TypeVar("_Checked")
_Model = TypeVar("_Model", StreamSidecar, Manifest)


@dataclass(frozen=True)
class Problem:
    """A problem found by validation.

    Attributes:
        code: Stable code, see spec/registry.md.
        place: File, with key, topic or frame where known.
        message: What is wrong.
    """

    code: str
    place: str
    message: str

    @classmethod
    def of(cls, error: FormatError) -> Problem:
        """The problem that an error tells of."""
        return cls(error.code, error.place, error.problem)

    def __str__(self) -> str:
        return f"{self.place}: {self.message} [{self.code}]"


def validate(
    path: Path | str,
    *,
    deep: bool = False,
    progress: Callable[[str, float | None], None] | None = None,
) -> list[Problem]:
    """Find all problems of a sidecar, a video with its sidecar, a dataset, or a folder of them.

    Args:
        path: What to validate, or its URL.
        deep: Also hash every file, decode every frame, rebuild every message, and compare.
        progress: Called with a phrase and the share of the work done, 0 to 1, if known.

    Returns:
        All problems; empty if there are none.

    Raises:
        SourceNotFoundError: The path does not exist.
        SourceError: It is not something that can be validated.
    """
    return list(dict.fromkeys(_problems(location(path), deep, progress or (lambda *_: None))))


def _problems(path: Path, deep: bool, report: _Report) -> list[Problem]:
    if not path.exists():
        raise SourceNotFoundError(path)
    if path.name == MANIFEST_NAME:
        path = path.parent
    if path.is_dir():
        folders = datasets_in(path)
        return [
            problem
            for number, folder in enumerate(folders)
            for problem in _validate_dataset(folder, deep, _scaled(report, number, len(folders)))
        ]
    sidecar = sidecar_of(path) if path.suffix == ".mp4" else path
    if sidecar.suffix not in (".yaml", ".yml"):
        raise SourceError(
            path,
            "is not a dataset, a sidecar or a dataset's video",
            "Give a dataset folder, a .yaml sidecar, or an .mp4 next to its sidecar.",
        )
    model, problems = _read(sidecar, "stream", StreamSidecar)
    if model is None:
        return problems
    stream = Stream(sidecar, sidecar=model)
    problems = _found(_check_stream(stream))
    return [*problems, *_found(_check_deep(stream, report))] if deep else problems


def _scaled(report: _Report, before: int, total: int, size: int = 1) -> _Report:
    """A progress callback for a part of the work.

    Args:
        report: Callback for the whole.
        before: Work done before the part, in any unit.
        total: The whole.
        size: The part.
    """

    def scaled(what: str, share: float | None = None) -> None:
        report(what, (before + size * (share or 0.0)) / max(1, total))

    return scaled


def _read(path: Path, kind: str, model: type[_Model]) -> tuple[_Model | None, list[Problem]]:
    """Check schema and model of one YAML file; the model is None if there is a problem."""
    try:
        document = load_document(path)
    except FormatError as error:
        return None, [Problem.of(error)]
    if document["kind"] != kind:
        return None, [Problem("kind-unknown", str(path), f"is not a {kind}")]
    if problem := cut_short(document):
        return None, [Problem("schema-invalid", str(path), problem)]
    problems = [
        Problem("schema-invalid", f"{path} at {place}", reason)
        for error in _schema_validator(kind).iter_errors(document)
        for place in [".".join(map(str, error.absolute_path)) or THE_TOP]
        for reason in [_shortened(error.message)]
    ]
    if problems:
        return None, problems
    try:
        return model.model_validate(document), []
    except ValidationError as error:
        return None, [
            Problem("model-invalid", f"{path} at {place}", reason)
            for place, reason in model_problems(error)
        ]


def _shortened(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:100]} ... {text[-80:]}"


@cache
def _schema_validator(kind: str) -> Any:
    from jsonschema import Draft202012Validator

    return Draft202012Validator(json.loads(schema_text(kind)))


def _found(errors: Iterable[FormatError]) -> list[Problem]:
    """The problems that errors tell of; one that is raised is the last."""
    found = []
    try:
        for error in errors:
            found.append(Problem.of(error))
    except FormatError as error:
        found.append(Problem.of(error))
    return found


def _validate_dataset(folder: Path, deep: bool, report: _Report) -> list[Problem]:
    """Check everything cheap, then, if deep, the rest."""
    manifest, problems = _read(folder / MANIFEST_NAME, "dataset", Manifest)
    if manifest is None:
        return problems
    of_files = _found(_check_files(folder, manifest, report))
    streams: list[Stream] = []
    for entry in manifest.streams:
        sidecar, found = _read(folder / entry.sidecar, "stream", StreamSidecar)
        problems += found
        if sidecar is not None:
            streams.append(Stream(folder / entry.sidecar, sidecar=sidecar))
            problems += _found(_check_entry(folder, entry, sidecar))
            problems += _found(_check_stream(streams[-1]))
    problems += _found(_check_listed(folder, manifest))
    dataset: Dataset | None = None
    if not of_files and not problems:
        dataset = Dataset.of(folder, manifest, streams, MessagesFile(folder / MESSAGES_NAME))
        problems += _found(_check_messages(dataset, manifest))
    if deep:
        problems += _found(_check_files(folder, manifest, report, deep=True))
        frames = [len(stream) for stream in streams]
        for number, stream in enumerate(streams):
            part = _scaled(report, sum(frames[:number]), sum(frames), frames[number])
            problems += _found(_check_deep(stream, part))
        if dataset is not None and not problems:
            report(f"reading {MESSAGES_NAME}", 1.0)
            problems += _found(_check_limits(dataset, manifest, _counted(dataset, manifest)))
            problems += _found(_check_untouched(dataset, manifest, report))
    told = {(problem.code, problem.place) for problem in of_files}
    return [*of_files, *(one for one in problems if (one.code, one.place) not in told)]


def _check_files(
    folder: Path, manifest: Manifest, report: _Report, *, deep: bool = False
) -> Iterator[FormatError]:
    """Check that each listed file exists with its size; small ones also with their hash.

    Args:
        folder: The dataset.
        manifest: Its manifest.
        report: See `validate`.
        deep: Check the hash of the others.
    """
    optional = {entry.video for entry in manifest.streams if entry.view}
    for entry in manifest.files:
        path = folder / entry.name
        if entry.name in optional and not path.exists():
            continue  # without it, the dataset is one of its views
        is_small = path.suffix == ".yaml"
        if deep and is_small:
            continue
        if deep or is_small:
            report(f"hashing {entry.name}", None)
        try:
            verify_file(path, entry, hashed=deep or is_small)
        except FormatError as error:
            yield error


def _inconsistent(folder: Path, problem: str) -> FormatError:
    return FormatError("manifest-inconsistent", folder / MANIFEST_NAME, problem)


def _check_listed(folder: Path, manifest: Manifest) -> Iterator[FormatError]:
    """Check that each file of the folder, and each stream's files, are in the manifest."""
    listed = {entry.name for entry in manifest.files}
    own = [name for entry in manifest.streams for name in entry.files]
    own.append(MESSAGES_NAME)
    for name in own:
        if name not in listed:
            yield _inconsistent(folder, f"does not list {name}")
    for name in sorted(listed.difference(own)):
        yield _inconsistent(folder, f"lists {name}, which belongs to no stream")
    alike: dict[str, str] = {}
    for name in sorted({*listed, MANIFEST_NAME}):
        if (other := alike.setdefault(name.casefold(), name)) != name:
            yield _inconsistent(
                folder, f"lists {other} and {name}, which may be one file elsewhere"
            )
    for path in sorted(folder.iterdir()):
        is_known = path.name in listed or path.name == MANIFEST_NAME
        if not is_known and path.suffix in (".mp4", ".yaml", ".mcap"):
            yield FormatError("file-unlisted", path, "is not listed in the manifest")


def _check_entry(folder: Path, entry: StreamEntry, sidecar: StreamSidecar) -> Iterator[FormatError]:
    """Check that a sidecar agrees with the manifest."""
    for what, own, listed in (
        ("topic", sidecar.channel.topic, entry.topic),
        ("video", sidecar.video.file, entry.video),
        ("view", sidecar.view and sidecar.view.file, entry.view),
        ("frames", sidecar.frames, entry.frames),
    ):
        if own != listed:
            problem = f"gives {what} {listed} for {entry.sidecar}, which gives {own}"
            yield _inconsistent(folder, problem)


def _check_stream(stream: Stream) -> Iterator[FormatError]:
    """Check a valid sidecar's columns, its scores and its videos."""
    for path, video in stream.videos:
        yield from _wrong_facts(path, video, deep=False)
    _ = stream.rebuilder  # decodes and checks the columns
    _ = stream.infos and stream.infos.templates
    quality = stream.sidecar.video.quality
    if quality is not None:
        try:
            quality.decode(len(stream))
        except ValueError as error:
            place = f"{stream.path} at video.quality.scores"
            raise FormatError("scores-invalid", place, str(error)) from None
    for layer in stream.layers:
        if (count := _count(layer)) != len(stream):
            problem = f"has {count} frames, but its sidecar says {len(stream)}"
            yield FormatError("frame-count", layer.video_path, problem)


def _count(stream: Stream) -> int:
    with stream.open_video(sequential=True) as decoder:
        return decoder.coded_frames


def _check_deep(stream: Stream, report: _Report) -> Iterator[FormatError]:
    """Check the videos' hashes, and that each frame decodes to a message of its digest, if any."""
    name = stream.video_path.name
    for path, video in stream.videos:
        report(f"hashing {path.name}", None)
        yield from _wrong_facts(path, video, deep=True)
    if any(_count(layer) != len(stream) for layer in stream.layers):
        return

    def tell(number: int) -> None:
        if number % _TELL_EVERY == 0:
            report(f"decoding {name}", number / len(stream))

    # a view that predicts is decoded with the images, another one is not
    for layer in [stream] if stream.sidecar.is_predicted else stream.layers:
        for error, *_ in layer.damages(tell):
            yield error


def _check_messages(dataset: Dataset, manifest: Manifest) -> Iterator[FormatError]:
    """Check that the number of messages is as packed, and that they can be unpacked."""
    gaps = [FormatError("messages-missing", topic, what) for topic, what in dataset.gaps()]
    if gaps:
        yield from gaps
        return
    total = sum(dataset.counts().values())
    if total != manifest.messages:
        problem = f"and the videos hold {total} messages, but the manifest says {manifest.messages}"
        yield FormatError("message-count", dataset.path / MESSAGES_NAME, problem)
        return
    yield from _check_verbatim(dataset, manifest)
    yield from _check_limits(dataset, manifest, ())


def _check_verbatim(dataset: Dataset, manifest: Manifest) -> Iterator[FormatError]:
    """Check that there are as many messages of each topic as are listed as stored verbatim."""
    totals, counts = Counter[str](), dataset.counts()
    for channel in dataset.channels:
        totals[channel.topic] += counts.get(channel.id, 0)
    recorded = Counter[str]()
    for channel in dataset.messages_file.channels:
        recorded[channel.topic] += dataset.messages_file.counts.get(channel.id, 0)
    for number, item in enumerate(manifest.verbatim):
        recorded[item.topic] -= item.messages
        problem = ""
        if not totals[item.topic]:
            problem = f"names topic {item.topic}, which has no messages"
        elif recorded[item.topic] < 0:
            problem = f"counts more messages of {item.topic} than {MESSAGES_NAME} holds"
        elif item.first + item.messages > totals[item.topic]:
            count = totals[item.topic]
            problem = f"begins at message {item.first} of {item.topic}, which has {count}"
        if problem:
            place = f"{dataset.path / MANIFEST_NAME} at verbatim.{number}"
            yield FormatError("manifest-inconsistent", place, problem)


def _check_untouched(
    dataset: Dataset, manifest: Manifest, report: _Report
) -> Iterator[FormatError]:
    """Check what a redaction left as it was against the digests of the originals."""
    for told in (topic for entry in manifest.redactions for topic in entry.topics):
        name = told.topic
        if told.untouched is None or dataset.absence(name.__eq__):
            continue
        report(f"comparing untouched blocks of {name}", 1.0)
        for problem in differences(told.untouched.values, _images(dataset, name)):
            place = f"{dataset.path / MANIFEST_NAME} at redactions"
            yield FormatError("redaction-mismatch", place, f"{name} {problem}")


def _images(dataset: Dataset, topic: str) -> Iterator[tuple[Encoding, Pixels]]:
    """The images of a topic of which messages have every sample."""
    splitters: dict[int, MessageSplitter] = {}
    for record in dataset.records(topics=[topic]):
        if isinstance(record, Message) and is_camera(record.channel):
            channel = record.channel
            with suppress(Refused):
                _, parts = splitters.setdefault(channel.id, MessageSplitter(channel)).split(record)
                if holds_pixels(parts):
                    shown = shown_by(channel, parts)
                    yield ENCODINGS[shown.encoding], shown.pixels


def _counted(dataset: Dataset, manifest: Manifest) -> Iterator[Record]:
    """All of messages.mcap, which must agree with its index and the manifest.

    Raises:
        FormatError: ``messages-unreadable``: a channel's number of messages differs;
            ``manifest-inconsistent``: the times of the first and last message of all do.
    """
    counts, place = Counter[int](), dataset.path / MESSAGES_NAME
    times = [message.log_time for stream in dataset.streams for message in _extremes(stream)]
    for record in dataset.messages_file.in_file_order():
        if isinstance(record, Message):
            counts[record.channel.id] += 1
            times = [min([record.log_time, *times]), max([record.log_time, *times])]
        yield record
    told = dataset.messages_file.counts
    for key in counts.keys() | told.keys():
        if counts[key] != told.get(key, 0):
            problem = f"holds {counts[key]} messages of channel {key}, but its index lists "
            raise FormatError("messages-unreadable", place, f"{problem}{told.get(key, 0)}")
    span, due = manifest.time_range, TimeRange(start=min(times), end=max(times)) if times else None
    if span != due:
        words = f"from {due.start} to {due.end}" if due else "absent, as there are no messages"
        where = f"{dataset.path / MANIFEST_NAME} at time_range"
        raise FormatError("manifest-inconsistent", where, f"must be {words}")


def _check_limits(
    dataset: Dataset, manifest: Manifest, records: Iterable[Record]
) -> Iterator[FormatError]:
    """Check that the recording's format can hold each channel and message, as unpacking requires.

    Args:
        dataset: The dataset.
        manifest: Its manifest.
        records: The records of messages.mcap.
    """
    storage = ""
    if manifest.format == "rosbag2":
        storage = recorded_storage(dataset.messages_file.in_file_order())
    writer = writer_of(manifest.format, storage)

    def refusal(
        check: Callable[[_Checked], None], item: _Checked, place: Path | str
    ) -> list[FormatError]:
        try:
            check(item)
        except ConversionError as error:
            return [FormatError("message-invalid", place, str(error))]
        return []

    for channel in dataset.channels:
        yield from refusal(writer.check_channel, channel, channel.topic)
    for stream in dataset.streams:
        for message in _extremes(stream):
            yield from refusal(writer.check_message, message, stream.path)
    refused: list[FormatError] = []
    for record in records:  # to the end: they are counted
        if isinstance(record, Message) and not refused:
            refused = refusal(writer.check_message, record, dataset.path / MESSAGES_NAME)
    yield from refused


def _extremes(stream: Stream) -> Iterator[Message]:
    """Messages with the smallest and largest times and numbers of a sidecar."""
    parts: list[Part] = [stream, *([stream.infos] if stream.infos else [])]
    for part in parts:
        columns = part.columns
        values = columns.log_time, columns.publish_time, columns.sequence
        for end in (np.min, np.max):
            log_time, publish_time, sequence = (int(end(column)) for column in values)
            yield Message(part.channel, log_time, publish_time, sequence, b"")


# ---------------------------------------------------------------- facts of the video


def _wrong_facts(path: Path, video: VideoModel, *, deep: bool) -> Iterator[FormatError]:
    """What a sidecar gets wrong about its video file.

    Args:
        path: The video; one that is missing is reported when it is opened.
        video: Its sidecar's description.
        deep: Also read the whole file.

    Raises:
        OSError: It cannot be read.
    """
    if not path.is_file():
        return
    size = path.stat().st_size
    if video.size is not None and size != video.size:
        yield VideoError(
            "size-mismatch", path, f"has {size} bytes, but its sidecar says {video.size}"
        )
        return
    due: Structures | None = None
    try:
        if video.references:
            due = video.references.decode(packets_of_groups(sample_table_of(path)))
            due.check()
    except VideoError:
        due = None  # reported when it is opened, if it cannot be read there either
    except ValueError as error:
        yield error if isinstance(error, FormatError) else _unfit(path, str(error))
        return
    if not deep or (video.sha256 is None and due is None):
        return
    _, sha256, found = digest_video(path, video.codec)
    if video.sha256 not in (None, sha256):
        yield VideoError("hash-mismatch", path, "does not match the SHA-256 in its sidecar")
    elif due is not None and (problem := _difference(due, found)):
        yield _unfit(path, problem)


def _difference(told: Structures, found: Structures | None) -> str:
    if found is None or len(found.groups) != len(told.groups):
        return "its packets do not show any"
    numbers = {text: number for number, text in enumerate(found.texts)}
    as_found = np.array([numbers.get(text, -1) for text in told.texts])
    wrong = np.flatnonzero(as_found[told.groups] != found.groups)
    return f"the packets of its group of pictures {wrong[0]} show others" if len(wrong) else ""


def _unfit(path: Path, problem: str) -> FormatError:
    return FormatError(
        "references-invalid", path, f"does not match the references in its sidecar: {problem}"
    )
