"""What packs tell of their progress: time left by simulated packs, and each way to show it."""

from __future__ import annotations

import dataclasses
import heapq
import io
import itertools
import json
import math
import os
import pty
import random
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from each import each, fresh
from mp4ds.cli.progress import Events, pack_progress, told_by
from mp4ds.cli.progress_live import drawn, live_progress
from mp4ds.cli.progress_log import Lines, Log, duration_text, left_text, percent_text, plain
from mp4ds.cli.standing import JobStanding
from mp4ds.demo import demo
from mp4ds.packing import PackProgress
from waiting import WATCHDOG_S, until

HOUR = 3600.0
HOSTILE = "/cam\x1b[31m\n\r\t\u202e\x00\x9b2J"


def told(
    done: float | None,
    *,
    dataset: str = "drive",
    parts: int = 240,
    before: int = 0,
    gigabytes: float = 50.0,
    cameras: int = 2,
    **values: Any,
) -> PackProgress:
    """What a pack tells that has done so much."""
    share = done or 0.0
    made = PackProgress(
        dataset=Path("/data") / dataset,
        phase="packing",
        done=done,
        bytes_read=int(gigabytes * 1e9 * share),
        bytes_total=int(gigabytes * 1e9),
        bytes_written=int(gigabytes * 1e8 * share),
        topics={f"/cam{n}": (int(36_000 * share), 36_000) for n in range(cameras)},
        tasks_done=max(before, int(parts * share)),
        tasks_total=parts,
        tasks_before=before,
    )
    return dataclasses.replace(made, **values)


@dataclasses.dataclass
class Clock:
    """Time that passes only when told to."""

    seconds: float = 1000.0
    start: datetime = datetime(2024, 5, 1, 12, 0, 0, tzinfo=timezone.utc)

    def __call__(self) -> float:
        return self.seconds

    def now(self) -> datetime:
        return self.start + timedelta(seconds=self.seconds - 1000.0)


# ---------------------------------------------------------------- time left

Work = Callable[[float], float]  # share done after so many seconds


def estimates(
    work: Work, seconds: float, *, step: float = 0.5, before: int = 0
) -> list[tuple[float, float]]:
    """Time and time left, wherever one was told, of a pack that ends after so many seconds."""
    job = JobStanding()
    found = []
    steps = int(seconds / step)
    stride = max(1, steps // 8000)
    for n in range(0, steps, stride):
        now = n * step
        job.take(told(work(now), before=before), now)
        left = job.seconds_left(now)
        if left is not None:
            assert left >= 0
            found.append((now, left))
    return found


def joining_seconds(gigabytes: float = 50.0) -> float:
    """What joining the parts of `told` is taken to last."""
    return gigabytes * 1e8 / 200e6


def worst(found: list[tuple[float, float]], end: float, *, after: float = 0.0) -> float:
    """The largest factor between what was told and what was true, beyond half a minute."""
    slack = 30.0
    factors = []
    for now, left in found:
        if now >= after:
            true, said = end - now + joining_seconds() + slack, left + slack
            factors.append(max(true / said, said / true))
    assert factors
    return max(factors)


def jittered(work: Work, size: float) -> Work:
    """Work that advances by fits and starts of up to so many seconds."""
    chance = random.Random(7)
    level = 0.0

    def told_late(now: float) -> float:
        nonlocal level
        level = max(level, work(max(0.0, now - chance.uniform(0, size))))
        return level

    return told_late


@each("seconds", [60.0, 600.0, HOUR, 10 * HOUR, 100 * HOUR])
@each("jitter", [0.0, 3.0])
def test_a_constant_pace_is_told_right_from_the_beginning(seconds: float, jitter: float) -> None:
    found = estimates(jittered(lambda now: now / seconds, jitter), seconds)
    assert found[0][0] <= max(12.0, 0.001 * seconds)
    assert found[0][0] >= 3.0
    assert worst(found, seconds) < (1.05 if not jitter else 1.25)


@pytest.mark.parametrize("seconds", [600.0, HOUR, 10 * HOUR])
def test_half_the_pace_is_told_after_a_minute_or_two_percent(seconds: float) -> None:
    half = seconds / 3  # half of the work in a third of the time

    def work(now: float) -> float:
        return now / half / 2 if now < half else 0.5 + (now - half) / half / 4

    found = estimates(work, seconds)
    adapted = half + max(60.0, 0.02 * 4 * half) + 30
    assert worst(found, seconds, after=adapted) < 1.1
    # before, nothing could know of it
    early = [(now, left) for now, left in found if now < half]
    assert worst(early, 2 * half) < 1.05


@each("seconds", [1200.0, 10 * HOUR])
@each("factor", [0.1, 3.0])
def test_any_change_of_pace_is_followed(seconds: float, factor: float) -> None:
    first = 0.4 * seconds
    end = first + 0.6 * seconds / factor

    def work(now: float) -> float:
        return (now if now < first else first + factor * (now - first)) / seconds

    found = estimates(work, end)
    adapted = first + max(60.0, 0.02 * seconds / factor) + 60
    assert worst(found, end, after=adapted) < 1.1


def test_what_an_earlier_run_did_does_not_count() -> None:
    seconds = 2 * HOUR
    found = estimates(lambda now: 0.8 + 0.2 * now / seconds, seconds, before=192)
    assert found[0][0] >= 3
    assert worst(found, seconds) < 1.05


def test_what_an_earlier_run_did_does_not_count_where_it_is_told_bit_by_bit() -> None:
    seconds, job = 2 * HOUR, JobStanding()
    for n in range(1, 193):
        job.take(told(n / 240, before=n), n / 1000)
        assert job.seconds_left(n / 1000) is None
    found = []
    for n in range(1, int(2 * seconds)):
        now = n * 0.5
        job.take(told(0.8 + 0.2 * now / seconds, before=192), now)
        if (left := job.seconds_left(now)) is not None:
            found.append((now, left))
    assert worst(found, seconds) < 1.05


def test_nothing_is_told_where_an_earlier_run_did_all_but_joining() -> None:
    job = JobStanding()
    job.take(told(1.0, before=240), 0.0)
    assert job.seconds_left(0.0) == pytest.approx(joining_seconds())


@each("seconds", [600.0, pytest.param(10 * HOUR, marks=pytest.mark.slow)])
@each("heard", [False, True], ids=["silent", "told-again"])
def test_a_stall_makes_the_time_left_grow(seconds: float, heard: bool) -> None:
    job, begin, stall = JobStanding(), seconds / 2, 300.0
    for n in range(int(begin * 2)):
        job.take(told(n / 2 / seconds), n / 2)
    before = job.seconds_left(begin)
    assert before is not None
    lefts = []
    for n in range(5, int(stall), 5):
        now = begin + n
        if heard:
            job.take(told((begin - 0.5) / seconds), now)
        lefts.append(job.seconds_left(now))
    assert None not in lefts
    grown: list[float] = [left for left in lefts if left is not None]
    assert grown[0] > before
    assert all(b - a > 1 for a, b in itertools.pairwise(grown))
    # as much as the window of a minute, or of 2 % of the work, tells
    window = max(60.0, 0.02 * seconds)
    expected = (before - joining_seconds()) * (window + stall) / window + joining_seconds()
    assert grown[-1] == pytest.approx(expected, rel=0.1)
    # it goes on, and the stall is forgotten
    found = []
    for n in range(int(begin * 2)):
        now = begin + stall + n / 2
        job.take(told((begin + n / 2) / seconds), now)
        if (left := job.seconds_left(now)) is not None:
            found.append((now, left))
    forgotten = begin + stall + max(2 * stall, window) + 10
    if forgotten < seconds + stall:
        assert worst(found, seconds + stall, after=forgotten) < 1.05


@each("spread", [0.0, 0.1, 0.3, 0.6])
def test_work_told_in_large_steps_is_no_reason_for_wild_estimates(spread: float) -> None:
    """Many machines begin their parts at once, and tell of them at their end alone."""
    chance, machines, lasting, parts = random.Random(3), 50, 600.0, 500
    free, ends = [0.0] * machines, []
    for _ in range(parts):
        ends.append(heapq.heappop(free) + lasting * chance.uniform(1 - spread, 1 + spread))
        heapq.heappush(free, ends[-1])
    ends.sort()
    job, done, found = JobStanding(), 0, []
    job.take(told(0.0, parts=parts), 0.0)
    for now in range(0, int(ends[-1] - lasting), 5):
        while ends[done] <= now:
            done += 1
            job.take(told(done / parts, parts=parts, tasks_done=done), float(now))
        if (left := job.seconds_left(now)) is not None:
            found.append((float(now), left))
    assert worst(found, ends[-1], after=lasting * (1 + spread)) < 3.5


def test_a_part_that_is_begun_again_does_not_confuse_it() -> None:
    job, seconds = JobStanding(), 3600.0
    found = []
    lost = 0.01
    for n in range(7200 + 72):
        now = n / 2
        job.take(told(now / seconds - (lost if now > 1800 else 0)), now)
        left = job.seconds_left(now)
        assert left is None or left >= 0
        if left is not None:
            found.append((now, left))
    assert worst(found, 3636.0) < 2.1
    assert worst(found, 3636.0, after=1960) < 1.05


def test_parts_that_failed_are_no_work_to_be_done() -> None:
    job = JobStanding()
    for n in range(901):
        done = min(0.9, n / 1000)
        job.take(told(done, failed=int(24 * n / 900), tasks_done=int(240 * done)), float(n))
    left = job.seconds_left(900.0)
    assert left is not None
    assert left < 1 + joining_seconds() * 240 / 216


@pytest.mark.parametrize(
    "state",
    [
        told(None, parts=0),
        told(0.5, phase="planning"),
        told(None, phase="planning", parts=0),
    ],
    ids=["nothing-tells", "planning", "planning-unknown"],
)
def test_nothing_is_told_that_is_not_known(state: PackProgress) -> None:
    job = JobStanding()
    for n in range(100):
        job.take(state, float(n))
        assert job.seconds_left(float(n)) is None
    assert job.share in (None, 0.0)


def test_planning_is_no_work_of_packing() -> None:
    job = JobStanding()
    for n in range(600):
        job.take(told(n / 600, phase="planning", parts=0, bytes_written=0), float(n))
    assert job.share == 0.0
    found = []
    for n in range(600, 1600):
        job.take(told((n - 600) / 1000), float(n))
        if (left := job.seconds_left(n)) is not None:
            found.append((float(n), left))
    assert worst(found, 1600.0) < 1.05


def test_no_time_left_is_told_of_a_share_of_a_job() -> None:
    job = JobStanding(whole=False)
    for n in range(100):
        job.take(told(n / 200), float(n))
    assert job.seconds_left(100.0) is None
    assert job.share == 99 / 200


def test_parts_tell_where_the_work_does_not() -> None:
    job = JobStanding()
    for n in range(120):
        job.take(told(None, tasks_done=n), 10.0 * n)
    assert job.share == 119 / 240
    left = job.seconds_left(1190.0)
    assert left == pytest.approx(1210, rel=0.05)


# ---------------------------------------------------------------- joining


def test_joining_is_estimated_from_bytes() -> None:
    job = JobStanding()
    for n in range(1000):
        job.take(told(n / 1000, gigabytes=400), float(n))
    joining = joining_seconds(400)
    assert job.seconds_left(999.0) == pytest.approx(1 + joining, abs=3)
    for n in range(int(joining)):
        job.take(told(1.0, gigabytes=400, phase="joining", note="cam.mp4"), 1000.0 + n)
        assert job.seconds_left(1000.0 + n) == pytest.approx(joining - n)
    # it takes longer: better nothing than a wrong time
    assert job.seconds_left(1000.0 + joining + 1) is None


def test_joining_that_tells_how_far_it_is_is_believed() -> None:
    job, lasting = JobStanding(), 900.0
    job.take(told(1.0, before=240), 0.0)
    for n in range(900):
        job.take(told(n / lasting, phase="joining", before=240), float(n))
        if n > 30:
            assert job.seconds_left(float(n)) == pytest.approx(lasting - n, rel=0.05, abs=2)


# ---------------------------------------------------------------- several datasets


def test_datasets_packed_side_by_side_count_together() -> None:
    """Of different sizes, one after the other, two at a time, with joins between."""
    sizes = {"a": 20.0, "b": 80.0, "c": 50.0, "d": 10.0, "e": 60.0}
    speed, join_rate = 0.1, 100e6  # GB/s of all; joins half as fast as is taken for granted
    job, now = JobStanding(), 0.0
    done = dict.fromkeys(sizes, 0.0)
    finished: set[str] = set()
    found: list[tuple[float, float]] = []
    for name, size in sizes.items():
        job.take(told(0.0, dataset=name, gigabytes=size), now)
    while len(finished) < len(sizes):
        at_work = [name for name in sizes if done[name] < 1][:2]
        now += 0.5
        for name in at_work:
            done[name] = min(1.0, done[name] + 0.5 * speed / len(at_work) / sizes[name])
            job.take(told(done[name], dataset=name, gigabytes=sizes[name]), now)
        for name in [name for name in sizes if done[name] >= 1 and name not in finished]:
            lasting = sizes[name] * 1e8 / join_rate
            for _ in range(int(2 * lasting)):
                job.take(told(1.0, dataset=name, gigabytes=sizes[name], phase="joining"), now)
                now += 0.5
            finished.add(name)
        if (left := job.seconds_left(now)) is not None:
            found.append((now, left))
    assert found[0][0] < 12
    factors = [(now - t + 30) / (left + 30) for t, left in found]
    assert max(max(factors), 1 / min(factors)) < 1.35


def test_a_join_is_no_stall_of_the_others() -> None:
    job = JobStanding()
    for n in range(1000):
        job.take(told(n / 1000, dataset="a"), float(n))
        job.take(told(n / 2000, dataset="b"), float(n))
    before = job.seconds_left(999.0)
    for n in range(100):
        job.take(told(1.0, dataset="a", phase="joining"), 1000.0 + n)
    job.take(told(0.5005, dataset="b"), 1100.0)
    after = job.seconds_left(1100.0)
    assert before is not None
    assert after is not None
    assert after < before + 60


# ---------------------------------------------------------------- anything at all


@st.composite
def jobs(draw: st.DrawFn) -> list[tuple[float, PackProgress]]:
    """Reports in any order, true or not."""
    now, found = 0.0, []
    for _ in range(draw(st.integers(1, 40))):
        now += draw(st.floats(0, 2000))
        share = draw(st.none() | st.floats(0, 1))
        state = told(
            share,
            dataset=draw(st.sampled_from(["a", "b", HOSTILE])),
            phase=draw(st.sampled_from(["planning", "packing", "packing", "joining"])),
            parts=draw(st.integers(0, 300)),
            before=draw(st.integers(0, 300)),
            gigabytes=draw(st.sampled_from([0.0, 1e-9, 1.0, 1e6])),
            cameras=draw(st.integers(0, 60)),
            failed=draw(st.integers(0, 300)),
            note=draw(st.text(max_size=30)),
        )
        names = draw(st.lists(st.text(max_size=80), max_size=3))
        topics = {**state.topics, **{name: (draw(st.integers(0, 9)), None) for name in names}}
        found.append((now, dataclasses.replace(state, topics=topics)))
    return found


@settings(max_examples=100, deadline=None)
@given(jobs(), st.integers(20, 200), st.integers(1, 60))
def test_whatever_is_told_nothing_silly_is_shown(
    reports: list[tuple[float, PackProgress]], width: int, height: int
) -> None:
    clock, log, events = Clock(0.0), io.StringIO(), io.StringIO()
    job = JobStanding()
    tellers = (
        Log(JobStanding(), Lines(log), clock=clock, now=clock.now),
        Events(JobStanding(), Lines(events), clock=clock, now=clock.now),
    )
    for now, state in reports:
        clock.seconds = now
        job.take(state, now)
        for teller in tellers:
            teller.take(state)
        left, share = job.seconds_left(now), job.share
        assert left is None or (left >= 0 and math.isfinite(left))
        assert share is None or 0 <= share <= 1
        looks_right(picture(job, width, height, now), width, height)
    for teller in tellers:
        teller.end("done")
    for line in log.getvalue().splitlines():
        assert re.fullmatch(r"\d\d:\d\d:\d\d packing [ -~]+", line)
    parsed(events.getvalue())


# ---------------------------------------------------------------- log files


def logged(work: Work, seconds: float, *, outcome: str = "done", step: float = 0.5) -> list[str]:
    """The lines of a pack."""
    clock, stream = Clock(), io.StringIO()
    log = Log(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(int(seconds / step) + 1):
        clock.seconds = 1000.0 + n * step
        log.take(told(work(n * step)))
    log.end(outcome)
    return stream.getvalue().splitlines()


def test_a_short_pack_logs_nothing() -> None:
    assert logged(lambda now: now / 9.9, 9.9) == []
    assert logged(lambda now: now / 9.9, 9.9, outcome="failed") == []


def test_the_log_of_a_pack() -> None:
    lines = logged(lambda now: now / 300, 300)
    assert lines[0] == "12:00:00 packing drive: started 2024-05-01 | 50.0 GB to pack"
    assert lines[1] == (
        "12:00:10 packing drive: 3 % | parts 8/240 | /cam0 1200/36000 120 Hz, "
        "/cam1 1200/36000 120 Hz | 1.7 GB -> 166.7 MB | 5 min left"
    )
    assert lines[-1] == (
        "12:05:00 packing drive: done after 5 min | parts 240/240 | 50.0 GB -> 5.0 GB"
    )
    shares = [int(re.findall(r": (\d+) % ", line)[0]) for line in lines[1:-1]]
    assert all(b - a in (5, 6) for a, b in itertools.pairwise(shares))


@pytest.mark.parametrize("outcome", ["done", "failed", "interrupted"])
def test_the_last_line_tells_how_it_ended(outcome: str) -> None:
    assert (
        f" packing drive: {outcome} after 60 s | "
        in logged(lambda n: n / 200, 60, outcome=outcome)[-1]
    )


def test_the_lines_of_a_long_pack_become_rare() -> None:
    lines = logged(lambda now: now / (60 * HOUR), 60 * HOUR, step=5.0)
    times = []
    day, last = 0, -1.0
    for line in lines[1:]:
        hours, minutes, seconds = map(int, line[:8].split(":"))
        at = day * 86_400 + hours * 3600 + minutes * 60 + seconds
        if at < last:
            day, at = day + 1, at + 86_400
        times.append(at - 12 * HOUR)
        last = at
    gaps = [b - a for a, b in itertools.pairwise(times)]
    assert times[0] == 10
    assert gaps[0] == 60
    assert max(gaps) == 600
    assert all(b >= a for a, b in itertools.pairwise(gaps[:50]))
    assert len(lines) < 500
    assert re.search(r"\| 2 d 1\d h left$|\| \d+ h \d+ min left$", lines[40])


def test_a_resumed_pack_tells_what_was_done_before() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(100):
        clock.seconds = 1000.0 + n
        log.take(told(0.8 + n / 10_000, before=192))
    assert "192 parts were done before" in stream.getvalue().splitlines()[0]


def test_silence_is_logged_too() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(100):
        clock.seconds = 1000.0 + n
        log.take(told(n / 1000))
    for n in range(100, 700):
        clock.seconds = 1000.0 + n
        log.tick()
    lines = stream.getvalue().splitlines()
    assert len(lines) >= 12
    assert lines[2].endswith(" | 16 min left")
    assert re.search(r"/cam0 3564/36000 \d.\d Hz.* 2 h \d+ min left$", lines[-1])


def test_the_log_of_several_datasets() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for name in ("a", "b", "c"):
        log.take(told(0.0, dataset=name))
    for n in range(1, 100):
        clock.seconds = 1000.0 + n
        log.take(told(n / 100, dataset="a"))
        log.take(told(n / 200, dataset="b", failed=1))
    log.take(told(1.0, dataset="a", phase="joining", note="cam0.mp4"))
    clock.seconds += 70
    log.tick()
    lines = stream.getvalue().splitlines()
    assert re.fullmatch(
        r"12:00:10 packing 3 datasets: 4 % \| parts 34/720, 1 failed \| a 10 %, b 4 % \| "
        r"7.2 GB -> 725.0 MB \| \d+ min left",
        lines[1],
    )
    assert "a joining cam0.mp4, b 49 %" in lines[-1]


def test_hostile_names_reach_no_log() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    topics = {HOSTILE + "\udcff" + str(n) + "x" * n: (n, None) for n in range(1000)}
    for n in range(20):
        clock.seconds = 1000.0 + n
        log.take(told(0.1, dataset=HOSTILE, topics=topics, note=HOSTILE))
    lines = stream.getvalue().splitlines()
    assert len(lines) == 2
    assert all(re.fullmatch(r"[ -~]{1,4000}", line) for line in lines)
    assert "and 980 more" in lines[1]


def test_lines_are_written_at_once() -> None:
    stream = io.TextIOWrapper(raw := io.BytesIO(), encoding="ascii", write_through=False)
    Lines(stream).write("one")
    assert raw.getvalue() == b"one\n"


class _Broken(io.StringIO):
    writes = 0

    def write(self, text: str) -> int:
        self.writes += 1
        raise BrokenPipeError


def test_a_pack_does_not_fail_for_want_of_a_log() -> None:
    stream = _Broken()
    lines = Lines(stream)
    lines.write("one")
    lines.write("two")
    assert stream.writes == 1
    closed = io.StringIO()
    closed.close()
    Lines(closed).write("one")


@each(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (99.4, "99 s"),
        (100, "2 min"),
        (3569, "59 min"),
        (3571, "1 h 0 min"),
        (4320, "1 h 12 min"),
        (47 * HOUR, "47 h 0 min"),
        (51 * HOUR, "2 d 3 h"),
        (1e9, "11574 d 2 h"),
    ],
)
def test_durations(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text
    assert left_text(seconds) == (f"{text} left" if seconds else "")


@each(("share", "text"), [(None, ""), (0, "0 %"), (0.29, "29 %"), (0.9999, "99 %"), (1, "100 %")])
def test_percents(share: float | None, text: str) -> None:
    assert percent_text(share) == text


def test_long_names_keep_their_end() -> None:
    assert plain("/robot" * 20 + "/front") == "..." + ("/robot" * 20 + "/front")[-57:]
    assert plain("/caméra") == "/cam\\xe9ra"


# ---------------------------------------------------------------- --json

KEYS: dict[str, dict[str, Any]] = {
    "start": {"dataset": str},
    "progress": {
        "dataset": str,
        "phase": str,
        "note": str,
        "done": (float, type(None)),
        "job_done": (float, type(None)),
        "tasks_done": int,
        "tasks_total": int,
        "tasks_before": int,
        "failed": int,
        "bytes_read": int,
        "bytes_total": int,
        "bytes_written": int,
        "topics": dict,
        "seconds_left": (float, type(None)),
    },
    "end": {"outcome": str, "seconds": float},
}


def parsed(text: str) -> list[dict[str, Any]]:
    """Events, each as the schema has it."""

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is no JSON")

    assert text.isascii()
    found = [json.loads(line, parse_constant=refuse) for line in text.splitlines()]
    for event in found:
        keys = KEYS[event["event"]]
        assert set(event) == {"event", "time", *keys}
        assert all(isinstance(event[key], kind) for key, kind in keys.items()), event
        assert datetime.fromisoformat(event["time"]).utcoffset() == timedelta(0)
        for topic in event.get("topics", {}).values():
            assert set(topic) == {"done", "total", "hz"}
    kinds = [event["event"] for event in found]
    if found:
        assert kinds[0] == "start"
        assert kinds[-1] == "end"
        assert set(kinds[1:-1]) == {"progress"}
    return found


def test_the_events_of_a_pack() -> None:
    clock, stream = Clock(), io.StringIO()
    events = Events(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(1001):
        clock.seconds = 1000.0 + n / 10
        events.take(told(n / 1000, note=HOSTILE))
    events.end("done")
    found = parsed(stream.getvalue())
    assert len(found) == 1 + 101 + 1
    assert found[51] == {
        "event": "progress",
        "time": "2024-05-01T12:00:50.000+00:00",
        "dataset": "/data/drive",
        "phase": "packing",
        "note": HOSTILE,
        "done": 0.5,
        "job_done": 0.5,
        "tasks_done": 120,
        "tasks_total": 240,
        "tasks_before": 0,
        "failed": 0,
        "bytes_read": 25_000_000_000,
        "bytes_total": 50_000_000_000,
        "bytes_written": 2_500_000_000,
        "topics": {f"/cam{n}": {"done": 18_000, "total": 36_000, "hz": 360.0} for n in range(2)},
        "seconds_left": pytest.approx(75.0, abs=1),
    }
    assert found[-2]["done"] == 1.0
    assert found[-1]["seconds"] == 100.0


def test_the_last_event_is_not_lost_and_none_is_told_twice() -> None:
    clock, stream = Clock(), io.StringIO()
    events = Events(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(5):
        clock.seconds = 1000.0 + n / 10
        events.take(told(n / 4))
    events.end("done")
    assert [event.get("done") for event in parsed(stream.getvalue())] == [None, 0.0, 1.0, None]


def test_each_dataset_is_told_of_once_a_second() -> None:
    clock, stream = Clock(), io.StringIO()
    events = Events(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(81):
        clock.seconds = 1000.0 + n / 8
        for name in ("a", "b"):
            events.take(told(n / 80, dataset=name))
            events.tick()
    events.end("interrupted")
    found = parsed(stream.getvalue())[1:-1]
    for name in ("a", "b"):
        own = [event for event in found if event["dataset"].endswith(name)]
        times = [datetime.fromisoformat(event["time"]).timestamp() for event in own]
        assert 11 <= len(own) <= 12
        assert min(b - a for a, b in itertools.pairwise(times[:-1])) >= 1  # and a last one
        assert own[-1]["done"] == 1.0


def test_silence_is_told_of_and_the_time_left_grows() -> None:
    clock, stream = Clock(), io.StringIO()
    events = Events(JobStanding(), Lines(stream), clock=clock, now=clock.now)
    for n in range(100):
        clock.seconds = 1000.0 + n
        events.take(told(n / 1000))
    for n in range(100, 200):
        clock.seconds = 1000.0 + n
        events.tick()
    events.end("failed")
    found = parsed(stream.getvalue())
    silent = [event["seconds_left"] for event in found[101:-1]]
    assert len(silent) == 10
    assert all(b > a for a, b in itertools.pairwise(silent))
    assert found[-1]["outcome"] == "failed"


def test_a_pack_that_does_not_begin_has_no_events() -> None:
    stream = io.StringIO()
    events = Events(JobStanding(), Lines(stream))
    events.tick()
    events.end("failed")
    assert stream.getvalue() == ""


# ---------------------------------------------------------------- while a pack runs


class _Counting:
    def __init__(self) -> None:
        self.calls: list[str] = []
        self.ticked = threading.Event()

    def take(self, state: PackProgress) -> None:
        self.calls.append("take")

    def tick(self) -> None:
        self.calls.append("tick")
        self.ticked.set()

    def end(self, outcome: str) -> None:
        self.calls.append(outcome)


@each(
    ("error", "outcome"),
    [
        (None, "done"),
        (ValueError, "failed"),
        (MemoryError, "failed"),
        (KeyboardInterrupt, "interrupted"),
        (SystemExit, "interrupted"),
    ],
)
def test_the_end_is_told_however_it_comes(error: type[BaseException] | None, outcome: str) -> None:
    teller, threads = _Counting(), threading.active_count()
    with (
        suppress(ValueError, MemoryError, KeyboardInterrupt, SystemExit),
        told_by(teller, tick_seconds=0.01) as take,
    ):
        take(told(0.5))
        assert teller.ticked.wait(WATCHDOG_S)
        if error is not None:
            raise error
    assert teller.calls[0] == "take"
    assert teller.calls[-1] == outcome
    assert set(teller.calls[1:-1]) == {"tick"}
    assert threading.active_count() == threads


@pytest.mark.parametrize("as_json", [False, True])
def test_a_short_pack_without_a_terminal(as_json: bool, capsys: pytest.CaptureFixture[str]) -> None:
    with pack_progress(as_json) as take:
        take(told(0.0))
        take(told(1.0))
    out, err = capsys.readouterr()
    assert out == ""
    found = parsed(err)
    assert [event["event"] for event in found] == ["start", "progress", "progress", "end"] * as_json


@pytest.mark.parametrize("kind", ["log", "events", "terminal"])
def test_telling_costs_less_than_a_percent(kind: str) -> None:
    """Of one core, at ten reports a second."""
    clock, count, stream = Clock(), 2000, io.StringIO()
    job = JobStanding()
    take: Callable[[PackProgress], None] = {
        "log": Log(job, Lines(stream), clock=clock, now=clock.now).take,
        "events": Events(job, Lines(stream), clock=clock, now=clock.now).take,
        "terminal": lambda state: job.take(state, clock()),
    }[kind]
    states = [told(n / count, cameras=14) for n in range(count)]
    begun = time.thread_time()
    for n, state in enumerate(states):
        clock.seconds = n / 10
        take(state)
        if kind == "terminal" and n % 5 == 0:  # drawn twice a second
            picture(job, 120, 40, clock())
    spent = time.thread_time() - begun
    assert spent < 0.01 * count / 10


def test_rich_is_imported_for_terminals_only() -> None:
    program = (
        "import sys, mp4ds.cli.progress as p\n"
        "with p.pack_progress(False) as take, p.pack_progress(True): pass\n"
        "print([name for name in sys.modules if name.split('.')[0] == 'rich'])"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert (result.stdout, result.stderr) == ("[]\n", "")


# ---------------------------------------------------------------- terminals


def picture(job: JobStanding, width: int, height: int, now: float) -> list[str]:
    """The lines that a terminal shows."""
    stream = io.StringIO()
    console = Console(
        file=stream,
        force_terminal=True,
        color_system=None,
        width=width,
        height=height,
        legacy_windows=False,
        _environ={},
    )
    console.print(drawn(job, width, height, now))
    return stream.getvalue().splitlines()


def looks_right(lines: list[str], width: int, height: int) -> None:
    """It fits, and steers nothing."""
    assert len(lines) <= max(2, height - 1)
    for line in lines:
        assert line.isprintable()
        assert cell_len(line) <= width


@fresh
def drive() -> JobStanding:
    """A pack with 14 cameras at 30 %."""
    job = JobStanding()
    for n in range(301):
        job.take(told(n / 1000, cameras=14), float(n))
    return job


def test_a_terminal_shows_all_and_each_topic(drive: JobStanding) -> None:
    lines = picture(drive, 120, 24, 300.0)
    looks_right(lines, 120, 24)
    assert len(lines) == 15
    assert re.fullmatch(
        r"packing \S+ +30 % parts 72/240  15.0 GB -> 1.5 GB  50.0 MB/s 12 min left *", lines[0]
    )
    for n, line in enumerate(lines[1:]):
        assert re.fullmatch(rf"  /cam{n} +10800/36000 +36 Hz", line)


@pytest.mark.parametrize("width", [40, 80])
def test_a_narrow_terminal_has_two_lines_of_all(drive: JobStanding, width: int) -> None:
    lines = picture(drive, width, 24, 300.0)
    looks_right(lines, width, 24)
    assert len(lines) == 16
    assert re.fullmatch(r"packing .* 30 % 12 min left *", lines[0])
    assert lines[1].startswith("  parts 72/240  15.0 GB")


@each("height", range(1, 24))
def test_a_low_terminal_summarizes_topics(drive: JobStanding, height: int) -> None:
    lines = picture(drive, 120, height, 300.0)
    looks_right(lines, 120, height)
    if 3 <= height < 16:
        hidden = 14 - (height - 3)
        rest = rf"  and {hidden} more topics +{hidden * 10800}/{hidden * 36000} *"
        assert re.fullmatch(rest, lines[-1])


def test_a_terminal_shows_the_datasets_in_work() -> None:
    job = JobStanding()
    for name in ("a", "b", "c", "d"):
        job.take(told(0.0, dataset=name), 0.0)
    for n in range(1, 101):
        job.take(told(n / 100, dataset="a"), float(n))
        job.take(told(n / 200, dataset="b"), float(n))
    job.take(told(1.0, dataset="a", phase="joining", note="cam0.mp4"), 100.0)
    lines = picture(job, 140, 24, 101.0)
    assert re.fullmatch(
        r"packing 0/4 datasets, joining cam0.mp4 \S+ +37 % parts 360/960  .* left *", lines[0]
    )
    assert re.match(r"  a +joining cam0.mp4  parts 240/240  50.0 GB -> 5.0 GB", lines[1])
    assert re.match(r"  b +50 %  parts 120/240  25.0 GB -> 2.5 GB  2\d\d.\d MB/s", lines[2])
    assert len(lines) == 3
    job.take(told(0.6, dataset="b"), 120.0)
    lines = picture(job, 140, 24, 120.0)
    assert lines[0].startswith("packing 1/4 datasets ")
    assert len(lines) == 2


def test_a_low_terminal_summarizes_datasets() -> None:
    job = JobStanding()
    for n in range(50):
        job.take(told(0.1, dataset=f"drive{n}"), 0.0)
    lines = picture(job, 120, 10, 1.0)
    looks_right(lines, 120, 10)
    assert lines[-1].strip() == "and 43 more in work"


def test_joining_is_shown_with_its_file() -> None:
    job = JobStanding()
    job.take(told(1.0, phase="joining", note="cam0.mp4"), 0.0)
    assert picture(job, 120, 24, 1.0)[0].startswith("joining cam0.mp4 ")
    job.take(told(0.25, phase="joining", note="cam1.mp4"), 0.0)
    assert " 25 % " in picture(job, 120, 24, 1.0)[0]


def test_a_terminal_shows_hostile_names_harmlessly() -> None:
    job = JobStanding()
    topics = {HOSTILE: (1, None), "[red]/[/red]": (2, 3), "漢字" * 60: (3, 4)}
    job.take(told(0.5, topics=topics, phase="joining", note=HOSTILE), 0.0)
    lines = picture(job, 80, 24, 1.0)
    looks_right(lines, 80, 24)
    assert any("[red]/[/red]" in line for line in lines)


@pytest.fixture
def terminal() -> Iterator[tuple[int, Any]]:
    """The two ends of a terminal: what is shown, and where to write."""
    shown_at, write_to = pty.openpty()
    with os.fdopen(write_to, "w") as stream:
        yield shown_at, stream
    os.close(shown_at)


def test_a_live_terminal(terminal: tuple[int, Any]) -> None:
    shown_at, stream = terminal
    console = Console(file=stream, width=100, height=24, _environ={"TERM": "xterm"})
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(_until(shown_at, b"/cam1")), daemon=True)
    reader.start()
    threads = threading.active_count()
    with live_progress(JobStanding(), console) as take:
        for n in range(10):
            take(told(n / 10))
            time.sleep(0.01)
        reader.join(WATCHDOG_S)
    until(lambda: threading.active_count() < threads)
    text = b"".join(read).decode()
    assert "packing" in text
    assert "/cam0" in text


def _until(file: int, word: bytes) -> bytes:
    found = b""
    while word not in found:
        found += os.read(file, 4096)
    return found


# ---------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two short recordings; not to be changed."""
    folder = tmp_path_factory.mktemp("drives")
    for name, seconds in (("day", 1.0), ("night", 0.6)):
        demo(folder / f"{name}.bag", seconds=seconds)
    return [folder / "day.bag", folder / "night.bag"]


def command(*arguments: object) -> list[str]:
    """Packing quickly, in parts."""
    quick = ("--quality", "crf=40", "--codec", "h264", "--preset", "ultrafast")
    return [sys.executable, "-m", "mp4ds", "pack", *map(str, arguments), *quick, "--gop", "4"]


def test_events_of_the_command(drives: list[Path], tmp_path: Path) -> None:
    result = subprocess.run(
        command(*drives, "--output", f"{tmp_path}/", "--window", "4", "--json"),
        capture_output=True,
        text=True,
        check=True,
    )
    assert [Path(made["dataset"]).name for made in json.loads(result.stdout)] == ["day", "night"]
    found = parsed(result.stderr)
    assert found[-1]["outcome"] == "done"
    reports = found[1:-1]
    shares = [event["job_done"] for event in reports]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    # both are known from the beginning, so that the share is of both
    assert {event["dataset"] for event in reports[:2]} == {
        str(tmp_path / "day"),
        str(tmp_path / "night"),
    }
    for name, frames in (("day", 15), ("night", 9)):
        last = [event for event in reports if Path(event["dataset"]).name == name][-1]
        assert last["tasks_done"] == last["tasks_total"] > 1
        counts = [(topic["done"], topic["total"]) for topic in last["topics"].values()]
        assert counts == [(frames, frames)] * 2


def test_events_of_a_pack_in_one_go(drives: list[Path], tmp_path: Path) -> None:
    result = subprocess.run(
        command(drives[0], "--output", tmp_path / "x", "--json"),
        capture_output=True,
        text=True,
        check=True,
    )
    found = parsed(result.stderr)
    assert found[-2]["done"] == found[-2]["job_done"] == 1.0
    assert found[-2]["tasks_total"] == 0


@pytest.mark.parametrize("term", ["xterm", pytest.param("dumb", marks=pytest.mark.slow)])
def test_the_command_on_a_terminal(
    term: str, drives: list[Path], tmp_path: Path, terminal: tuple[int, Any]
) -> None:
    shown_at, stream = terminal
    process = subprocess.Popen(
        command(*drives, "--output", f"{tmp_path}/", "--window", "4"),
        stdout=subprocess.PIPE,
        stderr=stream,
        text=True,
        env={**os.environ, "TERM": term, "COLUMNS": "120", "LINES": "30"},
    )
    found: list[bytes] = []
    threading.Thread(target=lambda: found.extend(_all(shown_at)), daemon=True).start()
    out, _ = process.communicate(timeout=WATCHDOG_S)
    assert process.returncode == 0
    assert "day" in out
    assert "\x1b" not in out
    until(lambda: term != "xterm" or b"datasets" in b"".join(found))
    text = b"".join(found).decode()
    if term == "dumb":
        assert text == ""
    else:
        assert re.search(r"packing \d/2 datasets", text)
        assert re.search(r"parts \d+/\d+", text)


def _all(file: int) -> Iterator[bytes]:
    with suppress(OSError):
        while data := os.read(file, 4096):
            yield data
