"""Recordings that are packed in parts: their pieces on an executor, and what becomes of them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import (
    FormatError,
    Mp4dsError,
    OptionError,
    PartsFailedError,
    RemoteError,
    SourceError,
    TargetError,
    WriteError,
    interrupted,
    path_text,
)
from mp4ds.files.outputs import is_seen, staged
from mp4ds.format.sidecars import MANIFEST_NAME
from mp4ds.packing.manifest import Digest, PartRecord, dataset_files, folder_size, summarize
from mp4ds.packing.options import PackOptions, PackProgress, PackSummary, TopicSummary
from mp4ds.packing.parts import (
    FACTS_NAME,
    SHARED,
    PartFacts,
    PartPacker,
    PartsFolder,
    PlanNote,
    digest_source,
    part_facts,
)
from mp4ds.packing.planning import Piece, Plan
from mp4ds.processes import failure_of
from mp4ds.records import Channel

Report = Callable[[PackProgress], None]

_POLL_SECONDS = 0.5
_LISTED = 10
_KEPT = "finished parts are kept: run the same command again to resume"


@dataclass
class PartedPack:
    """A recording that is packed in parts.

    Attributes:
        plan: How.
        paths: What to pack, as given by the user.
        target: The dataset.
        force: Replace an existing one.
        report: Called with progress.
        is_new: Whether no part was begun before.
        is_shared: Other machines may work in the same folder, or have begun it.
        failures: Name and error of each piece that failed.
    """

    plan: Plan
    paths: Sequence[Path]
    target: Path
    force: bool
    report: Report | None
    is_new: bool
    is_shared: bool
    failures: list[tuple[str, Mp4dsError]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.folder = PartsFolder(self.target)
        self._done: set[str] = set()
        self._messages = Counter[str]()  # packed, by topic
        self._read = self._written = 0
        self._digests: dict[str, Future[Digest]] = {}
        self.calls: dict[Future[Any], Piece | None] = {}

    def begin(self, *, anew: bool, alone: bool) -> None:
        """Take over the folder, which is locked.

        Args:
            anew: Discard what is there.
            alone: Nobody else is working there.

        Raises:
            Mp4dsError: It holds the parts of another pack.
        """
        if alone and (anew or self.folder.note() is None):  # parts without a plan may be of any
            self.folder.clear()
        note = PlanNote.of(self.plan)
        if self.folder.note() is None:
            self.folder.keep(note)
        self.folder.check(note, shared=self.is_shared)
        if alone:
            self.folder.sweep()
        for piece in self.plan.pieces:
            if facts := part_facts(self.folder.part(piece)):
                self._note_part(piece, facts)

    @property
    def missing(self) -> list[Piece]:
        """The pieces without parts."""
        return [piece for piece in self.plan.pieces if piece.name not in self._done]

    def submit(self, executor: Executor, packer: PartPacker, share: tuple[int, int] | None) -> None:
        """Begin what is left to do.

        Args:
            executor: Makes the calls.
            packer: Packs a piece.
            share: See `pack_parts`.
        """
        number, shares = share or (1, 1)
        hashed = self.plan.hashed if share is None else []
        self._digests = {one.path: executor.submit(digest_source, one) for one in hashed}
        self.calls = dict.fromkeys(self._digests.values())
        missing = self.missing
        for piece in self.plan.pieces[number - 1 :: shares]:
            if piece in missing:
                self.calls[executor.submit(packer, piece)] = piece
        self.tell()

    def ended(self, call: Future[Any]) -> None:
        """Note that a call has ended: that a piece is packed, or why not."""
        piece, error = self.calls.pop(call), call.exception()
        name = piece.name if piece else f"source-{[*self._digests.values()].index(call)}"
        if error is not None:
            self.failures.append((name, failure_of(error)))
        elif piece is not None:
            place = self.folder.part(piece)
            if not is_seen(lambda: part_facts(place) is not None, self.folder.path):
                gone = f"its part did not appear in {self.folder.path}; {SHARED}"
                self.failures.append((name, Mp4dsError(gone)))
            elif facts := part_facts(place):
                self._note_part(piece, facts)

    def _note_part(self, piece: Piece, facts: PartFacts) -> None:
        self._done.add(piece.name)
        for topic, (count, length) in facts.topics.items():
            self._messages[topic] += count
            self._read += length
        self._written += folder_size(self.folder.part(piece))

    def refuse_failures(self) -> None:
        """Report the pieces that failed.

        Raises:
            PartsFailedError: There are some.
        """
        if self.failures:
            failures = sorted(self.failures, key=lambda failure: failure[0])
            raise PartsFailedError(
                self.target,
                [(name, str(error)) for name, error in failures],
                len(self.plan.pieces),
                failures[0][1].exit_code,
            )

    def refuse_missing(self) -> None:
        """Refuse to put parts together of which some are missing.

        Raises:
            OptionError: Names them.
        """
        if names := [piece.name for piece in self.missing]:
            listed = ", ".join(names[:_LISTED]) + ", ..." * (len(names) > _LISTED)
            raise OptionError(
                f"{path_text(self.target)}: {len(names)} of {len(self.plan.pieces)} parts are "
                f"missing: {listed}. Run their shards, or pack without `join` to pack them here."
            )

    def tell_whole(self, part: PartRecord, done: float) -> None:
        """Report progress of a recording that is packed in one pass.

        Args:
            part: What was packed so far.
            done: Its share, 0 to 1.
        """
        topics = part.topics.values()
        self._messages = Counter({topic.topic: topic.messages for topic in topics})
        self._read = sum(topic.raw_bytes for topic in topics)
        self._written = folder_size(part.folder)
        self.tell(done=done)

    def tell(self, phase: str = "packing", note: str = "", done: float | None = None) -> None:
        """Report progress; `done` is that of the frames if it is not given."""
        if self.report is None:
            return
        messages, frames = self._messages, self.plan.frames
        total = sum(count or 0 for count in frames.values())
        if done is None and total:
            done = sum(min(messages[topic], count or 0) for topic, count in frames.items()) / total
        self.report(
            PackProgress(
                dataset=self.target,
                phase=phase,
                done=done,
                bytes_read=self._read,
                bytes_total=sum(source.size for source in self.plan.sources),
                bytes_written=self._written,
                topics={topic: (messages[topic], count) for topic, count in frames.items()},
                tasks_done=len(self._done),
                tasks_total=len(self.plan.pieces) if self.plan.is_divided else 0,
                failed=len(self.failures),
                note=note,
            )
        )

    def finish(self) -> PackSummary:
        """Put the parts together, and remove them.

        Raises:
            PartsFailedError: The dataset could not be written; the parts are kept.
            FormatError: A part was damaged after it was made; it will be made again.
            SourceError: The recording is damaged, or has changed.
        """
        self.tell("joining")
        places = [self.folder.part(piece) for piece in self.plan.pieces]
        try:
            with staged(self.target, force=self.force, owned=dataset_files) as made:
                made.mkdir()
                summary = self._join(made, places)
        except FormatError as error:
            for place in places:
                if str(error.place).startswith(f"{place}{os.sep}"):
                    (place / FACTS_NAME).unlink(missing_ok=True)  # so that it is made again
                    problem = "was damaged after it was written; run the same command again to redo"
                    problem += " this part"
                    raise FormatError("checksum-mismatch", error.place, problem) from None
            raise
        except OSError as error:
            if isinstance(error, (SourceError, TargetError)):
                raise
            refused = error if isinstance(error, WriteError) else WriteError(self.target, error)
            raise PartsFailedError(
                self.target, [("joining", str(refused))], len(self.plan.pieces), 1
            ) from None
        self.folder.remove()
        return summary

    def _join(self, made: Path, places: Sequence[Path]) -> PackSummary:
        plan, whole = self.plan, PartRecord(made)
        for place in places:
            facts = part_facts(place)
            if facts is None:
                raise FormatError("file-missing", place / MANIFEST_NAME, "or another file is gone")
            whole.skipped |= facts.skipped
            for name, (messages, size) in facts.topics.items():
                topic = whole.topics.setdefault(name, TopicSummary(name, ""))
                topic.messages += messages
                topic.raw_bytes += size
                notes = facts.notes.get(name, ())
                topic.notes += [note for note in notes if note not in topic.notes]
        with ExitStack() as stack:
            reader = stack.enter_context(plan.open())
            parts = [stack.enter_context(Dataset(place, layer="exact")) for place in places]
            for source in plan.sources:
                source.check()
            for manifest in (part.manifest for part in parts):
                if manifest:
                    whole.losses += [entry.to_record() for entry in manifest.losses]
                    whole.left_out |= dict.fromkeys(manifest.topics_left_out)
                    whole.redactions += manifest.redactions
            digests = {path: call.result() for path, call in self._digests.items()}
            changes = plan.origin(reader, whole, digests)
            concat(parts, made, changes=changes, report=lambda name: self.tell("joining", name))
            # last, since damage of a part would be taken for that of the index
            _check_index(reader, parts, plan.options.selected)
            size = sum(source.size for source in plan.sources)
            source_bytes = None if plan.options.is_slice else size
            return summarize(whole, self.target, source_bytes, too_large=reader.slice.left_out)


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

    def key_of(channel: Channel) -> tuple[object, ...]:
        # an image that cannot be reduced stays on its own channel
        return (channel.topic,) if reader.reduction else channel.identity

    # by channel; equal ones of a recording are one in a part
    found, due = Counter[tuple[object, ...]](), Counter[tuple[object, ...]]()
    for part in parts:
        counts = part.counts()
        for channel in part.channels:
            found[key_of(channel)] += counts.get(channel.id, 0)
    stats = reader.stats()
    listed = [one for one in reader.channels if selected(one.topic) and one.id in stats]
    for channel in listed:
        due[key_of(channel)] += stats[channel.id].count
    for channel in listed:
        key = key_of(channel)
        if found[key] != due[key]:
            raise SourceError(
                reader.path,
                f"is damaged: its index lists {due[key]} messages on {channel.topic}, but "
                f"{found[key]} were found",
            )


@contextmanager
def _claimed(packs: Sequence[PartedPack], *, alone: bool) -> Iterator[None]:
    """Lock the folders of packs; those without any parts are removed at the end."""
    with ExitStack() as stack:
        for pack in packs:
            stack.enter_context(pack.folder.claimed(shared=not alone))
        try:
            yield
        except BaseException as error:
            kept = not alone
            for pack in packs:
                if pack.folder.has_parts():
                    kept = True
                elif alone:
                    pack.folder.remove()
            if kept and isinstance(error, (KeyboardInterrupt, SystemExit)):
                raise interrupted(error, _KEPT) from None
            raise


def pack_parts(
    packs: Sequence[PartedPack],
    executor: AbstractContextManager[Executor],
    options: PackOptions,
    share: tuple[int, int] | None = None,
) -> Iterator[PackSummary]:
    """Pack recordings in parts, as one job.

    Args:
        packs: The recordings.
        executor: Opens what packs the pieces.
        options: How.
        share: Which share of the pieces to pack, from 1, and the number of shares; None to pack
            all, and to make the datasets.

    Yields:
        The result for each dataset that is made, as it is done.

    Raises:
        PartsFailedError: Pieces failed.
        RemoteError: The cluster was lost.
    """
    alone = share is None
    with _claimed(packs, alone=alone), executor as workers, ExitStack() as stack:
        for pack in packs:
            pack.begin(anew=options.restart, alone=alone)
            if options.join:
                pack.refuse_missing()
        for pack in packs:  # so that all work is known from the beginning
            packer = stack.enter_context(closing(PartPacker(pack.plan, pack.folder.path)))
            pack.submit(workers, packer, share)
        busy = list(packs)
        while busy:
            for pack in [pack for pack in busy if not pack.calls]:
                busy.remove(pack)
                if alone and not pack.failures:
                    yield pack.finish()
            calls = {call: pack for pack in busy for call in pack.calls}
            for call in wait(calls, _POLL_SECONDS, FIRST_COMPLETED).done:
                if options.cluster and call.cancelled():
                    problem = "the connection to the Dask scheduler was lost"
                    remedy = f"Check whether it is still running; {_KEPT}."
                    raise RemoteError(options.cluster, problem, remedy)
                calls[call].ended(call)
                if not options.keep_going:
                    calls[call].refuse_failures()
            for pack in busy:
                pack.tell()
        for pack in packs:
            pack.refuse_failures()
