"""What is needed of rospy: a node that starts or fails soon, and messages that stay bytes."""

from __future__ import annotations

import logging
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as TimedOut
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from mp4ds.errors import OptionError, PublishError
from mp4ds.publishers.ros1_topics import MessageType

_T = TypeVar("_T")

ANSWER_S = 4.0
"""For the master to answer, seconds."""

_BACKLOG = 1024
_LOGGING = "version: 1\nincremental: true\n"


def start_node(node: str) -> tuple[Any, str]:
    """Make this process a node; returns rospy, and where its master is.

    Raises:
        OptionError: The address of the master is none.
        PublishError: There is no rospy, or no master answers.
    """
    rosgraph, rospy = _imported()
    try:
        master = str(rosgraph.get_master_uri())
        # init_node() would ask for ever
        has_master = answer(rosgraph.is_master_online, ANSWER_S)
    except ValueError as error:
        raise OptionError(f"The address of the ROS master is wrong: {error}.") from None
    if not has_master:
        problem = "no ROS master answers there; start roscore, or set ROS_MASTER_URI"
        raise PublishError(master, problem)
    if rospy.core.is_initialized() or rospy.is_shutdown():
        raise PublishError(master, "this process was a ROS node already; start another one")
    try:
        with _own_logging():
            rospy.init_node(
                node,
                argv=[],
                anonymous=True,
                disable_signals=True,
                disable_rostime=True,  # this process tells the time, and waits for nobody's
                disable_rosout=True,  # /rosout may be a topic of the recording
            )
            _receive_many()
    except (rospy.ROSException, ValueError, OSError) as error:
        raise PublishError(master, f"no node can be started ({error})") from None
    return rospy, master


def _receive_many() -> None:
    """Let many subscribers come at once: beyond rospy's 5, they try again after seconds."""
    from rospy.impl.tcpros_base import init_tcpros_server

    server = init_tcpros_server().tcp_ros_server
    if server is not None:
        server.server_sock.listen(_BACKLOG)


def _imported() -> tuple[Any, Any]:
    before = logging.getLoggerClass()
    try:
        import rosgraph
        import rospy
    except ImportError as error:
        problem = (
            f"ROS 1 cannot be used here ({error}); source its setup.bash, or install python3-rospy "
            "and use an environment made by python3 -m venv --system-site-packages"
        )
        raise PublishError("rospy", problem) from None
    finally:
        logging.setLoggerClass(before)  # rosgraph sets its own for the whole process
    return rosgraph, rospy


@contextmanager
def _own_logging() -> Iterator[None]:
    """Keep rospy from configuring the logging of the whole process, unless the user asks for it."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "logging.yaml")
        config.write_text(_LOGGING)
        mine = {"ROS_PYTHON_LOG_CONFIG_FILE": str(config), "ROS_LOG_DIR": folder}
        mine = {key: value for key, value in mine.items() if key not in os.environ}
        os.environ.update(mine)
        try:
            yield
        finally:
            for key in mine:
                del os.environ[key]


def answer(call: Callable[[], _T], seconds: float) -> _T | None:
    """What a call returns, None if that takes too long: rospy's calls have no time-out."""
    future: Future[_T] = Future()

    def ask() -> None:
        try:
            future.set_result(call())
        except Exception as error:
            future.set_exception(error)

    threading.Thread(target=ask, daemon=True).start()
    try:
        return future.result(seconds)
    except TimedOut:
        return None


def is_name(name: str) -> bool:
    """Whether a topic may be called so."""
    import rosgraph.names

    return bool(name.strip("/")) and bool(rosgraph.names.is_legal_name(name))


def raw_class(kind: MessageType) -> Any:
    """A message class whose one field is the serialized message."""
    import genpy

    def serialize(self: Any, buff: Any) -> None:
        buff.write(self.payload)

    def deserialize(self: Any, data: bytes) -> Any:
        self.payload = bytes(data)
        return self

    members = {
        "__slots__": ["payload"],
        "_slot_types": ["uint8[]"],
        "_type": kind.name,
        "_md5sum": kind.md5sum,
        "_full_text": kind.definition,
        "_has_header": False,
        "serialize": serialize,
        "deserialize": deserialize,
    }
    return type(kind.name.rpartition("/")[2], (genpy.Message,), members)


def set_bool_class() -> Any:
    """The class of std_srvs/SetBool, which need not be installed."""
    request = "8b94c1b53db61fb6aed406028ad6332a", b"bool data\n"
    response = "937c9679a518e3a18d831e57125ea522", b"bool success\nstring message\n"
    members = {
        "_type": "std_srvs/SetBool",
        "_md5sum": "09fb03525b03e7ea1fd3992bafd87e16",
        "_request_class": raw_class(MessageType("std_srvs/SetBoolRequest", *request)),
        "_response_class": raw_class(MessageType("std_srvs/SetBoolResponse", *response)),
    }
    return type("SetBool", (), members)
