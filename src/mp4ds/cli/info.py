"""``mp4ds info`` and ``mp4ds validate``: what is in recordings and datasets."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

import click

from mp4ds.cli.options import argument, command, datasets_argument, jobs_option, option, takes
from mp4ds.cli.output import number, print_table, progress_of, say, show
from mp4ds.dataset.checks import Problem, validate
from mp4ds.dataset.dataset import Dataset, datasets_in
from mp4ds.errors import OptionError, SourceError, counted, path_text, size_text
from mp4ds.files.outputs import digest_file
from mp4ds.files.urls import location
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.options import HOW, SliceOptions
from mp4ds.plugins import info as facts
from mp4ds.processes import each

_TEXTS = {
    "topic": "topic",
    "dataset": "topic",
    "type": "type",
    **dict.fromkeys(("content", "stored", "begins", "profile"), "text"),
}


@command()
@argument(
    "paths",
    "PATH...",
    "A .bag, rosbag2 folder, .mcap, dataset or sidecar; or datasets, or a folder of them.",
    nargs=-1,
    required=True,
)
@option(
    "--checksums",
    is_flag=True,
    panel=HOW,
    help="Print the SHA-256 of a dataset's files in the format of sha256sum.",
)
@takes(SliceOptions)
def info_command(paths: Sequence[str], checksums: bool, options: SliceOptions) -> None:
    """Show what is in a recording or a dataset."""
    found = _found(paths)
    if len(found) > 1 and (options.is_slice or checksums):
        raise OptionError("These options work with one recording or dataset only.")
    with progress_of("reading") as tell:
        if checksums:
            path = found[0] / MANIFEST_NAME
            if not path.is_file():
                raise OptionError(f"{found[0]} is not a dataset; only datasets have checksums.")
            known = {item.name: item.sha256 for item in load_manifest(path).files}
            known[MANIFEST_NAME] = digest_file(path)[1]
            lines = [f"{sha256}  {name}" for name, sha256 in known.items()]
            show(known, lambda _: [*map(say, lines)])
        elif len(found) == 1:
            show(facts.info(found[0], options), _print_info)
        else:
            rows = []
            for done, path in enumerate(found):
                tell(path.name, done / len(found))
                rows.append(facts.brief(path))
            show(rows, _print_overview)


@command()
@datasets_argument
@option(
    "--deep",
    is_flag=True,
    panel=HOW,
    help="Also hash and decode every file and check every message's digest.",
)
@jobs_option
def validate_command(datasets: Sequence[str], deep: bool, jobs: int | None) -> None:
    """Check datasets and list every problem; exits with 1 if there are any."""
    places = datasets_in(datasets)
    found: dict[Path, list[Problem]] = {}
    with progress_of("validating") as tell:
        if len(places) == 1:
            found[places[0]] = validate(places[0], deep=deep, progress=tell)
        else:
            for path, problems in each(partial(validate, deep=deep), places, jobs):
                found[path] = problems
                tell(f"{len(found)} of {len(places)} datasets", len(found) / len(places))
    results = []
    for path, problems in found.items():
        result = {"path": path, "deep": deep, "problems": problems, "absent": "", "reduced": ""}
        if not problems:
            with Dataset(path) as dataset:
                result["absent"] = dataset.absence()
                result["reduced"] = dataset.manifest.reduced if dataset.manifest else ""
        results.append(result)
    shown = results[0] if len(results) == 1 else results
    show(shown, lambda _: _print_validation(results, deep=deep))
    if any(found.values()):
        raise click.exceptions.Exit(1)


def _found(paths: Sequence[str]) -> list[Path]:
    """What to show: one recording, or datasets."""
    try:
        return datasets_in(paths)
    except SourceError:
        if len(paths) > 1:
            raise
        return [location(paths[0])]  # a recording's folder, or nothing


def _print_validation(results: Sequence[Mapping[str, Any]], *, deep: bool) -> None:
    """Print all problems of datasets, what they lack, and how thorough the check was."""
    found: list[Problem] = [problem for result in results for problem in result["problems"]]
    for problem in found:
        say(path_text(problem))
    for what in ("absent", "reduced"):
        for result in results:
            if result[what]:
                say(f"{path_text(result['path'])}: {result[what]}")
    problems = counted(len(found), "problem") if found else "no problems"
    if not deep:
        depth = "; frames were not decoded (--deep does)"
    elif not found:
        here = " here" if any(result["absent"] for result in results) else ""
        depth = f"; every video{here} was decoded, every message with a digest{here} checked"
    else:
        depth = ""  # what is missing or broken was not
    if len(results) == 1:
        say(f"{path_text(results[0]['path'])}: {problems}{depth}")
        return
    wrong = sum(bool(result["problems"]) for result in results)
    where = f" in {wrong} of them" if wrong else ""
    say(f"{len(results)} datasets: {problems}{where}{depth}")


def _print_overview(rows: Sequence[facts.Brief]) -> None:
    """Print a line for each dataset, and totals."""
    base = os.path.commonpath([str(row.path.parent) for row in rows])

    def line(name: str, own: Sequence[facts.Brief], begins: str, profile: str) -> dict[str, str]:
        return {
            "dataset": name,
            "begins": begins,
            "seconds": f"{sum(row.seconds for row in own):.1f}",
            "messages": str(sum(row.messages for row in own)),
            "cameras": str(len({topic for row in own for topic in row.frames})),
            "frames": str(sum(sum(row.frames.values()) for row in own)),
            "size": size_text(sum(row.bytes for row in own)),
            "profile": profile,
        }

    table = []
    for row in rows:
        name = os.path.relpath(str(row.path), base) if base else str(row.path)
        table.append(line(name, [row], row.begins, row.profile))
    table.append(line(f"{len(rows)} datasets", rows, "", ""))
    print_table(table, _TEXTS, spare=("profile", "messages", "cameras", "begins"))


def _print_info(result: facts.Info) -> None:
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
    rows = [
        {
            "topic": topic.topic,
            "type": topic.type_name,
            "messages": str(topic.messages),
            "Hz": number(topic.rate_hz, 2),
            "jitter ms": number(topic.jitter_ms, 2),
            "gaps": str(topic.gaps or ""),
            "longest s": number(topic.longest_gap_s, 3),
            "size": size_text(topic.bytes) if topic.bytes is not None else "",
            "content": topic.content,
            "stored": topic.stored,
        }
        for topic in (*cameras, *others)
    ]
    spare = ("jitter ms", "longest s", "gaps", "stored", "size", "type")
    if print_table(rows, _TEXTS, spare=spare):
        say("shortened to fit; in full: --json, or `| less -S`")
    for note in result.notes:
        say(note)
