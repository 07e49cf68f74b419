"""Tables and a drawing of what benchmarks/loader.py measured."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from loader_peers import OURS
from measure import print_table

Figures = Sequence[Mapping[str, Any]]


@dataclass
class Cell:
    """One reader, one way to store, one pattern.

    Attributes:
        per_cpu: Frames per CPU second, of each round.
        per_second: Frames per second on the clock, of each round.
        faults: What is wrong with its frames, and how much of the last round.
        failures: Why there are none.
    """

    per_cpu: list[float] = field(default_factory=list)
    per_second: list[float] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)
    failures: dict[str, None] = field(default_factory=dict)

    @property
    def rate(self) -> float:
        """Frames per CPU second, the median."""
        return median(self.per_cpu) if self.per_cpu else 0.0

    @property
    def counts(self) -> bool:
        """Whether it gives the frames that are wanted."""
        return bool(self.per_cpu) and not self.failures and set(self.faults) <= {"other colours"}

    def __str__(self) -> str:
        if self.failures:
            return "fails"
        if not self.per_cpu:
            return ""
        faults = ", ".join(self.faults.values())
        text = number(self.rate)
        if len(self.per_cpu) > 1:
            text += f" ({number(min(self.per_cpu))} to {number(max(self.per_cpu))})"
        text += f", {number(median(self.per_second))}/s"
        return f"{text}; {faults}" if faults else text


def number(value: float) -> str:
    """With three digits."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def short(failure: str) -> str:
    """The beginning of what went wrong, without times and addresses."""
    return re.sub(r"\[[\d:]+\]|/\S+/", "", " ".join(failure.split()))[:120]


Cells = dict[tuple[str, str, str], Cell]


def cells_of(figures: Figures) -> Cells:
    """Cells by way to store, pattern and reader."""
    cells: Cells = defaultdict(Cell)
    for figure in figures:
        cell = cells[figure["way"], figure["pattern"], figure["peer"]]
        if "failed" in figure:
            cell.failures[short(figure["failed"])] = None
            continue
        cell.per_cpu.append(figure["frames"] / figure["cpu"])
        cell.per_second.append(figure["frames"] / figure["wall"])
        if figure["verdict"]:
            cell.faults[figure["verdict"].partition(" (")[0]] = figure["verdict"]
    return dict(cells)


def report(figures: Figures, patterns: Mapping[str, str], plot: Path | None) -> None:
    """Print the tables, and draw."""
    cells = cells_of(figures)
    measured = {pattern for _, pattern, _ in cells}
    patterns = {pattern: text for pattern, text in patterns.items() if pattern in measured}
    sizes = {figure["way"]: figure["bytes"] for figure in figures}
    videos = [way for way in sizes if "-" in way]
    others = [way for way in sizes if "-" not in way]
    best = "frames per CPU second: median (least to most), and frames per second on the clock"
    print(f"\nThe same files, {best}:")
    header: tuple[str, ...]
    header = ("codec", "GOP", "kB a frame", "pattern", OURS, "best other", "", "mp4ds / other")
    print_table(header, _against_best(cells, sizes, videos, patterns))
    print(f"\nOther ways to store the same frames, {best}:")
    header = ("stored as", "kB a frame", "pattern", "read by", "")
    print_table(header, _others(cells, sizes, others, patterns))
    print("\nmp4ds with each GOP against LeRobot's loader with LeRobot's encoding:")
    header = ("codec", "GOP", "size / LeRobot's", *(f"{text}" for text in patterns.values()))
    print_table(header, _against_lerobot(cells, sizes, videos, patterns))
    print(f"\nAll readers, {best}:")
    readers = list(dict.fromkeys(peer for way, _, peer in cells if way in videos))
    header = ("codec", "GOP", "pattern", *readers)
    print_table(header, _all(cells, videos, patterns, readers))
    print("\nFailures:\n")
    for text in _failures(cells):
        print(f"- {text}")
    if plot:
        from loader_plot import draw

        draw(_curves(cells, sizes), plot)


def _against_best(
    cells: Cells, sizes: Mapping[str, float], ways: Sequence[str], patterns: Mapping[str, str]
) -> Iterator[tuple[object, ...]]:
    for way in ways:
        codec, _, gop = way.partition("-")
        for pattern, text in patterns.items():
            ours = cells.get((way, pattern, OURS), Cell())
            name, best = _best(cells, way, pattern)
            ratio = f"{ours.rate / best.rate:.2f}" if ours.counts and best.counts else ""
            yield codec, gop, f"{sizes[way] / 1000:.1f}", text, ours, name, best, ratio


def _best(cells: Cells, way: str, pattern: str) -> tuple[str, Cell]:
    """The quickest of the others that gives the frames that are wanted."""
    found = {
        peer: cell
        for (a, b, peer), cell in cells.items()
        if (a, b) == (way, pattern) and peer != OURS and cell.counts
    }
    if not found:
        return "", Cell()
    return max(found.items(), key=lambda item: item[1].rate)


def _others(
    cells: Cells, sizes: Mapping[str, float], ways: Sequence[str], patterns: Mapping[str, str]
) -> Iterator[tuple[object, ...]]:
    for (way, pattern, peer), cell in cells.items():
        if way in ways and pattern in patterns:
            yield way, f"{sizes[way] / 1000:.1f}", patterns[pattern], peer, cell


def _against_lerobot(
    cells: Cells, sizes: Mapping[str, float], ways: Sequence[str], patterns: Mapping[str, str]
) -> Iterator[tuple[object, ...]]:
    for way in ways:
        codec, _, gop = way.partition("-")
        ratios = []
        for pattern in patterns:
            ours = cells.get((way, pattern, OURS), Cell())
            theirs = cells.get(("lerobot", pattern, "lerobot"), Cell())
            if not theirs.counts:
                theirs = cells.get(("lerobot", pattern, "lerobot (emulated)"), Cell())
            counts = ours.counts and theirs.counts
            ratios.append(f"{ours.rate / theirs.rate:.2f}" if counts else "")
        size = f"{sizes[way] / sizes['lerobot']:.2f}" if "lerobot" in sizes else ""
        yield codec, gop, size, *ratios


def _all(
    cells: Cells, ways: Sequence[str], patterns: Mapping[str, str], readers: Sequence[str]
) -> Iterator[tuple[object, ...]]:
    for way in ways:
        codec, _, gop = way.partition("-")
        for pattern, text in patterns.items():
            yield codec, gop, text, *(cells.get((way, pattern, peer), "") for peer in readers)


def _failures(cells: Cells) -> Iterator[str]:
    found: dict[tuple[str, str], set[str]] = defaultdict(set)
    for (way, _, peer), cell in cells.items():
        for failure in cell.failures:
            found[peer, failure].add(way)
    for (peer, failure), ways in found.items():
        yield f"{peer}, {', '.join(sorted(ways))}: {failure}"


Point = tuple[float, float, str]


def _curves(cells: Cells, sizes: Mapping[str, float]) -> dict[str, list[Point]]:
    """Of each reader and codec: bytes a frame, random frames per CPU second, and the GOP."""
    curves: dict[str, list[Point]] = defaultdict(list)
    for (way, pattern, peer), cell in cells.items():
        if pattern != "single" or not cell.counts:
            continue
        codec, _, gop = way.partition("-")
        name = f"{codec}, {peer}" if codec not in peer else peer
        curves[name].append((sizes[way], cell.rate, gop))
    return {name: sorted(points) for name, points in curves.items()}
