"""What packs tell of their progress, in each way to show it."""

from __future__ import annotations

import dataclasses
import io
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from mp4ds.cli.output import Log
from mp4ds.cli.pack import pack_progress, rows_of, share_of
from mp4ds.packing.options import PackOptions, PackProgress
from mp4ds.packing.pack import pack_each
from mp4ds.plugins.demo import demo
from test_terminal import Screen

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


Report = tuple[float, Sequence[PackProgress]]
"""After so many seconds, the states of all packs."""


def logged(reports: Iterable[Report], outcome: str = "done") -> list[str]:
    """The lines of a log."""
    clock, stream = Clock(), io.StringIO()
    log = Log(stream, clock=clock, now=clock.now)
    for seconds, states in reports:
        clock.seconds = 1000.0 + seconds
        log.show(rows_of({state.dataset: state for state in states}))
    log.end(outcome)
    return stream.getvalue().splitlines()


# ---------------------------------------------------------------- log files


def half_seconds(whole: float) -> Iterator[Report]:
    """A pack that takes so long, looked at twice a second."""
    return ((n / 2, [told(min(1.0, n / 2 / whole))]) for n in range(int(2 * whole) + 1))


@pytest.mark.parametrize("outcome", ["done", "failed"])
def test_a_short_pack_logs_nothing(outcome: str) -> None:
    assert logged(half_seconds(9.9), outcome) == []


def at(seconds: int) -> str:
    """The time of day after so many seconds, here."""
    return f"{(Clock.start + timedelta(seconds=seconds)).astimezone():%H:%M:%S}"


def test_the_log_of_a_pack() -> None:
    lines = logged(half_seconds(300))
    assert lines[0] == (
        f"{at(10)} packing drive: 3 % | parts 8/240  1.7 GB -> 166.7 MB | /cam0 1200/36000, "
        "/cam1 1200/36000 | 5 min left"
    )
    assert lines[-1] == (
        f"{at(300)} packing drive: done after 5 min | parts 240/240  50.0 GB -> 5.0 GB"
    )


def test_hostile_names_reach_no_log() -> None:
    topics = {HOSTILE + "\udcff" + str(n) + "x" * n: (n, None) for n in range(1000)}
    state = told(0.1, dataset=HOSTILE, topics=topics, note=HOSTILE)
    line, _ = logged((n, [state]) for n in range(20))
    assert re.fullmatch(r"[ -~]{1,4000}", line)
    assert "and 980 more" in line


@pytest.mark.parametrize("mode", ["r", "w"])
def test_a_pack_does_not_fail_for_want_of_a_log(mode: str) -> None:
    """The stream is closed, or cannot be written to."""
    with open(os.devnull, mode) as stream:  # noqa: PTH123
        if mode == "w":
            stream.close()
        log = Log(stream, clock=Clock())
        log.show(rows_of({Path("/data/drive"): told(0.5)}))
        log.end("done")


# ---------------------------------------------------------------- while a command runs


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
def test_the_end_is_told_however_it_comes(
    error: type[BaseException] | None,
    outcome: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mp4ds.cli.output._LEAST_PAUSE", 0.0)
    with suppress(error or ValueError), pack_progress() as take:
        take(told(0.5))
        if error is not None:
            raise error
    assert f" packing drive: {outcome} after 0 s | parts 120/240" in capsys.readouterr().err


def test_a_short_pack_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with pack_progress() as take:
        take(told(0.0))
        take(told(1.0))
    assert capsys.readouterr() == ("", "")


# ---------------------------------------------------------------- terminals


@contextmanager
def shown_on(screen: io.StringIO) -> Iterator[io.StringIO]:
    """Let standard error be a screen."""
    with mock.patch.object(sys, "stderr", screen):
        yield screen


def on_screen(*states: PackProgress, monkeypatch: pytest.MonkeyPatch, term: str = "xterm") -> str:
    """What a terminal shows at last."""
    for name, value in (("COLUMNS", "120"), ("LINES", "24"), ("TERM", term)):
        monkeypatch.setenv(name, value)
    with shown_on(Screen()) as screen, pack_progress() as take:
        for state in states:
            take(state)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.getvalue())


def test_a_terminal_shows_each_topic(monkeypatch: pytest.MonkeyPatch) -> None:
    text = on_screen(told(0.3, cameras=14), monkeypatch=monkeypatch)
    assert re.search(r"packing drive .* 30 % +parts 72/240  15\.0 GB -> 1\.5 GB", text)
    for n in range(14):
        assert re.search(rf"  /cam{n} .* 30 % +10800/36000", text)


def test_a_terminal_shows_each_dataset(monkeypatch: pytest.MonkeyPatch) -> None:
    joining = told(1.0, dataset="a", phase="joining", note="cam0.mp4")
    text = on_screen(told(0.5, dataset="b"), joining, monkeypatch=monkeypatch)
    assert re.search(r"packing 2 datasets .* 75 % +parts 360/480", text)
    assert re.search(r"  a .*100 % +joining cam0\.mp4  parts 240/240  50\.0 GB -> 5\.0 GB", text)
    assert re.search(r"  b .* 50 % +parts 120/240  25\.0 GB -> 2\.5 GB", text)


def test_hostile_names_steer_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    topics = {HOSTILE: (1, None), "[red]/[/red]": (2, 3), "{task.id}": (3, 4)}
    state = told(0.5, topics=topics, phase="joining", note=HOSTILE)
    text = on_screen(state, monkeypatch=monkeypatch)
    assert "\x1b" not in text
    assert "[red]/[/red]" in text
    assert "{task.id}" in text


def test_a_dumb_terminal_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert on_screen(told(0.3), monkeypatch=monkeypatch, term="dumb") == ""


# ---------------------------------------------------------------- a job


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two short recordings; not to be changed."""
    folder = tmp_path_factory.mktemp("drives")
    for name, seconds in (("day", 1.0), ("night", 0.6)):
        demo(folder / f"{name}.bag", seconds=seconds)
    return [folder / "day.bag", folder / "night.bag"]


@pytest.mark.slow
def test_a_job_reports_all_its_datasets(drives: list[Path], tmp_path: Path) -> None:
    seen: list[PackProgress] = []
    options = PackOptions(quality="crf=40", codec="h264", preset="ultrafast", gop=4, window=4)
    pack_each(drives, f"{tmp_path}/", options, progress=seen.append)
    states: dict[Path, PackProgress] = {}
    shares = []
    for state in seen:
        states[state.dataset] = state
        shares.append(share_of(states))
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    # both are known from the beginning, so that the share is of both
    assert {state.dataset.name for state in seen[:2]} == {"day", "night"}
    for name, frames in (("day", 15), ("night", 9)):
        last = [state for state in seen if state.dataset.name == name][-1]
        assert last.tasks_done == last.tasks_total > 1
        assert list(last.topics.values()) == [(frames, frames)] * 2
