"""What starting costs: importing, the command line, and loading a long sidecar.

    python benchmarks/startup.py [--frames N] [--rounds N]

The sidecars are those of packed recordings with their columns continued to 432,000 frames, two
hours at 60 Hz, with jittered stamps and log times and a digest per frame. They are loaded through
all tiers: YAML with its checksum, the shipped JSON Schema, the pydantic model, and columns and
digests to numpy arrays. CPU time is user and system time; imports are not part of loading.
"""

from __future__ import annotations

import json
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from jsonschema import Draft202012Validator
from numpy.typing import NDArray

import mp4ds
from measure import cpu_seconds, isolated, parser_of, print_machine, print_table, python
from mp4ds.format.fields import Columns, columns_model, decode_columns, digests_model
from mp4ds.format.models import StreamSidecar
from mp4ds.format.sidecars import dump_document, load_document, load_stream, schema_text
from recordings import times, write_bag, write_mcap

COMMANDS = {
    'python -c "pass"': ("-c", "pass"),
    'python -c "import mp4ds"': ("-c", "import mp4ds"),
    "python -m mp4ds --help": ("-m", "mp4ds", "--help"),
    'python -c "import mp4ds; mp4ds.pack"': ("-c", "import mp4ds; mp4ds.pack"),
    'python -c "import mp4ds; mp4ds.open"': ("-c", "import mp4ds; mp4ds.open"),
}
SIDECARS = {
    "ROS 1: log time, stamp, seq, of images and of a CameraInfo for each": write_bag,
    "ROS 2: log and publish time, sequence, stamp, of both": partial(
        write_mcap, compression="none"
    ),
}
STEPS = ("yaml", "schema", "model", "columns", "digests", "sum")


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=432_000)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    print_machine()
    print_table(("command", "CPU ms", "more than bare python"), commands(options.rounds))
    print(f"\nLoading a sidecar of {options.frames} frames, CPU ms, median of {options.rounds}:")
    print_table(("sidecar", "MB", *STEPS), sidecars(options.frames, options.rounds))


def commands(rounds: int) -> Iterator[tuple[object, ...]]:
    """CPU time of each command; they take turns."""
    cpu: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for number in range(rounds + 1):
        for name, arguments in COMMANDS.items():
            run = python(*arguments)
            if number:  # the first one fills caches and compiles
                cpu[name].append(1000 * run.cpu)
    base = median(next(iter(cpu.values())))
    for name, values in cpu.items():
        text = f"{median(values):.0f} ({min(values):.0f} to {max(values):.0f})"
        yield f"`{name}`", text, f"{median(values) - base:.0f}"


def sidecars(frames: int, rounds: int) -> Iterator[tuple[object, ...]]:
    """CPU time of loading each kind of sidecar."""
    for text, write in SIDECARS.items():
        with tempfile.TemporaryDirectory(prefix="mp4ds-benchmark-") as folder:
            path = Path(folder) / "long.yaml"
            write_sidecar(path, frames, write)
            steps = isolated(load_sidecar, path, rounds)
            megabytes = f"{path.stat().st_size / 1e6:.1f}"
        yield text, megabytes, *(f"{1000 * median(steps[s]):.1f}" for s in STEPS)


def write_sidecar(path: Path, frames: int, write: Callable[..., None]) -> None:
    """The sidecar of a recording of two frames, continued."""
    source = path.with_name("source.mcap" if isinstance(write, partial) else "source.bag")
    pixels = np.zeros((2, 240, 320), np.uint8)
    write(source, pixels, "bayer_rggb8", hertz=60.0)
    mp4ds.pack(source, path.with_name("packed"))
    (packed,) = path.parent.glob("packed/camera*.yaml")
    sidecar = load_stream(packed)
    stamps, log_times = np.array(list(islice(times(60.0), frames))).T
    words = np.random.default_rng(2).integers(0, 2**63, frames)
    info = sidecar.camera_info
    continued = {"messages": frames, "columns": columns(info.columns, stamps, log_times + 20_000)}
    whole = sidecar.model_copy(
        update={
            "frames": frames,
            "columns": columns(sidecar.columns, stamps, log_times),
            "digests": digests_model(words.tolist()),
            "camera_info": info.model_copy(update=continued),
        }
    )
    path.write_bytes(dump_document(whole))


def columns(short: Columns, stamps: NDArray[np.int64], log_times: NDArray[np.int64]) -> Columns:
    """Columns of more rows, of which there are the same."""
    count = len(stamps)
    jitter = np.random.default_rng(1).integers(500_000, 1_500_000, count)
    numbers, zeros = np.arange(count), np.zeros(count, np.int64)
    made = {
        "log_time": log_times,
        "publish_time": stamps + jitter if short.publish_time else log_times,
        "sequence": numbers if short.sequence else zeros,
        "stamp": stamps,
        "variant": zeros,
        "ordinal": numbers,
    }
    return columns_model(made | ({"seq": numbers} if short.seq else {}))


def load_sidecar(path: Path, rounds: int) -> dict[str, list[float]]:
    """CPU seconds of each step of loading a sidecar to arrays, and their sum, of each round."""
    schema = Draft202012Validator(json.loads(schema_text("stream")))
    found: dict[str, list[float]] = defaultdict(list)
    for _ in range(rounds):
        seconds: dict[str, float] = {}

        def measured(step: str, work: Callable[[], Any], told: dict[str, float] = seconds) -> Any:
            begun = cpu_seconds()
            done = work()
            told[step] = cpu_seconds() - begun
            return done

        document = measured("yaml", partial(load_document, path))
        measured("schema", partial(schema.validate, document))
        model = measured("model", partial(StreamSidecar.model_validate, document))
        parts = [(model.columns, model.frames)]
        parts.append((model.camera_info.columns, model.camera_info.messages))
        measured("columns", lambda ps=parts: [decode_columns(*p, 1, str(path)) for p in ps])
        measured("digests", partial(model.digests.decode, model.frames))
        for step, value in seconds.items():
            found[step].append(value)
        found["sum"].append(sum(seconds.values()))
    return found


if __name__ == "__main__":
    main()
