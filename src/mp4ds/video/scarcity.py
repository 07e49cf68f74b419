"""What the system refuses to ffmpeg, told from what is wrong with a file or picture."""

from __future__ import annotations

import errno
import os

_FILES = (errno.EMFILE, errno.ENFILE)
_ENOUGH_BYTES = 32 * 2**20


def raise_if_scarce(error: BaseException | None = None) -> None:
    """Raise for what the system lacks, where that may be why ffmpeg failed, or damaged a frame.

    Ffmpeg says that it has no memory of forged sizes, too, and of memory that is short it says all
    kinds of things. So it is tried.

    Raises:
        MemoryError: There is no memory left, or no thread may be started.
        OSError: Too many files are open.
    """
    number = getattr(error, "errno", None)
    if number in _FILES:
        raise OSError(number, os.strerror(number), getattr(error, "filename", None)) from None
    if number == errno.EAGAIN and "avcodec_open2" in str(error):  # of a thread
        raise MemoryError from None
    try:
        bytearray(_ENOUGH_BYTES)
    except MemoryError:
        raise MemoryError from None
