"""Where the tests find recordings, and what several of them share."""

from __future__ import annotations

import gc
import os
import re
import signal
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

import mp4ds
from mp4ds.errors import Mp4dsError
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.demo import demo
from mp4ds.video.codecs import check_pyav
from mp4ds.video.encoder import ordinary_scheduling
from sources import SOURCES, scene

NETWORKS = {
    "test_play_ros1": "ros1",
    "test_publish_ros1": "ros1",
    "test_record_ros1": "ros1",
    "test_ros_packages": "ros1",
    "test_publish_dds": "dds",
    "test_publish_ros2": "dds",
    "test_record_ros2": "dds",
}
"""Files of tests that need a network of ROS, and which; tools/test.sh collects them alone."""

DATA = Path(os.environ.get("MP4DS_DATA", Path(__file__).parents[2] / "shared" / "data"))


def real(name: str) -> Path:
    """A real recording, which is beside the project and not part of it."""
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the real recording {name} is not in {DATA}")
    return path


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Name a case by its argument where the value is no name: bytes, or long text."""
    is_name = isinstance(val, str) and len(val) <= 40 and val.isprintable()
    return argname if isinstance(val, (str, bytes)) and not is_name else None


def _number(item: pytest.Item, count: int) -> int:
    """Number of a case among so many, of which another one comes first in each row of a matrix."""
    axes = [mark.args[0] for mark in item.iter_markers("parametrize")]
    names = [re.split(r"\W", axis)[0] if isinstance(axis, str) else axis[0] for axis in axes]
    places = [item.callspec.indices[name] for name in names]  # type: ignore[attr-defined]
    return sum(place + place // count for place in places) % count


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the cases that `one_in` leaves out, and the tests that keep to times.

    Those run apart, one process for each network.
    """
    for item in items:
        if (one_in := item.get_closest_marker("one_in")) and _number(item, *one_in.args):
            item.add_marker(pytest.mark.slow)
        network = NETWORKS.get(item.path.stem)
        needs_master = "roscore" in getattr(item, "fixturenames", ())
        if needs_master and network != "ros1":
            raise pytest.UsageError(f"{item.nodeid}: its file is not one of NETWORKS, conftest.py")
        if network == "dds" or needs_master:
            item.add_marker(pytest.mark.network)
            item.add_marker(pytest.mark.xdist_group(network))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Three processes for two cores: tests also wait, for processes, servers and clocks."""
    return (os.cpu_count() or 1) * 3 // 2


def pytest_collection_finish() -> None:
    """Leave the tests themselves, half a million objects, out of every collection of garbage."""
    gc.collect()
    gc.freeze()


def pytest_configure() -> None:
    """Take Ctrl-C, and let what tests start take it, where a shell's `&` has it ignored."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("SIGQUIT", "SIGHUP"):
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)  # which no program inherits


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave real time.

    SVT-AV1, opened by PyAV itself as root, takes the thread there, and its own, which may outlive
    the test; what a test starts from them would hold up all others.
    """
    with ordinary_scheduling():
        return (yield)


pytest_runtest_protocol = pytest_collection


@pytest.fixture(scope="session", autouse=True)
def unsynced() -> Iterator[None]:
    """Do not wait for the disk: no test goes on after a power cut."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def written() -> Iterator[None]:
    """Skip what writes videos where PyAV is only good for reading."""
    with pytest.MonkeyPatch.context() as patch:
        try:
            check_pyav()
        except Mp4dsError as error:
            reason = str(error)
            for module in ("codecs", "media"):
                patch.setattr(f"mp4ds.video.{module}.check_pyav", lambda: pytest.skip(reason))
        yield


@pytest.fixture(scope="session")
def packed_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lossless dataset of a small ROS 1 bag; not to be changed."""
    folder = tmp_path_factory.mktemp("packed")
    source = folder / "source"
    paths = SOURCES["bag-none"](source, scene("bayer_rggb8"))
    mp4ds.pack(paths, folder / "dataset", PackOptions(codec="h264"))
    return folder / "dataset"


@pytest.fixture(scope="session")
def with_views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lossless dataset of the demo, whose Bayer and RGB cameras have views; not to be changed."""
    folder = tmp_path_factory.mktemp("viewed")
    demo(folder / "demo.mcap", seconds=1)
    mp4ds.pack(folder / "demo.mcap", folder / "dataset")
    assert len([*folder.glob("dataset/*.exact.mp4")]) == 2
    return folder / "dataset"
