"""What the command line shows: progress on stderr, results on stdout."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, is_dataclass
from datetime import datetime, timezone
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unicodedata import east_asian_width

import typer

from mp4ds.errors import Mp4dsError, counted, path_text, size_text
from mp4ds.options import iso_text, seconds_text
from mp4ds.records import latched_text

if TYPE_CHECKING:
    from mp4ds.dataset.checks import Problem
    from mp4ds.packing.options import PackSummary, TopicSummary
    from mp4ds.plugins.info import Brief, Info, ReadingSpeed, TopicInfo
    from mp4ds.records import Loss
    from mp4ds.unpacking.options import UnpackSummary

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


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Its heading.
        kind: ``number``, right-aligned; ``topic``, ``type`` or ``text``, which a terminal that is
            too narrow shortens.
        spare: A terminal that is too narrow leaves out the column with the largest number first;
            0: none does.
    """

    name: str
    kind: str = "number"
    spare: int = 0


def print_table(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], *, first: int | None = None
) -> bool:
    """Print a table with a line for each row, without the columns that are empty.

    A terminal shows what fits: few rows, short type names, fewer columns. Other programs get all.

    Args:
        columns: Its columns.
        rows: A text for each of them.
        first: How many rows a terminal shows if there are too many for it, the others by name.

    Returns:
        Whether anything was shortened or left out.
    """
    if _quiet:
        return False
    cells = [[shown(cell) for cell in row] for row in rows]
    width: int | None = None
    folded: list[list[str]] = []
    if sys.stdout.isatty():
        width = shutil.get_terminal_size().columns
        if len(rows) > _MOST_ROWS:
            cells, folded = cells[: first or _MOST_ROWS], cells[first or _MOST_ROWS :]
    kept = [n for n in range(len(columns)) if any(row[n] for row in cells)]
    table = [[column.name for column in columns], *cells]
    widths = _widths(kept, table)
    is_cut = width is not None and sum(widths.values()) + 2 * len(kept) - 2 > width
    if is_cut and width is not None:
        widths = _fitted(columns, kept, table, width)
    with printed():
        for number, row in enumerate(table):
            line = "  ".join(_cell(row[n], size, columns[n].kind) for n, size in widths.items())
            is_heading = width is not None and not number
            print(typer.style(line.rstrip(), bold=True) if is_heading else line.rstrip())
    if folded and width is not None:
        say(f"{counted(len(folded), f'other {columns[0].name}')}:")
        names = ", ".join(row[0] for row in folded)
        for line in textwrap.wrap(names, width - 2, max_lines=_MOST_LINES, placeholder=" ..."):
            say(f"  {line}")
    return is_cut or bool(folded)


def _widths(kept: Sequence[int], table: Sequence[Sequence[str]]) -> dict[int, int]:
    return {n: max(_width(row[n]) for row in table) for n in kept}


def _fitted(
    columns: Sequence[Column], kept: Sequence[int], table: list[list[str]], width: int
) -> dict[int, int]:
    """The columns that a terminal shows, and how wide; type names in the table are shortened."""
    for row in table:
        for n in kept:
            if columns[n].kind == "type":
                row[n] = re.sub(r"[\w.]+/(?:msg/)?", "", row[n])
    widths = _widths(kept, table)

    def excess(*, at_least: bool) -> int:
        sizes = (
            min(size, _SHORTEST.get(columns[n].kind, size)) if at_least else size
            for n, size in widths.items()
        )
        return sum(sizes) + 2 * len(widths) - 2 - width

    while excess(at_least=True) > 0 and any(columns[n].spare for n in widths):
        del widths[max(widths, key=lambda n: columns[n].spare)]
    while excess(at_least=False) > max(0, excess(at_least=True)):
        longer = [n for n in widths if widths[n] > _SHORTEST.get(columns[n].kind, widths[n])]
        widths[max(longer, key=lambda n: (columns[n].kind == "text", widths[n]))] -= 1
    return widths


def _width(text: str) -> int:
    """Columns of a terminal that a text takes."""
    return len(text) + sum(east_asian_width(letter) in "WF" for letter in text)


def _cell(text: str, width: int, kind: str) -> str:
    """A text of a table in a given width; if too long, without its end, or a topic's middle."""
    if _width(text) > width:
        begin = text[: (width - 3) // 3 if kind == "topic" else width - 3]
        end = text[len(text) - (width - 3 - len(begin)) :]
        while _width(begin) + _width(end) > width - 3:  # of wide letters
            begin, end = begin[:-1], end if begin else end[1:]
        text = f"{begin}...{end}"
    space = " " * (width - _width(text))
    return space + text if kind == "number" else text + space


def print_pack(summary: PackSummary) -> None:
    """Print what became of each topic."""
    cameras = [topic for topic in summary.topics if topic.frames]
    others = [topic for topic in summary.topics if not topic.frames]
    rows = [_pack_row(topic) for topic in (*cameras, *others)]
    print_table(_PACK_COLUMNS, rows, first=len(cameras))
    for topic in summary.topics:
        for reason, (count, first) in topic.verbatim.items():
            share = f"{count} of {counted(topic.messages, 'message')}"
            say(
                f"{topic.topic}: {share} stored verbatim in messages.mcap: {reason} (first: "
                f"message {first})"
            )
        for note in topic.notes:
            say(f"{topic.topic}: {note}")
    for what, count in summary.skipped.items():
        say(f"not packed exactly: {what} ({count})")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")
    _print_latched(summary)
    _print_losses(summary.losses, "listed in dataset.yaml")
    if not any(topic.files for topic in summary.topics):
        say("no topic became a video: all messages are stored unchanged in messages.mcap")
    if summary.not_copied:
        say(f"re-encoded, because it cannot be copied: {summary.not_copied}")
    if summary.is_copy:
        say(f"{path_text(summary.dataset)}: {size_text(summary.dataset_bytes)}, copied")
        return
    say(
        f"{path_text(summary.dataset)}: {size_text(summary.source_bytes)} -> "
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


def _print_losses(losses: Sequence[Loss], where: str) -> None:
    for loss in losses[:_LOSSES_SHOWN]:
        say(f"lost: {_loss_text(loss)}")
    if len(losses) > _LOSSES_SHOWN:
        say(f"lost: {counted(len(losses) - _LOSSES_SHOWN, 'more place')}, {where}")


def _loss_text(loss: Loss) -> str:
    place = f" at byte {loss.offset}" if loss.offset is not None else ""
    size = f", {size_text(loss.size)}" if loss.size is not None else ""
    messages = ""
    if loss.messages is not None:
        messages = f"; {counted(loss.messages, 'message') if loss.messages else 'no messages'}"
    topics = f" of {', '.join(loss.topics)}" if loss.topics else ""
    if loss.frames is None:
        return f"{loss.file}{place}{size}: {loss.problem}{messages}{topics}"
    first, last = loss.frames
    frames = f"frame {first}" if first == last else f"frames {first} to {last}"
    times = dict.fromkeys(seconds_text(time) for time in (loss.start, loss.end) if time is not None)
    logged = f", log time {' to '.join(times)}" if times else ""
    return f"{loss.file}: {frames}{topics}{logged}: {loss.problem}"


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
    """Print what was written, of things of that name, and what the target could not hold."""
    total = sum(summary.messages.values())
    topics = counted(len(summary.messages), "topic")
    say(f"{path_text(summary.output)}: {counted(total, noun)} of {topics}")
    for topic, now in summary.republished.items():
        taken = f" (the name {now.instead_of} is taken)" if now.instead_of else ""
        say(f"{topic}: written as {now.topic}, {now.type_name}{taken}")
    for topic, reasons in summary.as_recorded.items():
        for reason, count in reasons.items():
            say(f"{topic}: {counted(count, 'message')} as recorded: {reason}")
    for topic, reasons in summary.unconvertible.items():
        for reason, count in reasons.items():
            say(f"{topic}: {counted(count, 'message')} left out: {reason}")
    for topic, count in summary.thinned.items():
        say(f"{topic}: {counted(count, 'message')} left out")
    if summary.converted:
        say(f"converted between ROS 1 and ROS 2: {', '.join(summary.converted)}")
    for what, count in summary.omitted.items():
        say(f"not supported by this format: {what} ({count})")
    if summary.left_out:
        say(f"left out: {', '.join(summary.left_out)}")
    _print_latched(summary)
    for note in summary.notes:
        say(note)
    _print_losses(summary.losses, "listed with --json")


def _print_latched(summary: PackSummary | UnpackSummary) -> None:
    """Print which latched messages from before the slice were included."""
    if summary.latched:
        say(latched_text(summary.latched))
    if summary.latched_left_out:
        topics = ", ".join(summary.latched_left_out)
        say(f"left out, as too large: latched messages from before the start: {topics}")


def print_validation(found: Mapping[Path, list[Problem]], *, deep: bool) -> None:
    """Print all problems of datasets, and how thorough the check was."""
    for problem in chain.from_iterable(found.values()):
        say(path_text(problem))
    count = sum(map(len, found.values()))
    problems = counted(count, "problem") if count else "no problems"
    if not deep:
        depth = "; frames were not decoded (--deep does)"
    elif not count:
        depth = "; every video was decoded, every message with a digest checked"
    else:
        depth = ""  # what is missing or broken was not
    if len(found) == 1:
        say(f"{path_text(next(iter(found)))}: {problems}{depth}")
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
    kind = f"{result.kind}, profile {result.profile or '-'}"
    say(f"{path_text(result.path)}: {kind}, {size_text(result.bytes)}")
    if result.start is not None and result.end is not None:
        start = datetime.fromtimestamp(result.start / 1e9, timezone.utc)
        say(
            f"{start:%Y-%m-%d %H:%M:%S} UTC, {(result.end - result.start) / 1e9:.2f} s, "
            f"{counted(sum(topic.messages for topic in result.topics), 'message')}"
        )
    cameras = [topic for topic in result.topics if topic.content or topic.stored]
    others = [topic for topic in result.topics if not topic.content and not topic.stored]
    rows = [_info_row(topic) for topic in (*cameras, *others)]
    if print_table(_INFO_COLUMNS, rows, first=len(cameras)):
        say("shortened to fit; in full: --json, or `| less -S`")
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


_MOST_ROWS = 20  # of a table on a terminal
_MOST_LINES = 3  # of the names of other rows
_SHORTEST = {"topic": 24, "type": 12, "text": 20}
_SPEED_COLUMNS = [
    Column("topic", "topic"),
    Column("per frame"),
    Column("ms, random access"),
    Column("ms, in order"),
]
_PACK_COLUMNS = [
    Column("topic", "topic"),
    Column("type", "type", spare=3),
    Column("messages"),
    Column("frames", spare=2),
    Column("raw", spare=1),
    Column("packed"),
    Column("ratio"),
    Column("stored in", "text"),
]
_OVERVIEW_COLUMNS = [
    Column("dataset", "topic"),
    Column("begins", "text", spare=1),
    Column("seconds"),
    Column("messages", spare=3),
    Column("cameras", spare=2),
    Column("frames"),
    Column("size"),
    Column("profile", "text", spare=4),
]
_INFO_COLUMNS = [
    Column("topic", "topic"),
    Column("type", "type", spare=1),
    Column("messages"),
    Column("Hz"),
    Column("jitter ms", spare=6),
    Column("gaps", spare=4),
    Column("longest s", spare=5),
    Column("size", spare=2),
    Column("content", "text"),
    Column("stored", "text", spare=3),
]
