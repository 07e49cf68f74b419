"""One dataset of a recording: a spool, cut into pieces that are packed while the next is written.

What arrives is written with as little work as possible. Another process, of low priority, makes a
part of each complete piece by the code of `pack`, and at the end the dataset of all parts.
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

from mp4ds.bags.mcap import McapWriter
from mp4ds.errors import Mp4dsError, TargetExistsError, WriteError, path_text
from mp4ds.files.outputs import check_target, sync, sync_folder
from mp4ds.files.sources import RECORDING_NAME, UNFINISHED, salvage_command
from mp4ds.format.manifest import Source
from mp4ds.format.sidecars import load_about
from mp4ds.messages.serializations import is_camera
from mp4ds.options import Time
from mp4ds.packing.inspection import begins_anew, depends_on_others
from mp4ds.packing.manifest import dataset_files, folder_size
from mp4ds.packing.options import PackSummary
from mp4ds.packing.pack import pack
from mp4ds.packing.spool import SpoolFolder, SpoolSettings
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.ros.node import World
from mp4ds.processes import ProcessExecutor, available_cores
from mp4ds.records import Channel, Loss, Message, MetadataRecord
from mp4ds.times import INT64_MAX

_NS = 10**9
WINDOW_NS = 5 * _NS
"""Log time that a piece covers."""

_LATE_NS = _NS
"""How much later than its log time a message may come: threads that receive take turns."""

_GROUP_NS = 60 * _NS
"""How long a piece stays open, at most, for the next key frame of a video."""

_PACKED_BYTES = 250_000_000
"""Payloads of a window that a core packs in about that time."""

FAILURES = (Mp4dsError, CancelledError, OSError)


@dataclass
class Piece:
    """A piece that is open.

    Attributes:
        start: Log time, ns, at which it was begun.
        span: Log times, ns, of its first and its last message.
        bytes: Payloads of its messages.
        channels: Those of its messages, by id.
        is_video: Whether it has video packets.
        packets: Channels of video packets in it, which stay in it until their next key frame.
    """

    number: int
    writer: McapWriter
    start: int
    span: tuple[int, int] = (INT64_MAX, -1)
    bytes: int = 0
    channels: dict[int, Channel] = field(default_factory=dict)
    is_video: bool = False
    packets: set[int] = field(default_factory=set)


class Split:
    """One dataset of a recording.

    Args:
        target: Where to make it.
        options: How to record.
        profile: Where messages come from.
        others: What the recording holds besides messages.
        process: Packs the pieces, and joins the parts.
        jobs: One thread, which waits for the process, and is closed after it.
        warn: Called with a sentence.

    Attributes:
        made: The dataset, once it is complete.
        error: Why it is not.
        is_removed: Whether the recorder has removed it again.

    Raises:
        TargetError: It cannot be made there.
        WriteError: The disk refused.
    """

    looks_back = False

    def __init__(
        self,
        target: Path,
        options: RecordOptions,
        profile: World,
        others: Sequence[MetadataRecord],
        process: ProcessExecutor,
        jobs: ThreadPoolExecutor,
        warn: Callable[[str], None],
    ) -> None:
        self.target = target
        self.made: PackSummary | None = None
        self.error: Exception | None = None
        self.is_removed = False
        self.folder = SpoolFolder(target.with_name(target.name + UNFINISHED))
        self._options = options
        self._profile = profile
        self._others = others
        self._process = process
        self._jobs = jobs
        self._warn = warn
        self._span: tuple[int, int] | None = None
        self._raw_bytes: Counter[str] = Counter()  # by topic
        self._bytes = self._packed_bytes = self._parts_bytes = 0
        self._depends: dict[int, bool] = {}
        self._window_ns = WINDOW_NS
        self._open: list[Piece] = []  # all but the newest take what is late
        self._waiting: list[Piece] = []  # for the end, to be packed
        self._closed = [self.folder.path / RECORDING_NAME]  # since `written` told of them
        self._count = 0  # of pieces
        self._losses: Sequence[Loss] = ()
        check_target(target, force=options.force, owned=dataset_files)
        settings = SpoolSettings(
            format="bag" if profile == "ros1" else "rosbag2",
            profile=profile,
            quality=str(options.quality),
            codec=options.codec,
            preset=options.preset,
            gop=options.gop,
            looks_back=self.looks_back,
        )
        try:
            self.lock = self.folder.begin(settings)
            piece = self._begin(0)
            for record in self._others:
                piece.writer.add_metadata(record)
            self.flush()
        except FileExistsError:
            raise TargetExistsError(
                self.folder.path,
                "already exists: a recording of this name was not finished",
                "Choose another name, or recover that one first: "
                f"{salvage_command(self.folder.path)}",
            ) from None
        except OSError as error:
            raise WriteError(target, error) from None

    @property
    def spool_bytes(self) -> int:
        """Bytes of messages that are not packed yet."""
        return self._bytes - self._packed_bytes

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self.spool_bytes + self._parts_bytes

    @property
    def is_full(self) -> bool:
        """Whether the next message belongs into another dataset."""
        most_ns = round((self._options.max_duration or 0) * _NS)
        if most_ns and self._span and self._span[1] - self._span[0] >= most_ns:
            return True
        return self._options.max_size is not None and self.size >= self._options.max_size

    def written(self) -> list[Path]:
        """The files that are being written, and those closed since the last call."""
        closed, self._closed = self._closed, []
        return closed + [piece.writer.path for piece in self._open]

    # ------------------------------------------------------------ writing

    def _begin(self, start: int) -> Piece:
        path = self.folder.piece(self._count)
        writer = McapWriter(path, profile=self._profile, compression="none")
        self._open.append(Piece(self._count, writer, start))
        self._count += 1
        return self._open[-1]

    def write(self, message: Message) -> None:
        """Write a message, and close the pieces that get no more.

        Raises:
            OSError: It cannot be written.
        """
        time, newest = message.log_time, self._open[-1]
        if self._span is None:
            newest.start = time
        elif abs(time - newest.start) >= self._window_ns:
            self.flush()  # or a kill would leave a gap before what the new piece already has
            self._begin(time)
        start, end = self._span or (time, time)
        self._span = min(start, time), max(end, time)
        self._write(self._piece_for(message), message)
        self._complete_until(time)

    def _complete_until(self, time: int) -> None:
        """Close the pieces that get no more at a log time, ns."""
        while len(self._open) > 1:
            age = abs(time - self._open[1].start)
            if age < _LATE_NS or (self._open[0].packets and age < _GROUP_NS):
                break
            self._complete(self._open.pop(0))

    def _piece_for(self, message: Message) -> Piece:
        channel = message.channel.id
        for piece, later in pairwise(self._open):
            if message.log_time < later.start:
                return piece
            if channel in piece.packets:
                if not begins_anew(message):
                    return piece
                piece.packets.remove(channel)
        return self._open[-1]

    def _write(self, piece: Piece, message: Message) -> None:
        channel = message.channel
        if channel.id not in piece.channels:
            piece.channels[channel.id] = channel
            piece.writer.add_channel(channel)
            if channel.id not in self._depends:
                is_video = is_camera(channel) and depends_on_others(channel, message)
                self._depends[channel.id] = is_video
            if self._depends[channel.id]:
                piece.is_video = True
                piece.packets.add(channel.id)
        piece.writer.write(message)
        first, last = piece.span
        piece.span = min(first, message.log_time), max(last, message.log_time)
        piece.bytes += len(message.data)
        self._bytes += len(message.data)

    def flush(self) -> None:
        """Give the system what was written so far, so that it outlives this process.

        Raises:
            OSError: It cannot be written.
        """
        for piece in self._open:
            piece.writer.flush()

    def _close_piece(self, piece: Piece) -> None:
        piece.writer.finish()
        self._closed.append(piece.writer.path)

    def _complete(self, piece: Piece) -> None:
        self._close_piece(piece)
        # packing would not keep up, and take from receiving, at whatever priority
        if piece.bytes > _PACKED_BYTES * available_cores():
            self._waiting.append(piece)
        else:
            self._jobs.submit(self._pack, piece)

    def close(self, announced: Iterable[Channel], losses: Sequence[Loss] = ()) -> None:
        """Complete all pieces, and have the dataset made when they are packed.

        Args:
            announced: Channels, some of which may have no messages.
            losses: What came and is not there.

        Raises:
            OSError: It cannot be written.
        """
        self._losses = losses
        for channel in announced:
            self._open[-1].writer.add_channel(channel)
        while self._open:
            self._complete(self._open.pop(0))
        for piece in self._waiting:
            self._jobs.submit(self._pack, piece)
        self._jobs.submit(self._join)

    def abandon(self) -> None:
        """Close all files as they are, with what the disk still takes."""
        with suppress(OSError):
            self.flush()
        while self._open:
            piece = self._open.pop()
            piece.writer.abandon()
            self._closed.append(piece.writer.path)

    # ------------------------------------------------------------ packing

    def _pack(self, piece: Piece, start: int | None = None) -> None:
        """Pack a piece, perhaps without what is before a log time, ns."""
        if self.error is not None:  # what is not packed is kept as it is
            return
        try:
            call = _pack if start is None else partial(_pack, start=start)
            raw_bytes = self._process.submit(call, self.folder.path, piece.number).result()
            self._raw_bytes.update(raw_bytes)
            self._parts_bytes += folder_size(self.folder.part(piece.number))
            self._packed_bytes += piece.bytes
        except FAILURES as error:
            self.error = error
            self._warn(
                f"{self.folder.path}: no more is packed, what comes is still recorded: {error}"
            )

    def _join(self) -> None:
        if self.error is not None:
            return
        options = self._options
        join = partial(
            _join,
            force=options.force,
            about=options.about,
            sources=self._sources(),
            losses=self._losses,
        )
        try:
            made = self._process.submit(join, self.folder.path, self._count, self.target).result()
            raw = self._raw_bytes
            topics = [replace(topic, raw_bytes=raw[topic.topic]) for topic in made.topics]
            self.made = replace(made, topics=topics, source_bytes=raw.total(), is_copy=False)
            self.lock.close()
            self.folder.remove(self._count)
        except FAILURES as error:
            self.error = error
            self._warn(f"{self.folder.path}: the dataset could not be made: {error}")

    def _sources(self) -> list[Source]:
        """What the dataset is a slice of."""
        return []

    def left(self, error: Exception) -> WriteError:
        """The error, with where its messages are, and how they become a dataset."""
        path, target = (shlex.quote(path_text(path)) for path in (self.folder.path, self.target))
        left = f"It holds what was recorded. Then run: mp4ds pack --salvage {path} -o {target}"
        return WriteError(self.folder.path, error, left)


def sync_all(paths: Sequence[Path]) -> None:
    """Sync files to disk, with their names and those of their folders."""
    for path in paths:
        with suppress(OSError):  # what the disk refuses, its writer is told, too
            sync(path)
    for folder in {above for path in paths for above in (path.parent, path.parent.parent)}:
        sync_folder(folder)


# ---------------------------------------------------------------- in the process


def _pack(folder: Path, number: int, *, start: int | None = None) -> Mapping[str, int]:
    """Make the part of a piece, which is then removed; returns payload bytes by topic."""
    spool = SpoolFolder(folder)
    with spool.locked(shared=True):
        options = spool.settings().options()
        if start is not None:
            options = replace(options, start=Time(start, from_start=False))
        made = pack(spool.piece(number), spool.part(number), options)
        spool.piece(number).unlink()
    return {topic.topic: topic.raw_bytes for topic in made.topics}


def _join(
    folder: Path,
    count: int,
    target: Path,
    *,
    force: bool,
    about: str | None,
    sources: Sequence[Source],
    losses: Sequence[Loss],
) -> PackSummary:
    """Make the dataset of all parts, which stay."""
    spool = SpoolFolder(folder)
    told = load_about(about) if about is not None else None
    with spool.locked(shared=True):
        parts = [spool.part(number) for number in range(count)]
        return spool.join(parts, target, force=force, about=told, sources=sources, losses=losses)
