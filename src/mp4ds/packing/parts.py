"""A long recording is packed in parts, beside its dataset, which are put together in the end.

The folder of the parts is next to the dataset, on the same file system, under a name derived from
the dataset's, so that the same command finds it again. A part appears in it by one rename, when it
is complete: a dataset, with ``part.json`` for what its manifest does not tell. ``plan.json`` is
compared with the plan that is made again, and never read for anything else.

Somebody else may have put a folder there: in a shared folder, or in an unpacked archive. So nothing
is read from it, written to it or removed from it unless all of it belongs to this user and has
expected names, without any links; and the inode of the folder is noted, so that a copy is not
mistaken for the original. Other processes of the same user are trusted, and so is, where machines
share the folder and see other inodes (--shard, --join, --cluster), whatever that user put there.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from platform import node
from typing import Any

from mp4ds.bags.protocols import BagReader
from mp4ds.dataset.concat import concat
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import (
    Mp4dsError,
    OptionError,
    SourceError,
    TargetError,
    WriteError,
    advising,
    counted,
)
from mp4ds.files.outputs import (
    as_write_error,
    is_mine,
    lock,
    sync,
    sync_folder,
    write_synced,
)
from mp4ds.files.sources import SourceState, source_digest, unchanged
from mp4ds.files.urls import location, spelled
from mp4ds.format.fields import document_of, json_parser
from mp4ds.format.sidecars import COPY_AGAIN, MANIFEST_NAME, load_manifest
from mp4ds.options import CONTENT, ENCODING
from mp4ds.packing.manifest import Digest, origin_of, tools, write_manifest
from mp4ds.packing.packer import Exact, Packer, until_in_reach
from mp4ds.packing.planning import COPIED, PIECE_NAME, Piece, Plan
from mp4ds.processes import release_memory

_SUFFIX = ".mp4ds-part"
_PLAN_NAME = "plan.json"
FACTS_NAME = "part.json"
_ANEW = "Start over with `restart`."
_FULL = (errno.ENOSPC, errno.EDQUOT)
_NAMED = 3
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
SHARED = "all machines must share the dataset's folder"

_BEGUN = re.compile(rf"\.({PIECE_NAME})\.[a-z0-9_]{{8}}")  # a part in progress
_NAMES = re.compile(  # from the folder on; of folders, with a slash at the end
    rf"lock|plan\.json|\.plan\.json\.[^/]+\.part|({PIECE_NAME}|{_BEGUN.pattern})/(.*/)?[^/]*",
    re.DOTALL,
)


@dataclass(frozen=True)
class PlanNote:
    """What is noted of the plan that parts are made by: it is compared, and for nothing else.

    Attributes:
        paths: The recordings.
        sources: The state of all their files.
        options: Those that determine the result.
        tools: Versions of what packs.
        decisions: How images are stored, in words; none if that is not yet known.
        inode: Of the folder in which the parts were begun.
    """

    paths: list[str]
    sources: list[SourceState]
    options: dict[str, Any]
    tools: dict[str, str]
    decisions: list[list[str]]
    inode: int = 0

    @classmethod
    def of(cls, plan: Plan) -> PlanNote:
        """What there is to note."""
        options = {
            **plan.options.changing(CONTENT, ENCODING),
            "gop": plan.options.group_frames,
            "about": document_of(plan.about) if plan.about else None,
        }
        return cls(
            paths=list(plan.paths),
            sources=list(plan.sources),
            options=json.loads(json.dumps(options, default=str)),
            tools=dict(plan.tools),
            decisions=plan.texts,
        )

    def check_sources(self, paths: Sequence[Path]) -> None:
        """Refuse a recording that has changed: it might be taken for a damaged one.

        Args:
            paths: What is to be packed; no other files are looked at.

        Raises:
            SourceError: Names the file.
        """
        for given in map(spelled, paths):
            for source in self.sources:
                if f"{source.path}/".startswith(f"{given}/"):
                    source.check()


_parse_note = json_parser(PlanNote)


# ---------------------------------------------------------------- the folder


class PartsFolder:
    """The folder of a dataset's parts, which may not exist yet. See the module.

    Args:
        target: The dataset.
    """

    def __init__(self, target: Path) -> None:
        self.path = target.parent / f".{target.name}{_SUFFIX}"

    def part(self, piece: Piece) -> Path:
        """Where the part of a piece is, when it is done."""
        return self.path / piece.name

    @contextmanager
    def claimed(self, *, shared: bool) -> Iterator[None]:
        """Lock the folder while working in it.

        Args:
            shared: Others may work on other parts at the same time.

        Raises:
            TargetError: Another pack is working there, the folder cannot be created, or holds
                unexpected entries.
            WriteError: The disk is full.
        """
        try:
            self.path.mkdir(mode=0o700, exist_ok=True)
            self._check_folder()
            handle = os.open(self.path / "lock", os.O_RDWR | os.O_CREAT | _NO_LINK, 0o600)
        except OSError as error:
            if isinstance(error, TargetError):
                raise
            if error.errno in _FULL:
                with suppress(OSError):
                    self.path.rmdir()
                raise WriteError(self.path, error) from None
            raise TargetError(
                self.path, f"cannot be created: {error.strerror}", "Choose another folder."
            ) from None
        with os.fdopen(handle, "r+b") as file:
            try:
                lock(file, shared=shared)  # even without locks, parts appear complete
            except BlockingIOError:
                raise TargetError(
                    self.path, "another mp4ds is working there", "Wait for it, or stop it."
                ) from None
            self._check_entries()
            yield

    def _check_folder(self) -> None:
        """Refuse a folder that somebody else has put there.

        Raises:
            TargetError: It is another user's, or a link.
        """
        with suppress(FileNotFoundError):
            found = self.path.lstat()
            if not stat.S_ISDIR(found.st_mode):
                raise TargetError(
                    self.path,
                    "is not a folder, or is a symbolic link",
                    "Remove it; mp4ds creates its own.",
                )
            if not is_mine(found, self.path.parent):
                raise TargetError(self.path, "belongs to another user", "Choose another folder.")

    def _check_entries(self) -> None:
        """Refuse what is not made here.

        Raises:
            TargetError: Names some of it.
        """
        owner = self.path.lstat().st_uid
        unknown: list[str] = []
        waiting = [(self.path, "")]
        while waiting:
            place, prefix = waiting.pop()
            with suppress(FileNotFoundError), os.scandir(place) as entries:
                for entry in entries:
                    with suppress(FileNotFoundError):  # others finish parts meanwhile
                        found = entry.stat(follow_symlinks=False)
                        is_folder = stat.S_ISDIR(found.st_mode)
                        name = prefix + entry.name + "/" * is_folder
                        is_plain = is_folder or stat.S_ISREG(found.st_mode)
                        if not (is_plain and found.st_uid == owner and _NAMES.fullmatch(name)):
                            unknown.append(name)
                        elif is_folder:
                            waiting.append((Path(entry.path), name))
        if unknown:
            listed = ", ".join(sorted(unknown)[:_NAMED]) + ", ..." * (len(unknown) > _NAMED)
            raise TargetError(
                self.path,
                f"holds {counted(len(unknown), 'item')} that mp4ds did not make: {listed}",
                "Check what they are; if you remove the folder, packing starts over.",
            )

    # ------------------------------------------------------------ the plan

    def note(self) -> PlanNote | None:
        """What was noted of the plan of existing parts; None if there is nothing.

        Raises:
            TargetError: It is damaged, or of another version.
        """
        self._check_folder()
        path = self.path / _PLAN_NAME
        try:
            if not stat.S_ISREG(path.lstat().st_mode):
                raise TargetError(path, "is not a file, or is a symbolic link", "Remove it.")
            note: PlanNote = _parse_note(path.read_bytes())
        except ValueError:
            raise self._other("an unfinished pack, damaged or of another version") from None
        except OSError as error:
            if isinstance(error, TargetError):
                raise
            return None
        return note

    def keep(self, note: PlanNote) -> None:
        """Keep what is noted of a plan, unless another has done so meanwhile."""
        path = self.path / _PLAN_NAME
        values = {**asdict(note), "inode": self.path.lstat().st_ino}
        try:
            with suppress(FileExistsError):
                write_synced(path, json.dumps(values, indent=1).encode(), replace=False)
        except OSError as error:
            raise as_write_error(error, path) from None

    def check(self, plan: PlanNote, *, shared: bool) -> None:
        """Refuse to go on with the parts of another pack.

        Args:
            plan: What there is to note of this one.
            shared: It may have been begun by another machine.

        Raises:
            TargetError: They were made by other versions, elsewhere, or by other decisions.
            OptionError: The options or recordings are others.
            SourceError: The recording consists of other files.
        """
        note = self.note()
        if note is None:
            return
        if note.tools != plan.tools:
            theirs = ", ".join(f"{name} {version}" for name, version in note.tools.items())
            raise self._other(f"a pack started with other versions: {theirs}")
        if not shared and note.inode != self.path.lstat().st_ino:
            raise self._other("an unfinished pack that was started elsewhere")
        if note.paths != plan.paths:
            listed = ", ".join(str(location(path)) for path in note.paths)  # without signatures
            raise OptionError(f"{self.path} holds an unfinished pack of {listed}. {_ANEW}")
        for name, value in plan.options.items():
            if note.options.get(name) != value:
                raise OptionError(
                    f"The pack was started with a different `{name}`: "
                    f"{note.options.get(name)!r}, and now it is {value!r}. Give the same value to "
                    f"resume. {_ANEW}"
                )
        if note.sources != plan.sources:
            raise SourceError(
                location(plan.paths[0]),
                "consists of different files than when packing began",
                "Start over with `restart`.",
            )
        if plan.decisions and note.decisions != plan.decisions:
            raise self._other("parts that were encoded in another way")

    def _other(self, found: str) -> TargetError:
        """The error of a folder that holds something else."""
        return TargetError(self.path, f"holds {found}", _ANEW)

    # ------------------------------------------------------------ parts

    def has_parts(self) -> bool:
        """Whether there is anything to continue from."""
        try:
            return any(part_facts(path) for path in self.path.iterdir() if path.is_dir())
        except FileNotFoundError:
            return False
        except OSError:
            return True  # for all one knows

    def sweep(self) -> None:
        """Remove what processes left that were ended; nobody else may be at work."""
        for path in self.path.iterdir():
            if _BEGUN.fullmatch(path.name):
                shutil.rmtree(path, ignore_errors=True)
            elif path.name.startswith(f".{_PLAN_NAME}."):
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove all parts, and forget their plan.

        Raises:
            TargetError: They cannot be removed.
        """
        try:
            for path in self.path.iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
            # last: if this is killed, parts that remain must not be taken for those of another plan
            (self.path / _PLAN_NAME).unlink(missing_ok=True)
        except OSError as error:
            raise TargetError(
                self.path, f"cannot be emptied: {error.strerror}", "Remove it yourself."
            ) from None

    def remove(self) -> None:
        """Remove all that is made here."""
        with suppress(OSError):
            self.clear()
            (self.path / "lock").unlink(missing_ok=True)
            self.path.rmdir()


# ---------------------------------------------------------------- one part


@dataclass(frozen=True)
class PartFacts:
    """What the manifest of a part does not tell.

    Attributes:
        topics: Messages and bytes of each topic, in the order of the recording.
        notes: What else is worth knowing, by topic.
        skipped: What the source holds and no dataset can: a phrase -> how many.
    """

    topics: dict[str, tuple[int, int]]
    notes: dict[str, list[str]]
    skipped: dict[str, int]


_parse_facts = json_parser(PartFacts)


def part_facts(part: Path) -> PartFacts | None:
    """What became of a part; None if it is not there, or not whole."""
    try:
        facts: PartFacts = _parse_facts((part / FACTS_NAME).read_bytes())
        for entry in load_manifest(part / MANIFEST_NAME).files:
            found = (part / entry.name).lstat()
            if not stat.S_ISREG(found.st_mode) or found.st_size != entry.size:
                return None
    except (OSError, ValueError):
        return None
    return facts


class PartPacker:
    """Packs pieces of one recording into parts, in this process or in another one.

    It may be pickled; the recording is opened for the first piece, and again in each process, and
    stays open for the next, as reading its index may take long.

    Args:
        plan: The plan.
        folder: The folder of the parts.
    """

    def __init__(self, plan: Plan, folder: Path) -> None:
        self._plan = replace(plan, pieces=())  # of which there may be thousands
        self._folder = folder
        self._reader: BagReader | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return PartPacker, (self._plan, self._folder)

    def __call__(self, piece: Piece) -> None:
        """Pack a piece, unless its part is there; a piece may be packed twice at a time.

        Raises:
            SourceError: The recording is damaged, or has changed.
            Mp4dsError: This process is not like the one that made the plan.
            OSError: It cannot be written.
        """
        plan, place = self._plan, self._folder / piece.name
        if tools() != plan.tools:
            theirs = ", ".join(f"{name} {version}" for name, version in plan.tools.items())
            raise Mp4dsError(
                f"{node()} has other versions than {theirs}; install the same everywhere."
            )
        if not self._folder.is_dir():
            raise Mp4dsError(f"{self._folder} is not there on {node()}; {SHARED}.")
        if part_facts(place) is not None:
            return
        try:
            with unchanged(plan.sources), _appearing(place) as into:
                until_in_reach(partial(self._pack, piece, into))
        except BaseException:
            self.close()  # it may be damaged in what was read ahead
            raise
        finally:
            release_memory()  # a worker of a cluster that uses much gets no more calls

    def _pack(self, piece: Piece, into: Path, exact: Exact) -> None:
        for path in into.iterdir():
            path.unlink()
        if piece.name == COPIED:
            self._copy(piece, into)
            return
        if self._reader is None:
            self._reader = self._plan.open()
        part = Packer(self._reader, into, self._plan, piece, exact).run()
        topics = part.topics.values()
        facts = PartFacts(
            {topic.topic: (topic.messages, topic.raw_bytes) for topic in topics},
            {topic.topic: topic.notes for topic in topics if topic.notes},
            part.skipped,
        )
        (into / FACTS_NAME).write_text(json.dumps(asdict(facts)))
        write_manifest(part, origin_of(self._reader, part), str(self._plan.options.quality))

    def _copy(self, piece: Piece, into: Path) -> None:
        told: dict[str, Any] = {"losses": [], "topics_left_out": [], "redactions": []}
        with advising(COPY_AGAIN), Dataset(location(self._plan.paths[0])) as dataset:
            selected = piece.excerpt.has_topic
            concat([dataset], into, selected=selected, others=False, changes=told)
        (into / FACTS_NAME).write_text(json.dumps(asdict(PartFacts({}, {}, {}))))

    def close(self) -> None:
        """Close the recording."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None


@contextmanager
def _appearing(place: Path) -> Iterator[Path]:
    """Make a folder that appears when it is complete.

    Yields:
        The folder to fill.

    Raises:
        OSError: It cannot be written.
    """
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
    except OSError as error:
        raise WriteError(place, error) from None
    try:
        yield folder
        sync(folder)
        sync_folder(folder)
        if part_facts(place) is None:  # else another was quicker
            shutil.rmtree(place, ignore_errors=True)  # one that is not whole
            folder.rename(place)
            sync_folder(place.parent)
    except OSError as error:
        if part_facts(place) is None:
            raise as_write_error(error, place) from None
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def digest_source(source: SourceState) -> Digest:
    """Size in bytes and SHA-256 of a recording's file.

    Raises:
        SourceError: It cannot be read, or has changed.
    """
    path = location(source.path)
    try:
        with unchanged([source]):
            return source_digest(path)
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
