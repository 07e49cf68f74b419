"""Packs for URLs: the dataset is made on this machine, then uploaded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

from mp4ds.errors import SourceNotFoundError
from mp4ds.owned import Owned
from mp4ds.packing.job import open_recording, outcome_options, tools
from mp4ds.packing.report import PackOptions, PackProgress, PackSummary, TopicSummary
from mp4ds.remote import RemotePath
from mp4ds.sidecar import MANIFEST_NAME
from mp4ds.source_files import SourceState
from mp4ds.uploads import Upload

Report = Callable[[PackProgress], None]
Pack = Callable[[Path, PackOptions, "Report | None"], PackSummary]
"""Packs into a folder of this machine."""


def pack_to_store(
    paths: Sequence[Path],
    target: RemotePath,
    options: PackOptions,
    owned: Owned,
    pack: Pack,
    report: Report | None,
) -> PackSummary:
    """Pack a recording into a dataset at a URL.

    A dataset that an earlier run of the same command made and could not upload is not made again.

    Args:
        paths: The recordings.
        target: The dataset.
        options: How.
        owned: Tells which files of a dataset that is there mp4ds wrote.
        pack: Makes it here.
        report: Told of progress.

    Raises:
        RemoteError: It could not be uploaded; it is kept here.
        Mp4dsError: As `mp4ds.packing.pack`.
    """

    def make(local: Path) -> dict[str, Any]:
        return asdict(pack(local, options, _renamed(report, target))) | {"dataset": ""}

    values = Upload(target, last=MANIFEST_NAME).run(
        lambda: _order(paths, options),
        make,
        force=options.force,
        owned=owned,
        report=_upload_report(report, target),
    )
    return _from_values(values, target)


def shared_folder(target: RemotePath) -> Path:
    """Where the shares of a pack for a URL meet: the same on all machines that share TMPDIR."""
    upload = Upload(target, last=MANIFEST_NAME)
    upload.folder.mkdir(exist_ok=True)
    return upload.local


def _order(paths: Sequence[Path], options: PackOptions) -> dict[str, Any]:
    """What tells whether a dataset is what the same command would make now."""
    return {
        "paths": [str(path) for path in paths],
        "sources": [
            asdict(SourceState.of(file)) | {"path": str(file)} for file in _files_of(paths, options)
        ],
        "options": outcome_options(options),
        "tools": tools(),
    }


def _files_of(paths: Sequence[Path], options: PackOptions) -> list[Path]:
    if options.images is None:
        return [file for path in paths for file in _files(path)]
    with open_recording(paths, images=options.images) as reader:
        return list(reader.files)


def _files(path: Path) -> Iterator[Path]:
    if not path.exists():
        raise SourceNotFoundError(path)
    if not path.is_dir():
        yield path
        return
    found = sorted(file for file in path.iterdir() if file.is_file())
    yield from found or [path / "metadata.yaml"]  # a web server lists nothing


def _from_values(values: Mapping[str, Any], target: RemotePath) -> PackSummary:
    topics = [
        TopicSummary(**{**item, "verbatim": {k: (v[0], v[1]) for k, v in item["verbatim"].items()}})
        for item in values["topics"]
    ]
    return PackSummary(**{**values, "topics": topics, "dataset": target})


def _renamed(report: Report | None, target: RemotePath) -> Report | None:
    if report is None:
        return None
    dataset = cast(Path, target)
    return lambda state: report(replace(state, dataset=dataset))


def _upload_report(
    report: Report | None, target: RemotePath
) -> Callable[[str, int, int], None] | None:
    if report is None:
        return None

    def tell(name: str, done: int, total: int) -> None:
        report(
            PackProgress(
                dataset=cast(Path, target),
                phase="uploading",
                done=done / total if total else None,
                bytes_read=0,
                bytes_total=total,
                bytes_written=done,
                topics={},
                note=name,
            )
        )

    return tell
