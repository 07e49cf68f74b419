"""A real master of ROS 1, and processes beside it; on loopback alone.

Debian and Ubuntu have it: python3-rosmaster, python3-rospy, python3-rosbag and others; `.ci/run`
lists them. rospy is used in processes of their own, since one process can be one node, once.
"""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

import mp4ds
from waiting import WATCHDOG_S

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


def wait_until(true: Callable[[], bool], seconds: float = SECONDS) -> None:
    """Wait for something, but not for ever."""
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not in {seconds:g} s")
        time.sleep(0.02)


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


class Core:
    """A master, and the environment of those that use it; a context manager that ends all.

    Args:
        folder: For what they write.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._processes: list[Process] = []
        port, self._prefix, own_net = 11311, [], _own_net()
        if not own_net:
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
            self._master = subprocess.Popen(
                [*own_net, *command], env=self.environment, stdout=log, stderr=log
            )
        if own_net:
            self._prefix = ["nsenter", "-t", str(self._master.pid), "-n"]
            # until then, who is started beside it would be in the network of the tests
            net, here = (Path(f"/proc/{pid}/ns/net") for pid in (self._master.pid, "self"))
            wait_until(lambda: net.readlink() != here.readlink())
        asking = [*self._prefix, sys.executable, str(HERE / "ros1_state.py"), self.uri]
        self._state = Process(asking, self.environment)
        wait_until(lambda: self._master.poll() is not None or self._state.ask("nodes") is not None)

    def run(self, *command: str, **environment: str) -> tuple[int, str, str]:
        """Run a program beside the master; returns exit code, output and errors."""
        done = subprocess.run(
            [*self._prefix, *command],
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
                [*self._prefix, *command],
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                text=True,
            )

    def script(self, name: str, *arguments: str) -> Process:
        """Start a script of the tests with the tests' Python."""
        command = [*self._prefix, *python(str(HERE / name), *arguments)]
        process = Process(command, {**self.environment, "PYTHONPATH": str(HERE)})
        self._processes.append(process)
        return process

    def receiver(self, *topics: str) -> Process:
        """An ordinary subscriber, which says what it gets; see `ros1_receiver`."""
        process = self.script("ros1_receiver.py", *topics)
        assert process.next() == "ready"
        return process

    def nodes(self) -> list[str]:
        """The names of all nodes."""
        return list(self._state.ask("nodes"))

    def connections(self, node: str) -> Counter[str]:
        """How many connections a node has, by topic."""
        return Counter(self._state.ask("connections", node))

    def play(self, command: list[str], topics: Iterable[str], subscribers: int) -> tuple[str, str]:
        """Run a player to its end, once each topic has its subscribers.

        Returns its output and errors, when they have taken all that was sent.
        """
        before, wanted = {*self.nodes()}, dict.fromkeys(topics, subscribers)
        player = subprocess.Popen(
            [*self._prefix, *command, "--pause"],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            wait_until(lambda: any("play" in node for node in {*self.nodes()} - before))
            (node,) = (node for node in {*self.nodes()} - before if "play" in node)
            wait_until(lambda: self.connections(node) >= Counter(wanted))
            wait_until(lambda: sum(map(self.connections, before), Counter()) >= Counter(wanted))
            service = f"{node}/pause_playback"
            wait_until(lambda: self.run("rosservice", "call", service, "false")[0] == 0)
            output, errors = player.communicate(timeout=SECONDS)
        finally:
            player.kill()
            player.communicate()  # and close its pipes
        assert player.returncode == 0, errors
        wait_until(lambda: not any(map(self.connections, before)))
        return output, errors

    def end_processes(self) -> None:
        """End what scripts are still running."""
        while self._processes:
            self._processes.pop().end()

    def __enter__(self) -> Core:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end_processes()
        self._state.end()
        self._master.terminate()
        self._master.wait(SECONDS)


def _own_net() -> list[str]:
    """A command that runs another one in a network of its own, empty where that is not possible.

    Some ports of ROS 1 listen on all addresses.
    """
    if os.geteuid() or not all(map(shutil.which, ("unshare", "nsenter", "ip"))):
        return []
    lo = "ip link set lo up"
    if subprocess.run(["unshare", "-n", "sh", "-c", lo], capture_output=True).returncode:
        return []
    return ["unshare", "-n", "sh", "-c", f'{lo} && exec "$@"', "sh"]


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
    with Core(tmp_path_factory.mktemp("roscore")) as core:
        yield core


@pytest.fixture
def roscore(_core: Core) -> Iterator[Core]:
    """A master without nodes and without parameters."""
    yield _core
    _core.end_processes()
