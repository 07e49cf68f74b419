"""Tasks that the tests of the cluster give to its workers, which import them from here.

Each takes a folder and the name of its result. A result is there whole or not at all, as those of
a pack are.
"""

from __future__ import annotations

import gc
import hashlib
import os
import signal
import time
from pathlib import Path

from mp4ds.errors import SourceError

SECONDS = 0.3


def result(name: str) -> bytes:
    """What `write` leaves."""
    return hashlib.sha256(name.encode()).digest()


def write(folder: str, name: str) -> None:
    """Note the attempt with the process that makes it, take a while, leave the result."""
    place = Path(folder, name)
    if place.exists():
        return
    Path(folder, f"{name}.by-{os.getpid()}").touch()
    time.sleep(SECONDS)
    new = place.with_suffix(f".new-{os.getpid()}")
    new.write_bytes(result(name))
    new.rename(place)


def die(folder: str, name: str) -> None:
    """As `write`, but the worker does not survive the one that is deadly."""
    if name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    write(folder, name)


class Large:
    """Something in a cycle of references, which tells when its memory is given back."""

    def __init__(self, folder: str, name: str) -> None:
        self.mark = Path(folder, f"{name}.freed")
        self.cycle = self

    def __del__(self) -> None:
        self.mark.touch()


def leave_large(folder: str, name: str) -> None:
    """Leave something large to the collector, which does not run by itself."""
    gc.disable()
    Large(folder, name)


class OddError(Exception):
    """An error that does not survive pickling."""

    def __init__(self, first: str, second: object) -> None:
        super().__init__(first)
        self.second = second


def fail(folder: str, name: str) -> None:
    """Fail as the name says."""
    with Path(folder, name).open("a") as attempts:
        attempts.write("once\n")
    errors = {
        "source": SourceError("drive.bag", "is damaged", "Copy it again."),
        "disk": OSError(28, "No space left on device"),
        "odd": OddError("strange", lambda: None),
        "silent": RuntimeError(),
        "memory": MemoryError(),
    }
    if name in errors:
        raise errors[name]
