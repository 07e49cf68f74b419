"""Dataset -> bag, rosbag2 or MCAP."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePath

from mp4ds.bags.formats import open_writer, recording_names
from mp4ds.bags.protocols import WHOLE, BagReader, BagWriter, RecordingSlice
from mp4ds.dataset.dataset import Dataset, Paths, datasets_in
from mp4ds.dataset.messages import recorded_storage
from mp4ds.dataset.recording import (
    DatasetReader,
    examine,
    open_damaged,
    open_selected,
    slice_of,
    sliced,
)
from mp4ds.errors import (
    ConversionError,
    FormatError,
    OptionError,
    WriteError,
    advising,
    interrupted,
)
from mp4ds.files.outputs import local_target, staged
from mp4ds.files.urls import remote
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.options import Selection, SliceOptions, force, jpeg_quality, latched, option, what
from mp4ds.processes import each
from mp4ds.records import Attachment, Channel, Excerpt, Loss, Message, MetadataRecord, bounded
from mp4ds.unpacking.pictures import KINDS, FrameOptions, shown_by_packets
from mp4ds.unpacking.republish import Republished, Republisher

SUFFIXES = {"bag": ".bag", "rosbag2": "", "mcap": ".mcap"}
"""How the default name of an output ends, by what it is unpacked to."""

_WORLDS = {"bag": "ros1", "rosbag2": "ros2"}
_OURS = "mp4ds:"  # metadata records in which a dataset keeps the contents of a rosbag2 folder


@dataclass(frozen=True, kw_only=True)
class UnpackOptions(SliceOptions, FrameOptions):
    """How to unpack."""

    latched: bool = latched()
    salvage: bool = what("Restore what can be read of a damaged dataset.", False)
    storage: str | None = option(
        "Storage of rosbag2: sqlite3 or mcap; default: as recorded, else mcap.",
        choices=("sqlite3", "mcap"),
    )
    images: str | None = option(
        "Convert all cameras to raw, jpeg, png, compressed-video or ffmpeg messages; "
        "default: as recorded.",
        metavar="KIND",
        choices=KINDS,
    )
    jpeg_quality: int = jpeg_quality()
    skip_unconvertible: bool = option(
        "Leave out, and count, what the output format cannot hold.", False
    )
    force: bool = force()


@dataclass(frozen=True)
class UnpackProgress:
    """Progress of an unpack: messages written, and their total (0: unknown)."""

    messages: int
    messages_total: int


@dataclass(frozen=True)
class UnpackSummary:
    """The result of an unpack.

    Attributes:
        output: The recording made.
        messages: Messages written, by topic.
        converted: Types converted between ROS 1 and ROS 2, by topic.
        omitted: What the target cannot hold and was left out: a phrase -> how many.
        left_out: Topics left out on request.
        republished: The results for topics whose images are converted.
        as_recorded: If a conversion was requested, the camera topics with messages that stay as
            recorded: reason -> how many.
        unconvertible: Topics with messages left out because the target cannot hold them:
            reason -> how many.
        latched: Latched messages from before the slice, by topic.
        latched_left_out: Latched topics whose messages from before it are too large.
        losses: What could not be read, if a damaged dataset is salvaged.
        notes: Other deviations from the recording.
    """

    output: Path
    messages: dict[str, int] = field(default_factory=dict)
    converted: list[str] = field(default_factory=list)
    omitted: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    republished: dict[str, Republished] = field(default_factory=dict)
    as_recorded: dict[str, dict[str, int]] = field(default_factory=dict)
    unconvertible: dict[str, dict[str, int]] = field(default_factory=dict)
    latched: dict[str, int] = field(default_factory=dict)
    latched_left_out: list[str] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def unpack(
    dataset: Path | str,
    to: str | None = None,
    output: Path | str | None = None,
    options: UnpackOptions | None = None,
    *,
    progress: Callable[[UnpackProgress], None] | None = None,
) -> UnpackSummary:
    """Write a dataset's recording.

    Every message of a lossless stream is checked against its digest, and each sidecar, and
    messages.mcap unless a slice is taken, against the manifest. Damage is an error, unless only
    topics that are left out have it, or `salvage` asks for what can be read.

    Args:
        dataset: A dataset, or one video with its sidecar; or its URL.
        to: ``bag``, ``rosbag2`` or ``mcap``; None for what the suffix of the output says (``.bag``
            or ``.mcap``), else the recording's own format, or ``mcap`` for a single video.
        output: The file or folder to make; None for the dataset's name, next to it, or in the
            current folder if the dataset is at a URL.
        options: How.
        progress: Called after every few messages.

    Returns:
        What was written, and what the target could not hold.

    Raises:
        FormatError: The dataset is damaged; nothing is left behind.
        ConversionError: The target cannot hold a topic; names it.
        TargetError: The output cannot be written there.
        WriteError: The output could not be written; nothing is left behind.
        RemoteError: A store or web server fails.
    """
    chosen = options or UnpackOptions()
    with ExitStack() as stack:
        if not chosen.salvage:
            stack.enter_context(advising("`salvage` restores what can be read."))
        if to is None:
            suffix = PurePath(output).suffix if output else ""
            named = (to for to, its_own in SUFFIXES.items() if its_own and its_own == suffix)
            to = next(named, None) or _own_format(dataset, chosen)
        _check(to, chosen)
        given = local_target(output) if output else None
        whole, losses = _opened(dataset, chosen, verify=not chosen.is_slice)
        stack.enter_context(whole)
        target = given or local_target(default_output(whole.path, to))
        path = stack.enter_context(
            staged(target, force=chosen.force, owned=recording_names, sources=[whole.path])
        )
        try:
            for stream in whole.streams if chosen.salvage else ():
                if chosen.selected(stream.topic):
                    losses += examine(stream)
            if not chosen.salvage:
                whole.verify_sidecars(chosen.selected)
            if chosen.is_slice and not whole.is_in_time:  # filtered out of all, not found by time
                whole.verify_messages()
            summary = UnpackSummary(target, losses=losses)
            chosen.selected.check(whole.all_topics)
            summary.left_out.extend(item for item in whole.all_topics if not chosen.selected(item))
            part = slice_of(whole, chosen, chosen.selected)
            # messages with packets of a view instead of those recorded are converted, too
            is_replaced = any(
                stream.sidecar.replaces_packets
                for stream in whole.streams
                if chosen.selected(stream.topic)
            )
            if chosen.images or is_replaced:
                # whose frames are counted from the slice's first one
                with sliced(whole, part, path.parent, chosen.selected) as opened:
                    _unpack_recording(opened, path, to, chosen, summary, progress)
            else:
                if chosen.is_slice:
                    whole.verify_lossy_videos(chosen.selected)
                _unpack_recording(whole, path, to, chosen, summary, progress, part)
            latched = (item.channel.topic for item in part.latched)
            summary.latched.update(Counter(filter(chosen.selected, latched)))
            summary.latched_left_out.extend(filter(chosen.selected, part.left_out))
            summary.notes.extend(_notes(whole, chosen))
            summary.losses[:] = bounded(summary.losses)
            return summary
        except OSError as error:
            if error.errno is None:
                raise
            raise WriteError(target, error) from error


def _opened(
    dataset: Path | str, options: UnpackOptions, *, verify: bool = False
) -> tuple[Dataset, list[Loss]]:
    """The dataset, and what is lost of it by files that cannot be read."""
    selected, layer = options.selected, options.layer
    losses: list[Loss] = []
    if options.salvage:
        opened, losses = open_damaged(dataset, selected=selected, layer=layer)
    else:
        opened = open_selected(dataset, selected, layer=layer, verify_messages=verify)
    opened.jpeg_quality = options.jpeg_quality
    if layer is None:
        opened.require_exact(selected)
    return opened, losses


def _notes(dataset: Dataset, options: UnpackOptions) -> Iterator[str]:
    """What else the output does not have of the recording."""
    if dataset.damage:
        yield dataset.damage
    if dataset.manifest and dataset.manifest.reduced:
        yield dataset.manifest.reduced
    has_packets = options.images is not None and KINDS[options.images].family == "video"
    for stream in dataset.streams:
        shown = shown_by_packets(stream) if has_packets else stream
        if shown.sidecar.digests is not None or not options.selected(stream.topic):
            continue
        why = f"it was packed with quality {shown.sidecar.profile}"
        if shown.layer == "view":
            why = "they are those of its view"
        yield f"{stream.topic}: its pixels differ from those recorded: {why}"


def unpack_each(
    datasets: Paths,
    to: str | None = None,
    folder: Path | str | None = None,
    options: UnpackOptions | None = None,
    *,
    jobs: int | None = 1,
    progress: Callable[[UnpackProgress], None] | None = None,
) -> list[UnpackSummary]:
    """Write the recordings of several datasets; see `unpack`.

    Args:
        datasets: Datasets, folders of them, or patterns.
        to: See `unpack`.
        folder: Where to write, each named after its dataset; created if missing. None: each next to
            its dataset.
        options: How.
        jobs: Datasets to process in parallel; None for one per core.
        progress: Called after each dataset, with their counts.

    Raises:
        OptionError: Two would get the same name.
        Mp4dsError: As for `unpack`; those already written are kept.
    """
    outputs: dict[Path, Path | None] = {}
    for dataset in datasets_in(datasets):
        kind = to or _own_format(dataset, options or UnpackOptions())
        _check(kind, options or UnpackOptions())
        stem = dataset.name if dataset.is_dir() else dataset.stem
        outputs[dataset] = local_target(folder) / f"{stem}{SUFFIXES[kind]}" if folder else None
    named = [output for output in outputs.values() if output is not None]
    twice = [output for output, count in Counter(named).items() if count > 1]
    if twice:
        raise OptionError(f"Two datasets would become {twice[0]}. Unpack one of them elsewhere.")
    if folder is not None:
        local_target(folder).mkdir(exist_ok=True)
    work = partial(_unpack_one, to=to, options=options)
    summaries: list[UnpackSummary] = []
    try:
        for _, summary in each(work, [*outputs.items()], jobs):
            summaries.append(summary)
            if progress:
                progress(UnpackProgress(len(summaries), len(outputs)))
    except (KeyboardInterrupt, SystemExit) as error:
        done = f"{len(summaries)} of {len(outputs)} datasets were unpacked"
        raise interrupted(error, f"{done}, and no partial output was left behind") from None
    return summaries


def _unpack_one(
    item: tuple[Path, Path | None], to: str | None, options: UnpackOptions | None
) -> UnpackSummary:
    dataset, output = item
    return unpack(dataset, to, output, options)


def _own_format(dataset: Path | str, options: UnpackOptions) -> str:
    opened, _ = _opened(dataset, options)
    with opened:
        return opened.manifest.format if opened.manifest else "mcap"


def _check(to: str, options: UnpackOptions) -> None:
    """Refuse options that are unknown or contradict each other.

    Raises:
        OptionError: Says which, and lists the valid ones.
    """
    if to not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise OptionError(
            f"`to` {to!r} is not known. Use {known}; `mp4ds export images` writes images as files."
        )
    if options.storage and to != "rosbag2":
        raise OptionError(f"`storage` works with `to` rosbag2, not with `to` {to}.")
    if options.salvage and options.is_slice:
        raise OptionError(
            "`salvage` restores a whole dataset: pack what it restores, and unpack a slice of that."
        )


def default_output(dataset: Path, to: str) -> Path:
    """The default output for a dataset: next to it, never the source's own name."""
    if remote(dataset):
        stem = dataset.name if dataset.is_dir() else dataset.stem
        return Path(f"{stem}_unpacked{SUFFIXES[to]}")
    stem = dataset.resolve().name if dataset.is_dir() else dataset.stem
    return dataset.resolve().parent / f"{stem}_unpacked{SUFFIXES[to]}"


def _unpack_recording(
    dataset: Dataset,
    path: Path,
    to: str,
    options: UnpackOptions,
    summary: UnpackSummary,
    progress: Callable[[UnpackProgress], None] | None,
    part: RecordingSlice = WHOLE,
) -> None:
    selected = options.selected
    reader = DatasetReader(dataset)
    reader.slice = part
    source = dataset.manifest.format if dataset.manifest else ""
    republisher = Republisher(
        dataset,
        _WORLDS.get(to) or ("ros1" if dataset.profile == "ros1" else "ros2"),
        selected=selected,
        # a recording is restored to its own format unchanged, whatever its serializations
        converts_all=to in _WORLDS and to != source,
        kind=options.images,
        jpeg_quality=options.jpeg_quality,
    )
    reader.sources = republisher.sources
    storage = ""
    if to == "rosbag2":
        storage = options.storage or recorded_storage(dataset.messages_file.in_file_order())
    with open_writer(
        path,
        to,
        name=summary.output.name,
        profile=dataset.profile,
        library=dataset.manifest.library if dataset.manifest else "",
        storage=storage,
    ) as writer:
        topics = _Topics(writer, republisher, summary, may_skip=options.skip_unconvertible)
        topics.declare()
        for schema in dataset.messages_file.unused_schemas:
            writer.add_schema(schema)
        wanted = {item.topic for item in dataset.channels if selected(item.topic)}
        total = _total(dataset, reader, selected)
        done = found = 0
        for record in reader.records(Excerpt(topics=frozenset(wanted))):
            if isinstance(record, Attachment):
                writer.add_attachment(record)
            elif isinstance(record, MetadataRecord):
                # our record of a rosbag2 folder is useless in another format
                if to == "rosbag2" or source != "rosbag2" or not record.name.startswith(_OURS):
                    writer.add_metadata(record)
            else:
                found += 1
                if topics.write(record):
                    done += 1
                    if progress and done % 16 == 0:
                        progress(UnpackProgress(done, total))
        if dataset.is_salvaged:
            _account_for(total - found, summary.losses)
        elif found != total:
            problem = f"holds {found} messages, but should hold {total}"
            raise FormatError("message-count", dataset.path, problem)
    summary.omitted.update(Counter(writer.omitted) + Counter(republisher.omitted))
    summary.republished.update(republisher.republished)
    summary.as_recorded.update({t: dict(why) for t, why in republisher.as_recorded.items()})


def _total(dataset: Dataset, reader: BagReader, selected: Selection) -> int:
    """How many messages there should be of the selected topics."""
    manifest = dataset.manifest
    if reader.slice is not WHOLE:
        counts = {key: len(times) for key, times in reader.times().items()}
    elif manifest and manifest.messages and all(map(selected, dataset.all_topics)):
        return manifest.messages
    else:
        counts = dataset.counts()
    return sum(counts.get(item.id, 0) for item in dataset.channels if selected(item.topic))


def _account_for(missing: int, losses: list[Loss]) -> None:
    """Add how many messages are lost to a loss that does not say it, or as one of its own.

    Args:
        missing: How many the manifest counts that were not restored.
        losses: What is known to be lost.
    """
    missing -= sum(loss.messages or 0 for loss in losses)
    if missing <= 0:
        return
    for place, loss in enumerate(losses):
        if loss.messages is None:
            losses[place] = replace(loss, messages=missing)
            return
    problem = "more messages are counted in it, such as calibrations in a sidecar that is lost"
    losses.append(Loss(MANIFEST_NAME, None, None, problem, missing))


class _Topics:
    """The channels of a recording that is written."""

    def __init__(
        self, writer: BagWriter, republisher: Republisher, summary: UnpackSummary, *, may_skip: bool
    ) -> None:
        self._may_skip = may_skip
        self._writer = writer
        self._republisher = republisher
        self._summary = summary
        self._declared: set[int] = set()
        self._refused: dict[int, str] = {}

    def declare(self) -> None:
        """Declare the channels that are expected to have messages.

        Raises:
            ConversionError: The target cannot hold some of them; names all.
        """
        refused: dict[str, str] = {}
        for channel in self._republisher.channels:
            try:
                self._add(channel)
            except ConversionError as error:
                refused[channel.topic] = self._refused[channel.id] = error.problem
                self._skip(channel.topic, error.problem, 0)
        if refused and not self._may_skip:
            raise _refusal(refused)

    def _add(self, channel: Channel) -> None:
        made = self._republisher.outgoing(channel)
        self._declared.add(channel.id)
        self._writer.add_channel(made)
        self._summary.messages.setdefault(made.topic, 0)
        changed = made.message_encoding != channel.message_encoding
        if changed and made.topic not in self._summary.converted:
            self._summary.converted.append(made.topic)

    def write(self, message: Message) -> bool:
        """Write a message; returns whether the target can hold it."""
        channel = message.channel
        if channel.id in self._refused:
            return self._skip(channel.topic, self._refused[channel.id])
        try:
            if channel.id not in self._declared:
                self._add(channel)  # it was expected to have no messages left, but has one
            self._writer.write(self._republisher.converted(message))
        except ConversionError as error:
            if not self._may_skip:
                raise
            return self._skip(channel.topic, error.problem)
        self._summary.messages[channel.topic] += 1
        return True

    def _skip(self, topic: str, problem: str, count: int = 1) -> bool:
        counts = self._summary.unconvertible.setdefault(topic, {})
        counts[problem] = counts.get(problem, 0) + count
        return False


def _refusal(problems: dict[str, str]) -> ConversionError:
    """The error for topics that the target cannot hold, with the reason for each."""
    first, *others = problems
    listed = [problems[first], *(f"topic {topic}: {problems[topic]}" for topic in others)]
    return ConversionError(
        first,
        "; ".join(listed),
        "Exclude with "
        + " ".join(f"`exclude` {shlex.quote(topic)}" for topic in problems)
        + ", leave out and count with `skip_unconvertible`, or unpack to mcap, which keeps "
        "everything unchanged.",
    )
