"""``report``: a dataset as an HTML page next to its files, or many datasets as a list of pages.

index.html and a folder ``report`` are added to the dataset, or written elsewhere. The page plays
the dataset's videos, of lossless cameras their views; where browsers cannot, it shows stills. Its
columns are exact.
"""

from __future__ import annotations

import html
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import numpy as np

from mp4ds._version import __version__
from mp4ds.dataset.dataset import Dataset, Paths, datasets_in
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.views import size_after
from mp4ds.errors import (
    FormatError,
    Mp4dsError,
    OptionError,
    SourceError,
    TargetExistsError,
    VideoError,
    counted,
)
from mp4ds.files.outputs import (
    as_write_error,
    check_target,
    is_page,
    listed_names,
    local_target,
    staged,
    write_listing,
    write_synced,
)
from mp4ds.files.urls import remote
from mp4ds.options import Options, force, where
from mp4ds.plugins.info import Brief, TopicInfo, brief, notes_of, topics_of
from mp4ds.plugins.reporting.cameras import (
    ReportedCamera,
    axis_of,
    presentation_times,
    untimed,
    why_not_played,
)
from mp4ds.plugins.reporting.stills import Look, StillOptions, frames, spread
from mp4ds.processes import each
from mp4ds.video.images import ImageFile

_PAGE = files("mp4ds.plugins.reporting") / "page"
"""The page's static files."""

_INDEX = "index.html"
_FOLDER = "report"

_MOST_NOTES = 200
_STILLS, _PICTURES = "stills", "pictures"
_PICTURE_WIDTH = 240
_MOST_STILLS = 32  # of a camera
_STILL_WIDTH = 480


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """How to make a report."""

    output: Path | None = where(
        "Folder to write to; default: the dataset itself.", None, "-o", metavar="FOLDER"
    )
    force: bool = force("Replace an index.html that is not a report.")


@dataclass(frozen=True)
class CameraSummary:
    """What the page shows of a stream.

    Attributes:
        topic: Its topic.
        plays: Its ``video``, ``stills`` or ``nothing``.
        note: Why, if it is not its video.
    """

    topic: str
    plays: str
    note: str


@dataclass(frozen=True)
class ReportSummary:
    """A report that was made.

    Attributes:
        index: The page.
        cameras: In the order of the page.
        bytes: Total size of what was written.
        problems: What could not be shown of the dataset.
    """

    index: Path
    cameras: list[CameraSummary]
    bytes: int
    problems: list[str]


def report(
    dataset: Path | str,
    options: ReportOptions | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> ReportSummary:
    """Make the page of a dataset. An existing report is replaced.

    Args:
        dataset: A dataset, or one video with its sidecar, on this machine.
        options: How.
        progress: Called with a phrase now and then.

    Raises:
        SourceError: It is not a dataset.
        FormatError: The dataset breaks a rule of the format. A damaged video is not an error, but
            one of the summary's problems.
        OptionError: An option is wrong.
        TargetError: The report cannot be written there.
        WriteError: The report could not be written; what was there before remains.
    """
    chosen = options or ReportOptions()
    tell = progress or (lambda _: None)
    with Dataset(dataset) as opened:
        _check_local(opened.path)
        if opened.manifest is None and chosen.output is None:
            raise OptionError("A single video has no folder for a report: give `output`.")
        folder = local_target(chosen.output or opened.path)
        if folder.exists():
            _check_index(folder, chosen)
            check_target(folder / _FOLDER, force=True, owned=listed_names)
        else:
            check_target(folder, force=False, owned=listed_names)
        try:
            is_new = not folder.exists()
            folder.mkdir(exist_ok=True)
            try:
                return _write(opened, folder, tell)
            except BaseException:
                if is_new:
                    with suppress(OSError):
                        folder.rmdir()  # leave neither partial output nor an empty folder
                raise
        except OSError as error:
            raise as_write_error(error, folder) from error


def _check_local(path: Path) -> None:
    if remote(path):
        raise SourceError(path, "is not on this machine", "Copy the dataset first.")


def _check_index(folder: Path, options: ReportOptions) -> None:
    """Refuse to replace a page of the user's."""
    index = folder / _INDEX
    if os.path.lexists(index) and not is_page(index) and not options.force:
        raise TargetExistsError(index)


def _write(dataset: Dataset, folder: Path, tell: Callable[[str], None]) -> ReportSummary:
    problems: list[str] = []
    with staged(folder / _FOLDER, force=True, owned=listed_names) as path:
        path.mkdir()
        cameras = []
        for number, camera in enumerate(_cameras(dataset, problems)):
            try:
                _give_pictures(camera, folder, path, tell)
            except FormatError as error:
                camera.note = str(error)
                problems.append(str(error))
            cameras.append(camera)
            columns = _call("columns", number, camera.columns())
            (path / f"columns-{number}.js").write_bytes(columns)
        tell("topics")
        for part in _PAGE.iterdir():
            if part.name.endswith((".js", ".css")):
                (path / part.name).write_bytes(part.read_bytes())
        facts = _call("dataset", _data(dataset, cameras, problems))
        (path / "data.js").write_bytes(b"/* made by mp4ds report */\n" + facts)
        write_listing(path)
    index = folder / _INDEX
    write_synced(index, (_PAGE / _INDEX).read_bytes())
    written = [index, *(p for p in (folder / _FOLDER).rglob("*") if p.is_file())]
    return ReportSummary(
        index=index,
        cameras=[CameraSummary(c.name, c.plays, c.note) for c in cameras],
        bytes=sum(path.stat().st_size for path in written),
        problems=problems,
    )


def _cameras(dataset: Dataset, problems: list[str]) -> Iterator[ReportedCamera]:
    """The streams by topic; those whose columns cannot be read become problems."""
    streams = sorted(dataset.streams, key=lambda stream: (stream.topic, stream.path.stem))
    topics = Counter(stream.topic for stream in streams)
    for stream in streams:
        alone = topics[stream.topic] == 1
        name = stream.topic if alone else f"{stream.topic} ({stream.path.stem})"
        camera = ReportedCamera(stream.in_layer("view"), stream, name)
        try:
            camera.check()
        except FormatError as error:
            problems.append(str(error))
            continue
        yield camera


def _give_pictures(
    camera: ReportedCamera, folder: Path, made: Path, tell: Callable[[str], None]
) -> None:
    """Find the video that the page plays of a camera, or make stills.

    Raises:
        FormatError: Its video is damaged.
    """
    stream = camera.stream
    camera.times = presentation_times(stream)
    camera.note = why_not_played(stream)
    if not camera.note:
        path = os.path.relpath(stream.video_path.resolve(), folder.resolve())
        camera.video = quote(Path(path).as_posix())
        return
    (made / _STILLS).mkdir(exist_ok=True)
    with closing(Topic([stream])) as topic:
        scale = min(1.0, _STILL_WIDTH / stream.image_size[0])
        look = Look(topic, size_after(stream.topic, stream.image_size, scale))
        for number in spread(len(stream), _MOST_STILLS):
            tell(f"{stream.topic}: frame {number} of {len(stream)} for the page")
            name = f"{stream.path.stem}-{number}.jpg"
            try:
                picture = look.picture(topic.get([number])[0].data)
            except VideoError:  # of packets that refer to lost ones
                if stream.sidecar.body != "packet":
                    raise
                continue
            (made / _STILLS / name).write_bytes(ImageFile("rgb8", "jpeg").encode(picture))
            camera.stills[number] = f"{_FOLDER}/{_STILLS}/{quote(name)}"
        camera.caption = look.caption


# ---------------------------------------------------------------- data of the page


def _call(name: str, *values: Any) -> bytes:
    """A script that passes values to the page: ASCII, and safe inside an HTML element.

    Numbers that are not finite become null.
    """
    texts = [json.dumps(_finite(value), separators=(",", ":")) for value in values]
    return f"mp4dsReport.{name}({', '.join(texts)});\n".replace("<", "\\u003c").encode()


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value


def _data(dataset: Dataset, cameras: list[ReportedCamera], problems: list[str]) -> dict[str, Any]:
    manifest = dataset.manifest
    both = [{"stamp": c.stream.stamps, "log_time": c.stream.log_times} for c in cameras]
    axis, reasons = axis_of(both), untimed(both)
    # running maximum: the page shows a frame from the latest time so far
    base = min((int(columns[axis][0]) for columns in both), default=0)
    timed = [number for number, reason in enumerate(reasons) if not reason]
    try:
        topics = topics_of(dataset)
    except (FormatError, SourceError) as error:
        problems.append(str(error))
        topics = []
    notes = list(dict.fromkeys([*problems, *notes_of(dataset)]))
    more = [f"and {len(notes) - _MOST_NOTES} more"] if len(notes) > _MOST_NOTES else []
    return {
        "name": dataset.path.resolve().name,
        "version": __version__,
        "axis": axis,
        "base": str(base),
        "summary": _figures(dataset, topics),
        "reference": timed[0] if len(timed) > 1 else None,
        "cameras": [camera.facts(number, reasons[number]) for number, camera in enumerate(cameras)],
        "topics": [asdict(item) for item in topics],
        "transforms": [item.model_dump() for item in manifest.transforms] if manifest else [],
        "notes": [*notes[:_MOST_NOTES], *more],
    }


def _figures(dataset: Dataset, topics: list[TopicInfo]) -> dict[str, Any]:
    """Figures of the whole dataset: bytes, and nanoseconds as text, as BigInt reads them."""
    manifest = dataset.manifest
    summary: dict[str, Any] = {
        "messages": sum(item.messages for item in topics),
        "topics": len(topics),
    }
    if manifest is None:
        return summary | {"profile": dataset.streams[0].sidecar.profile}
    if span := manifest.time_range:
        summary |= {"start": str(span.start), "end": str(span.end)}
    return summary | {
        "profile": manifest.profile,
        "format": manifest.format,
        "bytes": sum(item.size for item in manifest.files if (dataset.path / item.name).exists()),
        "source_bytes": sum(source.size for source in manifest.sources),
        "sources": [source.name for source in manifest.sources][:_MOST_NOTES],
    }


# ---------------------------------------------------------------- many datasets


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
    jobs: int | None = 1,
    progress: Callable[[str, float | None], None] | None = None,
) -> OverviewSummary:
    """Make the report of each dataset, and a page that shows them all.

    Args:
        datasets: Datasets, folders of them, or patterns; on this machine.
        folder: Where to make the page. Each report is in its dataset.
        options: How the reports are made.
        jobs: Datasets at a time; None for one per core.
        progress: Called with a phrase, and the share done.

    Raises:
        SourceError: A path is not a dataset.
        OptionError: An option is for single reports only.
        TargetError: The page cannot be written there.
        WriteError: The page could not be written.
    """
    chosen = options or ReportOptions()
    if chosen.output is not None:
        raise OptionError("`output` works with one dataset only: each report is in its dataset.")
    found = datasets_in(datasets)
    for path in found:
        _check_local(path)
    place = local_target(folder)
    _check_index(place, chosen)
    tell = progress or (lambda *_: None)
    rows, problems = [], []
    try:
        place.mkdir(exist_ok=True)
        with staged(place / _FOLDER, force=True, owned=listed_names) as made:
            (made / _PICTURES).mkdir(parents=True)
            (made / "report.css").write_bytes((_PAGE / "report.css").read_bytes())
            work = partial(_shown, options=chosen, pictures=made / _PICTURES)
            numbered = [*enumerate(found)]
            for (number, path), (known, wrong) in each(work, numbered, jobs):
                tell(f"{number + 1} of {len(found)}: {path.name}", (number + 1) / len(found))
                problems += wrong
                rows.append(_row(path, known, number, place, made))
            write_listing(made)
        shown = [
            counted(len(found), "dataset"),
            *(f"not shown: {html.escape(problem)}" for problem in problems),
        ]
        page = Template((_PAGE / "overview.html").read_text(encoding="utf-8")).substitute(
            title=html.escape(place.name), facts="<br>".join(shown), rows="\n".join(rows)
        )
        write_synced(place / _INDEX, page.encode())
    except OSError as error:
        raise as_write_error(error, place) from error
    return OverviewSummary(place / _INDEX, len(found), problems)


def _shown(
    item: tuple[int, Path], options: ReportOptions, pictures: Path
) -> tuple[Brief | None, list[str]]:
    """Make report and picture of one dataset; returns its summary and any problems."""
    number, path = item
    try:
        known = brief(path)
        problems = report(path, options).problems
        if known.frames:
            topic = next(iter(known.frames))
            with Dataset(path) as dataset:
                middle = len(dataset[topic]) // 2
                scale = min(1.0, _PICTURE_WIDTH / dataset[topic].image_size[0])
            still = StillOptions(topic=topic, at=middle, resize=scale)
            frames(path, pictures / f"{number}.jpg", still)
    except Mp4dsError as error:
        with suppress(Mp4dsError):
            return brief(path), [str(error)]
        return None, [str(error)]
    return known, problems


def _row(path: Path, known: Brief | None, number: int, place: Path, made: Path) -> str:
    link = quote(Path(os.path.relpath(path / _INDEX, place)).as_posix())
    name = html.escape(os.path.relpath(path, place))
    picture = ""
    if (made / _PICTURES / f"{number}.jpg").exists():
        picture = f'<img src="{_FOLDER}/{_PICTURES}/{number}.jpg" alt="" loading="lazy">'
    cells = ["", "", "", "", ""]
    if known is not None:
        if known.title:
            name += f"<br><span class=muted>{html.escape(known.title)}</span>"
        cells = [
            known.begins.replace("T", " ").rstrip("Z"),
            f"{known.seconds:.1f} s",
            "<br>".join(f"{html.escape(t)}: {n}" for t, n in sorted(known.frames.items())),
            f"{known.bytes / 1e6:.1f} MB",
            html.escape(known.profile),
        ]
    body = "".join(f"<td>{cell}</td>" for cell in cells)
    return f'<tr><td>{picture}</td><td><a href="{link}">{name}</a></td>{body}</tr>'
