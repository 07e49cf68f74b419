"""Changes small valid recordings and datasets and holds mp4ds to its rules.

    nice python benchmarks/fuzz.py --count 100000 --seed 1 --keep findings

What is changed, and the rules, are in fuzz_rules.py, how it is changed in fuzz_changes.py: whatever
is read comes back, deep validation finds all that plain does, what passes it unpacks, salvage finds
no fewer messages than reading.
Besides, no input may lead to another error than an `Mp4dsError`, to a file that is written beside
the output, or changed, to more than 1 GiB of address space beyond what the idle process has, to
256 MiB of memory, or to 10 seconds. Every batch is read in a process of its own.

A finding is told by its seed, which makes the input again: ``--only SEED``; ``--keep`` keeps it.
"""

from __future__ import annotations

import gc
import hashlib
import json
import math
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzz_rules import Kind, make_kinds
from measure import parser_of, print_machine
from mp4ds import Mp4dsError

MEMORY = 2**30
"""Bytes of address space that an input may take, beyond what the idle process has."""

RESIDENT = 2**28
"""Bytes of memory that it may take."""

SECONDS = 10
"""After which it is ended."""

_BATCH = 128
_FINE = ("packed", "read", "refused", "valid")

# ---------------------------------------------------------------- running


class _TookTooLongError(BaseException):
    pass


def _content(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def _forget_peak() -> None:
    """Begin to measure anew, where the system can: a fork has the peak of what it comes from."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def try_input(kind: Kind, seed: str, around: Path) -> tuple[str, str]:
    """Check one input: what became of it, or what a finding is, and its traceback."""
    sandbox = around / "sandbox"
    given, out = sandbox / "given", sandbox / "out"
    for folder in (given, out):
        folder.mkdir(parents=True)
    others = sorted(path.name for path in around.iterdir())
    rng = random.Random(seed)
    kind.make(given, rng)
    _forget_peak()
    before, peak = _content(given), _peak()

    def ring(*_: object) -> None:
        raise _TookTooLongError

    signal.signal(signal.SIGALRM, ring)
    signal.alarm(SECONDS)
    result, text = "", ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = kind.check(given, out, rng)
    except Mp4dsError:
        result = "refused"
    except BaseException as error:
        result, text = f"{type(error).__name__}: {error}"[:300], traceback.format_exc()
    finally:
        signal.alarm(0)
    if _content(given) != before:
        result = "changed what it was given"
    if sorted(path.name for path in around.iterdir()) != others:
        result = "wrote beside its folder"
    if _peak() - peak > RESIDENT:
        result = f"took {(_peak() - peak) // 2**20} MiB"
    shutil.rmtree(sandbox, ignore_errors=True)
    return result, text


def _batch(kind: Kind, seeds: list[str], around: Path) -> Iterator[tuple[str, str, str]]:
    """Seed, result and traceback of inputs that one forked process checks."""
    reading, writing = os.pipe()
    gc.freeze()  # so that no collection copies the pages of its parent
    child = os.fork()
    if child == 0:
        os.close(reading)
        _limit()
        with os.fdopen(writing, "w") as pipe:
            for seed in seeds:
                print(json.dumps([seed, ""]), file=pipe, flush=True)
                try:
                    told = try_input(kind, seed, around)
                except Exception as error:  # our own
                    told = f"the fuzzer failed: {error!r}", traceback.format_exc()
                print(json.dumps([seed, *told]), file=pipe, flush=True)
        os._exit(0)
    os.close(writing)
    begun, ended = "", ""
    with os.fdopen(reading, buffering=1) as pipe:
        for line in _lines(pipe, child):
            told = json.loads(line)
            begun = told[0]
            if len(told) == 3:
                ended = begun
                yield told[0], told[1], told[2]
    _, status = os.waitpid(child, 0)
    if begun != ended:
        yield begun, f"its process died with status {status}", ""
        shutil.rmtree(around / "sandbox", ignore_errors=True)
        rest = seeds[seeds.index(begun) + 1 :]
        if rest:
            yield from _batch(kind, rest, around)


def _lines(pipe: Any, child: int) -> Iterator[str]:
    """What a process tells; it is killed where it tells nothing and does not hear the alarm."""
    unread = b""
    while True:
        if not select.select([pipe], [], [], 3 * SECONDS + 5)[0]:
            os.kill(child, signal.SIGKILL)
        piece = os.read(pipe.fileno(), 2**16)
        if not piece:
            return
        *lines, unread = (unread + piece).split(b"\n")
        yield from (line.decode() for line in lines)


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)


def run(
    kinds: dict[str, Kind],
    *,
    count: int,
    seed: int,
    seconds: float,
    around: Path,
) -> tuple[dict[str, Counter[str]], list[tuple[str, str, str]]]:
    """Check inputs of all kinds in turn, and begin no batch after so many seconds.

    Returns:
        Results by kind, and findings: seed, what came of it, and the traceback.
    """
    counts: dict[str, Counter[str]] = {name: Counter() for name in kinds}
    findings: list[tuple[str, str, str]] = []
    end = time.monotonic() + seconds
    names = [*kinds]
    unit = count / sum(kind.weight for kind in kinds.values())
    per_kind = [math.ceil(unit * kind.weight) for kind in kinds.values()]
    batches = [
        (name, first, min(first + _BATCH, due))
        for first in range(0, max(per_kind), _BATCH)
        for name, due in zip(names, per_kind, strict=True)
        if first < due
    ]
    for name, first, last in batches:
        if time.monotonic() > end:
            break
        seeds = [f"{seed}:{name}:{number}" for number in range(first, last)]
        for one, result, text in _batch(kinds[name], seeds, around):
            counts[name][result if result in _FINE else "found"] += 1
            if result not in _FINE:
                findings.append((one, result, text))
    return counts, findings


def main() -> None:
    """See the module."""
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--kind", action="append", help="only this one; may be repeated")
    parser.add_argument("--only", help="check the input of this seed alone, here")
    parser.add_argument("--keep", type=Path, help="a folder for inputs that are findings")
    options = parser.parse_args()
    fast = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=fast if fast.is_dir() else None) as name:
        folder = Path(name)
        (folder / "good").mkdir()
        (folder / "around").mkdir()
        kinds = make_kinds(folder / "good")
        for kind in kinds.values():  # so that all is imported before the first fork
            try_input(kind, "warm", folder / "around")
        if options.only:
            kind = kinds[options.only.split(":")[1]]
            if options.keep:
                _keep(options.only, "asked for", "", kind, options.keep)
            print(*try_input(kind, options.only, folder / "around"), sep="\n")
            return
        start, wanted = time.monotonic(), {key: kinds[key] for key in options.kind or kinds}
        counts, findings = run(
            wanted,
            count=options.count,
            seed=options.seed,
            seconds=options.seconds,
            around=folder / "around",
        )
        for finding in findings if options.keep else ():
            _keep(*finding, kinds[finding[0].split(":")[1]], options.keep)
    total = sum(sum(results.values()) for results in counts.values())
    seconds = time.monotonic() - start
    for key, results in counts.items():
        print(f"{key:32}", *(f"{what} {n}" for what, n in sorted(results.items())))
    print(f"all {total}, findings {len(findings)}, seed {options.seed}")
    print(f"{seconds:.0f} s, {total / seconds:.0f} inputs a second")
    print_machine()
    for one, what, _ in findings:
        print(one, what)
    sys.exit(bool(findings))


def _keep(seed: str, what: str, text: str, kind: Kind, keep: Path) -> None:
    place = keep / hashlib.sha256(seed.encode()).hexdigest()[:12]
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    kind.make(place, random.Random(seed))
    (place / "finding.txt").write_text(f"{seed}\n{what}\n{text}")


if __name__ == "__main__":
    main()
