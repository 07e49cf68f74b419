"""What packs tell of their progress, in each way to show it."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import pty
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from mp4ds.cli.progress import (
    Events,
    Lines,
    Log,
    LogOf,
    PackState,
    duration_text,
    left_text,
    on_terminal,
    progress_to,
)
from mp4ds.packing.options import PackProgress
from mp4ds.plugins.demo import demo
from waiting import WATCHDOG_S, until

HOUR = 3600.0
Work = Callable[[float], float]  # share done after so many seconds
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


# ---------------------------------------------------------------- where it stands


def paced(share: Callable[[float], float | None], seconds: int, **values: Any) -> PackState:
    """A job that was told of each second."""
    clock = Clock()
    job = PackState(clock=clock)
    for n in range(seconds + 1):
        clock.seconds = 1000.0 + n
        job.take(told(share(n), **values))
    return job


@pytest.mark.parametrize(("begin", "before"), [(0.0, 0), (0.8, 192)])
def test_the_time_left_is_by_what_this_run_did(begin: float, before: int) -> None:
    job = paced(lambda n: begin + n * (1 - begin) / 1000, 400, before=before)
    assert job.seconds_left == pytest.approx(600, abs=5)
    assert job.share == pytest.approx(begin + 0.4 * (1 - begin))


@pytest.mark.parametrize(
    "state",
    [told(None, parts=0), told(0.5, phase="planning"), told(None, phase="planning", parts=0)],
    ids=["nothing-tells", "planning", "planning-unknown"],
)
def test_nothing_is_told_that_is_not_known(state: PackProgress) -> None:
    clock = Clock()
    job = PackState(clock=clock)
    for n in range(100):
        clock.seconds = 1000.0 + n
        job.take(state)
        assert job.seconds_left is None
    assert job.share in (None, 0.0)


def test_parts_tell_where_the_work_does_not() -> None:
    job = PackState()
    job.take(told(None, tasks_done=119))
    assert job.share == 119 / 240


# ---------------------------------------------------------------- anything at all


@st.composite
def jobs(draw: st.DrawFn) -> list[tuple[float, PackProgress]]:
    """Reports in any order, true or not."""
    now, found = 0.0, []
    for _ in range(draw(st.integers(1, 8))):
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


@settings(max_examples=15, deadline=None)
@given(jobs(), st.integers(20, 200), st.integers(1, 60))
def test_whatever_is_told_nothing_silly_is_shown(
    reports: list[tuple[float, PackProgress]], width: int, height: int
) -> None:
    clock, log, events = Clock(0.0), io.StringIO(), io.StringIO()
    screen = io.StringIO()
    console = Console(
        file=screen, force_terminal=True, width=width, height=height, color_system=None
    )
    tellers = (
        Log(PackState(clock=clock), Lines(log), now=clock.now),
        Events(PackState(clock=clock), Lines(events), now=clock.now),
    )
    with on_terminal(console) as show:
        for now, state in reports:
            clock.seconds = now
            show(state)
            for teller in tellers:
                teller.take(state)
    assert all(letter.isprintable() or letter in "\n\r\x1b" for letter in screen.getvalue())
    for teller in tellers:
        teller.end("done")
    for line in log.getvalue().splitlines():
        assert re.fullmatch(r"\d\d:\d\d:\d\d packing [ -~]+", line)
    parsed(events.getvalue())


# ---------------------------------------------------------------- log files


def logged(work: Work, seconds: float, *, outcome: str = "done", step: float = 0.5) -> list[str]:
    """The lines of a pack."""
    clock, stream = Clock(), io.StringIO()
    log = Log(PackState(clock=clock), Lines(stream), now=clock.now)
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
        "12:00:10 packing drive: 3 % | /cam0 1200/36000, "
        "/cam1 1200/36000 | parts 8/240 | 1.7 GB -> 166.7 MB | 5 min left"
    )
    assert lines[-1] == (
        "12:05:00 packing drive: done after 5 min | parts 240/240 | 50.0 GB -> 5.0 GB"
    )
    assert [line[:8] for line in lines[2:-1]] == [f"12:0{n}:10" for n in range(1, 5)]


def test_a_resumed_pack_tells_what_was_done_before() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(PackState(clock=clock), Lines(stream), now=clock.now)
    for n in range(100):
        clock.seconds = 1000.0 + n
        log.take(told(0.8 + n / 10_000, before=192))
    assert "192 parts were already done" in stream.getvalue().splitlines()[0]


def test_the_log_of_several_datasets() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(PackState(clock=clock), Lines(stream), now=clock.now)
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
        r"12:00:10 packing 3 datasets: 4 % \| a 10 %, b 4 % \| parts 34/720 \| 1 failed \| "
        r"7.2 GB -> 725.0 MB \| \d+ min left",
        lines[1],
    )
    assert "a joining cam0.mp4, b 49 %" in lines[-1]


def test_hostile_names_reach_no_log() -> None:
    clock, stream = Clock(), io.StringIO()
    log = Log(PackState(clock=clock), Lines(stream), now=clock.now)
    topics = {HOSTILE + "\udcff" + str(n) + "x" * n: (n, None) for n in range(1000)}
    for n in range(20):
        clock.seconds = 1000.0 + n
        log.take(told(0.1, dataset=HOSTILE, topics=topics, note=HOSTILE))
    lines = stream.getvalue().splitlines()
    assert len(lines) == 2
    assert all(re.fullmatch(r"[ -~]{1,4000}", line) for line in lines)
    assert "and 980 more" in lines[1]


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


@pytest.mark.parametrize(
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
        "seconds_left": (int, type(None)),
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
            assert set(topic) == {"done", "total"}
    kinds = [event["event"] for event in found]
    if found:
        assert kinds[0] == "start"
        assert kinds[-1] == "end"
        assert set(kinds[1:-1]) == {"progress"}
    return found


def test_the_events_of_a_pack() -> None:
    clock, stream = Clock(), io.StringIO()
    events = Events(PackState(clock=clock), Lines(stream), now=clock.now)
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
        "topics": {f"/cam{n}": {"done": 18_000, "total": 36_000} for n in range(2)},
        "seconds_left": 50,
    }
    assert found[-2]["done"] == 1.0
    assert found[-1]["seconds"] == 100.0


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


@pytest.mark.parametrize(
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
        progress_to(teller, tick_seconds=0.01) as take,
    ):
        take(told(0.5))
        assert teller.ticked.wait(WATCHDOG_S)
        if error is not None:
            raise error
    *others, last = teller.calls
    assert last == outcome
    assert others.count("take") == 1
    assert set(others) == {"take", "tick"}
    assert threading.active_count() == threads


# ---------------------------------------------------------------- other commands


def test_a_line_every_ten_seconds() -> None:
    stream, seconds = io.StringIO(), [0.0]
    tell = LogOf("validating", Lines(stream), clock=lambda: seconds[0])
    for second in range(40):
        seconds[0] = float(second)
        tell(f"frame {second}\x1b", second / 80)
    tell("hashing")
    lines = stream.getvalue().splitlines()
    assert [line.partition(" ")[2] for line in lines] == [
        "validating: frame 10\\x1b | 12 % | 70 s left",
        "validating: frame 20\\x1b | 25 % | 60 s left",
        "validating: frame 30\\x1b | 37 % | 50 s left",
    ]


# ---------------------------------------------------------------- terminals


def screen(*states: PackProgress) -> str:
    """What a terminal shows at last."""
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=120, height=24, color_system=None)
    with on_terminal(console) as take:
        for state in states:
            take(state)
    return stream.getvalue()


def test_a_terminal_shows_each_topic() -> None:
    text = screen(told(0.3, cameras=14))
    assert re.search(r"packing drive .* 30% parts 72/240  15\.0 GB -> 1\.5 GB", text)
    for n in range(14):
        assert re.search(rf"  /cam{n} .* 30% 10800/36000", text)


@pytest.fixture
def terminal() -> Iterator[tuple[int, Any]]:
    """The two ends of a terminal: what is shown, and where to write."""
    shown_at, write_to = pty.openpty()
    with os.fdopen(write_to, "w") as stream:
        yield shown_at, stream
    os.close(shown_at)


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
        assert re.search(r"packing 2 datasets", text)
        assert re.search(r"parts \d+/\d+", text)


def _all(file: int) -> Iterator[bytes]:
    with suppress(OSError):
        while data := os.read(file, 4096):
            yield data
