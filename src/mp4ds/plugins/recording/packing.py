"""Packs what is recorded while the recording goes on, in a process of low priority."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from functools import partial
from pathlib import Path

from mp4ds.errors import Mp4dsError, RecordError, TargetError, WriteError
from mp4ds.files.outputs import check_target
from mp4ds.files.sources import UNFINISHED, salvage_command
from mp4ds.format.sidecars import load_about
from mp4ds.packing.manifest import dataset_files, folder_size, summary_of
from mp4ds.packing.options import PackSummary
from mp4ds.packing.pack import pack
from mp4ds.packing.processes import CallError, ProcessExecutor
from mp4ds.packing.spool import SpoolFolder, SpoolSettings
from mp4ds.plugins.recording.options import RecordOptions
from mp4ds.plugins.recording.source import Source
from mp4ds.plugins.recording.spool import SpoolWriter
from mp4ds.records import MetadataRecord

_NICE = 10
_NS = 10**9
_FAILURES = (CallError, CancelledError, OSError)


class PackingProcess:
    """Packs one piece at a time, in a process of low priority. A context manager."""

    def __init__(self) -> None:
        self._executor = ProcessExecutor(1, nice=_NICE)
        self._thread = ThreadPoolExecutor(1, "packing")
        self._jobs: list[Future[None]] = []

    def submit(self, job: Callable[[], None]) -> None:
        """Run a job that packs or joins, after all earlier ones, in another thread."""
        self._jobs.append(self._thread.submit(job))

    def wait(self, seconds: float) -> bool:
        """Wait until all jobs have run; returns whether they have."""
        return not wait(self._jobs, seconds).not_done

    def __enter__(self) -> PackingProcess:
        return self

    def __exit__(self, exc_type: type[BaseException] | None, *_: object) -> None:
        if exc_type is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
            self._executor.shutdown(cancel_futures=True)  # in the middle of a piece
        self._thread.shutdown()
        self._executor.shutdown()

    def pack(self, folder: Path, number: int) -> None:
        """Make the part of a piece, which is then removed.

        Raises:
            CallError: It failed.
        """
        self._executor.submit(_pack, folder, number).result()

    def join(
        self, folder: Path, count: int, target: Path, *, force: bool, about: str | None
    ) -> None:
        """Make the dataset of all parts.

        Args:
            folder: The folder.
            count: How many parts there are.
            target: The dataset.
            force: Replace an existing one.
            about: A file that describes the recording.

        Raises:
            CallError: It failed.
        """
        self._executor.submit(_join, folder, count, target, force, about).result()


class Split:
    """One dataset of a recording.

    Args:
        target: Where to make it.
        options: How to record.
        source: Where messages come from.
        others: What the recording holds besides messages.
        packing: Packs the pieces of its spool, and joins the parts.

    Raises:
        TargetError: It cannot be made there.
        WriteError: The disk refused.
    """

    def __init__(
        self,
        target: Path,
        options: RecordOptions,
        source: Source,
        others: Sequence[MetadataRecord],
        packing: PackingProcess,
    ) -> None:
        self.target = target
        self.made: PackSummary | None = None
        self.error: Exception | None = None
        self.folder = SpoolFolder(target.with_name(target.name + UNFINISHED))
        self._options = options
        self._source = source
        self._packing = packing
        self._most_ns = round((options.max_duration or 0) * _NS)
        self._parts = 0
        self._packed_bytes = 0  # of messages
        self._parts_bytes = 0
        check_target(target, force=options.force, owned=dataset_files)
        settings = SpoolSettings(
            format=source.format,
            profile=source.profile,
            quality=str(options.quality),
            codec=options.codec,
            preset=options.preset,
            gop=options.gop,
        )
        try:
            self.lock = self.folder.begin(settings)
            self.spool = SpoolWriter(self.folder, source.profile, others, self._on_closed)
        except FileExistsError:
            raise TargetError(
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
        return self.spool.bytes - self._packed_bytes

    @property
    def size(self) -> int:
        """Bytes so far."""
        return self.spool_bytes + self._parts_bytes

    @property
    def is_full(self) -> bool:
        """Whether the next message belongs into another dataset."""
        span = self.spool.span
        if self._most_ns and span and span[1] - span[0] >= self._most_ns:
            return True
        return self._options.max_size is not None and self.size >= self._options.max_size

    def _on_closed(self, number: int, size: int) -> None:
        self._packing.submit(partial(self._pack, number, size))

    def _pack(self, number: int, size: int) -> None:
        if self.error is None:  # otherwise it is kept as it is
            try:
                self._packing.pack(self.folder.path, number)
                self._parts_bytes += folder_size(self.folder.part(number))
                self._packed_bytes += size
                self._parts += 1
            except _FAILURES as error:
                self.error = error
                self._source.warn(
                    f"{self.folder.path}: no more is packed, what comes is still recorded: {error}"
                )

    def close(self) -> None:
        """Complete the spool, and have the dataset made when all of it is packed.

        Raises:
            OSError: The disk refused.
        """
        self.spool.close(filter(None, list(self._source.topics.values())))
        self._packing.submit(self._join)

    def _join(self) -> None:
        if self.error is not None:
            return
        options, count = self._options, self._parts
        try:
            self._packing.join(
                self.folder.path, count, self.target, force=options.force, about=options.about
            )
            self.made = self._summary()
            self.lock.close()
            self.folder.remove(count)
        except (Mp4dsError, *_FAILURES) as error:
            self.error = error

    def _summary(self) -> PackSummary:
        made, raw = summary_of(self.target), self.spool.raw_bytes
        topics = [replace(topic, raw_bytes=raw[topic.topic]) for topic in made.topics]
        return replace(made, topics=topics, source_bytes=raw.total(), is_copy=False)

    def failure(self, error: Exception) -> Exception:
        """What to raise because of an error; what was recorded stays where it is."""
        if isinstance(error, Mp4dsError):
            return error
        return RecordError(self.folder.path, self.target, error)


# ---------------------------------------------------------------- in the process


def _pack(folder: Path, number: int) -> None:
    spool = SpoolFolder(folder)
    with spool.locked(shared=True):
        spool.pack(number, pack)


def _join(folder: Path, count: int, target: Path, force: bool, about: str | None) -> None:
    spool = SpoolFolder(folder)
    told = load_about(about) if about is not None else None
    with spool.locked(shared=True):
        spool.join(count, target, force=force, about=told)
