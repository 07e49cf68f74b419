"""What a disk may hold after a power cut: states made of a log of what processes did to a folder.

``disk_log.c``, compiled when it is needed, logs each write, size, sync and name below a folder. A
cut comes between any two of them. What is in a file is certain only up to its last sync. Of names
there are two models:

- ``journal``: as ext4 and XFS, all changes of names reach the disk in their order, and a sync of a
  file or folder takes those before its own with it.
- ``any``: a name is certain only once its folder was synced, as POSIX has it; others are there or
  not, whatever came later. Only the names of one file keep their order.

Kinds of what is in files beyond their last sync: ``prefix``, all, with all names, as after
``kill -9``; ``lost``, nothing; ``torn``, up to a sector of some write; ``reordered``, pages and
sectors of any time; ``zeros``, the size and some of the data; ``mixed``, each file its own.
"""

from __future__ import annotations

import hashlib
import os
import random
import struct
import subprocess
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path, PurePosixPath

KINDS = ("lost", "torn", "reordered", "zeros", "mixed")
MODELS = ("journal", "any")
_HEAD = struct.Struct("<QQQqQQQ")
_SECTORS = 512, 4096
_PAGE = 4096
_EXCHANGE = 2


def run_logged(command: Sequence[object], root: Path, log: Path) -> None:
    """Run a program, logging what it does below a folder.

    Raises:
        ValueError: It failed.
    """
    library = log.with_name("disk_log.so")
    source = Path(__file__).with_name("disk_log.c")
    compiler = (sysconfig.get_config_var("CC") or "cc").split()[0]
    flags = ["-O1", "-shared", "-fPIC", "-w", "-o", library, source, "-ldl", "-lpthread"]
    subprocess.run([compiler, *flags], check=True)
    log.unlink(missing_ok=True)
    added = {"LD_PRELOAD": str(library), "DISK_LOG": str(log), "DISK_LOG_ROOT": str(root)}
    words, environment = list(map(str, command)), {**os.environ, **added}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"{words} exited with code {done.returncode}: {done.stderr}")


@dataclass(eq=False)
class Thing:
    """A file or folder, whatever its names.

    Attributes:
        data: Writes into a file: number in the log, offset, bytes; bytes are None where the size is
            set to the offset.
        synced: When a sync was complete, and when it had begun: numbers in the log.
        names: Changes of its names, by their place among all of them.
    """

    is_folder: bool
    data: list[tuple[int, int, bytes | None]] = field(default_factory=list)
    synced: list[tuple[int, int]] = field(default_factory=list)
    names: list[int] = field(default_factory=list)
    entries: dict[str, Thing] = field(default_factory=dict)  # of a folder, while it is replayed

    def certain(self, cut: int) -> int:
        """The number in the log before which all is on the disk."""
        return max((begun for done, begun in self.synced if done < cut), default=0)

    def content(self, count: int) -> bytes:
        """What is in it after so many writes."""
        held = bytearray()
        for _, at, data in self.data[:count]:
            end = at if data is None else at + len(data)
            if len(held) < end or data is None:
                held[end:] = bytes(max(0, end - len(held)))
            if data is not None:
                held[at:end] = data
        return bytes(held)


@dataclass(frozen=True)
class Change:
    """A change of names: of each thing, the folder and name that it loses and gets, or None."""

    number: int
    moves: tuple[tuple[Thing, tuple[Thing, str] | None, tuple[Thing, str] | None], ...]


@dataclass(frozen=True)
class State:
    """What is on the disk after a cut.

    Attributes:
        cut: Number in the log of what was not done any more.
        time: Its time by the monotonic clock, ns: the power may have been cut up to then.
        files: Content by path; None for a folder.
    """

    kind: str
    model: str
    cut: int
    time: int
    files: Mapping[str, bytes | None]

    @property
    def digest(self) -> str:
        """Equal for equal files."""
        found = hashlib.sha256()
        for path, data in sorted(self.files.items()):
            found.update(f"{path}\0{-1 if data is None else len(data)}\0".encode() + (data or b""))
        return found.hexdigest()

    def write(self, folder: Path) -> None:
        """Make it in a folder."""
        for path, data in sorted(self.files.items()):
            if data is None:
                (folder / path).mkdir(parents=True, exist_ok=True)
            else:
                (folder / path).write_bytes(data)


class Disk:
    """A folder, and the log of what was done below it.

    Args:
        root: The folder as it is after the log.
        log: The log.
        before: What was there before: inode, and content or None for a folder, by relative path.

    Raises:
        ValueError: The log does not tell all that was done, or not what became of it.
    """

    def __init__(
        self, root: Path, log: Path, before: Mapping[str, tuple[int, bytes | None]]
    ) -> None:
        self._root = PurePosixPath(os.path.normpath(root))
        self._inodes: dict[int, Thing] = {}
        self._top = Thing(is_folder=True)
        self.changes: list[Change] = []
        self.times: list[int] = [0]
        self._begun: dict[tuple[int, int], int] = {}
        self.checked = 0  # contents that were compared
        for path, (inode, data) in sorted(before.items()):
            thing = self._top if path == "." else Thing(data is None)
            thing.data = [] if data is None else [(0, 0, data)]
            thing.synced = [(0, 1)]
            self._inodes[inode] = thing
            if path != ".":
                self._change(0, (thing, None, self._place(path)))
        for event in _events(log.read_bytes()):
            self.times.append(event[1])
            self._take(len(self.times) - 1, *event)
        final = snapshot(root)
        made = self._listed(self._top)
        if {path: data for path, (_, data) in final.items() if path != "."} != made:
            raise ValueError("the log does not lead to what is in the folder")

    def _place(self, path: str) -> tuple[Thing, str]:
        relative = PurePosixPath(os.path.normpath(self._root / path)).relative_to(self._root)
        folder = self._top
        for name in relative.parts[:-1]:
            folder = folder.entries[name]
        return folder, relative.name

    def _change(self, number: int, *moves: tuple[Thing, object, object]) -> None:
        change = Change(number, moves)  # type: ignore[arg-type]
        for thing, _, _ in moves:
            thing.names.append(len(self.changes))
        self.changes.append(change)
        _apply(change)

    def _take(
        self, number: int, kind: str, _: int, inode: int, at: int, one: str, two: str, data: bytes
    ) -> None:
        if kind == "X":
            raise ValueError(f"{one} {two}: is not known to the log")
        if kind in "CM":
            self._inodes[inode] = Thing(is_folder=kind == "M")
            self._change(number, (self._inodes[inode], None, self._place(one)))
        elif kind == "L":
            self._change(number, (self._inodes[inode], None, self._place(one)))
        elif kind == "U":
            folder, name = self._place(one)
            self._change(number, (folder.entries[name], (folder, name), None))
        elif kind == "R":
            old, new = self._place(one), self._place(two)
            thing, other = old[0].entries[old[1]], new[0].entries.get(new[1])
            moves = [(thing, old, new)]
            if other is not None and other is not thing:
                moves.insert(0, (other, new, old if at & _EXCHANGE else None))
            self._change(number, *moves)
        elif inode in self._inodes:  # else of a file without a name
            thing = self._inodes[inode]
            if kind in "WT":
                thing.data.append((number, at, data if kind == "W" else None))
            elif kind == "S":
                self._begun[inode, at] = number
            elif kind == "E":
                thing.synced.append((number, self._begun.pop((inode, at))))
            elif kind == "H" and thing.content(len(thing.data)) != data:
                raise ValueError("a file holds what is not in the log")
            self.checked += kind == "H"

    def _listed(self, folder: Thing, prefix: str = "") -> dict[str, bytes | None]:
        found: dict[str, bytes | None] = {}
        for name, thing in folder.entries.items():
            found[prefix + name] = None if thing.is_folder else thing.content(len(thing.data))
            if thing.is_folder:
                found |= self._listed(thing, f"{prefix}{name}/")
        return found

    # ------------------------------------------------------------ states

    def state(self, seed: int | str) -> State:
        """One of the states; the same for the same seed."""
        rng = random.Random(seed)
        # half of the cuts are near to a sync or a change of names, of which there are few
        near = [change.number for change in self.changes]
        near += [n for thing in self._inodes.values() for times in thing.synced for n in times]
        cut = rng.randrange(1, len(self.times) + 1)
        if rng.random() < 0.5:
            cut = min(max(1, rng.choice(near) + rng.randrange(-1, 3)), len(self.times))
        kind = rng.choice(("prefix", *KINDS))
        model = "" if kind == "prefix" else rng.choice(MODELS)
        self._replay(cut, model, rng)
        time = self.times[min(cut, len(self.times) - 1)]
        return State(kind, model, cut, time, dict(self._on_disk(self._top, "", cut, kind, rng)))

    def _replay(self, cut: int, model: str, rng: random.Random) -> None:
        """Have the names that are on the disk."""
        done = [change for change in self.changes if change.number < cut]
        certain: set[int] = set()
        for place, change in reversed([*enumerate(done)]):
            for thing, old, new in change.moves:
                places = [new or old] if model == "any" else [old, new]
                synced = [folder.certain(cut) for folder, _ in filter(None, places)]
                if model != "any":
                    synced.append(thing.certain(cut))
                if change.number < max(synced):
                    certain.add(place)
            if place in certain:  # and with it what was before, of each thing
                for thing, _, _ in change.moves:
                    certain.update([one for one in thing.names if one < place][-1:])
        least = max(certain, default=-1) + 1
        end = rng.choice((least, len(done), rng.randint(least, len(done))))
        share = rng.choice((0.0, 0.5, 0.9, 1.0))
        left_out: set[Thing] = set()
        self._top.entries = {}
        for change in self.changes:
            for thing, _, _ in change.moves:
                thing.entries = {}
        for place, change in enumerate(done):
            moved = {thing for thing, _, _ in change.moves}
            if model == "any" and not left_out & moved:
                is_there = place in certain or rng.random() < share
            else:
                is_there = place < end if model == "journal" else model == ""
            if is_there:
                _apply(change)
            else:
                left_out |= moved

    def _on_disk(
        self, folder: Thing, prefix: str, cut: int, kind: str, rng: random.Random
    ) -> Iterator[tuple[str, bytes | None]]:
        for name, thing in sorted(folder.entries.items()):
            if thing.is_folder:
                yield prefix + name, None
                yield from self._on_disk(thing, f"{prefix}{name}/", cut, kind, rng)
            else:
                own = rng.choice(("prefix", *KINDS[:-1])) if kind == "mixed" else kind
                yield prefix + name, _left(thing, cut, own, rng)


def _apply(change: Change) -> None:
    for thing, old, _ in change.moves:
        if old is not None and old[0].entries.get(old[1]) is thing:
            del old[0].entries[old[1]]
    for thing, _, new in change.moves:
        if new is not None:
            new[0].entries[new[1]] = thing


def _left(thing: Thing, cut: int, kind: str, rng: random.Random) -> bytes:
    """What is on the disk of a file."""
    numbers = [number for number, _, _ in thing.data]
    count = sum(1 for number in numbers if number < cut)
    safe = sum(1 for number in numbers if number < thing.certain(cut))
    whole = thing.content(count)
    if kind == "prefix" or safe >= count:
        return whole
    before = thing.content(safe)
    if kind == "lost":
        return before
    if kind == "torn":
        middle = rng.randrange(safe, count)
        _, at, data = thing.data[middle]
        if data is None:
            return thing.content(middle)
        sector = rng.choice(_SECTORS)
        ends = range(at // sector * sector + sector, at + len(data), sector)
        end = rng.choice([at, *ends, at + len(data)])
        held = thing.content(middle)
        return held[:at].ljust(at, b"\0") + data[: end - at] + held[end:]
    if kind == "zeros":
        first = rng.randrange(0, len(whole) // _PAGE + 1) * _PAGE
        held = before + bytes(max(0, len(whole) - len(before)))
        return (whole[:first] + held[first:])[: len(whole)]
    versions = [before, thing.content(rng.randint(safe, count)), whole]
    page = rng.choice(_SECTORS)
    size = len(whole)
    chosen = [rng.choice(versions)[at : at + page] for at in range(0, size, page)]
    if rng.random() < 0.5:  # the size is that of what was written
        while chosen and not chosen[-1]:
            chosen.pop()
    return b"".join(part.ljust(page, b"\0") for part in chosen)[:size]


def _events(log: bytes) -> Iterator[tuple[str, int, int, int, str, str, bytes]]:
    place = 0
    while place < len(log):
        kind, time, inode, at, one, two, size = _HEAD.unpack_from(log, place)
        ends = [place + _HEAD.size]
        for length in (one, two, size):
            ends.append(ends[-1] + length)
        first, second, data = (log[a:b] for a, b in pairwise(ends))
        yield chr(kind), time, inode, at, os.fsdecode(first), os.fsdecode(second), data
        place = ends[-1]


def snapshot(root: Path) -> dict[str, tuple[int, bytes | None]]:
    """Inode and content, None of a folder, of all in a folder by relative path; ``.`` is itself."""
    return {
        path.relative_to(root).as_posix(): (
            path.lstat().st_ino,
            None if path.is_dir() else path.read_bytes(),
        )
        for path in (root, *root.rglob("*"))
    }
