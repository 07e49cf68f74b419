"""Recording -> dataset -> recording, as several tests go; and what is found on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mp4ds
from compare import compare
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.unpack import UnpackOptions
from scenes import Scene
from sources import SOURCES, Source

TARGETS = {
    "bag": ("bag", None),
    "rosbag2-sqlite3": ("rosbag2", "sqlite3"),
    "rosbag2-mcap": ("rosbag2", "mcap"),
    "mcap": ("mcap", None),
    "rosbag2": ("rosbag2", None),
}
OWN_TARGET = {"bag": "bag", "rosbag2": "rosbag2-mcap", "mcap": "mcap"}


def packed(folder: Path, recorded: Scene, source: str = "bag-none", **options: Any) -> Path:
    """A dataset of a scene in a source."""
    paths = SOURCES[source](folder / "source", recorded)
    mp4ds.pack(paths, folder / "dataset", PackOptions(**options))
    return folder / "dataset"


def own_target(source: str) -> str:
    """The target of a source's own format."""
    kind = source.split("-")[0]
    return "rosbag2-sqlite3" if source.startswith("rosbag2-sqlite3") else OWN_TARGET[kind]


def output_of(folder: Path, target: str) -> Path:
    """Where `unpacked` writes."""
    return folder / f"again{ {'bag': '.bag', 'mcap': '.mcap'}.get(TARGETS[target][0], '') }"


def unpacked(folder: Path, target: str) -> Path:
    """What comes out of ``folder / "dataset"``."""
    to, storage = TARGETS[target]
    output = output_of(folder, target)
    mp4ds.unpack(folder / "dataset", to, output, UnpackOptions(storage=storage))
    return output


@dataclass(frozen=True)
class Journey:
    """A recording that was packed, validated and unpacked.

    Attributes:
        sources: Of the recording.
        output: What came out.
        summary: Of the pack.
        dataset: The dataset between.
    """

    sources: list[Path]
    output: Path
    summary: mp4ds.PackSummary
    dataset: Path

    def frames(self, topic: str) -> tuple[int, int]:
        """Messages of a topic, and how many of them are frames of videos."""
        (found,) = (entry for entry in self.summary.topics if entry.topic == topic)
        return found.messages, found.frames

    def reasons(self, topic: str) -> dict[str, int]:
        """Why messages of a topic are in no video, and how many."""
        (found,) = (entry for entry in self.summary.topics if entry.topic == topic)
        return {reason: count for reason, (count, _) in found.verbatim.items()}


def journey(
    folder: Path,
    write: Source,
    scene: Scene,
    target: str,
    ignore_pixels: Sequence[str] = (),
    **options: Any,
) -> Journey:
    """Write a scene, pack it, validate it, and unpack it: what comes out is equal.

    Args:
        folder: Where to do it; empty.
        write: The source's writer.
        scene: What to record.
        target: One of `TARGETS`.
        ignore_pixels: Topics whose pixels may differ.
        options: Of the pack.
    """
    sources = write(folder / "source", scene)
    summary = mp4ds.pack(sources, folder / "dataset", PackOptions(**options))
    assert mp4ds.validate(folder / "dataset", deep=True) == []
    output = unpacked(folder, target)
    assert compare(sources, output, ignore_pixels=ignore_pixels) == []
    return Journey(sources, output, summary, folder / "dataset")
