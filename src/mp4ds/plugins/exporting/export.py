"""Dataset -> image files and the formats of other tools, which keep what they support."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path

from mp4ds._version import __version__
from mp4ds.dataset.dataset import datasets_in
from mp4ds.dataset.recording import HOW_TO_SALVAGE, open_selected, slice_of, sliced
from mp4ds.errors import OptionError, advising
from mp4ds.files.outputs import listed_names, local_target, staged
from mp4ds.format.fields import document_of
from mp4ds.packing.options import plugin
from mp4ds.plugins.exporting.folders import (
    write_colmap,
    write_euroc,
    write_images,
    write_tum,
)
from mp4ds.plugins.exporting.job import (
    NOTE_NAME,
    UNSELECTED,
    ExportJob,
    ExportOptions,
    ExportSummary,
)

_FORMATS: dict[str, tuple[str, Callable[..., None]]] = {
    "images": ("a folder of images", write_images),
    "euroc": ("EuRoC", write_euroc),
    "tum": ("TUM", write_tum),
    "colmap": ("COLMAP", write_colmap),
    "lerobot": ("LeRobot", lambda *jobs: plugin("exporting.lerobot:write")(*jobs)),
}
"""Name of a format -> as its users write it, and what writes it."""


def export(
    datasets: Path | str | Sequence[Path | str],
    to: str,
    output: Path | str,
    options: ExportOptions | None = None,
    *,
    progress: Callable[[str, float | None], None] | None = None,
) -> ExportSummary:
    """Export a dataset to image files or another tool's format, keeping what that supports.

    Args:
        datasets: A dataset, or one video with its sidecar, or its URL; for lerobot also several,
            each of which becomes an episode.
        to: ``images``, ``euroc``, ``tum``, ``colmap`` or ``lerobot``.
        output: The folder to make.
        options: How.
        progress: Called now and then with a phrase, and the share of frames done if known.

    Returns:
        What was written, and every message that was not, counted by reason.

    Raises:
        OptionError: An option is wrong, or the format cannot hold anything of the dataset.
        FormatError: The dataset is damaged; nothing is left behind.
        TargetError: The output cannot be written there.
        WriteError: The output could not be written; nothing is left behind.
        RemoteError: A store or web server fails.
    """
    chosen = options or ExportOptions()
    if not isinstance(datasets, (str, Path)) and not [*datasets]:
        raise OptionError("there is no dataset to export")
    paths = datasets_in(datasets)
    if to not in _FORMATS:
        raise OptionError(f"format {to!r} is not known. Use {', '.join(_FORMATS)}.")
    name, write = _FORMATS[to]
    in_colour = to == "lerobot"  # its videos are
    if len(paths) > 1 and to != "lerobot":
        raise OptionError(
            f"{name} holds a single dataset, but {len(paths)} were given: export them one by one."
        )
    chosen.check_for(to)
    target = local_target(output)
    with ExitStack() as stack, advising(HOW_TO_SALVAGE):
        layer, check_all = "view" if in_colour else chosen.layer, not chosen.is_slice
        opened = [
            stack.enter_context(
                open_selected(path, chosen.uses, layer=layer, verify_messages=check_all)
            )
            for path in paths
        ]
        if layer is None:
            for one in opened:
                one.require_exact(chosen.uses)
        owned, sources = partial(listed_names, listing=NOTE_NAME), [one.path for one in opened]
        path = stack.enter_context(staged(target, force=chosen.force, owned=owned, sources=sources))
        summary, jobs = ExportSummary(target, to), list[ExportJob]()
        for number, one in enumerate(opened):
            span, place = slice_of(one, chosen, chosen.uses), path.parent / str(number)
            job = ExportJob(
                stack.enter_context(sliced(one, span, place, chosen.uses)),
                path,
                chosen,
                summary,
                progress or (lambda *_: None),
                where=f"{one.path.name}: " if len(opened) > 1 else "",
                in_colour=in_colour,
                as_recorded=to == "images",
                views=[part.topic for part in one.streams if part.layer == "view"],
            )
            jobs.append(job)
        write(*jobs)
        for job in jobs:
            job.leave_out_rest(name)
        if not summary.messages:
            why = [
                f"{topic}: {reason}"
                for topic, found in summary.left_out.items()
                for reason in found
                if reason != UNSELECTED
            ]
            raise OptionError(
                f"{name} cannot hold any topic of {jobs[0].dataset.path}: "
                f"{why[0] if why else 'it has no messages'}."
            )
        files = sorted(p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file())
        note: dict[str, object] = {"mp4ds": __version__, **asdict(summary)}
        note |= {"output": target.name, "files": files}
        manifests = [job.dataset.manifest for job in jobs]
        if abouts := [one.about for one in manifests if one and one.about]:
            note["about"] = list(map(document_of, abouts))
        (path / NOTE_NAME).write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
        return summary
