"""Where a recording is cut, and how topics are grouped: by properties, for any recording."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mp4ds.packing.planning import cut_times, spans_of

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
    spans = spans_of(cuts)
    assert (spans[0][0], spans[-1][1]) == (None, None)
    assert [end for _, end in spans[:-1]] == [start for start, _ in spans[1:]] == cuts
    assert all(cut > min(map(min, lists)) for cut in cuts)
    for column in columns:
        if len(np.unique(column)) == len(column):
            edges = [0, *np.searchsorted(column, np.array(cuts, np.int64)), len(column)]
            assert max(np.diff(edges)) <= 2.5 * frames


def test_a_camera_alone_is_cut_after_so_many_frames() -> None:
    times = np.arange(0, 1000, 10)
    assert cut_times([times], 30) == [300, 600]  # and 40 frames in the last
    assert cut_times([times], 40) == [400, 800]
    assert cut_times([times], 60) == [600]
    assert cut_times([times], 100) == []
    assert cut_times([], 10) == []


def test_another_camera_is_cut_where_the_busiest_rests() -> None:
    busy = np.arange(0, 600, 10)
    late = np.arange(5000, 5800, 10)
    assert cut_times([busy, late[:60]], 30) == [300]
    assert cut_times([late, np.arange(0, 1000, 10)], 30) == [300, 600, 900, 5300, 5600]


def test_a_clock_that_jumps_makes_no_endless_row_of_windows() -> None:
    times = np.concatenate([np.arange(0, 600, 10), 1_700_000_000 * 10**9 + np.arange(0, 600, 10)])
    assert len(cut_times([times], 30)) == 3
