"""What starting costs: importing, the command line, a short pack, and loading a long sidecar.

    python benchmarks/startup.py [--frames N] [--rounds N]

The pack is of a recording of 0.2 s, two cameras; what it imports is then imported alone.

The sidecars hold 432,000 frames, two hours at 60 Hz, with jittered stamps and log times and a
digest per frame, and are loaded through all tiers: YAML with its checksum, the shipped JSON
Schema, the pydantic model, and columns and digests to numpy arrays. CPU time is user and system
time; imports are not part of loading.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import median

from measure import job, print_machine, print_table, python

COMMANDS = {
    'python -c "pass"': ("-c", "pass"),
    'python -c "import mp4ds"': ("-c", "import mp4ds"),
    "python -m mp4ds --help": ("-m", "mp4ds", "--help"),
    'python -c "import mp4ds; mp4ds.pack"': ("-c", "import mp4ds; mp4ds.pack"),
    'python -c "import mp4ds; mp4ds.open"': ("-c", "import mp4ds; mp4ds.open"),
}
MODULES = """
import sys
from contextlib import suppress
from mp4ds.cli import main
with suppress(SystemExit):
    main()
specs = {name: getattr(module, "__spec__", None) for name, module in sys.modules.items()}
known = (name for name, spec in specs.items() if spec and spec.name == name)
print(*(name for name in known if name.replace(".", "").isidentifier()))
"""
SIDECARS = {
    "ros1": "ROS 1: log time, stamp, seq",
    "ros2": "ROS 2 MCAP: log and publish time, sequence, stamp",
    "ros1-info": "ROS 1 with a CameraInfo per frame: log time, stamp, seq of both",
}
STEPS = ("yaml", "schema", "model", "columns", "digests", "sum")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=432_000)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    print_machine()
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        rows = commands({**COMMANDS, **pack_commands(Path(folder))}, options.rounds)
        print_table(("command", "CPU ms", "more than bare python"), rows)
    print(f"\nLoading a sidecar of {options.frames} frames, CPU ms, median of {options.rounds}:")
    print_table(("sidecar", "MB", *STEPS), sidecars(options.frames, options.rounds))


def pack_commands(folder: Path) -> dict[str, tuple[str, ...]]:
    """A short pack on the command line, and the imports of it alone."""
    source, dataset = str(folder / "short.bag"), str(folder / "dataset")
    python("-m", "mp4ds", "demo", source, "--seconds", "0.2")
    arguments = ("pack", source, "--output", dataset, "--force")
    names = python("-c", MODULES, *arguments).output.splitlines()[-1].split()
    return {
        "python -m mp4ds pack SHORT": ("-m", "mp4ds", *arguments),
        "... its imports alone": ("-c", f"import {', '.join(names)}"),
    }


def commands(named: Mapping[str, tuple[str, ...]], rounds: int) -> Iterator[tuple[object, ...]]:
    """CPU time of each command; they take turns."""
    cpu: dict[str, list[float]] = {name: [] for name in named}
    for number in range(rounds + 1):
        for name, arguments in named.items():
            run = python(*arguments)
            if number:  # the first one fills caches and compiles
                cpu[name].append(1000 * run.cpu)
    base = median(next(iter(cpu.values())))
    for name, values in cpu.items():
        text = f"{median(values):.0f} ({min(values):.0f} to {max(values):.0f})"
        yield f"`{name}`", text, f"{median(values) - base:.0f}"


def sidecars(frames: int, rounds: int) -> Iterator[tuple[object, ...]]:
    """CPU time of loading each kind of sidecar."""
    with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
        for kind, text in SIDECARS.items():
            path = Path(folder) / f"{kind}.yaml"
            size = job("write_sidecar", path=path, frames=frames, kind=kind)["bytes"]
            steps = job("load_sidecar", path=path, rounds=rounds)
            yield text, f"{size / 1e6:.1f}", *(f"{1000 * median(steps[s]):.1f}" for s in STEPS)


if __name__ == "__main__":
    main()
