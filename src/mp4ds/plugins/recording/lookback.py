"""Looking back: of the spool only the newest stays, until a trigger saves it as a dataset.

Nothing is packed before: pieces are written to disk in any case, so that packing them would cost
much time of the processor, and spare no writing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from mp4ds.bags.formats import open_sources
from mp4ds.bags.latched import has_late, latched_before
from mp4ds.bags.mcap import McapWriter
from mp4ds.bags.protocols import with_own_payload
from mp4ds.errors import TargetError, TargetExistsError
from mp4ds.files.outputs import sync, sync_folder
from mp4ds.format.manifest import Excerpt as SourceExcerpt
from mp4ds.format.manifest import Source
from mp4ds.plugins.recording.spool import FAILURES, WINDOW_NS, Piece, Split, sync_all
from mp4ds.records import Channel, Excerpt, Loss, Message

_PIECES = 10
"""Into so many a short window is divided, at least: how exactly the disk keeps to it."""

_Made = TypeVar("_Made")


def at_first_free(paths: Iterator[Path], make: Callable[[Path], _Made]) -> _Made:
    """What is made at the first of endless paths that no other recorder takes meanwhile."""
    while True:
        with suppress(TargetExistsError):
            return make(next(paths))


class Saved(Split):
    """A dataset of what a recorder that looks back has.

    Its folder has hard links to the pieces: they live until the dataset is made, whatever is
    removed, or saved in other datasets.

    Args:
        start: Its first log time, ns.
        end: The log time, ns, before which it ends.
        spool: As for `Split`.

    Attributes:
        is_over: Whether pieces of the time after it have begun.
        awaited: The numbers of its pieces that are still written.
    """

    def __init__(self, start: int, end: int, *spool: Any) -> None:
        super().__init__(*spool)
        self.start, self.end = start, end
        self._first = start  # log time, ns: earlier are latched messages
        self.is_over = False
        self.awaited: set[int] = set()
        self._numbers: dict[int, int] = {}  # by those of the spool

    def begin(self, before: Path, pieces: Sequence[Piece], announced: Iterable[Channel]) -> None:
        """Take the pieces that are complete, and the latched messages from before them.

        Args:
            before: Latched messages from before all pieces.
            pieces: All that are complete, in order.
            announced: Channels, some of which may have no messages.
        """
        with open_sources([before]) as reader:
            records = [one for one in reader.records() if isinstance(one, Message)]
            latched = list(map(with_own_payload, records))
        channels: dict[object, Channel] = {}
        for channel in (*(message.channel for message in latched), *announced):
            channels.setdefault(channel.identity, replace(channel, id=len(channels)))
        first = self._open.pop()
        for channel in channels.values():
            first.writer.add_channel(channel)
        for message in latched:
            self._write(first, message.of_channel(channels[message.channel.identity]))
        self._close_piece(first)
        sync_all(self.written())
        self._jobs.submit(self._pack, first)
        for piece in pieces:
            self.link(piece)
            self.take(piece)

    def link(self, piece: Piece) -> None:
        """Include a piece, which may still be written."""
        number = self._numbers[piece.number] = self._count
        self._count += 1
        self.folder.piece(number).hardlink_to(piece.writer.path)
        sync_folder(self.folder.path)  # before the other name is removed

    def take(self, piece: Piece) -> None:
        """Have a piece packed that is linked and complete, without what is before the start."""
        first, last = piece.span
        # a video would begin with frames that are hidden, and could not be joined
        is_cut = first < self.start <= last and not piece.is_video
        if first < self.start and not is_cut:
            self._first = min(self._first, first)
        self._bytes += piece.bytes
        piece = replace(piece, number=self._numbers[piece.number])
        self._jobs.submit(self._pack, piece, self.start if is_cut else None)

    def _sources(self) -> list[Source]:
        excerpt = SourceExcerpt(start=self._first)
        return [Source(name=self.folder.path.name, size=self._bytes, excerpt=excerpt)]

    def finish(self) -> None:
        """Have the dataset made when all is packed."""
        self._jobs.submit(self._join)


class LookBack(Split):
    """A spool of which only the newest stays; parts of it are saved as datasets.

    Before a piece is removed, its latched messages go into piece 0, for the datasets to begin with.
    All that takes long, or reads, is done by a thread of its own, in order.

    What cannot be saved stays in its folder.

    Args:
        target: Names its folder.
        new_paths: Gives paths for the next dataset, endlessly.
        keep_ns: Log time to keep.
        more_ns: Log time after a trigger that is saved, too.
        spool: As for `Split`.

    Attributes:
        saved: The datasets, complete or not.
        unsaved: Why something could not be saved, if so.

    Raises:
        TargetError: The file system cannot link files.
    """

    looks_back = True

    def __init__(
        self,
        target: Path,
        new_paths: Callable[[], Iterator[Path]],
        keep_ns: int,
        more_ns: int,
        *spool: Any,
    ) -> None:
        self.saved: list[Saved] = []
        self.unsaved: Exception | None = None
        self._unsaved_spans: list[tuple[int, int]] = []  # log times, ns
        self._time = 0  # the latest log time, ns
        self._saving: list[Saved] = []  # those that get more pieces
        self._kept: deque[Piece] = deque()  # that are complete
        self._new_paths = new_paths
        self._keep_ns, self._more_ns = keep_ns, more_ns
        self._spool = spool
        self._keeper = ThreadPoolExecutor(1, "look-back")
        super().__init__(target, *spool)
        self._window_ns = min(WINDOW_NS, keep_ns // _PIECES)
        self._close_piece(self._open.pop())
        link = self.folder.piece(1)
        try:
            link.hardlink_to(self.folder.piece(0))
            link.unlink()
        except OSError as error:
            self._remove()
            problem = f"its file system cannot link files: {error.strerror}"
            raise TargetError(self.target, problem, "Look back on another one.") from None
        self._begin(0)

    # ------------------------------------------------------------ writing

    def write(self, message: Message) -> None:
        """Write a message, and remove what is too old.

        Raises:
            OSError: It cannot be written.
        """
        self.advance(message.log_time)
        super().write(message)

    def advance(self, time: int) -> None:
        """Let datasets end that end before a log time, ns.

        Raises:
            OSError: The disk refused something.
        """
        if self.error is not None:
            raise self.error
        if self._span and abs(time - self._time) > self._keep_ns:
            self._warn("the clock has jumped: of the time before, no more is looked back at")
        self._time = time
        for saved in [one for one in self._saving if not one.start <= time < one.end]:
            if saved.is_over:
                continue
            saved.is_over = True
            if self._open[-1].start < saved.end <= time:  # else a clock has jumped back
                self.flush()
                self._begin(saved.end)
            self._finish(saved)
        self._complete_until(time)

    def save(self, time: int, announced: Iterable[Channel]) -> None:
        """Save what there is before a log time, ns, and what comes soon after."""
        self._prune(time)
        start, end = max(0, time - self._keep_ns), time + self._more_ns
        try:
            saved = at_first_free(
                self._new_paths(), lambda path: Saved(start, end, path, *self._spool)
            )
        except FAILURES as error:
            self._keep_unsaved(start, end, error)
            return
        self.saved.append(saved)
        self._saving.append(saved)
        self._later(saved.begin, self.folder.piece(0), [*self._kept], [*announced], saved=saved)
        for piece in self._open:
            self._include(saved, piece)

    def _include(self, saved: Saved, piece: Piece) -> None:
        if piece.start < saved.end:
            saved.awaited.add(piece.number)
            self._later(saved.link, piece, saved=saved)

    def _begin(self, start: int) -> Piece:
        piece = super()._begin(start)
        for saved in self._saving:
            if not saved.is_over:
                self._include(saved, piece)
        return piece

    def _complete(self, piece: Piece) -> None:
        self._close_piece(piece)
        self._kept.append(piece)
        for saved in [one for one in self._saving if piece.number in one.awaited]:
            saved.awaited.remove(piece.number)
            self._later(saved.take, piece, saved=saved)
            self._finish(saved)
        self._prune(max(piece.span[1], piece.start))

    def _finish(self, saved: Saved) -> None:
        if saved.is_over and not saved.awaited:
            self._saving.remove(saved)
            self._later(saved.finish, saved=saved)

    def _prune(self, time: int) -> None:
        """Remove the pieces that are too old at a log time, ns, or from before a clock's jump."""
        while self._kept and abs(time - self._kept[0].span[1]) > self._keep_ns:
            piece = self._kept.popleft()
            self._packed_bytes += piece.bytes
            self._later(self._forget, piece)

    def close(self, announced: Iterable[Channel], losses: Sequence[Loss] = ()) -> None:
        """End all datasets, and remove what is in none of them.

        Args:
            announced: Channels, some of which may have no messages.
            losses: What came and is not there; in which of the datasets, is not known.

        Raises:
            OSError: It cannot be written.
        """
        while self._open:
            self._complete(self._open.pop(0))
        for saved in [*self._saving]:
            saved.is_over = True
            self._finish(saved)
        self._later(self._remove, [*self._kept])
        self._keeper.shutdown()
        if self.error is not None:
            raise self.error

    def abandon(self) -> None:
        """Close all files as they are, with what the disk still takes."""
        super().abandon()
        self._keeper.shutdown()

    # ------------------------------------------------------------ in a thread of its own

    def _later(
        self, call: Callable[..., None], *arguments: Any, saved: Saved | None = None
    ) -> None:
        """Do something later; if it fails for a dataset, its messages stay, and all goes on."""

        def run() -> None:
            try:
                if self.error is None:
                    call(*arguments)
            except FAILURES as error:
                if saved is None:
                    self.error = error
                    return
                saved.error = saved.error or error
                self._keep_unsaved(saved.start, saved.end, error)

        self._keeper.submit(run)

    def _keep_unsaved(self, start: int, end: int, error: Exception) -> None:
        self.unsaved = error
        self._unsaved_spans.append((start, end))
        self._warn(f"{self.folder.path}: keeps what could not be saved: {error}")

    @property
    def _latched_before_unsaved(self) -> Path:
        return self.folder.piece(0).with_suffix(".before")

    def _forget(self, piece: Piece) -> None:
        """Remove a piece but for its latched messages; keep it if it could not be saved."""
        first, last = piece.span
        is_kept = any(first < end and start <= last for start, end in self._unsaved_spans)
        if is_kept and not self._latched_before_unsaved.exists():
            self._latched_before_unsaved.hardlink_to(self.folder.piece(0))
        if any(map(has_late, piece.channels.values())):
            before = self.folder.piece(0)
            new = before.with_suffix(".new")
            with open_sources([before, piece.writer.path]) as reader:
                latched, left_out = latched_before(reader, Excerpt())
            for topic in left_out:
                self._warn(f"{topic}: its latched messages are too large to be kept")
            writer = McapWriter(new, profile=self._profile)
            for record in self._others:
                writer.add_metadata(record)
            for message in latched:
                writer.add_channel(message.channel)
                writer.write(message)
            writer.finish()
            sync(new)
            sync_folder(new.parent)  # or the piece before this might be there again
            new.replace(before)
            sync_folder(new.parent)
        if not is_kept:
            piece.writer.path.unlink()

    def _remove(self, kept: Sequence[Piece] = ()) -> None:
        if self.unsaved is not None:
            for piece in kept:
                self._forget(piece)
            with suppress(FileNotFoundError):  # nothing came in its time
                self._latched_before_unsaved.replace(self.folder.piece(0))
            self.lock.close()
            return
        for number in range(self._count):
            self.folder.piece(number).unlink(missing_ok=True)
        self.lock.close()
        self.folder.remove(0)
