"""Which files a damaged rosbag2 recording consists of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mp4ds.bags.mcap_records import SALVAGE_REMEDY
from mp4ds.bags.rosbag2_metadata import METADATA_FILE, BagInfo, read_bag_info
from mp4ds.bags.rosbag2_parts import STORAGE_NAME, unlisted_storage
from mp4ds.bags.zstd_files import is_zstd
from mp4ds.errors import SourceError, SourceNotFoundError
from mp4ds.records import Loss


@dataclass(frozen=True, slots=True)
class StorageFile:
    """A storage file.

    Attributes:
        path: The file.
        is_compressed: Whether it is compressed as a whole.
        messages: How many messages it has by metadata.yaml, None where that does not tell.
    """

    path: Path
    is_compressed: bool
    messages: int | None


def find_storage(path: Path) -> tuple[BagInfo | None, list[StorageFile], list[Loss]]:
    """What belongs to a recording.

    Args:
        path: A folder, or a storage file.

    Returns:
        The metadata.yaml where it can be read, the storage files in reading order, and what
        of the folder is missing or could not be read.

    Raises:
        SourceError: There is no storage file, or the disk does not give it.
    """
    if not path.exists():
        raise SourceNotFoundError(path)
    losses: list[Loss] = []
    folder = path if path.is_dir() else path.parent
    info = _info(folder, losses)
    if not path.is_dir():
        if info and path.name not in info.file_names:
            info = None
        return info, [_storage_file(path, _counts(info))], []
    names = _names(folder, info, losses)
    if not names and not info:
        raise SourceError(
            path,
            f"has no {METADATA_FILE} and no storage file",
            "Give a rosbag2 folder, a ROS 1 .bag or an .mcap file.",
        )
    counts = _counts(info)
    files = []
    for name in names:
        try:
            files.append(_storage_file(folder / name, counts))
        except SourceError as error:
            losses.append(unreadable(name, error, counts.get(name)))
    return info, files, losses


def _info(folder: Path, losses: list[Loss]) -> BagInfo | None:
    path = folder / METADATA_FILE
    if not path.exists():
        losses.append(Loss(METADATA_FILE, None, None, "is missing", 0))
        return None
    try:
        return read_bag_info(path)
    except SourceError as error:
        losses.append(unreadable(METADATA_FILE, error, 0))
        return None


def unreadable(name: str, error: SourceError, messages: int | None) -> Loss:
    """A file of which nothing can be read."""
    problem = str(error).removeprefix(f"{error.path}: ").removesuffix(SALVAGE_REMEDY)
    return Loss(name, None, None, problem.rstrip(" .;"), messages)


def _names(folder: Path, info: BagInfo | None, losses: list[Loss]) -> Sequence[str]:
    """Storage files in reading order: those that are listed, and those that should be."""
    listed = list(info.file_names) if info else []
    counts = _counts(info)
    for name in listed:
        if not (folder / name).is_file():
            losses.append(Loss(name, None, None, "is missing", counts.get(name)))
    others = unlisted_storage(folder, listed)
    if info:
        for name in sorted(others, key=_number):
            losses.append(Loss(name, None, None, f"is not listed in {METADATA_FILE}; was read", 0))
    found = [name for name in listed if (folder / name).is_file()]
    return sorted([*found, *others], key=_number) if others else found


def _number(name: str) -> tuple[str, int, str]:
    match = STORAGE_NAME.fullmatch(name)
    return (match["stem"], int(match["number"] or 0), name) if match else (name, 0, name)


def _storage_file(path: Path, counts: Mapping[str, int]) -> StorageFile:
    return StorageFile(path, is_zstd(path), counts.get(path.name))


def _counts(info: BagInfo | None) -> Mapping[str, int]:
    """Messages of each storage file by metadata.yaml, as far as it tells."""
    return info.counts if info else {}
