"""Columns of integers, and the presentation times made from stamps."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from mp4ds.times import (
    INT64_MAX,
    INT64_MIN,
    MAX_GAP_NS,
    TIMESCALE,
    PresentationClock,
    decode_column,
    encode_column,
)

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

Int64 = st.integers(INT64_MIN, INT64_MAX)
# Any integers; those of a clock; those of a counter; few different ones in runs.
Columns = (
    st.lists(Int64, min_size=1, max_size=50)
    | st.lists(st.integers(33_000_000, 34_000_000), min_size=1, max_size=50).map(
        lambda steps: [1_700_000_000_000_000_000 + sum(steps[: i + 1]) for i in range(len(steps))]
    )
    | st.lists(st.tuples(st.integers(-3, 3), st.integers(1, 40)), min_size=1, max_size=6).map(
        lambda runs: [value for value, count in runs for _ in range(count)]
    )
    | st.builds(
        lambda start, step, count: [start + step * i for i in range(count)],
        st.integers(-(2**40), 2**40),
        st.integers(-(2**30), 2**30),
        st.integers(1, 60),
    )
    | st.lists(st.sampled_from([INT64_MIN, -1, 0, 1, INT64_MAX]), min_size=1, max_size=30)
)
# spec/index.md, "Columns"
TOKEN = r"-?[0-9]+(?:\*[0-9]+)?"
VALUES = re.compile(rf"[ \n]*(?:{TOKEN}(?:[ \n]+{TOKEN})*[ \n]*)?")


def decode_by_the_spec(start: int, step: int, text: str) -> list[int]:
    """The spec's words in plain Python: sums modulo 2^64, in two's complement."""
    values = [start]
    for token in text.split():
        residual, _, count = token.partition("*")
        for _ in range(int(count or 1)):
            total = values[-1] + step + int(residual)
            values.append((total + 2**63) % 2**64 - 2**63)
    return values


# ---------------------------------------------------------------- columns


@steady
@given(Columns)
@example([INT64_MIN, INT64_MAX, INT64_MIN])
@example([0, INT64_MIN, 0, INT64_MIN, 5])
@example([0, INT64_MAX, 1, 7, -1])
def test_any_column_returns(values: list[int]) -> None:
    encoded = encode_column(values)
    start, step, text = encoded["start"], encoded["step"], encoded["values"]
    assert type(start) is int
    assert type(step) is int
    assert isinstance(text, str)
    decoded = decode_column(start, step, text, len(values))
    assert decoded.dtype == np.int64
    assert decoded.tolist() == values
    assert decode_by_the_spec(start, step, text) == values


@steady
@given(Columns, st.data())
def test_what_others_write_is_read(values: list[int], data: st.DataObject) -> None:
    """Another step, other runs, other line breaks: the writer is free."""
    step = data.draw(Int64)
    tokens = []
    for before, after in itertools.pairwise(values):
        residual = (after - before - step + 2**63) % 2**64 - 2**63
        tokens.append(f"{residual}*1" if data.draw(st.booleans()) else str(residual))
    if tokens:
        tokens[0] = tokens[0].split("*")[0] + "*1"
    space = st.sampled_from([" ", "\n", "  ", " \n", "\n\n"])
    text = "".join(token + data.draw(space) for token in tokens)
    assert decode_column(values[0], step, text, len(values)).tolist() == values


@pytest.mark.parametrize(
    ("text", "count"),
    [
        *((text, 2) for text in ("x", "1.0", "1e3", "0x1", "+1", "1_0", "1,", "1\t", "1\r\n")),
        *((text, 2) for text in ("\u0661", "1\u00a0", "1\x00", "-", "- 1", "--1", "1-", "1 -")),
        *(
            (text, 2)
            for text in ("*", "1*", "*1", "1*-1", "1* 1", "1 *1", "1**1", "1*0 1", "1*1*1")
        ),
        *((text, 3) for text in ("1-2", "1--2", "1 2 -", "1*1-2")),
        *((text, 2) for text in ("", " ", "1 2", "1*2", "1*1 1", "1 1 1")),
        *((text, 1) for text in ("1", "0*1", "-")),
        *((text, 2) for text in ("9223372036854775808", "-9223372036854775809", "9" * 40)),
        *(
            (text, 2)
            for text in ("9223372036854775808*1", "-9223372036854775809*1", "9" * 40 + "*1")
        ),
        ("9" * 5000 + "*1", 2),
        ("1*" + "9" * 5000, 2),
        ("0*99999999999999999999", 2),
        ("0*9999999999999 0*9999999999999", 3),
    ],
)
def test_bad_columns_are_refused_with_a_reason(text: str, count: int) -> None:
    with pytest.raises(ValueError, match=r"\w+ \w+") as caught:
        decode_column(0, 0, text, count)
    assert len(str(caught.value)) < 200


@steady
@given(st.text(" \n-*0123456789", max_size=12), st.integers(1, 5))
def test_random_text_is_read_by_the_grammar_or_refused(text: str, count: int) -> None:
    try:
        found = decode_column(0, 0, text, count).tolist()
    except ValueError:
        return
    assert VALUES.fullmatch(text)
    assert found == decode_by_the_spec(0, 0, text)
    assert len(found) == count


# ---------------------------------------------------------------- presentation times

Gaps = st.sampled_from(
    [0, 1, 999, 1000, 1001, 33_333_333, 10**9, MAX_GAP_NS - 1, MAX_GAP_NS, MAX_GAP_NS + 1]
) | st.integers(-(10**13), 10**13)


def ticks(stamps: list[int], log_times: list[int]) -> list[int]:
    clock = PresentationClock()
    return [clock.tick(s, t) for s, t in zip(stamps, log_times, strict=True)]


def ticks_by_the_spec(stamps: list[int], log_times: list[int]) -> list[int]:
    found: list[int] = []
    elapsed, tick = 0, -1
    for i in range(len(stamps)):
        if i:
            gap = stamps[i] - stamps[i - 1]
            if not 0 < gap <= 1000 * 10**9:
                gap = min(max(log_times[i] - log_times[i - 1], 0), 1000 * 10**9)
            elapsed += gap
        tick = max(elapsed // 1000, tick + 1)
        elapsed = max(elapsed, tick * 1000)
        found.append(tick)
    return found


@steady
@given(st.lists(st.tuples(Int64, Int64) | st.tuples(Gaps, Gaps), min_size=1, max_size=40))
@example([(0, 0)] * 5)
@example([(5, 5), (4, 4), (3, 3)])
@example([(0, 0), (INT64_MAX, INT64_MAX), (INT64_MIN, INT64_MIN), (INT64_MAX, INT64_MIN)])
def test_ticks_increase_whatever_the_clocks_do(times: list[tuple[int, int]]) -> None:
    stamps, log_times = [s for s, _ in times], [t for _, t in times]
    found = ticks(stamps, log_times)
    assert found[0] == 0
    steps = np.diff(found)
    assert (steps > 0).all()
    # 2,147 s is where FFmpeg's mp4 muxer breaks at this timescale
    assert (steps <= 1000 * TIMESCALE + 1).all()
    assert found == ticks_by_the_spec(stamps, log_times)
