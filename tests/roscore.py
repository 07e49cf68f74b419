"""A real master of ROS 1, and processes beside it; on loopback alone.

Debian and Ubuntu have it: python3-rosmaster, python3-rospy, python3-rosbag and others; `.ci/run`
lists them. rospy is used in processes of their own, since one process can be one node, once.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from xmlrpc.client import Fault, ServerProxy, Transport

import pytest

import mp4ds
from waiting import WATCHDOG_S, until

HERE = Path(__file__).parent
SECONDS = WATCHDOG_S
RECORD = "/usr/lib/rosbag/record"
PLAY = "/usr/lib/rosbag/play"

_PACKAGES = "/usr/lib/python3/dist-packages"
# What pip installed goes before what Debian did, numpy and yaml above all; what the tests import,
# before both.
_PYTHON = f"""
import runpy, sys
sys.path.insert(0, {str(Path(mp4ds.__file__).parents[1])!r})
sys.path.append({_PACKAGES!r})
del sys.argv[0]
if sys.argv[0].endswith(".py"):
    runpy.run_path(sys.argv[0], run_name="__main__")
else:
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def python(*arguments: str) -> list[str]:
    """The command of a script or module for the Python of the tests, which finds rospy too."""
    return [sys.executable, "-c", _PYTHON, *arguments]


_END = object()


class Process:
    """A process that says things in lines of JSON and is told others."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.popen = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._lines: queue.Queue[Any] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with self.popen.stdout or sys.stdin as stream:
            for line in stream:
                if not line.startswith("shutdown request"):  # rospy tells it here
                    self._lines.put(json.loads(line))
        self._lines.put(_END)

    def next(self, seconds: float = SECONDS) -> Any:
        """What it says next."""
        found = self._lines.get(timeout=seconds)
        if found is _END:
            self._lines.put(_END)
            raise EOFError(f"it has ended: {self.popen.wait(SECONDS)}")
        return found

    def take(self, count: int) -> list[Any]:
        """The next things that it says."""
        found: list[Any] = []
        try:
            while len(found) < count:
                found.append(self.next(60))
        except queue.Empty:
            raise TimeoutError(f"{len(found)} of {count} came: {found}") from None
        return found

    def silence(self, seconds: float = 0.5) -> list[Any]:
        """What it says within some time, which is long for what is on its way."""
        time.sleep(seconds)
        found = []
        while not self._lines.empty():
            found.append(self.next())
        return found

    def ask(self, what: str, *arguments: Any) -> Any:
        """Tell it something and wait for what it says to that."""
        self.tell(what, *arguments)
        return self.next()

    def tell(self, what: str, *arguments: Any) -> None:
        """Tell it something."""
        if self.popen.stdin is not None:
            self.popen.stdin.write(json.dumps([what, *arguments]) + "\n")
            self.popen.stdin.flush()

    def stop(self) -> None:
        """Let it stand still."""
        self.popen.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let it go on."""
        self.popen.send_signal(signal.SIGCONT)

    def end(self) -> int:
        """End it by its number, with the time to sign off; returns the exit code."""
        self.resume()
        self.popen.terminate()
        try:
            self.popen.wait(20)
        except subprocess.TimeoutExpired:
            self.popen.kill()
        code = self.popen.wait(SECONDS)
        if self.popen.stdin is not None:
            self.popen.stdin.close()
        self._reader.join(SECONDS)
        return code


class _Transport(Transport):
    """Of requests that are answered soon, or not at all."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = 5.0
        return connection


def asked(uri: str, method: str, *arguments: str) -> Any:
    """What a master or node answers; None if it does not, or has gone."""
    try:
        with ServerProxy(uri, transport=_Transport()) as proxy:
            return getattr(proxy, method)("/tests", *arguments)
    except (OSError, Fault):
        return None


class Core:
    """A master, and the environment of those that use it.

    Args:
        folder: For what they write.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._processes: list[Process] = []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.uri = f"http://127.0.0.1:{port}/"
        home = {"ROS_HOME": str(folder / "ros"), "ROS_LOG_DIR": str(folder / "log")}
        address = {"ROS_MASTER_URI": self.uri, "ROS_IP": "127.0.0.1"}
        unset = ("PYTHONPATH", "ROS_HOSTNAME", "ROS_NAMESPACE", "ROS_ROOT")
        self.environment = {
            **{key: value for key, value in os.environ.items() if key not in unset},
            **home,
            **address,
        }
        command = ["/usr/bin/rosmaster", "--core", "-p", str(port)]
        with (folder / "master.log").open("w") as log:
            self._master = subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)
        until(lambda: asked(self.uri, "getPid"), self._master)

    def run(self, *command: str, **environment: str) -> tuple[int, str, str]:
        """Run a program beside the master; returns exit code, output and errors."""
        done = subprocess.run(
            command,
            env={**self.environment, **environment},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=SECONDS,
        )
        return done.returncode, done.stdout, done.stderr

    def start(self, *command: str) -> subprocess.Popen[str]:
        """Start a program beside the master, the output of which goes into the folder."""
        with (self.folder / f"{Path(command[0]).name}.log").open("a") as log:
            return subprocess.Popen(
                command,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                text=True,
            )

    def script(self, name: str, *arguments: str) -> Process:
        """Start a script of the tests with the tests' Python."""
        environment = {**self.environment, "PYTHONPATH": str(HERE)}
        process = Process(python(str(HERE / name), *arguments), environment)
        self._processes.append(process)
        return process

    def receiver(self, *topics: str) -> Process:
        """An ordinary subscriber, which says what it gets; see `ros1_receiver`."""
        process = self.script("ros1_receiver.py", *topics)
        assert process.next() == "ready"
        return process

    def nodes(self) -> list[str]:
        """The names of all nodes."""
        state = asked(self.uri, "getSystemState") or [[]]
        return sorted({node for kind in state[-1] for _, names in kind for node in names})

    def connections(self, node: str) -> Counter[str]:
        """How many connections a node has, by topic."""
        code, _, uri = asked(self.uri, "lookupNode", node) or (-1, "", "")
        found = (asked(uri, "getBusInfo") if code == 1 else None) or [[]]
        return Counter(one[4] for one in found[-1] if len(one) < 6 or one[5])

    def play(self, command: list[str], topics: Iterable[str], subscribers: int) -> tuple[str, str]:
        """Run a player to its end, once each topic has its subscribers.

        Returns its output and errors, when they have taken all that was sent.
        """
        before, wanted = {*self.nodes()}, dict.fromkeys(topics, subscribers)
        player = subprocess.Popen(
            [*command, "--pause"],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            until(lambda: any("play" in node for node in {*self.nodes()} - before))
            (node,) = (node for node in {*self.nodes()} - before if "play" in node)
            until(lambda: self.connections(node) >= Counter(wanted))
            until(lambda: sum(map(self.connections, before), Counter()) >= Counter(wanted))
            service = f"{node}/pause_playback"
            until(lambda: self.run("rosservice", "call", service, "false")[0] == 0)
            output, errors = player.communicate(timeout=SECONDS)
        finally:
            player.kill()
            player.communicate()  # and close its pipes
        assert player.returncode == 0, errors
        until(lambda: not any(map(self.connections, before)))
        return output, errors

    def end_processes(self) -> None:
        """End what scripts are still running."""
        while self._processes:
            self._processes.pop().end()

    def close(self) -> None:
        """End all of them."""
        self.end_processes()
        self._master.terminate()
        self._master.wait(SECONDS)


def missing() -> str:
    """Why there is no ROS 1 here, empty if there is."""
    for program in ("/usr/bin/rosmaster", "/usr/bin/rosnode", RECORD, PLAY):
        if not Path(program).exists():
            return f"ROS 1 is not installed: no {program}"
    probe = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.append({_PACKAGES!r}); import rospy"],
        capture_output=True,
        text=True,
    )
    return f"this Python has no rospy: {probe.stderr.strip()[-200:]}" if probe.returncode else ""


@pytest.fixture(scope="session")
def _core(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Core]:
    if why := missing():
        pytest.skip(why)
    with closing(Core(tmp_path_factory.mktemp("roscore"))) as core:
        yield core


@pytest.fixture
def roscore(_core: Core) -> Iterator[Core]:
    """A master without nodes and without parameters."""
    yield _core
    _core.end_processes()
