"""What frames on demand cost, against other readers and other ways to store them.

    python benchmarks/loader.py [--way NAME ...] [--peer P ...] [--pattern P ...] [--resize WxH]

All readers (loader_readers.py) read the same mp4 files, of the same clip, encoded with several
GOPs; beside them LeRobot's encoding as its loader reads it, and folders of PNG and JPEG files.
Measured are single frames at random, batches of 32 random frames, windows of 8 consecutive frames
at random places, all frames in order, and a shuffled epoch: every frame once, in batches, at
random, or as FrameStream mixes them, of which is told how alike neighbours are. Each reader is in
a process of its own, for ``--seconds`` a pattern, and they take turns within each round; places
are the same for all. CPU time is user and system time of all threads, opening and imports left
out.

Every frame that is read is compared with one pass in order, by 16 x 16 of its pixels: ours have to
be equal, those of others more like those of this frame than of any other. Frames that are less than
30 dB like ours are told as of other colours.

With ``--resize`` frames are asked for in another size: of mp4ds with ``resize=``, of torchcodec
with its own Resize transform, of PyAV with swscale's default. Some are compared with the whole ones
reduced by Pillow's box filter, and told if they are less than 30 dB like these.

Files stay in ``--folder``.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from loader_readers import (
    BATCH,
    CODECS,
    LOADERS,
    OURS,
    PATTERNS,
    STILLS,
    WINDOW,
    Loader,
    Size,
    Store,
    Stored,
    grid,
    peers_for,
)
from measure import (
    cpu_seconds,
    figure_of,
    isolated,
    parse_size,
    parser_of,
    print_machine,
    print_table,
    save,
)
from recordings import HERTZ

WAYS = (*(f"{codec}-{gop}" for codec in CODECS for gop in (2, 30)), "lerobot", *STILLS)
LEAST_DB = 30.0
_LEAST_READS = 4


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=2000, help="of the clip")
    parser.add_argument("--size", type=parse_size, default=(1280, 720), help="WxH")
    ways = "CODEC-GOP, lerobot, png, jpeg, lossless, exact, view"
    parser.add_argument("--way", nargs="+", default=WAYS, help=ways)
    parser.add_argument("--peer", nargs="+", help="all by default")
    parser.add_argument("--pattern", nargs="+", choices=PATTERNS, default=list(PATTERNS))
    parser.add_argument("--resize", type=parse_size, help="WxH to ask for")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each pattern")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--stills", type=int, default=300, help="PNG and JPEG files")
    parser.add_argument("--plot", type=Path, help="an SVG to draw, of the first pattern")
    folder = Path(tempfile.gettempdir()) / "mp4ds-loader"
    parser.add_argument("--folder", type=Path, default=folder)
    options = parser.parse_args()
    print_machine("torchcodec", "torch")
    print(
        f"- {options.frames} frames of {options.size[0]}x{options.size[1]}, "
        f"{options.seconds:g} s a pattern, {options.rounds} rounds",
        flush=True,
    )
    options.folder.mkdir(parents=True, exist_ok=True)
    store = Store(options.folder, options.frames, options.size, options.stills)
    stored = [store.stored(name) for name in options.way]
    cells: Cells = defaultdict(Cell)
    for number in range(options.rounds):
        for one in stored:
            take_turns(cells, one, number, options)
    sizes = {one.name: one.bytes_per_frame for one in stored}
    report(cells, sizes, options.pattern)
    if options.plot:
        draw(cells, sizes, options.plot, options.pattern[0])


# ---------------------------------------------------------------- measuring


def take_turns(cells: Cells, stored: Stored, number: int, options: argparse.Namespace) -> None:
    """One turn of all that read what is stored in a way."""
    peers = [peer for peer in peers_for(stored.name) if not options.peer or peer in options.peer]
    turn = number % max(len(peers), 1)
    for peer in [*peers[turn:], *peers[:turn]]:
        for pattern in options.pattern:
            if peer in LOADERS and pattern != "epoch":
                continue
            cell = cells[stored.name, pattern, peer]
            arguments = stored, peer, pattern, options.resize, options.seconds, number
            try:
                frames, cpu, wall, fault, cell.mixed = isolated(measured, *arguments)
            except Exception as error:  # whatever a library raises, or that it is missing
                cell.failures[short(f"{type(error).__name__}: {error}")] = None
                continue
            cell.per_cpu.append(frames / cpu)
            cell.per_second.append(frames / wall)
            if fault:
                cell.faults[fault.partition(" (")[0]] = fault


def measured(
    stored: Stored, name: str, pattern: str, size: Size | None, seconds: float, seed: int
) -> tuple[int, float, float, str, str]:
    """Frames, CPU seconds and seconds of one reader with one pattern; what is wrong; how mixed."""
    peer = peers_for(stored.name)[name](stored, size)
    if name in LOADERS:  # with what is loaded when the first frame is read
        next(peer.batches())
    else:
        peer.read([0])
    numbers: list[int] = []
    grids: list[Any] = []
    start, cpu = time.perf_counter(), cpu_seconds()
    for reads, (wanted, found) in enumerate(_reads(peer, stored, pattern, size, seed), 1):
        grids.extend(np.array(some) for some in grid(found))
        numbers += wanted
        late = pattern != "epoch" and time.perf_counter() - start >= seconds
        if late and reads >= _LEAST_READS:
            break
    cpu, wall = cpu_seconds() - cpu, time.perf_counter() - start
    if size:
        fault = "" if name in LOADERS else reduced_verdict(peer, stored, size)
    else:
        exact = name == OURS and stored.dataset is not None
        fault = verdict(stored, np.array(numbers), np.stack(grids), exact=exact)
    return len(numbers), cpu, wall, fault, mixed(numbers) if pattern == "epoch" else ""


def mixed(numbers: Sequence[int]) -> str:
    """How far samples are from those before them in the clip: as in order 1, as by chance 0."""
    whole = np.reshape(numbers[: len(numbers) // BATCH * BATCH], (-1, BATCH))
    correlation = np.corrcoef(whole[:, :-1].ravel(), whole[:, 1:].ravel())[0, 1]
    near = np.abs(whole[:, :, None] - whole[:, None, :]) < HERTZ
    return f"neighbours correlate by {correlation:.2f}, {near.mean():.0%} within a second"


def _reads(
    peer: Any, stored: Stored, pattern: str, size: Size | None, seed: int
) -> Iterator[tuple[list[int], Any]]:
    """Frames that are wanted, and what is read, without end."""
    count = stored.frames
    while pattern == "order":
        if size:  # which not all can do while they iterate
            yield from (([number], peer.read([number])) for number in range(count))
            continue
        for number, frame in enumerate(peer.in_order()):
            yield [number], frame[None]
    rng = np.random.default_rng((seed, list(PATTERNS).index(pattern)))
    if pattern == "epoch":
        if isinstance(peer, Loader):
            yield from peer.batches()
            return
        for batch in np.split(rng.permutation(count), range(BATCH, count, BATCH)):
            yield batch.tolist(), peer.read(batch.tolist())
        return
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


def reduced_verdict(peer: Any, stored: Stored, size: Size) -> str:
    """Whether frames of another size are like the whole ones, reduced."""
    numbers = np.linspace(0, stored.frames - 1, 8).astype(int).tolist()
    wholes = peers_for(stored.name)[OURS](stored, None).read(numbers)
    reduced = [Image.fromarray(one).resize(size, Image.Resampling.BOX) for one in wholes]
    error = np.square(np.asarray(peer.read(numbers), np.float32) - np.stack(reduced))
    decibel = 10 * np.log10(255**2 / error.mean(axis=(1, 2, 3)).max())
    return "" if decibel > LEAST_DB else f"other colours ({decibel:.0f} dB)"


# ---------------------------------------------------------------- tables


@dataclass
class Cell:
    """One reader, one way to store, one pattern.

    Attributes:
        per_cpu: Frames per CPU second, of each round.
        per_second: Frames per second on the clock, of each round.
        faults: What is wrong with its frames, and how much of the last round.
        failures: Why there are none.
        mixed: How an epoch was shuffled.
    """

    per_cpu: list[float] = field(default_factory=list)
    per_second: list[float] = field(default_factory=list)
    faults: dict[str, str] = field(default_factory=dict)
    failures: dict[str, None] = field(default_factory=dict)
    mixed: str = ""

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
        return "; ".join(filter(None, (text, faults, self.mixed)))


def number(value: float) -> str:
    """With three digits."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def short(failure: str) -> str:
    """The beginning of what went wrong, without times and addresses."""
    return re.sub(r"\[[\d:]+\]|/\S+/", "", " ".join(failure.split()))[:120]


Cells = dict[tuple[str, str, str], Cell]


def report(cells: Cells, sizes: Mapping[str, float], patterns: Sequence[str]) -> None:
    """Print the tables."""
    best = "frames per CPU second: median (least to most), and frames per second on the clock"
    print(f"\nThe same files, {best}:")
    header: tuple[str, ...]
    header = ("codec", "GOP", "kB a frame", "pattern", OURS, "best other", "", "mp4ds / other")
    print_table(header, _against_best(cells, sizes, patterns))
    print(f"\nOther ways to store the same frames, {best}:")
    header = ("stored as", "kB a frame", "pattern", "read by", "")
    others = (
        (way, f"{sizes[way] / 1000:.1f}", PATTERNS[pattern], peer, cell)
        for (way, pattern, peer), cell in cells.items()
        if "-" not in way
    )
    print_table(header, others)
    for (way, pattern, peer), cell in cells.items():
        for text in cell.failures:
            print(f"- {peer}, {way}, {pattern}: {text}")


def _against_best(
    cells: Cells, sizes: Mapping[str, float], patterns: Sequence[str]
) -> Iterator[tuple[object, ...]]:
    """Ours, and the quickest of the others that gives the frames that are wanted."""
    for way, pattern in product((way for way in sizes if "-" in way), patterns):
        found = {peer: cell for (*key, peer), cell in cells.items() if key == [way, pattern]}
        ours = found.pop(OURS, Cell())
        sound = [(cell.rate, peer) for peer, cell in found.items() if cell.counts]
        rate, name = max(sound, default=(0.0, ""))
        codec, _, gop = way.partition("-")
        told = f"{sizes[way] / 1000:.1f}", PATTERNS[pattern]
        ratio = f"{ours.rate / rate:.2f}" if ours.counts and rate else ""
        yield codec, gop, *told, ours, name, found.get(name, ""), ratio


# ---------------------------------------------------------------- a drawing

_COLOURS = {
    "mp4ds": "#0b5fff",
    "FrameStream": "#0b5fff",
    "FrameDataset": "#6c3bd1",
    "torchcodec": "#d1495b",
    "pyav": "#8a8a8a",
}
_OTHER = "#444444"
_TICKS = ((5, 10, 20, 50, 100, 200, 500, 1000, 2000), (10, 20, 50, 100, 200, 500))


def curves_of(
    cells: Cells, sizes: Mapping[str, float], drawn: str
) -> dict[tuple[str, str], dict[float, tuple[float, str]]]:
    """Of each codec and reader, by bytes a frame: frames per CPU second, and the GOP or the way.

    Of torchcodec's modes the best at each point.
    """
    curves: dict[tuple[str, str], dict[float, tuple[float, str]]] = defaultdict(dict)
    for (way, pattern, peer), cell in cells.items():
        # how we read LeRobot's file is no way to store frames
        if pattern != drawn or not cell.counts or (way, peer) == ("lerobot", OURS):
            continue
        codec, _, gop = way.partition("-")
        curve = curves[codec, "" if way in ("lerobot", *STILLS) else peer.partition(" ")[0]]
        label = gop or codec
        curve[sizes[way]] = max(curve.get(sizes[way], (0.0, label)), (cell.rate, label))
    return curves


def draw(cells: Cells, sizes: Mapping[str, float], path: Path, pattern: str) -> None:
    """Draw bytes of a frame against frames per CPU second of a pattern, as an SVG."""
    from matplotlib import ticker

    figure, axes = figure_of((9, 5))
    for (codec, reader), curve in curves_of(cells, sizes, pattern).items():
        name = f"{codec}, {reader}" if reader else codec
        style = "--" if codec == "h264" else "-"
        points = sorted((size / 1e3, *point) for size, point in curve.items())
        places, rates = [point[0] for point in points], [point[1] for point in points]
        color = _COLOURS.get(reader, _OTHER)
        width = 3.0 if reader == "mp4ds" else 1.5
        axes.plot(places, rates, style, color=color, linewidth=width, marker="o", label=name)
        for size, rate, label in points:
            text = label if reader in _COLOURS else name
            axes.annotate(text, (size, rate), xytext=(6, 4), textcoords="offset points")
    axes.set(xscale="log", yscale="log")
    for axis, ticks in zip((axes.xaxis, axes.yaxis), _TICKS, strict=True):
        axis.set_major_locator(ticker.FixedLocator(ticks))
        axis.set_major_formatter(ticker.FormatStrFormatter("%d"))
        axis.set_minor_locator(ticker.NullLocator())
    axes.set(xlabel="kB a frame", ylabel=f"frames per CPU second, {PATTERNS[pattern]}")
    lines = [line for line in axes.get_lines() if len(line.get_xdata()) > 1]
    axes.legend(handles=lines, frameon=False, loc=(0.5, 0.15))
    save(figure, path)


if __name__ == "__main__":
    main()
