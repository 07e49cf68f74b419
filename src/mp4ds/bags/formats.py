"""The table of recording formats, and how a path tells which one it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

from mp4ds.bags.protocols import BagReader, BagWriter
from mp4ds.errors import OptionError, SourceError, SourceNotFoundError
from mp4ds.owned import begins_with
from mp4ds.records import Channel, Message
from mp4ds.remote import remote
from mp4ds.source_files import HOW_TO_OPEN, video_at

if TYPE_CHECKING:
    from mp4ds.bags.salvage.reader import Salvage, SalvageReader

# each imports its library when it is needed: a recording is of one format


def _read_bag(path: Path) -> BagReader:
    from mp4ds.bags.ros1 import Ros1Reader

    return Ros1Reader(path)


def _read_mcap(path: Path) -> BagReader:
    from mp4ds.bags.mcap import McapReader

    return McapReader(path)


def _read_rosbag2(path: Path) -> BagReader:
    from mp4ds.bags.rosbag2 import Rosbag2Reader

    return Rosbag2Reader(path)


_READERS: dict[str, Callable[[Path], BagReader]] = {
    "bag": _read_bag,
    "mcap": _read_mcap,
    "rosbag2": _read_rosbag2,
}


def _salvage_bag(path: Path) -> Salvage:
    from mp4ds.bags.salvage.ros1 import Ros1Salvage

    return Ros1Salvage(path)


def _salvage_mcap(path: Path) -> Salvage:
    from mp4ds.bags.salvage.mcap import McapSalvage

    return McapSalvage(path)


def _salvage_rosbag2(path: Path) -> Salvage:
    from mp4ds.bags.salvage.rosbag2 import Rosbag2Salvage

    return Rosbag2Salvage(path)


_SALVAGERS: dict[str, Callable[[Path], Salvage]] = {
    "bag": _salvage_bag,
    "mcap": _salvage_mcap,
    "rosbag2": _salvage_rosbag2,
}

_MAGIC = {b"#ROSBAG V": "bag", b"\x89MCAP0\r\n": "mcap", b"SQLite format 3\0": "rosbag2"}
_FILE_MAGIC = [magic for magic, name in _MAGIC.items() if name != "rosbag2"]
_SUFFIXES = {".bag": "bag", ".mcap": "mcap", ".db3": "rosbag2"}


def format_of(path: Path) -> str:
    """The format of a recording, by its first bytes; by its name where these are damaged.

    Raises:
        SourceNotFoundError: There is nothing.
        SourceError: It is no recording, or cannot be read.
    """
    try:
        if not path.exists():
            raise SourceNotFoundError(path)
        if path.is_dir():
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
    if path.suffix in _SUFFIXES:
        return _SUFFIXES[path.suffix]
    remedy = "Give a ROS 1 .bag, a rosbag2 folder or an .mcap file."
    if video := video_at(path):
        raise SourceError(path, f"is {video}, and no recording", f"{remedy} {HOW_TO_OPEN}")
    raise SourceError(path, "is not a recording that mp4ds knows", remedy)


def recording_names(path: Path) -> set[str] | None:
    """Names of a recording's files; see `mp4ds.owned.Owned`."""
    from mp4ds.bags.rosbag2_metadata import METADATA_FILE, read_bag_info

    if path.is_file():
        return {""} if begins_with(path, *_FILE_MAGIC) else None
    try:
        info = read_bag_info(path / METADATA_FILE)
    except SourceError:
        return None
    return {METADATA_FILE, *info.file_names} if info.file_names else None


def open_reader(path: Path) -> BagReader:
    """Open one recording of any format.

    Raises:
        SourceError: It cannot be read; says why and what to do.
    """
    return _READERS[format_of(path)](path)


@overload
def open_sources(paths: Sequence[Path], *, salvage: Literal[True]) -> SalvageReader: ...


@overload
def open_sources(paths: Sequence[Path], *, salvage: bool = False) -> BagReader: ...


def open_sources(paths: Sequence[Path], *, salvage: bool = False) -> BagReader:
    """Open recordings that belong together, such as a split bag, as one.

    Args:
        paths: The recordings.
        salvage: Read what can be read of damaged ones, with a `SalvageReader`.

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
    if salvage:
        return _open_salvaged(paths)
    if len(paths) == 1:
        return open_reader(paths[0])
    from mp4ds.bags.multi import MultiReader

    return MultiReader([partial(open_reader, path) for path in paths])


def _open_salvaged(paths: Sequence[Path]) -> SalvageReader:
    for path in filter(remote, paths):
        raise SourceError(path, "is not salvaged where it is", "Download it first.")
    openers = [partial(_SALVAGERS[format_of(path)], path) for path in paths]
    if len(paths) == 1:
        return openers[0]()
    from mp4ds.bags.salvage.multi import MultiSalvage

    return MultiSalvage(openers)


def limits_of(
    target: str, storage: str
) -> tuple[Callable[[Channel], None], Callable[[Message], None]]:
    """What refuses channels, and what messages, that a format cannot hold, as its writer does.

    Args:
        target: ``bag``, ``rosbag2`` or ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.
    """
    if target == "bag":
        from mp4ds.bags import ros1_write

        return ros1_write.check_channel, ros1_write.check_message
    if target == "rosbag2" and storage == "sqlite3":
        from mp4ds.bags import rosbag2_sqlite_write

        return rosbag2_sqlite_write.check_channel, rosbag2_sqlite_write.check_message
    from mp4ds.bags.mcap_write import check_message

    return lambda _: None, check_message


def open_writer(
    path: Path, target: str, *, name: str, profile: str, library: str, storage: str
) -> BagWriter:
    """Open a recording for writing.

    Args:
        path: Where to write; does not exist yet.
        target: ``bag``, ``rosbag2`` or ``mcap``.
        name: Final name, which a rosbag2 folder gives to its files.
        profile: MCAP profile, for ``mcap``.
        library: MCAP library string, for ``mcap``.
        storage: ``sqlite3`` or ``mcap``, for ``rosbag2``.

    Raises:
        OptionError: The target is unknown.
        OSError: The disk refused.
    """
    if target == "bag":
        from mp4ds.bags.ros1_write import Ros1Writer

        return Ros1Writer(path)
    if target == "rosbag2":
        from mp4ds.bags.rosbag2_write import Rosbag2Writer

        return Rosbag2Writer(path, storage=storage, name=name)
    if target == "mcap":
        from mp4ds.bags.mcap_write import McapWriter

        return McapWriter(path, profile=profile, library=library)
    raise OptionError(f"--to {target!r} is not known. Use bag, rosbag2, mcap or images.")
