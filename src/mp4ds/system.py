"""What systems do each in their own way: locks between processes, and exchanging two names."""

from __future__ import annotations

import ctypes
import errno
import os
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_AT_FDCWD = -100
_UNABLE = (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EXDEV)


def lock(file: IO[Any], *, shared: bool = False) -> bool:
    """Lock a file for as long as it is open, or its process lives.

    Args:
        file: Open for writing, as NFS wants it.
        shared: Others may hold it, too, if they share it.

    Returns:
        Whether it is locked; False where the system or the file system has no locks.

    Raises:
        BlockingIOError: Another holds it.
    """
    if fcntl is None:
        return False
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return False
    return True


def is_mine(stat: os.stat_result, folder: Path) -> bool:
    """Whether something belongs to the user whom this process works for.

    Args:
        stat: What is told of it.
        folder: One beside it: a server may have another name for the user.
    """
    if not hasattr(os, "geteuid") or stat.st_uid == os.geteuid():
        return True
    with suppress(OSError), tempfile.TemporaryFile(dir=folder) as file:
        return os.fstat(file.fileno()).st_uid == stat.st_uid
    return False


def exchange(one: Path, other: Path) -> bool:
    """Exchange what stands under two names, in one step.

    Returns:
        Whether that was done; False where the system or the file system cannot.

    Raises:
        OSError: It can, and failed.
    """
    return _renamed(one, other, linux=2, macos=2)  # RENAME_EXCHANGE, RENAME_SWAP


def rename_to_new(old: Path, new: Path) -> bool:
    """Rename, unless there is something under the new name.

    Returns:
        Whether that was done; False where the system or the file system cannot.

    Raises:
        FileExistsError: There is something.
        OSError: It failed.
    """
    return _renamed(old, new, linux=1, macos=4)  # RENAME_NOREPLACE, RENAME_EXCL


def _renamed(old: Path, new: Path, *, linux: int, macos: int) -> bool:
    names = os.fsencode(old), os.fsencode(new)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if sys.platform == "darwin":
            failed = libc.renamex_np(*names, macos)
        else:
            failed = libc.renameat2(_AT_FDCWD, names[0], _AT_FDCWD, names[1], linux)
    except (AttributeError, OSError, TypeError):  # it has no such function, or no such library
        return False
    if not failed:
        return True
    code = ctypes.get_errno()
    if code in _UNABLE:
        return False
    raise OSError(code, os.strerror(code), str(old), None, str(new))
