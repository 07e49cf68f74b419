"""Keyboard controls of a running command, which always restore the terminal."""

from __future__ import annotations

import os
import re
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any

try:
    import termios
    import tty
except ImportError:  # Windows
    termios = None  # type: ignore[assignment]

_POLL_S = 0.2
"""How often to check whether the command is in the foreground again."""

_KEY = re.compile(rb"\x1b[\[O][\x20-\x3f]*[^\x20-\x3f]?|.", re.DOTALL)
_CUT = re.compile(rb"\x1b(?:[\[O][\x20-\x3f]*)?\Z")  # the rest of which will come
_MOST_CUT = 32
_ARROWS = {
    b"\x1b" + kind + letter: name
    for kind in (b"[", b"O")
    for letter, name in ((b"A", "up"), (b"B", "down"), (b"C", "right"), (b"D", "left"))
}


class Keyboard:
    """A context manager that runs actions when keys are pressed.

    It does nothing if standard input is not a terminal.

    The terminal is set to deliver each key at once, without echo. Its settings are restored at the
    end, and while the program is stopped (Ctrl-Z) or in the background, where it reads nothing.

    Args:
        actions: The action of each key, named as by `keys_in`; other keys are ignored.
        fd: File descriptor of the terminal; None for standard input.
    """

    def __init__(
        self, actions: Mapping[str, Callable[[], object]], *, fd: int | None = None
    ) -> None:
        self._actions = actions
        self._fd = _terminal(fd)
        self._before: list[Any] | None = None
        self._is_left = False
        # reentrant, as a signal may arrive while the main thread holds it
        self._lock = threading.RLock()
        self._handles_stop = False

    def __enter__(self) -> Keyboard:
        if self._fd is not None:
            is_main = threading.current_thread() is threading.main_thread()  # who can handle one
            if is_main and signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:
                signal.signal(signal.SIGTSTP, self._on_stop)
                self._handles_stop = True
            self._take(self._fd)
            self._wake = os.pipe()
            arguments = (self._fd, self._wake[0])
            self._thread = threading.Thread(
                target=self._read, args=arguments, name="keys", daemon=True
            )
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the terminal, and end the thread."""
        if self._fd is None:
            return
        self._leave(self._fd)
        os.close(self._wake[1])
        self._thread.join(_POLL_S * 5)  # not for long: the action of a key may be stuck
        if not self._thread.is_alive():
            os.close(self._wake[0])
        if self._handles_stop:
            signal.signal(signal.SIGTSTP, signal.SIG_DFL)

    def _read(self, fd: int, wake: int) -> None:
        cut = b""
        while True:
            watched = [wake, fd] if self._take(fd) else [wake]
            ready, _, _ = select.select(watched, [], [], _POLL_S)
            if wake in ready:
                return
            if fd not in ready:
                continue
            try:
                data = os.read(fd, 256)
            except OSError:  # it was closed
                return
            if not data:
                return
            data = cut + data
            match = _CUT.search(data)
            cut = match[0][-_MOST_CUT:] if match else b""
            for key in keys_in(data[: len(data) - len(cut)]):
                if action := self._actions.get(key):
                    action()

    def _on_stop(self, number: int, _: FrameType | None) -> None:
        """Stop as usual; after the program has continued, the thread sets the terminal again."""
        if self._fd is not None:
            self._leave(self._fd)
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)
        signal.signal(number, self._on_stop)
        with self._lock:
            self._is_left = False

    # ------------------------------------------------------------ terminal

    def _take(self, fd: int) -> bool:
        """Switch to single keys if the program is in the foreground; returns whether it is."""
        with self._lock:
            if self._is_left or not _is_in_foreground(fd):
                return False
            if self._before is None:
                try:
                    before = termios.tcgetattr(fd)
                    tty.setcbreak(fd, termios.TCSANOW)
                except termios.error:  # it was closed
                    return False
                self._before = before
            return True

    def _leave(self, fd: int) -> None:
        """Restore the settings, and leave them alone."""
        with self._lock:
            self._is_left = True
            before, self._before = self._before, None
            if before is not None and _is_in_foreground(fd):
                try:
                    termios.tcsetattr(fd, termios.TCSANOW, before)
                except termios.error:  # it was closed
                    return


def keys_in(data: bytes) -> Iterator[str]:
    """The keys in what a terminal sends: a character, ``up``, ``down``, ``left`` or ``right``.

    Other sequences, such as those of function keys, and a lone escape are ignored.
    """
    for key in _KEY.findall(data):
        if key in _ARROWS:
            yield _ARROWS[key]
        elif len(key) == 1 and key.isascii() and key != b"\x1b":
            yield key.decode()


def _is_in_foreground(fd: int) -> bool:
    """Whether the terminal may be read and set: a background program would be stopped."""
    try:
        return os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:  # not the controlling terminal: nothing would stop the program
        return True


def _terminal(fd: int | None) -> int | None:
    """The terminal, if there is one."""
    try:
        number = sys.stdin.fileno() if fd is None else fd
        return number if termios is not None and os.isatty(number) else None
    except (AttributeError, OSError, ValueError):  # standard input is None, closed, or no file
        return None
