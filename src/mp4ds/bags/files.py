"""Files of recordings: opening them, saying what is wrong with them, and decompressing them."""

from __future__ import annotations

import io
import os
import shutil
from bz2 import BZ2Decompressor
from contextlib import closing, suppress
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard

from mp4ds.errors import OptionError, SourceError, SourceNotFoundError
from mp4ds.options import parse_size

SALVAGE = "use `mp4ds pack --salvage` to pack what is still readable."
SALVAGE_REMEDY = "U" + SALVAGE[1:]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

_LFS_POINTER = b"version https://git-lfs.github.com/spec/"
_PIECE_BYTES = 16 * 2**20
_PACKED_PIECE = 2**16
_COPY_BYTES = 2**22


class DamageError(ValueError):
    """Damage inside a record; the reader adds where it is."""


class OversizeError(DamageError):
    """A chunk or message that would take too much memory, or says so because it is damaged.

    Args:
        what: What it is, a phrase.
        most: Bytes that it may have.
    """

    def __init__(self, what: str, most: int) -> None:
        super().__init__(f"{what}, over the limit of {most}")


def unreadable(path: Path, place: str, error: Exception, remedy: str) -> SourceError:
    """The error for a recording with damage, or with something too large.

    Args:
        path: The recording.
        place: Where in it; comes after "is damaged".
        error: What is wrong there.
        remedy: What to do about damage.
    """
    if isinstance(error, OversizeError):
        remedy = (
            f"If it is sound, and fits in memory, set the environment variable {DECOMPRESSED} to a "
            f"larger size, such as 4G, or {SALVAGE}"
        )
        return SourceError(path, f"cannot be read{place}: {error}", remedy)
    return SourceError(path, f"is damaged{place}: {error}", remedy)


def open_source(path: Path) -> BinaryIO:
    """Open a file of a recording, refusing anything else.

    Raises:
        SourceError: It is missing, unreadable, not a regular file, empty, or a git-lfs pointer.
    """
    try:
        if not path.is_file() and not path.is_dir() and path.exists():
            raise SourceError(path, "is not a regular file")  # opening a pipe could block forever
        stream = path.open("rb")
    except FileNotFoundError:
        raise SourceNotFoundError(path) from None
    except OSError as error:
        raise SourceError(path, f"cannot be read: {error.strerror}") from None
    head = stream.read(len(_LFS_POINTER))
    stream.seek(0)
    if head and head != _LFS_POINTER:
        return stream
    stream.close()
    if not head:
        raise SourceError(path, "is empty")
    raise SourceError(path, "is a git-lfs pointer, not the recording", "Run `git lfs pull`.")


def other_begin(path: Path, kind: str, magic: bytes, start: bytes) -> SourceError:
    """The error for a file that does not begin with the magic bytes of its kind."""
    if start.startswith(magic.rstrip()):
        problem = f"is {kind} with converted line endings, as if copied in text mode"
        return SourceError(path, problem, f"Copy it again in binary mode, or {SALVAGE}")
    remedy = f"If it is damaged, {SALVAGE}"
    return SourceError(path, f"is not {kind}: it does not start like one", remedy)


# ---------------------------------------------------------------- bounds

DECOMPRESSED = "MP4DS_MAX_DECOMPRESSED"
"""Environment variable with the bytes that one chunk or message may decompress to."""

ZSTD_PIECE = 2**11
"""Bytes of zstd decompressed at a time, which give 64 MiB at most."""

ALWAYS_ALLOWED = 128 * 2**20
_CHUNK_RATIO = 256  # of lz4 it is 255
_FILE_RATIO = 1024
_MOST = 512 * 2**20  # recorders make chunks of 1 to 4 MiB unless told otherwise


def most_unpacked(packed: int) -> int:
    """Maximum decompressed size of a chunk or message of so many bytes, unless told otherwise.

    Small ones are not limited by their ratio: they may hold a black picture.
    """
    return min(max(ALWAYS_ALLOWED, _CHUNK_RATIO * packed), _MOST)


def most_held(packed: int | None = None) -> int:
    """Maximum decompressed size of a chunk or message, as `DECOMPRESSED` says if it is set.

    Args:
        packed: Its compressed size; None where that of the whole file is known only.

    Raises:
        OptionError: The variable does not hold a size.
    """
    told = os.environ.get(DECOMPRESSED)
    if not told:
        return _MOST if packed is None else most_unpacked(packed)
    try:
        return parse_size(told)
    except OptionError as error:
        raise OptionError(f"{DECOMPRESSED}: {error}") from None


# ---------------------------------------------------------------- decompressing

_MACHINES: dict[str, Any] = {
    "bz2": BZ2Decompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
}
_DAMAGE = (OSError, RuntimeError, EOFError, ValueError, zstandard.ZstdError)


def unpack(compression: str, data: bytes | memoryview, size: int) -> tuple[bytes, int]:
    """The content of a compressed chunk, and how many bytes of the data it took.

    Args:
        compression: ``bz2``, ``lz4`` or ``zstd``.
        data: As stored; what follows bz2 or lz4 data is ignored.
        size: Of the content; decompression never goes beyond it.

    Raises:
        DamageError: The data is damaged or of another size, or the compression is not known.
    """
    if compression not in _MACHINES:
        raise DamageError(f"it is compressed with {compression!r}, which is not supported")
    if size > (most := most_held(len(data))):
        raise OversizeError(f"it declares {size} bytes but has {len(data)}", most)
    if compression == "zstd":
        return unzstd(data, size), len(data)
    machine = _MACHINES[compression]()
    try:
        content = _expand(machine, data, size)
    except (OSError, RuntimeError):
        raise DamageError(f"its {compression} data is damaged") from None
    if not machine.eof:
        raise DamageError(f"its {compression} data does not unpack to {size} bytes")
    if len(content) != size:
        raise DamageError(f"it unpacks to {len(content)} bytes instead of {size}")
    return content, len(data) - len(machine.unused_data or b"")


def _expand(machine: Any, data: bytes | memoryview, size: int) -> bytes:
    """Decompress data to a size, or to a byte more if there is more.

    A large result is made in pieces: both libraries need twice its memory to make it at once.
    """
    if size <= _PIECE_BYTES:
        content: bytes = machine.decompress(data, max_length=size + 1)
        return content
    gathered = io.BytesIO()
    for at in range(0, len(data), _PACKED_PIECE):
        piece = data[at : at + _PACKED_PIECE]
        while not machine.eof and (left := size + 1 - gathered.tell()) > 0:
            gathered.write(machine.decompress(piece, max_length=min(left, _PIECE_BYTES)))
            piece = b""
            if machine.needs_input:
                break
    return gathered.getvalue()


def unzstd(data: bytes | memoryview, size: int | None = None) -> bytes:
    """Decompress one zstd frame.

    Args:
        data: The frame.
        size: Size of the content if known; otherwise the frame must state it.

    Raises:
        DamageError: It is not a zstd frame, damaged, or of another size.
    """
    try:
        stated = zstandard.frame_content_size(data)
        if stated < 0 and size is None:
            return _unzstd_unsized(data)
        if size is not None and stated not in (-1, size):
            raise DamageError(f"zstd data holds {stated} bytes instead of {size}")
        if stated > (most := most_held(len(data))):
            raise OversizeError(f"zstd data declares {stated} bytes but has {len(data)}", most)
        return zstandard.ZstdDecompressor().decompress(
            data, max_output_size=size or 0, allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise DamageError(f"zstd data is damaged: {error}") from None


def _unzstd_unsized(data: bytes | memoryview) -> bytes:
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    content = io.BytesIO()
    most = most_held(len(data))
    used = 0
    while used < len(data) and not decompressor.eof:
        content.write(decompressor.decompress(data[used : used + ZSTD_PIECE]))
        used += ZSTD_PIECE
        if content.tell() > most:
            raise OversizeError(f"zstd data of {len(data)} bytes unpacks to {content.tell()}", most)
    if not decompressor.eof or decompressor.unused_data or used < len(data):
        raise DamageError("zstd data is cut short, or holds more than one frame")
    return content.getvalue()


# ---------------------------------------------------------------- damaged chunks

_SMALL_PIECE = 64
"""Bytes decompressed at a time from damaged data: the piece with the damage yields nothing."""

_CLOSE = 16
"""Bytes at the end, of a marker and a checksum, that are decompressed one by one."""

_MAGIC = {b"BZh": "bz2", b"\x04\x22\x4d\x18": "lz4", ZSTD_MAGIC: "zstd"}


def recover(compression: str, data: memoryview, size: int) -> tuple[bytes, int, str, bool]:
    """Decompress as much as possible of a chunk.

    Args:
        compression: Its name: ``none`` or empty, ``bz2``, ``lz4`` or ``zstd``; if damaged, it is
            inferred from the data.
        data: As stored; may be cut short.
        size: Expected size; no more is decompressed, and no more than data of this length can hold.

    Returns:
        What could be decompressed, from the beginning; bytes of the data that belong to it, 0 if
        unknown; what is wrong, a phrase, empty if nothing is; and whether the content is correct,
        though some of it may be missing.
    """
    if compression in ("", "none"):
        content = bytes(data[:size])
        problem = "" if len(content) == size else "a chunk is cut short"
        return content, len(content), problem, True
    most = most_held(len(data))
    limit = f", the limit ({DECOMPRESSED} sets another)" if size > most else ""
    size = min(size, most)
    start = bytes(data[:4])
    found = next((name for magic, name in _MAGIC.items() if start.startswith(magic)), compression)
    if found not in _MACHINES:
        problem = f"a chunk is compressed with {compression!r}, which is not supported"
        return b"", 0, problem, True
    with suppress(DamageError):
        return (*unpack(found, data, size), "", True)
    machine = _MACHINES[found]()
    gathered = io.BytesIO()  # pieces in a list would need the memory twice
    is_verified = found == "bz2"  # it has a checksum for each block
    used, problem, is_sound = 0, f"the {found} data of a chunk is cut short", True
    try:
        body = max(0, len(data) - _CLOSE)
        places = chain(range(0, body, _SMALL_PIECE), range(body, len(data) + 1))
        for begin, end in pairwise(places):
            made = [machine.decompress(data[begin:end])]
            while made[-1] and not machine.eof:  # bz2 compares a checksum with the last of a block
                made.append(machine.decompress(b""))
            gathered.writelines(made)
            if gathered.tell() > size:
                problem = f"the {found} data of a chunk unpacks to more than {size} bytes{limit}"
                is_sound = is_verified
                gathered.truncate(size)
                break
            if machine.eof:
                used, problem = end - len(machine.unused_data or b""), ""
                if gathered.tell() != size:
                    problem = f"a chunk holds {gathered.tell()} bytes instead of {size}"
                    is_sound = is_verified
                break
    except _DAMAGE:
        problem, is_sound = f"the {found} data of a chunk is damaged", is_verified
    return gathered.getvalue(), used, problem, is_sound


# ---------------------------------------------------------------- files compressed as a whole


def copy_file(path: Path, target: Path) -> None:
    """Download a remote file, with the -wal or -journal beside a database that was not closed.

    Raises:
        SourceError: There is not enough space for it.
        RemoteError: It cannot be read.
        OSError: The target cannot be written.
    """
    sides = (path.with_name(path.name + ending) for ending in ("-wal", "-journal"))
    found = [path, *(side for side in sides if side.exists())]
    size = sum(side.stat().st_size for side in found)
    if size > shutil.disk_usage(target.parent).free:
        problem = (
            f"is an sqlite3 database of {size} bytes, which must be copied to {target.parent} to "
            "be read, and there is not enough space"
        )
        raise SourceError(path, problem, "Set TMPDIR to another folder.")
    for side in found:
        ending = side.name.removeprefix(path.name)
        with closing(side.open("rb")) as stream, Path(f"{target}{ending}").open("wb") as output:
            shutil.copyfileobj(stream, output, _COPY_BYTES)


def decompress_file(path: Path, target: Path, *, to_damage: bool = False) -> str:
    """Decompress a file into another one.

    Args:
        path: The compressed file.
        target: The file to write.
        to_damage: Whether to decompress a damaged one as far as possible.

    Returns:
        Why it ended before the file did, a phrase; empty if it did not.

    Raises:
        SourceError: The file is damaged, cut short, or decompresses to too much; or to nothing.
        OSError: The target cannot be written.
    """
    # not held in memory, so that its ratio alone is limited
    most = max(ALWAYS_ALLOWED, _FILE_RATIO * path.stat().st_size)
    problem, is_within = "", False
    frame = zstandard.ZstdDecompressor().decompressobj()
    with closing(open_source(path)) as stream, target.open("wb") as output:
        while not problem and (piece := stream.read(ZSTD_PIECE)):
            while piece:
                try:
                    output.write(frame.decompress(piece))
                except zstandard.ZstdError as error:
                    problem = f"its zstd data is damaged near byte {stream.tell()}: {error}"
                    break
                if output.tell() > most:
                    problem = f"it unpacks to more than {most} bytes, too many for its size"
                    break
                is_within = not frame.eof
                piece = b"" if is_within else frame.unused_data
                if not is_within:
                    frame = zstandard.ZstdDecompressor().decompressobj()
        if is_within and not problem:
            problem = "its zstd data is cut short"
        if problem and not to_damage:
            raise SourceError(path, problem, f"Copy it again, or {SALVAGE}")
        if not output.tell():
            raise SourceError(path, problem or "holds nothing")
    return problem
