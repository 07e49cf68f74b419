"""Bytes of a frame against frames per CPU second, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

Point = tuple[float, float, str]

_COLOURS = {"mp4ds": "#0b5fff", "torchcodec": "#d1495b", "pyav": "#8a8a8a"}
_OTHER = "#444444"
_TICKS = ((5, 10, 20, 50, 100, 200, 500, 1000, 2000), (10, 20, 50, 100, 200, 500))


def draw(curves: Mapping[str, Sequence[Point]], path: Path) -> None:
    """Draw a curve for each reader and codec; of torchcodec's modes the best at each point.

    Args:
        curves: By name, bytes of a frame, random frames per CPU second, and a label of each point.
        path: The SVG to make.
    """
    import matplotlib

    matplotlib.use("agg")
    matplotlib.rcParams["svg.fonttype"] = "none"
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 5))
    for name, points in _merged(curves).items():
        codec, _, reader = name.partition(", ")
        style = "--" if codec == "h264" else "-"
        sizes, rates = [point[0] / 1e3 for point in points], [point[1] for point in points]
        color = _COLOURS.get(reader, _OTHER)
        width = 3.0 if reader == "mp4ds" else 1.5
        axes.plot(sizes, rates, style, color=color, linewidth=width, marker="o", label=name)
        for size, rate, (*_, label) in zip(sizes, rates, points, strict=True):
            text = label if reader in _COLOURS else name
            axes.annotate(text, (size, rate), xytext=(6, 4), textcoords="offset points")
    axes.set(xscale="log", yscale="log")
    for axis, ticks in zip((axes.xaxis, axes.yaxis), _TICKS, strict=True):
        axis.set_major_locator(matplotlib.ticker.FixedLocator(ticks))
        axis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%d"))
        axis.set_minor_locator(matplotlib.ticker.NullLocator())
    axes.set(xlabel="kB a frame", ylabel="random frames per CPU second")
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    lines = [line for line in axes.get_lines() if len(line.get_xdata()) > 1]
    axes.legend(handles=lines, frameon=False, loc=(0.5, 0.15))
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def _merged(curves: Mapping[str, Sequence[Point]]) -> dict[str, list[Point]]:
    found: dict[str, dict[float, Point]] = {}
    for name, points in curves.items():
        codec, _, reader = name.partition(", ")
        if (codec, reader) == ("lerobot", "mp4ds"):
            continue  # how we read LeRobot's file is no way to store frames
        if reader.startswith("torchcodec"):
            reader = "torchcodec"
        short = codec if codec in ("png", "jpeg", "lerobot") else f"{codec}, {reader}"
        best = found.setdefault(short, {})
        for point in points:
            known = best.get(point[0])
            if known is None or known[1] < point[1]:
                best[point[0]] = point
    return {name: sorted(best.values()) for name, best in found.items()}
