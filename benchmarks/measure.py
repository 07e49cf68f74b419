"""Running benchmark jobs as processes of their own, and reporting what they cost."""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

_JOBS = str(Path(__file__).with_name("jobs.py"))


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


def python(*arguments: str) -> Run:
    """Run a Python interpreter and measure it.

    Raises:
        SystemExit: It failed; what it said is on stderr.
    """
    start = time.perf_counter()
    command = [sys.executable, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        output = process.stdout.read() if process.stdout else ""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"failed with exit code {process.returncode}: {' '.join(command)}")
    return Run(usage.ru_utime + usage.ru_stime, time.perf_counter() - start, output)


def cpu_seconds() -> float:
    """User and system time of this process, all threads."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def job(name: str, **arguments: Any) -> dict[str, Any]:
    """Run a function of jobs.py in a process of its own and return what it returns."""
    run = python(_JOBS, name, json.dumps(arguments, default=str))
    result: dict[str, Any] = json.loads(run.output.splitlines()[-1])
    return result


def spread(values: Sequence[float], digits: int = 2) -> str:
    """Median, least and most."""
    return f"{median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def print_machine() -> None:
    """What the figures were measured with."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        pass
    packages = ("av", "mcap", "rosbags", "numpy", "pillow", "zstandard", "pydantic")
    versions = ", ".join(f"{name} {version(name)}" for name in packages)
    print(f"- machine: {model}, {os.cpu_count()} cores, {platform.system()} {platform.release()}")
    print(f"- Python {platform.python_version()}, mp4ds {_mp4ds_version()}, {versions}")
    print(f"- load before: {os.getloadavg()[0]:.2f}", flush=True)


def _mp4ds_version() -> str:
    from mp4ds import __version__

    return __version__


def print_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A Markdown table, one line at a time as the rows come."""
    print(f"\n| {' | '.join(header)} |\n|{' --- |' * len(header)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(map(str, row))} |", flush=True)


def parse_size(text: str) -> tuple[int, int]:
    """``WxH`` of even numbers."""
    width, _, height = text.partition("x")
    size = int(width), int(height)
    if size[0] % 2 or size[1] % 2:
        raise ValueError("width and height must be even")
    return size
