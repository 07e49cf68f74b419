"""What frames on demand cost, against other readers and other ways to store them.

    python benchmarks/loader.py frames [--codec C ...] [--gop N ...] [--peer P ...] [--plot F.svg]
    python benchmarks/loader.py report [--plot F.svg]
    python benchmarks/loader.py epoch  [--epochs N] ...
    python benchmarks/loader.py open   [--streams N] [--datasets N] ...
    python benchmarks/loader.py sizes  [--made WxH] [--way CODEC-GOP ...] ...

``frames``: all readers (loader_peers.py) read the same mp4 files, of the same clip
(loader_clips.py), encoded with several GOPs; beside them LeRobot's loader with LeRobot's encoding,
and folders of PNG and JPEG files. Measured are single frames at random, batches of 32 random
frames, windows of 8 consecutive frames at random places, and all frames in order. Each reader is in
a process of its own, for ``--seconds`` a pattern, and they take turns within each round; places are
the same for all. CPU time is user and system time of all threads, opening and imports left out.

Every frame that is read is compared with one pass in order: ours by all pixels (which are read
once more for it), the others by 16 x 16 of its pixels, which have to be more like those of this
frame than of any other. Frames that are less than 30 dB like ours are told as of other colours.

Files stay in ``--folder``, figures in its ``figures.jsonl``, of which ``report`` prints the tables.

``epoch``, ``open`` and ``sizes`` are in loader_epoch.py, loader_open.py and loader_sizes.py.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import loader_epoch
import loader_open
import loader_sizes
from loader_clips import (
    BATCH,
    CODECS,
    PATTERNS,
    WINDOW,
    Store,
    Stored,
    digest,
    grid,
    ways,
)
from loader_peers import OURS, Peer, peers_for, versions
from loader_report import report
from measure import cpu_seconds, parse_size, print_machine

GOPS = (2, 30, 120, 240)
LEAST_DB = 30.0
_LEAST_READS = 4
_FIGURES = "figures.jsonl"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    choices: dict[str, Callable[[argparse.ArgumentParser], object]] = {
        "frames": _frames_options,
        "report": _report_options,
        "epoch": loader_epoch.options,
        "open": loader_open.options,
        "sizes": loader_sizes.options,
        "job": lambda command: command.add_argument("arguments"),
    }
    for name, add_options in choices.items():
        command = commands.add_parser(name)
        command.add_argument(
            "--folder", type=Path, default=Path(tempfile.gettempdir()) / "mp4ds-loader"
        )
        add_options(command)
    options = parser.parse_args()
    if options.command == "job":
        print(json.dumps(job(**json.loads(options.arguments))), flush=True)
        return
    options.folder.mkdir(parents=True, exist_ok=True)
    if options.command == "report":
        report(_figures(options.folder), PATTERNS, options.plot)
        return
    print_machine()
    runs = {"frames": frames, "epoch": loader_epoch.run, "open": loader_open.run}
    (runs | {"sizes": loader_sizes.run})[options.command](options)


def _frames_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=int, default=2000, help="of the clip")
    parser.add_argument("--size", type=parse_size, default=(1280, 720), help="WxH")
    parser.add_argument("--codec", nargs="+", choices=CODECS, default=list(CODECS))
    parser.add_argument("--gop", nargs="+", type=int, default=list(GOPS))
    parser.add_argument("--way", nargs="+", help="CODEC-GOP, lerobot, png, jpeg; instead of both")
    parser.add_argument("--peer", nargs="+", help="all by default")
    parser.add_argument("--pattern", nargs="+", choices=PATTERNS, default=list(PATTERNS))
    parser.add_argument("--seconds", type=float, default=3.0, help="of each pattern")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stills", type=int, default=300, help="PNG and JPEG files")
    parser.add_argument("--append", action="store_true", help="to the figures there are")
    parser.add_argument("--only-make", action="store_true", help="the files, and stop")
    _report_options(parser)


def _report_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plot", type=Path, help="an SVG to draw")


# ---------------------------------------------------------------- frames


def frames(options: argparse.Namespace) -> None:
    """Measure all cells, round by round, then print the tables."""
    print(f"- {versions()}")
    print(
        f"- {options.frames} frames of {options.size[0]}x{options.size[1]}, "
        f"{options.seconds:g} s a pattern, {options.rounds} rounds",
        flush=True,
    )
    store = Store(options.folder, options.frames, options.size, options.stills)
    names = options.way or ways(options.codec, options.gop)
    sizes = {name: store.stored(name).bytes_per_frame for name in names}
    if options.only_make:
        return
    with (options.folder / _FIGURES).open("a" if options.append else "w") as kept:
        for number in range(options.rounds):
            for name in names:
                for figure in _round(store, name, number, options):
                    figure["bytes"] = sizes[name]
                    kept.write(json.dumps(figure) + "\n")
                    kept.flush()
    report(_figures(options.folder), PATTERNS, options.plot)


def _figures(folder: Path) -> list[dict[str, Any]]:
    path = folder / _FIGURES
    if not path.exists():
        raise SystemExit(f"{path} is not there: run `loader.py frames` with this --folder first.")
    return [json.loads(line) for line in path.read_text().splitlines()]


def _round(
    store: Store, name: str, number: int, options: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """One turn of all that read what is stored in a way."""
    peers = [peer for peer in peers_for(name) if not options.peer or peer in options.peer]
    turn = number % max(len(peers), 1)
    for peer in [*peers[turn:], *peers[:turn]]:
        arguments = {
            "folder": str(options.folder),
            "clip": [store.frames, store.size, store.stills],
            "name": name,
            "peer": peer,
            "patterns": options.pattern,
            "seconds": options.seconds,
            "seed": number,
        }
        for figure in _run(arguments):
            yield {"way": name, "peer": peer, "round": number, **figure}


def _run(arguments: dict[str, Any]) -> list[dict[str, Any]]:
    """Figures of a process of its own; what went wrong if it fails."""
    command = [sys.executable, __file__, "job", json.dumps(arguments)]
    patterns, limit = arguments["patterns"], 120 + 40 * arguments["seconds"]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return [{"pattern": pattern, "failed": "takes too long"} for pattern in patterns]
    if run.returncode:
        last = run.stderr.strip().splitlines()[-1:] or [f"exit code {run.returncode}"]
        return [{"pattern": pattern, "failed": last[0]} for pattern in patterns]
    found: list[dict[str, Any]] = json.loads(run.stdout.splitlines()[-1])
    return found


def job(
    folder: str,
    clip: tuple[int, tuple[int, int], int],
    name: str,
    peer: str,
    patterns: Sequence[str],
    seconds: float,
    seed: int,
) -> list[dict[str, Any]]:
    """Measure one reader of one video with several patterns."""
    count, size, stills = clip
    stored = Store(Path(folder), count, (size[0], size[1]), stills).stored(name)
    kind = peers_for(name)[peer]
    figures = []
    for pattern in patterns:
        try:
            opened = _warm(kind.opener, stored)
            figure, numbers, grids = _measure(opened, stored.frames, pattern, seconds, seed)
        except ModuleNotFoundError as error:
            figures.append({"pattern": pattern, "failed": f"not installed: {error.name}"})
            continue
        except Exception as error:  # whatever a library raises
            figures.append({"pattern": pattern, "failed": f"{type(error).__name__}: {error}"})
            continue
        exact = peer == OURS and stored.dataset is not None
        figure["verdict"] = verdict(stored, numbers, grids, exact=exact)
        if exact and not figure["verdict"]:
            figure["verdict"] = _replay(opened, stored, numbers, pattern)
        figures.append({"pattern": pattern, **figure})
    return figures


def _warm(opener: Any, stored: Stored) -> Peer:
    """Opened, with what is loaded when the first frame is read."""
    peer: Peer = opener(stored)
    peer.read([0])
    return peer


def _measure(
    peer: Peer, count: int, pattern: str, seconds: float, seed: int
) -> tuple[dict[str, Any], NDArray[np.int64], NDArray[Any]]:
    """What a pattern costs; which frames were read, and some of their pixels."""
    numbers: list[int] = []
    grids: list[Any] = []
    start, cpu = time.perf_counter(), cpu_seconds()
    for reads, (wanted, found) in enumerate(_reads(peer, count, pattern, seed), 1):
        grids.extend(np.array(some) for some in grid(found))
        numbers += wanted
        if time.perf_counter() - start >= seconds and reads >= _LEAST_READS:
            break
    cpu, wall = cpu_seconds() - cpu, time.perf_counter() - start
    figure = {"frames": len(numbers), "cpu": cpu, "wall": wall}
    return figure, np.array(numbers), np.stack(grids)


def _reads(peer: Peer, count: int, pattern: str, seed: int) -> Iterator[tuple[list[int], Any]]:
    """Frames that are wanted, and what is read, without end."""
    if pattern == "order":
        while True:
            for number, frame in enumerate(peer.in_order()):
                yield [number], frame[None]
    rng = np.random.default_rng((seed, list(PATTERNS).index(pattern)))
    while True:
        if pattern == "single":
            wanted = [int(rng.integers(count))]
        elif pattern == "batch":
            wanted = rng.choice(count, min(BATCH, count), replace=False).tolist()
        else:
            first = int(rng.integers(max(count - WINDOW, 1)))
            wanted = list(range(first, min(first + WINDOW, count)))
        yield wanted, peer.read(wanted)


# ---------------------------------------------------------------- whether it is right


def verdict(stored: Stored, numbers: NDArray[np.int64], grids: NDArray[Any], *, exact: bool) -> str:
    """What is wrong with the frames that were read; empty where nothing is."""
    reference = stored.reference["grids"]
    if grids.dtype.kind == "f":
        grids = np.rint(grids * 255).astype(np.uint8)
    if exact:
        return "" if np.array_equal(grids, reference[numbers]) else "not exact"
    alike = _shapes(grids) @ _shapes(reference).T
    wrong = alike[np.arange(len(numbers)), numbers] < alike.max(axis=1) - 1e-5
    if wrong.any():
        return f"wrong frame ({wrong.mean():.0%})"
    error = np.square(grids.astype(np.float32) - reference[numbers]).mean()
    decibel = 10 * np.log10(255**2 / max(float(error), 1e-6))
    return "" if decibel > LEAST_DB else f"other colours ({decibel:.0f} dB)"


def _shapes(grids: NDArray[Any]) -> NDArray[np.float32]:
    """Brightness without its mean and scale, which readers convert differently."""
    grey = grids.astype(np.float32).mean(axis=-1).reshape(len(grids), -1)
    grey -= grey.mean(axis=1, keepdims=True)
    shapes: NDArray[np.float32] = grey / np.maximum(np.linalg.norm(grey, axis=1), 1e-6)[:, None]
    return shapes


def _replay(peer: Peer, stored: Stored, numbers: NDArray[np.int64], pattern: str) -> str:
    """Read the same frames once more, and compare all of their pixels."""
    digests = stored.reference["digests"]
    step = {"single": 1, "batch": BATCH, "window": WINDOW}.get(pattern, 1)
    if pattern == "order":
        found = (digest(frame) for frame in peer.in_order())
        pairs = zip(digests[: len(numbers)].tolist(), found, strict=False)
        return "" if all(a == b for a, b in pairs) else "not exact"
    for start in range(0, len(numbers), step):
        wanted = numbers[start : start + step]
        for number, frame in zip(wanted, peer.read(wanted.tolist()), strict=True):
            if digest(frame) != int(digests[number]):
                return "not exact"
    return ""


if __name__ == "__main__":
    main()
