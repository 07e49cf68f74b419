"""Bytes of a frame against frames per CPU second, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

Point = tuple[float, float, str]


def draw(curves: Mapping[str, Sequence[Point]], path: Path) -> None:
    """Draw one curve for each reader and codec.

    Args:
        curves: By name, bytes of a frame, random frames per CPU second, and a label of each point.
        path: The SVG to make.
    """
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    readers = dict.fromkeys(_reader(name) for name in curves)
    colors = {reader: f"C{number % 10}" for number, reader in enumerate(readers)}
    figure, axes = pyplot.subplots(figsize=(10, 6))
    for name, points in curves.items():
        ours = _reader(name).startswith("mp4ds")
        axes.plot(
            [point[0] for point in points],
            [point[1] for point in points],
            label=name,
            color="black" if ours else colors[_reader(name)],
            linewidth=2.5 if ours else 1.2,
            linestyle="--" if name.startswith("h264") else "-",
            marker="o" if ours else ".",
        )
        for size, rate, label in points:
            axes.annotate(
                label, (size, rate), fontsize=7, xytext=(3, 3), textcoords="offset points"
            )
    axes.set(xscale="log", yscale="log")
    axes.set(xlabel="bytes a frame", ylabel="single random frames per CPU second")
    axes.set_title("Numbers at the points: frames from one key frame to the next", fontsize=9)
    axes.grid(visible=True, which="both", alpha=0.2)
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1))
    figure.tight_layout()
    figure.savefig(path)


def _reader(name: str) -> str:
    codec, _, reader = name.partition(", ")
    return reader if codec in ("av1", "h264", "png", "jpeg") or reader.startswith("mp4ds") else name
