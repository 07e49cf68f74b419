"""The table of recording formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from mp4ds.bags.combined import MultiReader
from mp4ds.bags.protocols import BagReader, BagWriter
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, read_bag_info
from mp4ds.errors import OptionError, SourceError, SourceNotFoundError
from mp4ds.files.outputs import begins_with
from mp4ds.files.sources import (
    HOW_TO_OPEN,
    refuse_unfinished,
    video_at,
)
from mp4ds.files.urls import remote
from mp4ds.records import Channel, Message

# by name: each imports its library, and a recording has one format
_READERS = {
    "bag": "ros1:Ros1Reader",
    "mcap": "mcap:McapReader",
    "rosbag2": "rosbag2:Rosbag2Reader",
}
_SALVAGERS = {
    "bag": "salvage.ros1:Ros1Salvage",
    "mcap": "salvage.mcap:McapSalvage",
    "rosbag2": "salvage.rosbag2:Rosbag2Salvage",
}


_WRITERS = {
    "bag": "ros1_writer:Ros1Writer",
    "mcap": "mcap:McapWriter",
    "rosbag2": "rosbag2:Rosbag2Writer",
}


def _class(name: str) -> Any:
    module, _, found = name.partition(":")
    return getattr(import_module(f"mp4ds.bags.{module}"), found)


_MAGIC = {b"#ROSBAG V": "bag", b"\x89MCAP0\r\n": "mcap", b"SQLite format 3\0": "rosbag2"}
_FILE_MAGIC = [magic for magic, name in _MAGIC.items() if name != "rosbag2"]
RECORDING_SUFFIXES = {".bag": "bag", ".mcap": "mcap", ".db3": "rosbag2"}
"""File suffix -> format."""


def format_of(path: Path) -> str:
    """The format of a recording, by its first bytes, or by its name if these are damaged.

    Raises:
        SourceNotFoundError: It does not exist.
        SourceError: It is not a recording, or cannot be read.
    """
    try:
        if not path.exists():
            raise SourceNotFoundError(path)
        if path.is_dir():
            refuse_unfinished(path)
            return "rosbag2"
        if not path.is_file():
            raise SourceError(path, "is neither a file nor a folder")
        with path.open("rb") as stream:
            start = stream.read(16)
    except SourceError:
        raise
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
    for magic, name in _MAGIC.items():
        if start.startswith(magic):
            return name
    if path.suffix in RECORDING_SUFFIXES:
        return RECORDING_SUFFIXES[path.suffix]
    remedy = "Give a ROS 1 .bag, a rosbag2 folder or an .mcap file."
    if video := video_at(path):
        raise SourceError(path, f"is {video}, not a recording", f"{remedy} {HOW_TO_OPEN}")
    raise SourceError(path, "is not in a recording format that mp4ds supports", remedy)


def recording_names(path: Path) -> set[str] | None:
    """Names of a recording's files; see `mp4ds.files.outputs.Owned`."""
    if path.is_file():
        return {""} if begins_with(path, *_FILE_MAGIC) else None
    try:
        info = read_bag_info(path / METADATA_FILE)
    except SourceError:
        return None
    return {METADATA_FILE, *info.file_names} if info.file_names else None


Opener = Callable[[Path], BagReader]
"""Opens one recording."""


def open_reader(path: Path) -> BagReader:
    """Open one recording of any format.

    Raises:
        SourceError: It cannot be read; says why, and what to do.
    """
    reader: BagReader = _class(_READERS[format_of(path)])(path)
    return reader


def open_sources(
    paths: Sequence[Path], *, salvage: bool = False, opener: Opener = open_reader
) -> BagReader:
    """Open recordings that belong together, such as a split bag, as one recording.

    Args:
        paths: The recordings.
        salvage: Read what is readable of damaged ones, instead of failing: the reader's `losses`
            then say what is not.
        opener: Opens one of them, unless they are salvaged.

    Raises:
        SourceError: One of them cannot be read, or is given twice.
    """
    if not paths:
        raise OptionError("No recording was given.")
    seen: set[Path] = set()
    for path in paths:
        resolved = path.resolve()
        if resolved in seen:
            raise SourceError(path, "is given twice")
        seen.add(resolved)
    is_alone = len(paths) == 1
    if salvage:
        for path in filter(remote, paths):
            problem = "cannot be salvaged from a remote location"
            raise SourceError(path, problem, "Download it first.")
        formats = {path: format_of(path) for path in paths}

        def opener(path: Path) -> BagReader:
            reader: BagReader = _class(_SALVAGERS[formats[path]])(path, is_alone=is_alone)
            return reader

    return opener(paths[0]) if is_alone else MultiReader([partial(opener, path) for path in paths])


def limits_of(
    target: str, storage: str
) -> tuple[Callable[[Channel], None], Callable[[Message], None]]:
    """The writer's checks that a format can hold a channel, and a message.

    Args:
        target: ``bag``, ``rosbag2`` or ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.
    """
    is_sqlite = target == "rosbag2" and storage == "sqlite3"
    name = (
        "rosbag2_sqlite:SqliteWriter"
        if is_sqlite
        else _WRITERS["bag" if target == "bag" else "mcap"]
    )
    writer: type[BagWriter] = _class(name)
    return writer.check_channel, writer.check_message


def open_writer(
    path: Path, target: str, *, name: str, profile: str, library: str, storage: str
) -> BagWriter:
    """Open a recording for writing.

    Args:
        path: Where to write; does not exist yet.
        target: ``bag``, ``rosbag2`` or ``mcap``.
        name: Final name, used for the files in a rosbag2 folder.
        profile: MCAP profile, for ``mcap``.
        library: MCAP library string, for ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.

    Raises:
        OptionError: The target is unknown.
        OSError: It cannot be written.
    """
    options: Mapping[str, Mapping[str, str]] = {
        "bag": {},
        "rosbag2": {"storage": storage, "name": name},
        "mcap": {"profile": profile, "library": library},
    }
    if target not in options:
        raise OptionError(f"`to` {target!r} is not known. Use bag, rosbag2, mcap or images.")
    writer: BagWriter = _class(_WRITERS[target])(path, **options[target])
    return writer
