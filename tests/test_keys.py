"""Keys of a real (pseudo) terminal control the player, and the terminal is given back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from mp4ds.cli.nodes import Keyboard
from mp4ds.cli.play import player_keys
from ros2_sides import Controls
from waiting import until

ESC = b"\x1b"


@dataclass
class Terminal:
    """A terminal: what types and shows, and what the program has."""

    hand: int
    fd: int

    def type(self, keys: bytes) -> None:
        os.write(self.hand, keys)

    @property
    def attributes(self) -> list[Any]:
        return termios.tcgetattr(self.fd)

    @property
    def gives_keys(self) -> bool:
        return not self.attributes[3] & (termios.ICANON | termios.ECHO)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    hand, fd = os.openpty()
    yield Terminal(hand, fd)
    for descriptor in {hand, fd}:
        os.close(descriptor)


# ---------------------------------------------------------------- keys


KEYS: dict[str, tuple[bytes, tuple[Any, ...]]] = {
    "space": (b" ", ("toggle_paused",)),
    "right": (ESC + b"[C", ("play_next",)),
    "right-application": (ESC + b"OC", ("play_next",)),
    "s": (b"s", ("play_next",)),
    "up": (ESC + b"[A", ("set_rate", 2.75)),
    "down": (ESC + b"[B", ("set_rate", 2.27272727)),
    "t": (b"t", ("toggle_topic_pauses",)),
}


@pytest.mark.parametrize("name", KEYS)
def test_each_key(name: str, terminal: Terminal) -> None:
    typed, asked = KEYS[name]
    controls = Controls()
    with Keyboard(player_keys(controls), fd=terminal.fd):
        terminal.type(typed)
        until(lambda: bool(controls.asked))
    assert controls.asked == [asked]


# ---------------------------------------------------------------- the terminal is given back


def test_the_terminal_is_as_it_was_after_the_end(terminal: Terminal) -> None:
    before = terminal.attributes
    handlers = {n: signal.getsignal(n) for n in signal.valid_signals()}
    with Keyboard(player_keys(Controls()), fd=terminal.fd):
        assert terminal.gives_keys
        assert terminal.attributes[3] & termios.ISIG
    assert terminal.attributes == before
    assert {n: signal.getsignal(n) for n in signal.valid_signals()} == handlers
    assert "keys" not in [thread.name for thread in threading.enumerate()]


# ---------------------------------------------------------------- signals, in a session of its own


PLAYER = """
import time
from mp4ds.cli import prepare_process
from mp4ds.cli.nodes import Keyboard
prepare_process()
with Keyboard({" ": lambda: print("toggled", flush=True)}):
    print("entered", flush=True)
    while True:
        time.sleep(0.05)
"""

# a shell in the small: the player is its job, in the foreground of the terminal, and both
# tell by lines on standard error what happens
SHELL = """
import fcntl, os, resource, signal, sys, termios
usual = termios.tcgetattr(0)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
def say(text): os.write(2, (text + "\\n").encode())
job = os.fork()
if job == 0:
    os.setpgid(0, 0)
    os.tcsetpgrp(0, os.getpid())
    signal.signal(signal.SIGTTOU, signal.SIG_DFL)
    os.dup2(2, 1)
    os.execv(sys.executable, [sys.executable, "-c", sys.argv[1]])
say(f"job {job}")
while True:
    _, status = os.waitpid(job, os.WUNTRACED)
    os.tcsetpgrp(0, os.getpgrp())
    if not os.WIFSTOPPED(status):
        say(f"ended {os.waitstatus_to_exitcode(status)}")
        break
    termios.tcsetattr(0, termios.TCSANOW, usual)
    say("stopped")
    while (command := sys.stdin.readline().strip()) in ("bg", "fg"):
        if command == "fg":
            os.tcsetpgrp(0, job)
        os.kill(job, signal.SIGCONT)
        say(command)
        if command == "fg":
            break
"""


class Session:
    """A shell with one job on a terminal."""

    def __init__(self, terminal: Terminal) -> None:
        self._shell = subprocess.Popen(
            [sys.executable, "-c", SHELL, PLAYER],
            stdin=terminal.fd,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
            text=True,
        )
        self._lines: list[str] = []
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()
        self.expect("job")
        self.job = int(self._lines[0].split()[1])

    def _listen(self) -> None:
        assert self._shell.stderr is not None
        self._lines.extend(iter(self._shell.stderr.readline, ""))

    def expect(self, line: str, times: int = 1) -> None:
        until(lambda: sum(told.startswith(line) for told in self.lines) >= times)

    @property
    def lines(self) -> list[str]:
        return [*self._lines]

    def close(self) -> None:
        self._shell.kill()
        self._shell.wait()
        self._thread.join()
        assert self._shell.stderr is not None
        self._shell.stderr.close()


@pytest.fixture
def session(terminal: Terminal) -> Iterator[Session]:
    made = Session(terminal)
    yield made
    if not any(line.startswith("ended") for line in made.lines):
        os.kill(made.job, signal.SIGKILL)
    made.close()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_the_terminal_is_as_it_was_after_a_signal(
    number: signal.Signals, terminal: Terminal, session: Session
) -> None:
    session.expect("entered")
    before = [*terminal.attributes]
    before[3] |= termios.ICANON | termios.ECHO
    assert terminal.gives_keys
    os.kill(session.job, number)
    session.expect("ended")
    code = -number if number == signal.SIGINT else 128 + number
    assert f"ended {code}\n" in session.lines
    assert terminal.attributes[3] == before[3]


def test_ctrl_z_gives_the_terminal_back_and_fg_takes_it(
    terminal: Terminal, session: Session
) -> None:
    session.expect("entered")
    for n in range(1, 3):
        terminal.type(b" ")
        session.expect("toggled", 2 * n - 1)
        terminal.type(b"\x1a")
        session.expect("stopped", n)
        assert not terminal.gives_keys
        terminal.type(b"fg\n")
        session.expect("fg", n)
        until(lambda: terminal.gives_keys)
        terminal.type(b" ")
        session.expect("toggled", 2 * n)


def test_in_the_background_the_terminal_is_left_alone(terminal: Terminal, session: Session) -> None:
    session.expect("entered")
    terminal.type(b"\x1a")
    session.expect("stopped")
    terminal.type(b"bg\n")
    session.expect("bg")
    time.sleep(0.6)
    assert not terminal.gives_keys
    # it was not stopped again, since it did not touch the terminal
    assert Path(f"/proc/{session.job}/stat").read_text().split()[2] in "SR"
    terminal.type(b"fg\n")
    session.expect("fg")
    until(lambda: terminal.gives_keys)
    terminal.type(b" ")
    session.expect("toggled")
