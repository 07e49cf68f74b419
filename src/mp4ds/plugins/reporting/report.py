"""``report``: a dataset as an HTML page next to its files.

index.html and a folder ``report`` are added to the dataset, or written elsewhere. The page plays
the dataset's own videos if browsers can, else small proxies; its columns are exact.
"""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from mp4ds.dataset.dataset import Dataset
from mp4ds.dataset.stream import Stream
from mp4ds.errors import FormatError, OptionError, SourceError, TargetExistsError
from mp4ds.files.outputs import (
    as_write_error,
    check_target,
    is_page,
    listed_names,
    staged,
    write_listing,
    write_synced,
)
from mp4ds.files.urls import remote
from mp4ds.options import WHERE, SliceOptions, force, option
from mp4ds.plugins.reporting.cameras import ReportedCamera, Scores, read_scores, scores_of
from mp4ds.plugins.reporting.page import (
    FOLDER_NAME,
    INDEX_NAME,
    PROXIES_NAME,
    TopicRow,
    index_page,
    topic_rows,
    write_folder,
)
from mp4ds.plugins.reporting.proxies import (
    make_proxy,
    presentation_times,
    proxy_key,
    proxy_size,
    why_not_in_browsers,
    why_not_seen,
)

PROXIES = ("auto", "all", "none")
_KEYS_NAME = "proxies.json"


@dataclass(frozen=True, kw_only=True)
class ReportOptions(SliceOptions):
    """How to make a report."""

    output: Path | None = option(
        "Folder to write to; default: the dataset itself.",
        None,
        "-o",
        panel=WHERE,
        metavar="FOLDER",
    )
    proxies: str = option(
        "Make small videos for cameras browsers cannot play (auto), for all, or for none.",
        "auto",
        metavar="WHICH",
    )
    proxy_width: int = option(
        "Maximum width of a proxy.", 640, metavar="PIXELS", least=64, most=3840
    )
    scores: Path | None = option("Quality scores per frame, to plot.", metavar="JSON")
    force: bool = force("Replace an index.html that is not a report.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.proxies not in PROXIES:
            raise OptionError(f"`proxies` {self.proxies!r} is not known. Use {', '.join(PROXIES)}.")


@dataclass(frozen=True)
class CameraSummary:
    """What the page plays for a stream.

    Attributes:
        topic: Its topic.
        plays: Its own ``video``, a ``proxy``, or ``nothing``.
        note: Why, if it is not its own video.
    """

    topic: str
    plays: str
    note: str


@dataclass(frozen=True)
class ReportSummary:
    """A report that was made.

    Attributes:
        index: The page.
        files: The files it needs, by path from the common folder of dataset and page.
        cameras: In the order of the page.
        bytes: Total size of what was written.
        problems: What could not be shown of the dataset.
    """

    index: Path
    files: dict[str, Path] = field(repr=False)
    cameras: list[CameraSummary]
    bytes: int
    problems: list[str]

    @property
    def start(self) -> str:
        """Path of the page's URL when `files` are served."""
        return quote(next(name for name, path in self.files.items() if path == self.index))


def report(
    dataset: Path | str,
    options: ReportOptions | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> ReportSummary:
    """Make the page of a dataset. An existing report is replaced; its proxies are reused.

    Args:
        dataset: A dataset, or one video with its sidecar, on this machine.
        options: How. A slice is first made into a dataset, at `output`.
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
    if chosen.slice:
        return _report_slice(dataset, chosen, tell)
    with Dataset(dataset) as opened:
        if remote(opened.path):
            raise SourceError(opened.path, "is not on this machine", "Copy the dataset first.")
        if opened.manifest is None and chosen.output is None:
            raise OptionError("A single video has no folder for a report: give `output`.")
        folder = Path(os.path.abspath(chosen.output or opened.path))  # noqa: PTH100 - as named
        _check_place(folder, force=chosen.force)
        scores = _scores(opened, chosen.scores)
        try:
            is_new = not folder.exists()
            folder.mkdir(exist_ok=True)
            try:
                return _write(opened, folder, chosen, scores, tell)
            except BaseException:
                if is_new:
                    with suppress(OSError):
                        folder.rmdir()  # leave neither partial output nor an empty folder
                raise
        except OSError as error:
            raise as_write_error(error, folder) from error


def _report_slice(
    dataset: Path | str, options: ReportOptions, tell: Callable[[str], None]
) -> ReportSummary:
    """The report of a slice, which is first made into a dataset."""
    from mp4ds.packing.options import PackOptions
    from mp4ds.packing.pack import pack

    if options.output is None:
        raise OptionError("Give `output`: where to write the slice as a dataset with its report.")
    tell("copying the slice")
    span = PackOptions(
        start=options.start, end=options.end, duration=options.duration, force=options.force
    )
    pack(dataset, options.output, span)
    whole = replace(options, start=None, end=None, duration=None, output=None)
    return report(options.output, whole, progress=tell)


def _scores(dataset: Dataset, path: Path | None) -> Mapping[str, Scores]:
    """The scores of a file.

    Raises:
        OptionError: It has scores for an unknown stream.
    """
    scores = read_scores(path) if path else {}
    for topic in scores:
        if topic not in dataset:
            known = ", ".join(dataset.topics) or "none"
            raise OptionError(f"`scores` {path} has {topic!r}, which is not one of {known}.")
    return scores


def _check_place(folder: Path, *, force: bool) -> None:
    """Refuse early if something must not be replaced.

    Raises:
        TargetError: Says what.
    """
    if folder.exists():
        index = folder / INDEX_NAME
        if os.path.lexists(index) and not is_page(index) and not force:
            raise TargetExistsError(index)
        check_target(folder / FOLDER_NAME, force=True, owned=listed_names)
    else:
        check_target(folder, force=False, owned=listed_names)


def _write(
    dataset: Dataset,
    folder: Path,
    options: ReportOptions,
    scores: Mapping[str, Scores],
    tell: Callable[[str], None],
) -> ReportSummary:
    target = folder / FOLDER_NAME
    problems: list[str] = []
    with staged(target, force=True, owned=listed_names) as path:
        path.mkdir()
        proxies = _Proxies(old=target, new=path)
        cameras = []
        for camera in _cameras(dataset, scores, problems):
            try:
                _give_video(camera, folder, options, proxies, tell)
            except FormatError as error:
                camera.note = str(error)
                problems.append(str(error))
            cameras.append(camera)
        proxies.write_keys()
        tell("topics")
        write_folder(path, dataset, cameras, _topics(dataset, problems), problems)
        write_listing(path)
    write_synced(folder / INDEX_NAME, index_page())
    return _summary(dataset, folder, cameras, problems)


def _cameras(
    dataset: Dataset, scores: Mapping[str, Scores], problems: list[str]
) -> Iterator[ReportedCamera]:
    """The streams by topic; those whose columns cannot be read become problems."""
    streams = sorted(dataset.streams, key=lambda stream: (stream.topic, stream.path.stem))
    topics = Counter(stream.topic for stream in streams)
    for stream in streams:
        alone = topics[stream.topic] == 1
        name = stream.topic if alone else f"{stream.topic} ({stream.path.stem})"
        camera = ReportedCamera(stream, name, scores=scores_of(stream, scores))
        try:
            camera.check()
        except FormatError as error:
            problems.append(str(error))
            continue
        yield camera


def _topics(dataset: Dataset, problems: list[str]) -> list[TopicRow]:
    try:
        return topic_rows(dataset)
    except (FormatError, SourceError) as error:
        problems.append(str(error))
        return []


def _give_video(
    camera: ReportedCamera,
    folder: Path,
    options: ReportOptions,
    proxies: _Proxies,
    tell: Callable[[str], None],
) -> None:
    """Find or make what the page plays of a camera.

    Raises:
        FormatError: Its video is damaged.
    """
    stream = camera.stream
    camera.times = presentation_times(stream)
    unplayable = why_not_in_browsers(stream.video_path)
    camera.note = unplayable or why_not_seen(stream)
    if options.proxies == "all" or (camera.note and options.proxies == "auto"):
        camera.note = camera.note or "requested"
        camera.video, camera.caption = proxies.give(stream, camera.times, options.proxy_width, tell)
        camera.is_proxy = True
    elif not unplayable:
        camera.video = _url(stream.video_path, folder)


def _url(path: Path, folder: Path) -> str:
    """URL of a file, relative to a page in a folder."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


class _Proxies:
    """The proxies of a report in progress, and those of the previous one."""

    def __init__(self, *, old: Path, new: Path) -> None:
        self._old = old / PROXIES_NAME
        self._new = new / PROXIES_NAME
        self._known: dict[str, list[str]] = {}
        self._made: dict[str, list[str]] = {}
        with suppress(OSError, ValueError, AttributeError):
            found = json.loads((self._old / _KEYS_NAME).read_bytes())
            self._known = {str(name): [str(part) for part in item] for name, item in found.items()}

    def give(
        self, stream: Stream, times: NDArray[np.int64], width: int, tell: Callable[[str], None]
    ) -> tuple[str, str]:
        """Make a proxy, or reuse an earlier one.

        Returns:
            Its URL relative to the page, and its caption.
        """
        self._new.mkdir(exist_ok=True)
        name = f"{stream.path.stem}.mp4"
        size = proxy_size(stream.image_size, width)
        key = proxy_key(stream, size)
        known = self._known.get(name, [])
        if key and len(known) == 2 and known[0] == key and self._take(name):
            caption = known[1]
        else:
            caption = make_proxy(stream, self._new / name, size=size, times=times, progress=tell)
        self._made[name] = [key, caption]
        return f"{FOLDER_NAME}/{PROXIES_NAME}/{quote(name)}", caption

    def _take(self, name: str) -> bool:
        """Reuse an old proxy in the new report."""
        try:
            os.link(self._old / name, self._new / name)
        except OSError:
            try:
                shutil.copyfile(self._old / name, self._new / name)
            except OSError:
                (self._new / name).unlink(missing_ok=True)
                return False
        return True

    def write_keys(self) -> None:
        """Write the keys of the proxies, for the next report."""
        if self._made:
            (self._new / _KEYS_NAME).write_text(json.dumps(self._made))


def _summary(
    dataset: Dataset, folder: Path, cameras: list[ReportedCamera], problems: list[str]
) -> ReportSummary:
    own = [folder / INDEX_NAME, *(p for p in (folder / FOLDER_NAME).rglob("*") if p.is_file())]
    videos = [c.stream.video_path for c in cameras if c.video and not c.is_proxy]
    everything = [*own, *(video.resolve() for video in videos)]
    base = Path(os.path.commonpath([folder.resolve(), *(v.resolve().parent for v in videos)]))
    return ReportSummary(
        index=folder / INDEX_NAME,
        files={_place(path, base): path for path in everything},
        cameras=[
            CameraSummary(
                c.name, "proxy" if c.is_proxy else "video" if c.video else "nothing", c.note
            )
            for c in cameras
        ],
        bytes=sum(path.stat().st_size for path in own),
        problems=problems,
    )


def _place(path: Path, base: Path) -> str:
    resolved = path.parent.resolve() / path.name
    return f"/{resolved.relative_to(base).as_posix()}"
