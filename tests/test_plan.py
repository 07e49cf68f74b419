"""Which topics become streams, what they are called, how they are encoded, where they are cut."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import pytest
import xxhash
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter

from mp4ds.format.fields import FileName
from mp4ds.format.sidecars import FileNames
from mp4ds.options import Selection
from mp4ds.times import cut_times

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


# ---------------------------------------------------------------- selection


@pytest.mark.parametrize(
    ("topics", "exclude", "chosen"),
    [
        ([], [], ["/a/image", "/a/info", "/b", "c"]),
        (["/a/*"], [], ["/a/image", "/a/info"]),
        (["/a/*"], ["*info"], ["/a/image"]),
        (["/c"], [], ["c"]),
        ([], ["/a/*"], ["/b", "c"]),
        (["/[ab]*"], [], ["/a/image", "/a/info", "/b"]),
    ],
)
def test_selections(topics: Sequence[str], exclude: Sequence[str], chosen: list[str]) -> None:
    selected = Selection(topics, exclude)
    assert [t for t in ("/a/image", "/a/info", "/b", "c") if selected(t)] == chosen


# ---------------------------------------------------------------- file names

DEVICES = {"con", "prn", "aux", "nul", *(f"{p}{n}" for p in ("com", "lpt") for n in range(10))}
Topics = (
    st.text(max_size=30)
    | st.lists(
        st.sampled_from(["a", "A", "-2", "-3", "_", ".", "/", "con", "aux.x", "dataset", "..",
                         "messages", "topic", "image_raw", "\u00e4", " ", "\\", ":", ".exact",
                         "x" * 60]),
        max_size=6,
    ).map("".join)
    | st.text("aB", min_size=95, max_size=250)
)  # fmt: skip


def stem_by_the_spec(topic: str, taken: set[str]) -> str:
    """spec/index.md, "File names", in its own order."""
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", topic.strip("/")).strip("._-")
    stem = stem or "topic"
    if len(stem) > 100:
        stem = stem[:83] + "-" + xxhash.xxh64(topic.encode("utf-8")).hexdigest()
    if stem.lower().endswith(".exact"):
        stem += "_"
    if stem.split(".")[0].lower() in DEVICES | {"dataset", "messages"}:
        stem = "topic_" + stem
    name = stem
    for number in range(2, 10**6):
        if name.lower() not in taken:
            break
        name = f"{stem}-{number}"
    taken.add(name.lower())
    return name


@steady
@given(st.lists(Topics, max_size=12))
@example(["a", "A", "a-2", "a", "A-2", "/a/"])
@example(["a-2", "a", "a"])
@example(["con", "topic_con", "CON", "con.x", "/com1", "lpt0.image", "com10"])
@example(["dataset", "messages", "Messages.MCAP", "dataset.yaml"])
@example(["../../etc/passwd", "..", ".", "/", "", "\0", "C:\\x", "~/x", "-rf"])
@example(["x" * 101, "x" * 101 + "y", "X" * 101])
@example(
    ["cam", "cam.exact", "CAM.Exact", "cam.exact_", "x" * 94 + ".exact", ".exact", "con.exact"]
)
def test_names_are_plain_and_never_collide(topics: list[str]) -> None:
    names, taken = FileNames(), set[str]()
    pattern = TypeAdapter(FileName)
    files: set[str] = {"dataset.yaml", "messages.mcap"}
    for topic in topics:
        stem = names.name_for(topic)
        assert stem == stem_by_the_spec(topic, taken)
        assert stem.lower().split(".")[0] not in DEVICES
        for file in (f"{stem}.mp4", f"{stem}.exact.mp4", f"{stem}.yaml"):
            pattern.validate_python(file)
            assert file.casefold() not in files
            files.add(file.casefold())


# ---------------------------------------------------------------- where a recording is cut

TIMES = st.lists(
    st.lists(st.integers(-(2**62), 2**62) | st.integers(0, 50), min_size=1, max_size=80),
    min_size=1,
    max_size=4,
)


@given(TIMES, st.integers(2, 12))
def test_spans_hold_every_time_once_and_few_frames(lists: list[list[int]], frames: int) -> None:
    columns = [np.sort(np.array(times, np.int64)) for times in lists]
    cuts = cut_times(columns, frames)
    assert cuts == sorted(set(cuts))
    assert all(cut > min(map(min, lists)) for cut in cuts)
    for column in columns:
        if len(np.unique(column)) == len(column):
            edges = [0, *np.searchsorted(column, np.array(cuts, np.int64)), len(column)]
            assert max(np.diff(edges)) <= 2.5 * frames
