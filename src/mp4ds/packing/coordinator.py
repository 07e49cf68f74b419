"""Runs the tasks of divided packs on an engine, and makes datasets from their results."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import (
    FormatError,
    OptionError,
    PartsFailedError,
    SourceError,
    TargetError,
    WriteError,
    interrupted,
    path_text,
)
from mp4ds.files.outputs import is_seen, move_into_place, sync
from mp4ds.format.manifest import Manifest
from mp4ds.format.models import StreamSidecar
from mp4ds.format.sidecars import MANIFEST_NAME, dump_document
from mp4ds.packing.engine import Engine, Outcome
from mp4ds.packing.job import Job, Task, with_latched
from mp4ds.packing.manifest import (
    RECORD_NAME,
    Origin,
    PartFacts,
    PartRecord,
    PartStream,
    dataset_files,
    folder_size,
    read_record,
    summarize,
)
from mp4ds.packing.options import PackProgress, PackSummary, TopicSummary
from mp4ds.packing.pack import PackRun
from mp4ds.packing.planning import share
from mp4ds.packing.workplace import Workplace
from mp4ds.plan import FileNames, Selection

_REPORT_SECONDS = 0.1

Report = Callable[[PackProgress], None]


class JobProgress:
    """Adds up the progress of tasks.

    Args:
        job: The job.
        target: The dataset.
        report: Called several times a second; None for nobody.
    """

    def __init__(self, job: Job, target: Path, report: Report | None) -> None:
        self._job = job
        self._target = target
        self._report = report
        self._told: dict[str, Mapping[str, tuple[int, int]]] = {}
        self._next = 0.0
        self._bytes_total = sum(source.size for source in job.sources)
        self._parts = sum(task.source is None for task in job.tasks)
        self._done: set[str] = set()
        self._before = 0
        self.failed = 0
        self.bytes_written = 0

    def heard(self, name: str, told: Mapping[str, Any]) -> None:
        """Take a task's report."""
        if "topics" in told:
            self._told[name] = told["topics"]
            self.report()

    def finished(self, name: str, topics: Mapping[str, tuple[int, int]], *, before: bool) -> None:
        """Note that a task is done.

        Args:
            name: Of the task.
            topics: Messages and bytes of each of its topics.
            before: Whether an earlier run did it.
        """
        self._told[name] = topics
        self._done.add(name)
        self._before += before
        self.report()

    def report(self, phase: str = "packing", note: str = "", *, now: bool = False) -> None:
        """Report the pack's progress, unless it was just reported."""
        clock = time.monotonic()
        if self._report is None or (clock < self._next and not now):
            return
        self._next = clock + _REPORT_SECONDS
        messages: dict[str, int] = {}
        size = 0
        for topics in self._told.values():
            for topic, (count, length) in topics.items():
                messages[topic] = messages.get(topic, 0) + count
                size += length
        self._report(
            PackProgress(
                dataset=self._target,
                phase=phase,
                done=self._share(messages),
                bytes_read=size,
                bytes_total=self._bytes_total,
                bytes_written=self.bytes_written,
                topics={
                    topic: (messages.get(topic, 0), self._job.work[topic][0])
                    for topic in self._job.cameras
                },
                tasks_done=len(self._done),
                tasks_total=self._parts,
                tasks_before=self._before,
                failed=self.failed,
                note=note,
            )
        )

    def _share(self, messages: Mapping[str, int]) -> float | None:
        work = self._job.work
        total = sum(count * cost for count, cost in work.values())
        if not total:
            return None
        return (
            sum(min(messages.get(t, 0), count) * cost for t, (count, cost) in work.items()) / total
        )


# ---------------------------------------------------------------- coordinator

_LISTED = 10
_JOINED_AT_ONCE = 4  # more would only wait for the disk
_SHARED = "all machines must share the dataset's folder"
_KEPT = "finished parts are kept: run the same command again to resume"


class Coordinator:
    """Runs the tasks of several packs as one.

    Args:
        runs: The packs.
        engine: Runs the tasks.
        keep_going: Continue with other tasks if one fails.
        share_of: Which share of the tasks to run, and the number of shares.
        report: Called with progress.
    """

    def __init__(
        self,
        runs: Sequence[PackRun],
        engine: Engine,
        *,
        keep_going: bool = False,
        share_of: tuple[int, int] = (1, 1),
        report: Report | None = None,
    ) -> None:
        self._runs = {str(run.place.folder): run for run in runs}
        self._engine = engine
        self._keep_going = keep_going
        self._share = share_of
        self._progress = {
            folder: JobProgress(run.job, run.target, report) for folder, run in self._runs.items()
        }

    def refuse_missing(self) -> None:
        """Refuse to join missing parts.

        Raises:
            OptionError: Names the parts that are missing.
        """
        for run in self._runs.values():
            names = [task.name for task in run.missing]
            if names:
                listed = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
                count = f"{len(names)} of {len(run.job.tasks)} parts"
                raise OptionError(
                    f"{path_text(run.target)}: {count} are missing: {listed}. Run their "
                    "shards, or pack without `join` to pack them here."
                )

    def run(self) -> Iterator[PackRun]:
        """Run all tasks.

        Yields:
            Each pack of which all tasks are done.

        Raises:
            PartsFailedError: Tasks failed.
        """
        tasks: list[tuple[str, ...]] = []
        waiting: dict[str, int] = {}
        for folder, run in self._runs.items():
            missing = {task.name for task in run.missing}
            own = share(self._share[0], [(task.name,) for task in run.job.tasks], self._share[1])
            names = [name for (name,) in own if name in missing]
            waiting[folder] = len(missing)
            tasks += [(folder, name) for name in names]
            self._tell_done(run, [task for task in run.job.tasks if task.name not in missing])
        for progress in self._progress.values():
            progress.report(now=True)  # so that all work is known from the beginning
        for folder, run in self._runs.items():
            if not waiting[folder]:
                yield run
        if tasks:
            yield from self._run(tasks, waiting)
        for run in self._runs.values():
            run.raise_failures()

    def _run(self, tasks: list[tuple[str, ...]], waiting: dict[str, int]) -> Iterator[PackRun]:
        with closing(self._engine.run(tasks, self._heard)) as outcomes:
            for outcome in outcomes:
                folder = outcome.task[0]
                waiting[folder] -= self._take(outcome)
                if self._runs[folder].failures and not self._keep_going:
                    return
                if not waiting[folder]:
                    yield self._runs[folder]

    def _heard(self, task: tuple[str, ...], told: dict[str, Any]) -> None:
        self._progress[task[0]].heard(task[1], told)

    def _take(self, outcome: Outcome) -> bool:
        """Note a task's end; returns whether its result exists."""
        folder, name = outcome.task
        run, progress = self._runs[folder], self._progress[folder]
        error, task = outcome.error, run.job.task(name)
        if error is None and not is_seen(lambda: run.place.is_done(task), run.place.parts):
            error = ("TargetError", f"its result did not appear in {run.place.parts}; {_SHARED}")
        if error is None:
            self._tell_done(run, [task], before=False)
        else:
            run.fail(name, *error)
            progress.failed += 1
            progress.report(now=True)
        return error is None

    def _tell_done(self, run: PackRun, tasks: Sequence[Task], *, before: bool = True) -> None:
        progress = self._progress[str(run.place.folder)]
        for task in tasks:
            if task.source is not None:
                continue
            place = run.place.parts / task.name
            record = read_record(place) or {"topics": []}
            progress.bytes_written += folder_size(place)
            topics = {t["topic"]: (t["messages"], t["raw_bytes"]) for t in record["topics"]}
            progress.finished(task.name, topics, before=before)

    def finish(self, run: PackRun) -> PackSummary:
        """Make the dataset of a pack whose tasks are done, and remove the parts.

        Raises:
            PartsFailedError: It could not be written; finished parts are kept.
            FormatError: A part was damaged after it was made.
        """
        progress = self._progress[str(run.place.folder)]
        progress.report("joining", now=True)
        folder = run.place.joined
        try:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            summary = self._join(run, folder, progress)
            sync(folder)
            move_into_place(
                folder, run.target, run.place.replaced, force=run.force, owned=dataset_files
            )
        except OSError as error:
            if isinstance(error, (SourceError, TargetError)):
                raise
            refused = error if isinstance(error, WriteError) else WriteError(run.target, error)
            raise PartsFailedError(
                run.target, [("joining", str(refused))], len(run.job.tasks), 1
            ) from None
        finally:
            shutil.rmtree(folder, ignore_errors=True)  # already gone if all went well
        run.place.remove()
        return summary

    @staticmethod
    def _join(run: PackRun, folder: Path, progress: JobProgress) -> PackSummary:
        job = run.job
        places = [run.place.parts / task.name for task in job.tasks if task.source is None]
        facts = list(map(PartFacts.load, places))
        selected = Selection(job.options["topics"], job.options["exclude"])
        with ExitStack() as stack:
            reader = stack.enter_context(job.open())
            with _forgetting_damaged(places):
                parts = [stack.enter_context(Dataset(place)) for place in places]
                manifests = [part.manifest for part in parts if part.manifest]
                _check_facts(parts, facts)
                digests = job.digests(reader, partial(_digest, run.place))
                job.check_sources(reader.files)
                origin = Origin.of(reader.files, digests, job.about, reader.slice.span)
                losses = [item.to_record() for one in manifests for item in one.losses]
                left_out = [topic for one in manifests for topic in one.topics_left_out]
                changes = origin.fields(reader, losses, left_out)
                if job.is_single:
                    parts[0].verify_messages()
                    for name in facts[0].files:
                        _link(places[0] / name, folder / name)
                    manifest = manifests[0].model_copy(update=changes)
                    (folder / MANIFEST_NAME).unlink()
                    (folder / MANIFEST_NAME).write_bytes(dump_document(manifest))
                    sidecars = [stream.sidecar for stream in parts[0].streams]
                else:
                    manifest, sidecars = concat(
                        parts,
                        folder,
                        changes=changes,
                        report=lambda name: progress.report("joining", name, now=True),
                    )
                # last, since damage of a part would be taken for that of the index
                _check_index(reader, parts, selected)
            whole = _joined(folder, manifest, sidecars, facts)
            whole.losses, whole.left_out = losses, dict.fromkeys(left_out)
            size = sum(source.size for source in job.sources)
            summary = summarize(whole, run.target, None if job.slice else size, origin)
            return with_latched(summary, reader)


@contextmanager
def _forgetting_damaged(places: Sequence[Path]) -> Iterator[None]:
    """Where parts cannot be joined, see to it that damaged ones are made again.

    Raises:
        FormatError: Names a damaged file.
    """
    try:
        yield
    except FormatError as error:
        for place in places:
            if str(error.place).startswith(f"{place}{os.sep}"):
                (place / RECORD_NAME).unlink(missing_ok=True)
                raise FormatError(
                    "checksum-mismatch",
                    error.place,
                    "was damaged after it was written; run the same command again to redo this "
                    "part",
                ) from None
        raise


def _check_facts(parts: Sequence[Dataset], facts: Sequence[PartFacts]) -> None:
    """Refuse parts whose facts are not those of their datasets.

    Raises:
        FormatError: Names one; it is made again.
    """
    for part, told in zip(parts, facts, strict=True):
        found = Counter[str]()
        counts = part.counts()
        for channel in part.channels:
            found[channel.topic] += counts.get(channel.id, 0)
        if +found != +Counter({topic.topic: topic.messages for topic in told.topics}):
            (part.path / RECORD_NAME).unlink()
            raise FormatError("file-missing", part.path, "was damaged after it was made")


def _check_index(
    reader: BagReader, parts: Sequence[Dataset], selected: Callable[[str], bool]
) -> None:
    """Refuse parts that together lack messages: those of other channels do not make up for it.

    Args:
        reader: The recording.
        parts: All of them, undamaged.
        selected: Whether a topic is packed.

    Raises:
        SourceError: The recording's index is wrong.
    """
    found = Counter[tuple[object, ...]]()  # by channel; equal ones of a recording are one in a part
    for part in parts:
        counts = part.counts()
        for channel in part.channels:
            found[channel.identity] += counts.get(channel.id, 0)
    stats = reader.stats()
    due = Counter[tuple[object, ...]]()
    for channel in reader.channels:
        if selected(channel.topic) and channel.id in stats:
            due[channel.identity] += stats[channel.id].count
    for channel in reader.channels:
        key = channel.identity
        if key in due and found[key] != due[key]:
            raise SourceError(
                reader.path,
                f"is damaged: its index lists {due[key]} messages on {channel.topic}, but "
                f"{found[key]} were found",
            )


def _joined(
    folder: Path, manifest: Manifest, sidecars: Sequence[StreamSidecar], facts: Sequence[PartFacts]
) -> PartRecord:
    """What became of each topic in all parts together."""
    topics: dict[str, TopicSummary] = {}
    skipped: dict[str, int] = {}
    for part in facts:
        skipped |= part.skipped
        for topic in part.topics:
            if topic.topic in topics:
                topics[topic.topic].extend(topic, topics[topic.topic].messages)
            else:
                topics[topic.topic] = topic
    names = FileNames()
    streams = [
        PartStream(Path(entry.sidecar).stem, sidecar, names.name_for(entry.topic)[1])
        for entry, sidecar in zip(manifest.streams, sidecars, strict=True)
    ]
    return PartRecord(folder, topics, streams, skipped=skipped)


def _link(path: Path, new: Path) -> None:
    try:
        new.hardlink_to(path)
    except OSError:
        shutil.copyfile(path, new)


def _digest(place: Workplace, number: int) -> tuple[int, str]:
    folder = place.parts / f"source-{number}"
    record = read_record(folder) or {}
    size, sha256 = record.get("size"), str(record.get("sha256"))
    if not isinstance(size, int) or not re.fullmatch("[0-9a-f]{64}", sha256):
        raise FormatError("file-missing", folder, "disappeared or was damaged after it was made")
    return size, sha256


@contextmanager
def claimed(runs: Sequence[PackRun], *, shared: bool) -> Iterator[None]:
    """Lock the work folders of packs; those without any results are removed at the end."""
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run.place.claimed(shared=shared))
        try:
            yield
        except BaseException as error:
            kept = shared
            for run in runs:
                if run.place.has_results():
                    kept = True
                elif not shared:
                    run.place.remove()
            if kept and isinstance(error, (KeyboardInterrupt, SystemExit)):
                raise interrupted(error, _KEPT) from None
            raise
