"""Many datasets in one table, and as a page with a picture and report of each."""

from __future__ import annotations

import html
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from mp4ds.dataset.collections import Paths, datasets_in, each
from mp4ds.dataset.dataset import Dataset
from mp4ds.errors import Mp4dsError, OptionError, SourceError, TargetExistsError, counted
from mp4ds.files.outputs import (
    as_write_error,
    is_page,
    listed_names,
    staged,
    write_listing,
    write_synced,
)
from mp4ds.files.urls import remote
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.plugins.reporting.page import FOLDER_NAME, INDEX_NAME
from mp4ds.plugins.reporting.report import ReportOptions, report
from mp4ds.plugins.reporting.stills import StillOptions, frames

_ASSETS = files("mp4ds.plugins.reporting") / "page"
_PICTURES = "pictures"
_WIDTH = 240  # of a picture
_NS = 10**9


@dataclass(frozen=True)
class Brief:
    """A dataset's summary from its manifest.

    Attributes:
        path: The dataset.
        profile: Its profile.
        format: Of the recording.
        messages: Number of messages.
        frames: How many of these are video frames, by topic.
        start: First log time, nanoseconds; None without messages.
        end: Last log time, nanoseconds.
        bytes: Of its files.
        title: Its title.
    """

    path: Path
    profile: str
    format: str
    messages: int
    frames: dict[str, int]
    start: int | None
    end: int | None
    bytes: int
    title: str = ""

    @property
    def seconds(self) -> float:
        """From the first message to the last."""
        return 0.0 if self.start is None or self.end is None else (self.end - self.start) / _NS


def brief(path: Path) -> Brief:
    """Summarise a dataset from its manifest.

    Raises:
        SourceError: It is not a dataset.
        FormatError: The manifest breaks a rule of the format.
    """
    if not (path / MANIFEST_NAME).is_file():
        raise SourceError(path, "is not a dataset", "Give folders made by `mp4ds pack`.")
    manifest = load_manifest(path / MANIFEST_NAME)
    by_topic: dict[str, int] = {}
    for stream in manifest.streams:
        by_topic[stream.topic] = by_topic.get(stream.topic, 0) + stream.frames
    span = manifest.time_range
    return Brief(
        path=path,
        profile=manifest.profile,
        format=manifest.format,
        messages=manifest.messages,
        frames=by_topic,
        start=span.start if span else None,
        end=span.end if span else None,
        bytes=sum(entry.size for entry in manifest.files),
        title=(manifest.about and manifest.about.title) or "",
    )


# ---------------------------------------------------------------- page


@dataclass(frozen=True)
class OverviewSummary:
    """A page of several datasets.

    Attributes:
        index: The page.
        datasets: Number of datasets shown.
        problems: What could not be shown.
    """

    index: Path
    datasets: int
    problems: list[str] = field(default_factory=list)


def reports(
    datasets: Paths,
    folder: Path | str,
    options: ReportOptions | None = None,
    *,
    jobs: int = 1,
    progress: Callable[[str, float | None], None] | None = None,
) -> OverviewSummary:
    """Make the report of each dataset, and a page that shows them all.

    Args:
        datasets: Datasets, folders of them, or patterns; on this machine.
        folder: Where to make the page. Each report is in its dataset.
        options: How the reports are made.
        jobs: Datasets at a time.
        progress: Called with a phrase, and the share done.

    Raises:
        SourceError: A path is not a dataset.
        OptionError: An option is for single reports only.
        TargetError: The page cannot be written there.
        WriteError: The page could not be written.
    """
    chosen = options or ReportOptions()
    if chosen.output is not None or chosen.scores is not None or chosen.slice:
        raise OptionError("`scores`, `start`, `end` and `duration` work with one dataset only.")
    found = datasets_in(datasets)
    for path in found:
        if remote(path):
            raise SourceError(path, "is not on this machine", "Copy the dataset first.")
    place = Path(os.path.abspath(folder))  # noqa: PTH100 - as named
    index = place / INDEX_NAME
    if os.path.lexists(index) and not is_page(index) and not chosen.force:
        raise TargetExistsError(index)
    tell = progress or (lambda *_: None)
    rows, problems = [], []
    try:
        place.mkdir(exist_ok=True)
        with staged(place / FOLDER_NAME, force=True, owned=listed_names) as made:
            (made / _PICTURES).mkdir(parents=True)
            (made / "report.css").write_bytes((_ASSETS / "report.css").read_bytes())
            work = partial(_shown, options=chosen, pictures=made / _PICTURES)
            numbered = [*enumerate(found)]
            for (number, path), (told, wrong) in each(work, numbered, jobs):
                tell(f"{number + 1} of {len(found)}: {path.name}", (number + 1) / len(found))
                problems += wrong
                rows.append(_row(path, told, number, place, made))
            write_listing(made)
        page = _page(html.escape(place.name), _facts(found, problems), rows)
        write_synced(index, page.encode())
    except OSError as error:
        raise as_write_error(error, place) from error
    return OverviewSummary(index, len(found), problems)


def _shown(
    item: tuple[int, Path], options: ReportOptions, pictures: Path
) -> tuple[Brief | None, list[str]]:
    """Make report and picture of one dataset; returns its summary and any problems."""
    number, path = item
    try:
        told = brief(path)
        problems = report(path, options).problems
        if told.frames:
            topic = next(iter(told.frames))
            with Dataset(path) as dataset:
                middle = len(dataset[topic]) // 2
                scale = min(1.0, _WIDTH / dataset[topic].image_size[0])
            still = StillOptions(topic=topic, at=middle, resize=scale)
            frames(path, pictures / f"{number}.jpg", still)
    except Mp4dsError as error:
        with suppress(Mp4dsError):
            return brief(path), [str(error)]
        return None, [str(error)]
    return told, problems


def _page(title: str, facts: str, rows: Sequence[str]) -> str:
    page = (_ASSETS / "overview.html").read_text(encoding="utf-8")
    for name, text in (("title", title), ("facts", facts), ("rows", "\n".join(rows))):
        page = page.replace(f"<!--{name}-->", text)
    return page


def _facts(found: Sequence[Path], problems: Sequence[str]) -> str:
    told = [counted(len(found), "dataset")]
    told += [f"not shown: {html.escape(problem)}" for problem in problems]
    return "<br>".join(told)


def _row(path: Path, told: Brief | None, number: int, place: Path, made: Path) -> str:
    link = quote(Path(os.path.relpath(path / INDEX_NAME, place)).as_posix())
    name = html.escape(os.path.relpath(path, place))
    picture = ""
    if (made / _PICTURES / f"{number}.jpg").exists():
        picture = f'<img src="{FOLDER_NAME}/{_PICTURES}/{number}.jpg" alt="" loading="lazy">'
    cells = ["", "", "", "", ""]
    if told is not None:
        name += f"<br><span class=muted>{html.escape(told.title)}</span>" if told.title else ""
        begun = ""
        if told.start is not None:
            with suppress(ValueError, OverflowError, OSError):
                moment = datetime.fromtimestamp(told.start // _NS, timezone.utc)
                begun = f"{moment:%Y-%m-%d %H:%M:%S}"
        cameras = "<br>".join(f"{html.escape(t)}: {n}" for t, n in sorted(told.frames.items()))
        cells = [
            begun,
            f"{told.seconds:.1f} s",
            cameras,
            f"{told.bytes / 1e6:.1f} MB",
            html.escape(told.profile),
        ]
    body = "".join(f"<td>{cell}</td>" for cell in cells)
    return f'<tr><td>{picture}</td><td><a href="{link}">{name}</a></td>{body}</tr>'
