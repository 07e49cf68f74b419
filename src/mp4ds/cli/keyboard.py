"""Keyboard controls of a running command, which always restore the terminal."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any

_POLL_S = 0.2
"""How often to check whether the command is in the foreground again."""

_ENDING = ("SIGTERM", "SIGHUP", "SIGQUIT")
"""Signals whose default action ends the program at once."""

_ESCAPE = 0x1B
_ARROWS = {ord("A"): "up", ord("B"): "down", ord("C"): "right", ord("D"): "left"}
_MAX_SEQUENCE = 32


class Keyboard:
    """A context manager that runs actions when keys are pressed.

    It does nothing if standard input is not a terminal.

    The terminal is set to deliver each key at once, without echo. Its settings are restored at the
    end, even if an exception or a signal ends the program, and while the program is stopped
    (Ctrl-Z) or in the background, where it reads nothing.

    Args:
        actions: The action of each key, named as by `Keys`; other keys are ignored.
        fd: File descriptor of the terminal; None for standard input.
    """

    def __init__(
        self, actions: Mapping[str, Callable[[], object]], *, fd: int | None = None
    ) -> None:
        self._actions = actions
        self._terminal = _terminal(fd)
        self._handlers: dict[int, Any] = {}
        self._wake: tuple[int, int] | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Keyboard:
        if self._terminal is not None:
            self._handle_signals()
            try:
                self._wake = os.pipe()
                self._thread = threading.Thread(
                    target=self._read,
                    args=(self._terminal, self._wake[0]),
                    name="keys",
                    daemon=True,
                )
                self._terminal.take()
                self._thread.start()
            except BaseException:
                self._leave()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._leave()

    def _leave(self) -> None:
        """Restore the terminal, and end the thread."""
        if self._terminal is not None:
            self._terminal.leave()
        if self._wake is not None:
            os.close(self._wake[1])
            # do not wait for long: the action of a key may be stuck
            if self._thread is not None and self._thread.ident is not None:
                self._thread.join(_POLL_S * 5)
            if self._thread is None or not self._thread.is_alive():
                os.close(self._wake[0])
            self._wake = None
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    # ------------------------------------------------------------ keys

    def _read(self, terminal: _Terminal, wake: int) -> None:
        keys = Keys()
        while True:
            is_ours = terminal.take()
            watched = [wake, terminal.fd] if is_ours else [wake]
            ready, _, _ = select.select(watched, [], [], _POLL_S)
            if wake in ready:
                return
            if terminal.fd not in ready:
                continue
            try:
                data = os.read(terminal.fd, 256)
            except OSError:  # it was closed
                return
            if not data:
                return
            for key in keys.feed(data):
                if action := self._actions.get(key):
                    action()

    # ------------------------------------------------------------ signals

    def _handle_signals(self) -> None:
        """Only the main thread can; in others, the terminal is restored at the end only."""
        if threading.current_thread() is not threading.main_thread():
            return
        for name in _ENDING:
            number = getattr(signal, name)
            if signal.getsignal(number) is signal.SIG_DFL:
                self._handlers[number] = signal.signal(number, self._on_end)
        if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL:
            self._handlers[signal.SIGTSTP] = signal.signal(signal.SIGTSTP, self._on_stop)

    def _on_end(self, number: int, frame: FrameType | None) -> None:
        if self._terminal is not None:
            self._terminal.leave()
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)

    def _on_stop(self, number: int, frame: FrameType | None) -> None:
        """Stop as usual; after the program has continued, the thread sets the terminal again."""
        if self._terminal is None:
            return
        self._terminal.leave()
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)
        signal.signal(number, self._on_stop)
        self._terminal.come_back()


class Keys:
    """Decodes keys from what a terminal sends, in pieces of any size."""

    def __init__(self) -> None:
        self._sequence = b""

    def feed(self, data: bytes) -> Iterator[str]:
        """The keys that are complete: a character, ``up``, ``down``, ``left`` or ``right``.

        Other sequences, such as those of function keys, and a lone escape are ignored.
        """
        for byte in data:
            if byte == _ESCAPE:
                self._sequence = b"\x1b"
            elif not self._sequence or (self._sequence == b"\x1b" and byte not in b"[O"):
                self._sequence = b""
                if byte < 0x80:
                    yield chr(byte)
            elif len(self._sequence) > 1 and 0x40 <= byte <= 0x7E:
                is_bare = len(self._sequence) == 2
                self._sequence = b""
                if is_bare and byte in _ARROWS:
                    yield _ARROWS[byte]
            else:
                self._sequence = (self._sequence + bytes([byte]))[:_MAX_SEQUENCE]


class _Terminal:
    """A terminal that can be switched to deliver keys at once, and back."""

    def __init__(self, fd: int, termios: Any) -> None:
        self.fd = fd
        self._termios = termios
        self._before: list[Any] | None = None
        self._is_left = False
        # reentrant, as a signal may arrive while the main thread holds it
        self._lock = threading.RLock()

    def take(self) -> bool:
        """Switch to single keys if the program is in the foreground; returns whether it is."""
        with self._lock:
            if self._is_left or not self._is_in_foreground():
                return False
            if self._before is None:
                try:
                    before = self._termios.tcgetattr(self.fd)
                    self._termios.tcsetattr(self.fd, self._termios.TCSANOW, self._keyed(before))
                except self._termios.error:  # it was closed
                    return False
                self._before = before
            return True

    def leave(self) -> None:
        """Restore the settings, and leave them alone until `come_back`."""
        with self._lock:
            self._is_left = True
            before, self._before = self._before, None
            if before is None or not self._is_in_foreground():
                return
            try:
                self._termios.tcsetattr(self.fd, self._termios.TCSANOW, before)
            except self._termios.error:  # it was closed
                return

    def come_back(self) -> None:
        """Allow `take` again."""
        with self._lock:
            self._is_left = False

    def _keyed(self, before: list[Any]) -> list[Any]:
        attributes = [*before[:6], [*before[6]]]
        attributes[3] &= ~(self._termios.ICANON | self._termios.ECHO)
        attributes[6][self._termios.VMIN] = 1
        attributes[6][self._termios.VTIME] = 0
        return attributes

    def _is_in_foreground(self) -> bool:
        """Whether the terminal may be read and set: a background program would be stopped."""
        try:
            return os.tcgetpgrp(self.fd) == os.getpgrp()
        except OSError:  # not the controlling terminal: nothing would stop the program
            return True


def _terminal(fd: int | None) -> _Terminal | None:
    """The terminal, if there is one."""
    try:
        import termios

        number = sys.stdin.fileno() if fd is None else fd
        return _Terminal(number, termios) if os.isatty(number) else None
    except (ImportError, AttributeError, OSError, ValueError):
        # no termios on this system; standard input is None, closed, or not a real file
        return None
