"""`mp4ds play` as users run it: its keys on a terminal, its signals, its exit codes, its words."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import mp4ds
from commands import Result, call, program
from mp4ds.plugins.ros.node import chosen_world
from player_scenes import make_drive
from ros2_sides import alone_in_ros2
from waiting import WATCHDOG_S

WAIT_S = WATCHDOG_S
pytest.importorskip("cyclonedds")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    mp4ds.pack(make_drive(folder / "drive.bag"), folder / "drive")
    return folder / "drive"


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "mp4ds", "play", *map(str, arguments)]


@pytest.fixture(autouse=True)
def _ros2(monkeypatch: pytest.MonkeyPatch) -> None:
    alone_in_ros2(monkeypatch)


def run(*arguments: str | Path) -> Result:
    return program(*command(*arguments), code=None)


class Terminal:
    """A command on a pseudo-terminal; a context manager."""

    def __init__(self, *arguments: str | Path) -> None:
        self._master, slave = pty.openpty()
        os.set_blocking(self._master, False)
        self.process = subprocess.Popen(
            command(*arguments), stdin=slave, stdout=slave, stderr=slave, start_new_session=True
        )
        os.close(slave)
        self.text = ""

    def read(self) -> str:
        while True:
            try:
                data = os.read(self._master, 65536)
            except OSError:
                return self.text
            if not data:
                return self.text
            self.text += data.decode(errors="replace")

    def until(self, pattern: str) -> re.Match[str]:
        """Wait for words that come after those waited for before."""
        end = time.monotonic() + WAIT_S
        while not (found := re.search(pattern, self.read())):
            assert time.monotonic() < end, self.text[-2000:]
            time.sleep(0.02)
        self.text = self.text[found.end() :]
        return found

    def press(self, keys: bytes) -> None:
        os.write(self._master, keys)

    def end(self) -> int:
        code = self.process.wait(WAIT_S)
        self.read()
        return code

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._master)


def test_plays_and_tells(drive: Path) -> None:
    done = run(drive, "--ros2", "-r", "5", "--json")
    assert done.code == 0, done.err
    result = json.loads(done.out)
    assert result["messages"] == {"/tf": 40, "/tf_static": 2, "/camera/image_raw": 20}
    assert not result["stopped"]
    assert re.search(r"publishing to ROS 2, domain \d+", done.err)


def test_keys(drive: Path) -> None:
    with Terminal(drive, "--ros2", "--pause", "--topics", "/camera/*") as shown:
        shown.until("1x paused  0 messages")
        shown.press(b"\x1b[C")
        shown.until("1 messages")
        shown.press(b"s\x1b[C")
        shown.until("3 messages")
        shown.press(b"\x1b[A")
        shown.until(r"1\.1x paused")
        shown.press(b"\x1b[B\x1b[B")
        shown.until(r"0\.909\d*x paused")
        shown.press(b" ")
        assert shown.end() == 0
        assert "20 messages in" in shown.text


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_signals(drive: Path, number: signal.Signals, code: int) -> None:
    """Ctrl-C ends with 0, as `ros2 bag play` does."""
    with Terminal(drive, "--ros2", "-r", "0.2") as shown:
        shown.until(r"0\.2x playing  [1-9]")
        os.kill(shown.process.pid, number)
        assert shown.end() == code
        assert "stopped before the end" in shown.text
        assert "Traceback" not in shown.text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{}", "--ros1", "--ros2"], "--ros1 contradicts --ros2"),
        (["{}", "--ros2", "-s", "3"], "'3' is not one of 'sqlite3', 'mcap'"),
        (["{}", "--ros2", "--log-level", "loud"], "--log-level 'loud'"),
        (["{}", "--ros2", "--publish-service-requests"], "services are not called"),
        (["{}", "--ros2", "--message-order", "sent"], "'sent' is not 'received'"),
        (["{}", "--ros1", "--wait-for-all-acked", "5"], "works with ros2, not with ros1"),
        (["{}", "--ros2", "--queue", "5"], "works with ros1, not with ros2"),
        (["{}", "--ros2", "--ros-args", "-r", "__node:=a/b"], "'a/b' is not a valid node name"),
        (["{}/none", "--ros2"], "none"),
    ],
)
def test_errors_are_sentences(drive: Path, arguments: list[str], words: str) -> None:
    done = call("play", *(argument.format(drive) for argument in arguments))
    assert done.code == 2, done.err
    assert words in done.err
    assert "Traceback" not in done.err


@pytest.mark.parametrize(
    ("version", "modules", "kind"),
    [
        ("1", [], "ros1"),
        ("2", [], "ros2"),
        ("", ["rospy"], "ros1"),
        ("", ["rclpy", "rospy"], "ros2"),
        ("", ["cyclonedds"], "ros2"),
        ("", [], None),
    ],
)
def test_what_is_sourced(
    version: str, modules: list[str], kind: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_VERSION", version)
    monkeypatch.setattr(
        "mp4ds.plugins.ros.node.find_spec",
        lambda name: object() if name in modules else None,
    )
    if kind:
        assert chosen_world("play", None) == kind
        return
    with pytest.raises(mp4ds.RemoteError, match="no ROS is sourced"):
        chosen_world("play", None)
