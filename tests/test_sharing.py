"""One stream in several threads and after a fork, in processes of their own: the bug crashes."""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path

import av
import numpy as np
import pytest

import mp4ds
from commands import program

BEGIN = """
import os, sys, threading
import numpy as np
import mp4ds

stream = next(iter(mp4ds.open(sys.argv[1])))
options = {"format": "rgb", "resize": (64, 48)}
numbers = range(0, len(stream), 3)
expected = {n: stream.read([n], **options)[0] for n in numbers}

def check(seed):
    for n in np.random.default_rng(seed).permutation(numbers).tolist():
        if not np.array_equal(stream.read([n], **options)[0], expected[n]):
            raise SystemExit(f"frame {n} differs")
        stamp = int(stream.stamps[n])
        (frame,) = stream.between(stamp, stamp + 1, **options)
        if not np.array_equal(frame.data, expected[n]):
            raise SystemExit(f"frame {n} of a time differs")

def fork(work):
    child = os.fork()
    if not child:
        status = 1
        try:
            work()
            status = 0
        except SystemExit as error:
            print(error, flush=True)
        except BaseException as error:
            print(type(error).__name__, error, flush=True)
        finally:
            os._exit(status)
    return child

def status(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
"""

THREADS = """
failed = []

def safely(seed):
    try:
        check(seed)
    except BaseException as error:
        failed.append(error)

threads = [threading.Thread(target=safely, args=(seed,)) for seed in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(failed or "as alone")
"""

FORKS = """
children = [fork(lambda: check(seed)) for seed in range(3)]
check(3)
print([status(child) for child in children])
"""

LOCKED = """
inside, go_on = threading.Event(), threading.Event()

def hold():
    with stream._opened.lock:
        inside.set()
        go_on.wait()

holder = threading.Thread(target=hold)
holder.start()
inside.wait()
child = fork(lambda: check(0))
print(status(child))
go_on.set()
holder.join()
"""

ITERATOR = """
frames = iter(stream)
next(frames)
child = fork(lambda: next(frames))
print(status(child))
print(len(stream) - 1 - sum(1 for _ in frames))
"""


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory, packed_bag: Path) -> dict[str, Path]:
    """A stream of a dataset, and a video without a sidecar."""
    video = tmp_path_factory.mktemp("video") / "other.mp4"
    with av.open(str(video), "w") as container:
        track = container.add_stream("libx264", rate=30, options={"g": "8"})
        track.width, track.height, track.pix_fmt = 96, 64, "yuv420p"
        for number in range(30):
            pixels = np.full((64, 96, 3), 8 * number, np.uint8)
            container.mux(track.encode(av.VideoFrame.from_ndarray(pixels, "rgb24")))
        container.mux(track.encode(None))
    return {"stream": packed_bag, "video": video}


def result(script: str, path: Path) -> list[str]:
    command = (sys.executable, "-W", "ignore", "-c", BEGIN + script, path)
    return program(*command).out.splitlines()


@pytest.mark.parametrize("kind", ["stream", "video"])
def test_threads_get_the_same_frames(kind: str, paths: dict[str, Path]) -> None:
    assert result(THREADS, paths[kind]) == ["as alone"]


@pytest.mark.parametrize("kind", ["stream", "video"])
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_forks_get_the_same_frames(kind: str, paths: dict[str, Path]) -> None:
    assert result(FORKS, paths[kind]) == ["[0, 0, 0]"]
    assert result(LOCKED, paths[kind]) == ["0"]


@pytest.mark.parametrize("kind", ["stream", "video"])
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_an_iterator_stays_in_its_process(kind: str, paths: dict[str, Path]) -> None:
    said, code, left = result(ITERATOR, paths[kind])
    assert "cannot go on in process" in said
    assert said.endswith("a fork of it: begin it again there")
    assert (code, left) == ("1", "0")


def test_a_stream_in_use_can_be_pickled(packed_bag: Path) -> None:
    with mp4ds.open(packed_bag) as dataset:
        stream = next(iter(dataset))
        frame = stream[1]
        again = pickle.loads(pickle.dumps(stream))
        assert np.array_equal(again[1].data, frame.data)
        again.close()
