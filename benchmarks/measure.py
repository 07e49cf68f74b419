"""What the benchmarks share: processes of their own, what they cost, and tables."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any


@dataclass(frozen=True, slots=True)
class Run:
    """What a process cost.

    Attributes:
        cpu: Seconds of all cores, user and system, from its start to its end.
        wall: Seconds on the clock.
        output: What it printed.
    """

    cpu: float
    wall: float
    output: str


def python(*arguments: object) -> Run:
    """Run a Python interpreter and measure it.

    Raises:
        SystemExit: It failed; what it said is on stderr.
    """
    start = time.perf_counter()
    command = [sys.executable, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        output = process.stdout.read() if process.stdout else ""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"failed with exit code {process.returncode}: {' '.join(command)}")
    return Run(usage.ru_utime + usage.ru_stime, time.perf_counter() - start, output)


def isolated(function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """The result of a function that runs in a new process."""
    context = multiprocessing.get_context("spawn")  # so that it has no memory of this one
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments, **options).result()


def cpu_seconds() -> float:
    """User and system time of this process, all threads."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def spread(values: Sequence[float], digits: int = 2) -> str:
    """Median, least and most."""
    return f"{median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def psnr(error: float) -> str:
    """Of a mean squared error of 8 bits, dB."""
    return f"{10 * math.log10(255**2 / error):.1f}" if error else "exact"


def figure_of(size: tuple[float, float]) -> tuple[Any, Any]:
    """A figure of matplotlib and its axes, with a grid; size in inches."""
    import matplotlib

    matplotlib.use("agg")
    matplotlib.rcParams["svg.fonttype"] = "none"
    matplotlib.rcParams["svg.hashsalt"] = "mp4ds"
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=size)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def save(figure: Any, path: Path) -> None:
    """Save a figure as an SVG, without the date."""
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


def print_machine(*more: str) -> None:
    """What the figures were measured with; more packages are named if they are installed."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        pass
    packages = ("mp4ds", "av", "mcap", "rosbags", "numpy", "pillow", "zstandard", "pydantic")
    names = (*packages, *filter(find_spec, more))
    versions = ", ".join(f"{name} {version(name)}" for name in names)
    print(f"- machine: {model}, {os.cpu_count()} cores, {platform.system()} {platform.release()}")
    print(f"- Python {platform.python_version()}, {versions}")
    print(f"- load before: {os.getloadavg()[0]:.2f}", flush=True)


def print_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A Markdown table, one line at a time as the rows come."""
    print(f"\n| {' | '.join(header)} |\n|{' --- |' * len(header)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |", flush=True)


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """A command line whose help is the docstring of its module."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawTextHelpFormatter
    )


def parse_size(text: str) -> tuple[int, int]:
    """``WxH`` of even numbers."""
    width, _, height = text.partition("x")
    size = int(width), int(height)
    if size[0] % 2 or size[1] % 2:
        raise ValueError("width and height must be even")
    return size
