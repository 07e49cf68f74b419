"""Frames of several cameras, matched by their stamps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mp4ds
from mp4ds.times import match, synchronize
from sources import (
    IMAGE,
    START,
    Record,
    Scene,
    image_cdr,
    image_ros1,
    picture,
    write_mcap,
)

STAMPS = st.lists(
    st.one_of(st.integers(0, 12), st.integers(0, 200), st.integers(-(2**63), 2**63 - 1)),
    max_size=14,
)


def ranked(stamps: Sequence[int], kind: int) -> list[tuple[int, int, int, int]]:
    """Stamp, number among the equal ones, topic, frame."""
    return [
        (stamp, list(stamps[:number]).count(stamp), kind, number)
        for number, stamp in enumerate(stamps)
    ]


def one_by_one(reference: Sequence[int], other: Sequence[int], tolerance: int) -> list[int]:
    """As `mp4ds.Sync` says it: neighbours in time, the nearest pair first, then the earlier."""
    line = sorted([*ranked(reference, 0), *ranked(other, 1)])
    pairs = sorted(
        (later[0] - earlier[0], place)
        for place, (earlier, later) in enumerate(pairwise(line))
        if earlier[2] != later[2] and later[0] - earlier[0] <= tolerance
    )
    found, taken = [-1] * len(reference), set()
    for _, place in pairs:
        if not {place, place + 1} & taken:
            taken |= {place, place + 1}
            (_, _, _, frame), (_, _, _, fellow) = sorted(
                line[place : place + 2], key=lambda item: item[2]
            )
            found[frame] = fellow
    return found


@settings(max_examples=600, deadline=None)
@given(
    reference=STAMPS,
    other=STAMPS,
    tolerance=st.one_of(st.integers(0, 5), st.integers(0, 200), st.just(2**70)),
)
def test_any_two_topics(reference: list[int], other: list[int], tolerance: int) -> None:
    found = match(
        np.array(reference, np.int64), np.array(other, np.int64), tolerance_ns=tolerance
    ).tolist()
    assert found == one_by_one(reference, other, tolerance)
    used = [frame for frame in found if frame >= 0]
    assert len(set(used)) == len(used)


@settings(max_examples=200, deadline=None)
@given(
    topics=st.lists(STAMPS, min_size=1, max_size=4),
    chosen=st.one_of(st.none(), st.integers(0, 3)),
    tolerance=st.integers(0, 200),
)
def test_any_topics(topics: list[list[int]], chosen: int | None, tolerance: int) -> None:
    stamps = {f"/{number}": np.array(item, np.int64) for number, item in enumerate(topics)}
    reference = None if chosen is None else f"/{chosen % len(topics)}"
    sync = synchronize(stamps, tolerance_ns=tolerance, reference=reference)
    fewest = min(range(len(topics)), key=lambda number: len(topics[number]))
    assert sync.reference == (reference or f"/{fewest}")
    assert (sync.topics, sync.tolerance_ns) == (tuple(stamps), tolerance)
    own = topics[int(sync.reference[1:])]
    rows = []
    for number, stamp in sorted(enumerate(own), key=lambda pair: (pair[1], pair[0])):
        row = [
            number if f"/{n}" == sync.reference else one_by_one(own, other, tolerance)[number]
            for n, other in enumerate(topics)
        ]
        if -1 not in row:
            rows.append(row)
            assert all(abs(topics[n][i] - stamp) <= tolerance for n, i in enumerate(row))
    assert sync.indices.dtype == sync.stamps.dtype == np.int64
    assert sync.indices.shape == sync.stamps.shape == (len(sync), len(topics))
    assert sync.indices.tolist() == rows
    for column, (topic, times) in enumerate(stamps.items()):
        assert np.array_equal(sync.stamps[:, column], times[sync.indices[:, column]])
        every = [*sync.indices[:, column].tolist(), *sync.unmatched[topic].tolist()]
        assert sorted(every) == list(range(len(times)))
        assert sync.unmatched[topic].tolist() == sorted(sync.unmatched[topic].tolist())


# ---------------------------------------------------------------- datasets


def cameras(**stamps: Sequence[int]) -> Scene:
    """Topics with images whose first pixel is their number."""
    records, rng = [], np.random.default_rng(0)
    for topic, times in stamps.items():
        for number, time in enumerate(times):
            pixels = picture("mono8", frame=number, width=64, height=48, rng=rng)
            pixels[0, 0] = number
            fields: dict[str, Any] = {"width": 64, "height": 48, "encoding": "mono8"}
            fields |= {"data": pixels.tobytes(), "stamp": START + time}
            records.append(
                Record(
                    f"/{topic}/image",
                    IMAGE,
                    START + time,
                    ros1=image_ros1(**fields),
                    cdr=image_cdr(**fields),
                )
            )
    return Scene(sorted(records, key=lambda record: record.log_time))


@pytest.fixture
def three(tmp_path: Path) -> Path:
    made = cameras(
        left=[0, 100, 200, 300, 400, 500],
        right=[3, 104, 150, 299, 401, 700],
        top=[90, 201, 310, 395],
    )
    write_mcap(tmp_path / "drive.mcap", made)
    mp4ds.pack(tmp_path / "drive.mcap", tmp_path / "drive")
    return tmp_path / "drive"


def test_a_dataset(three: Path) -> None:
    with mp4ds.open(three) as dataset:
        sync = dataset.sync(tolerance_ns=10)
        assert sync.topics == ("/left/image", "/right/image", "/top/image")
        assert sync.reference == "/top/image"
        assert sync.indices.tolist() == [[4, 4, 3]]  # right lacks 200, and 310 is 11 from 299
        sync = dataset.sync(tolerance_ns=11)
        assert sync.indices.tolist() == [[3, 3, 2], [4, 4, 3]]
        assert (sync.stamps - START).tolist() == [[300, 299, 310], [400, 401, 395]]
        left = {topic: frames.tolist() for topic, frames in sync.unmatched.items()}
        assert left["/left/image"] == [0, 1, 2, 5]
        assert left["/top/image"] == [0, 1]
        pair = dataset.sync(["/right/image", "left_image"], tolerance_ns=5)
        assert pair.topics == ("/right/image", "left_image")
        assert pair.reference == "/right/image"
        assert pair.indices.tolist() == [[0, 0], [1, 1], [3, 3], [4, 4]]
        for column, topic in enumerate(pair.topics):
            pixels = dataset[topic].read(pair.indices[:, column], format="native")
            assert pixels[:, 0, 0].tolist() == [0, 1, 3, 4]
        assert dataset.sync(["/top/image"], tolerance_ns=0).indices.tolist() == [[0], [1], [2], [3]]
        assert len(dataset.sync(tolerance_ns=0, reference="/left/image")) == 0


@pytest.mark.parametrize(
    ("topics", "options", "problem"),
    [
        (["/none"], {"tolerance_ns": 1}, "no topic '/none'; there are: /left/image, /right"),
        ("/left/image", {"tolerance_ns": 1}, r"such as \['/left/image'\]"),
        ([], {"tolerance_ns": 1}, "no topics"),
        (["/left/image", "/left/image"], {"tolerance_ns": 1}, "twice"),
        (None, {"tolerance_ns": -1}, "-1 ns"),
        (["/left/image"], {"tolerance_ns": 1, "reference": "/top/image"}, "is not one of /left"),
    ],
)
def test_what_cannot_be_matched(topics: Any, options: Any, problem: str, three: Path) -> None:
    with mp4ds.open(three) as dataset, pytest.raises(mp4ds.OptionError, match=problem):
        dataset.sync(topics, **options)
