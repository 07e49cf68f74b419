"""What the command line shows: progress on stderr, results on stdout."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from datetime import datetime, timezone
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from mp4ds.errors import Mp4dsError, counted
from mp4ds.options import iso_text

if TYPE_CHECKING:
    from mp4ds.dataset.checks import Problem
    from mp4ds.packing.options import PackSummary, TopicSummary
    from mp4ds.plugins.info import Info, ReadingSpeed, TopicInfo
    from mp4ds.plugins.reporting.overview import Brief
    from mp4ds.records import Loss
    from mp4ds.unpacking.unpack import UnpackSummary

_LOSSES_SHOWN = 20
_quiet = False


def be_quiet() -> None:
    """From now on, print neither results for people nor progress."""
    global _quiet
    _quiet = True


def is_quiet() -> bool:
    """Whether nothing but errors and JSON is printed."""
    return _quiet


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    return str(value)


@contextmanager
def printed() -> Iterator[None]:
    """Report system errors as errors of standard output: no other file is involved.

    Raises:
        Mp4dsError: It cannot be written to.
        typer.Exit: The reader has closed it.
    """
    try:
        yield
    except BrokenPipeError:
        raise typer.Exit(1) from None
    except OSError as error:
        raise Mp4dsError(
            f"standard output: {error.strerror or error}. The command's output text is lost; the "
            "files it wrote are complete."
        ) from None


def print_json(value: Any) -> None:
    """Print a result for scripts."""
    text = json.dumps(value, default=_jsonable, indent=2)
    with printed():
        print(text)


def shown(value: object) -> str:
    """A text without terminal control characters, which topic and file names may contain."""
    text = str(value)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def say(value: object) -> None:
    """Print one line."""
    if _quiet:
        return
    with printed():
        print(shown(value))


def complain(value: object) -> None:
    """Print a line to stderr; failing to print it is not an error."""
    with suppress(OSError, ValueError):
        print(f"mp4ds: {shown(value)}", file=sys.stderr, flush=True)


def size_text(count: float) -> str:
    """A size in a suitable unit."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} TB"


def print_table(columns: list[tuple[str, str]], rows: list[list[str]]) -> None:
    """Print a table; a column is right-aligned, or folds if the screen is too narrow."""
    if _quiet:
        return
    from rich.console import Console
    from rich.table import Table

    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console = Console(markup=False, highlight=False, width=_PIPE_WIDTH)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name, kind in columns:
        if kind == "right":
            table.add_column(name, justify="right", no_wrap=True)
        else:
            table.add_column(name, overflow="fold")
    for row in rows:
        table.add_row(*map(shown, row))
    with printed():
        console.print(table)


def print_pack(summary: PackSummary) -> None:
    """Print what became of each topic."""
    print_table(_PACK_COLUMNS, [_pack_row(topic) for topic in summary.topics])
    for topic in summary.topics:
        for reason, (count, first) in topic.verbatim.items():
            say(
                f"{topic.topic}: {count} of {topic.messages} messages stored verbatim in "
                f"messages.mcap: {reason} (first: message {first})"
            )
        for note in topic.notes:
            say(f"{topic.topic}: {note}")
    for what, count in summary.skipped.items():
        say(f"not packed exactly: {count} {what}")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")
    for loss in summary.losses[:_LOSSES_SHOWN]:
        say(f"lost: {_loss_text(loss)}")
    if len(summary.losses) > _LOSSES_SHOWN:
        say(f"lost: {len(summary.losses) - _LOSSES_SHOWN} more places, listed in dataset.yaml")
    if not any(topic.files for topic in summary.topics):
        say("no topic became a video: all messages are stored unchanged in messages.mcap")
    if summary.not_copied:
        say(f"re-encoded, because it cannot be copied: {summary.not_copied}")
    if summary.is_copy:
        say(f"{summary.dataset}: {size_text(summary.dataset_bytes)}, copied")
        return
    say(
        f"{summary.dataset}: {size_text(summary.source_bytes)} -> "
        f"{size_text(summary.dataset_bytes)}{_change(summary)}, of which messages.mcap "
        f"{size_text(summary.messages_bytes)}"
    )
    if summary.larger:
        say(f"larger than its source: {summary.larger}")


def _change(summary: PackSummary) -> str:
    """How much smaller a dataset is than its source; empty if the source has no bytes."""
    if not summary.source_bytes:
        return ""
    ratio = summary.source_bytes / summary.dataset_bytes
    return f" ({ratio:.2f} times smaller)" if ratio >= 1 else f" ({1 / ratio:.2f} times as large)"


def _loss_text(loss: Loss) -> str:
    place = f" at byte {loss.offset}" if loss.offset is not None else ""
    size = f", {size_text(loss.size)}" if loss.size is not None else ""
    messages = f"; {loss.messages} messages" if loss.messages is not None else ""
    topics = f" of {', '.join(loss.topics)}" if loss.topics else ""
    return f"{loss.file}{place}{size}: {loss.problem}{messages}{topics}"


def _pack_row(topic: TopicSummary) -> list[str]:
    stored = ", ".join(topic.files)
    if not stored:
        modelled = topic.messages and topic.frames == topic.messages
        stored = "sidecar" if modelled else "messages.mcap"
    ratio = topic.raw_bytes / topic.packed_bytes if topic.packed_bytes else 0
    return [
        topic.topic,
        topic.type_name,
        str(topic.messages),
        str(topic.frames) if topic.files else "",
        size_text(topic.raw_bytes) if topic.raw_bytes else "",
        size_text(topic.packed_bytes) if topic.packed_bytes else "",
        _number(ratio or None, 2),
        stored,
    ]


def print_unpack(summary: UnpackSummary, noun: str) -> None:
    """Print what was written, and what the target could not hold."""
    total = sum(summary.messages.values())
    say(f"{summary.output}: {total} {noun} of {len(summary.messages)} topics")
    for topic, now in summary.republished.items():
        taken = f" (the name {now.instead_of} is taken)" if now.instead_of else ""
        say(f"{topic}: written as {now.topic}, {now.type_name}{taken}")
    for topic, reasons in summary.as_recorded.items():
        for reason, count in reasons.items():
            say(f"{topic}: {count} messages as recorded: {reason}")
    for topic, reasons in summary.unconvertible.items():
        for reason, count in reasons.items():
            say(f"{topic}: {count} messages left out: {reason}")
    for topic, count in summary.thinned.items():
        say(f"{topic}: {count} messages left out")
    if summary.converted:
        say(f"converted between ROS 1 and ROS 2: {', '.join(summary.converted)}")
    for what, count in summary.omitted.items():
        say(f"not supported by this format: {count} {what}")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")


def print_validation(found: Mapping[Path, list[Problem]], *, deep: bool) -> None:
    """Print all problems of datasets, and how thorough the check was."""
    for problem in chain.from_iterable(found.values()):
        say(problem)
    count = sum(map(len, found.values()))
    problems = counted(count, "problem") if count else "no problems"
    if not deep:
        depth = "; frames were not decoded (--deep does)"
    elif not count:
        depth = "; every video was decoded, every message with a digest checked"
    else:
        depth = ""  # what is missing or broken was not
    if len(found) == 1:
        say(f"{next(iter(found))}: {problems}{depth}")
        return
    wrong = sum(map(bool, found.values()))
    where = f" in {wrong} of them" if wrong else ""
    say(f"{len(found)} datasets: {problems}{where}{depth}")


def print_overview(rows: Sequence[Brief]) -> None:
    """Print a line for each dataset, and totals."""
    base = os.path.commonpath([str(row.path.parent) for row in rows])
    table = [
        [
            os.path.relpath(str(row.path), base) if base else str(row.path),
            _moment(row.start),
            f"{row.seconds:.1f}",
            str(row.messages),
            str(len(row.frames)),
            str(sum(row.frames.values())),
            size_text(row.bytes),
            row.profile,
        ]
        for row in rows
    ]
    total = [
        f"{len(rows)} datasets",
        "",
        f"{sum(row.seconds for row in rows):.1f}",
        str(sum(row.messages for row in rows)),
        str(len({topic for row in rows for topic in row.frames})),
        str(sum(sum(row.frames.values()) for row in rows)),
        size_text(sum(row.bytes for row in rows)),
        "",
    ]
    print_table(_OVERVIEW_COLUMNS, [*table, total])


def _moment(time_ns: int | None) -> str:
    """A time in UTC; empty if there is none."""
    if time_ns is None:
        return ""
    return iso_text(time_ns - time_ns % 10**9)


def print_info(result: Info) -> None:
    """Print what is in a recording or dataset."""
    say(f"{result.path}: {result.kind}, profile {result.profile or '-'}, {size_text(result.bytes)}")
    if result.start is not None and result.end is not None:
        start = datetime.fromtimestamp(result.start / 1e9, timezone.utc)
        say(
            f"{start:%Y-%m-%d %H:%M:%S} UTC, {(result.end - result.start) / 1e9:.2f} s, "
            f"{sum(topic.messages for topic in result.topics)} messages"
        )
    print_table(_INFO_COLUMNS, [_info_row(topic) for topic in result.topics])
    for note in result.notes:
        say(note)


def print_speeds(speeds: Sequence[ReadingSpeed]) -> None:
    """Print how long reading frames takes."""
    rows = [
        [
            item.topic,
            size_text(item.bytes_per_frame),
            _number(item.random_ms, 1),
            _number(item.in_order_ms, 1),
        ]
        for item in speeds
    ]
    if rows:
        print_table(_SPEED_COLUMNS, rows)


def _info_row(topic: TopicInfo) -> list[str]:
    return [
        topic.topic,
        topic.type_name,
        str(topic.messages),
        _number(topic.rate_hz, 2),
        _number(topic.jitter_ms, 2),
        str(topic.gaps) if topic.gaps else "",
        _number(topic.longest_gap_s, 3),
        size_text(topic.bytes) if topic.bytes is not None else "",
        topic.content,
        topic.stored,
    ]


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


_PIPE_WIDTH = 160
_SPEED_COLUMNS = [
    ("topic", "fold"),
    ("per frame", "right"),
    ("ms, random access", "right"),
    ("ms, in order", "right"),
]
_PACK_COLUMNS = [
    ("topic", "fold"),
    ("type", "fold"),
    ("messages", "right"),
    ("frames", "right"),
    ("raw", "right"),
    ("packed", "right"),
    ("ratio", "right"),
    ("stored in", "fold"),
]
_OVERVIEW_COLUMNS = [
    ("dataset", "fold"),
    ("begins", "left"),
    ("seconds", "right"),
    ("messages", "right"),
    ("cameras", "right"),
    ("frames", "right"),
    ("size", "right"),
    ("profile", "left"),
]
_INFO_COLUMNS = [
    ("topic", "fold"),
    ("type", "fold"),
    ("messages", "right"),
    ("Hz", "right"),
    ("jitter ms", "right"),
    ("gaps", "right"),
    ("longest s", "right"),
    ("size", "right"),
    ("content", "fold"),
    ("stored", "fold"),
]
