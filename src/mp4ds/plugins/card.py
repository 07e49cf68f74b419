"""The dataset card of a folder of datasets: README.md as the Hugging Face Hub reads it."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mp4ds.format.manifest import About
from mp4ds.format.sidecars import MANIFEST_NAME, load_manifest
from mp4ds.plugins.info import Brief, brief

_LICENSES = frozenset(
    [
        *("apache-2.0", "bsd-2-clause", "bsd-3-clause", "cc-by-2.0", "cc-by-2.5", "cc-by-3.0"),
        *("cc-by-4.0", "cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nc-nd-3.0"),
        *("cc-by-nc-nd-4.0", "cc-by-nc-sa-2.0", "cc-by-nc-sa-3.0", "cc-by-nc-sa-4.0"),
        *("cc-by-nd-4.0", "cc-by-sa-3.0", "cc-by-sa-4.0", "cc0-1.0", "gpl-2.0", "gpl-3.0"),
        *("lgpl-3.0", "mit", "odbl", "odc-by", "pddl", "unlicense"),
    ]
)
"""Identifiers of SPDX that the Hub knows, in its small letters; others are told by name."""
_TAGS = ("robotics", "video", "ros", "mp4ds")
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"))
_LARGE = "n>1M"
_PLACE = "OWNER/NAME"
"""Stands for the repository, which nobody but its owner knows."""


def card(datasets: Sequence[Path]) -> str:
    """Markdown with the metadata of the Hub: what was told by ``about``, and a table of datasets.

    Args:
        datasets: Their folders; at least one.

    Raises:
        SourceError: One is no dataset.
        FormatError: A manifest breaks a rule of the format.
    """
    briefs = [brief(path) for path in datasets]
    manifests = [load_manifest(path / MANIFEST_NAME) for path in datasets]
    told = [manifest.about or About() for manifest in manifests]
    versions = ", ".join(_different(manifest.mp4ds for manifest in manifests))
    titles, licenses = _different(it.title for it in told), _different(it.license for it in told)
    title = titles[0] if len(titles) == 1 else "Robot camera recordings"
    lines = ["---", *_metadata(title, licenses, briefs, told), "---", "", f"# {_text(title)}", ""]
    for description in _different(it.description for it in told):
        lines += [_text(description), ""]
    lines += [*_facts(licenses, told), "", *_table(briefs, told), "", *_use(briefs[0], versions)]
    return "\n".join(lines) + "\n"


def _different(values: Iterable[str | None]) -> list[str]:
    """Each value once, in their order."""
    return list(dict.fromkeys(value for value in values if value))


def _metadata(
    title: str, licenses: Sequence[str], briefs: Sequence[Brief], told: Sequence[About]
) -> list[str]:
    """YAML, each value as JSON, which YAML is a superset of."""
    frames = sum(sum(it.frames.values()) for it in briefs)
    license_id = licenses[0].lower() if len(licenses) == 1 else ""
    keywords = [word for it in told for word in it.keywords]
    values: dict[str, Any] = {"pretty_name": title}
    if license_id in _LICENSES:
        values["license"] = license_id
    elif licenses:
        values |= {"license": "other", "license_name": ", ".join(licenses)}
    values["tags"] = _different([*_TAGS, *keywords])
    values["task_categories"] = ["robotics"]
    values["size_categories"] = [
        next((name for most, name in _SIZES if frames < most), _LARGE),
    ]
    return [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()]


def _facts(licenses: Sequence[str], told: Sequence[About]) -> list[str]:
    authors = _different(
        f"{_text(author.name)}{f' ({_text(author.affiliation)})' if author.affiliation else ''}"
        for it in told
        for author in it.authors
    )
    links = [f"https://doi.org/{doi}" for doi in _different(it.doi for it in told)]
    links += _different(link for it in told for link in it.links)
    facts = {
        "Authors": "; ".join(authors),
        "License": ", ".join(map(_text, licenses)),
        "Links": " ".join(f"<{link}>" for link in links if not re.search(r"[<>]", link)),
    }
    return [f"- **{name}**: {value}" for name, value in facts.items() if value]


def _table(briefs: Sequence[Brief], told: Sequence[About]) -> list[str]:
    lines = [
        "| dataset | cameras | frames | seconds | MB | quality |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for it, about in zip(briefs, told, strict=True):
        name = _text(it.path.name) + (f": {_text(about.title)}" if about.title else "")
        cells = (
            *(name, ", ".join(map(_text, it.frames)), sum(it.frames.values())),
            *(f"{it.seconds:.1f}", f"{it.bytes / 1e6:.1f}", _text(it.profile)),
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def _use(first: Brief, versions: str) -> list[str]:
    topic = next(iter(first.frames), "/camera/image_raw")
    url = f"hf://datasets/{_PLACE}/{' '.join(first.path.name.split())}"
    return [
        f"These are datasets of [mp4ds](https://github.com/mp4ds/mp4ds), format {versions}:",
        "mp4 files that VLC, mpv and ffmpeg play, with exact stamps, headers and calibrations in",
        "YAML.",
        "",
        "```sh",
        "pip install 'mp4ds[remote]' huggingface_hub",
        f"mp4ds info {shlex.quote(url)}",
        f"mp4ds unpack {shlex.quote(url)} --to mcap",
        "```",
        "",
        "```python",
        "import mp4ds",
        "",
        f"with mp4ds.open({_quoted(url)}) as dataset:",
        f"    frame = dataset[{_quoted(topic)}][0]",
        "    print(frame.stamp_ns, frame.data.shape, frame.intrinsics)",
        "```",
    ]


def _text(text: str) -> str:
    """A text that is shown as it is, in one line of Markdown."""
    return re.sub(r"([\\|<>\[\]*_`#])", r"\\\1", " ".join(text.split()))


def _quoted(text: str) -> str:
    """A text as Python has it, in one line."""
    return json.dumps(text, ensure_ascii=False)
