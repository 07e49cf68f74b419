"""Damages small valid files of every kind and reads them: only success or an `Mp4dsError` may come.

    python benchmarks/fuzz.py --count 100000 --seed 1 --seconds 3600 --keep findings

Every input is read in a process forked for a batch, with at most 1 GiB of address space more than
the idle process has, and 10 seconds. Another error, a hang, a death, or a file that is written
beside the input is a finding: it is told with its kind and seed, and kept with what it raised.
An input is made again by ``--kind KIND --only SEED``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import xxhash

import mp4ds
import mp4ds.checks
import mp4ds.dataset
import mp4ds.packing
import mp4ds.packing.coordinator
from in_parts import InlineEngine
from mp4ds import Mp4dsError, yamlio
from mp4ds.bags import open_sources
from mp4ds.packing import PackOptions
from mp4ds.packing.part import Part
from mp4ds.packing.workplace import Workplace
from mp4ds.records import Excerpt, Message
from mp4ds.sidecar import load_manifest, load_stream
from sources import SOURCES, scene

MEMORY = 2**30
"""Bytes of address space that reading may take, beyond what the idle process has."""

SECONDS = 10
"""After which one reading is ended."""

_BATCH = 128
_LENGTHS = (0, 1, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
_PACK = PackOptions(window=3, codec="h264")
_RECORDINGS = (
    *("bag-none", "bag-bz2", "bag-lz4", "mcap-ros2-none", "mcap-ros2-lz4", "mcap-ros2-zstd"),
    *("mcap-unchunked", "mcap-unindexed", "rosbag2-sqlite3-v9", "rosbag2-mcap-v9"),
    *("rosbag2-sqlite3-zstd-file", "rosbag2-sqlite3-zstd-message"),
)


@dataclass(frozen=True)
class Kind:
    """What is damaged.

    Attributes:
        folder: Holds the good files.
        victims: Names of those that are damaged, below the folder.
        read: Reads what became of a copy of the folder.
        sign: Whether text gets a fitting checksum again, half of the times.
    """

    folder: Path
    victims: list[str]
    read: Callable[[Path, random.Random], None]
    sign: Callable[[bytes], bytes] | None = None


# ---------------------------------------------------------------- the good files


def make_kinds(folder: Path) -> dict[str, Kind]:
    """Good files of every kind, and how they are read."""
    kinds: dict[str, Kind] = {}
    for name in _RECORDINGS:
        place = folder / name
        place.mkdir()
        (path,) = SOURCES[name](place, scene("mono8", frames=2, width=16, height=8))
        inner = path.relative_to(place)
        if path.is_dir():
            files = [str(file.relative_to(place)) for file in path.iterdir()]
            data = [file for file in files if not file.endswith(".yaml")]
            read = partial(_read_recording, name=str(inner))
            kinds[name] = Kind(place, data, read)
            kinds[f"{name}-metadata"] = Kind(place, [str(inner / "metadata.yaml")], read)
        else:
            kinds[name] = Kind(place, [str(inner)], partial(_read_recording, name=str(inner)))
    for kind in [*kinds.values()]:  # so that all is imported before the first fork
        for salvage in (False, True):
            with open_sources([kind.folder / Path(kind.victims[0]).parts[0]], salvage=salvage) as r:
                list(r.records())
    kinds |= _dataset_kinds(folder)
    kinds |= _work_kinds(folder)
    return kinds


def _dataset_kinds(folder: Path) -> dict[str, Kind]:
    place = folder / "dataset"
    place.mkdir()
    (folder / "source").mkdir()
    (source,) = SOURCES["bag-none"](folder / "source", scene("bayer_rggb8", frames=4))
    mp4ds.pack(source, place / "drive", PackOptions(codec="h264"))
    stream = next((place / "drive").glob("*.mp4")).with_suffix(".yaml").name
    return {
        "sidecar": Kind(place, [f"drive/{stream}"], _read_dataset, _sign_yaml),
        "manifest": Kind(place, ["drive/dataset.yaml"], _read_dataset, _sign_yaml),
        "video": Kind(place, [f"drive/{Path(stream).stem}.mp4"], _read_dataset),
        "messages": Kind(place, ["drive/messages.mcap"], _read_dataset),
    }


def _work_kinds(folder: Path) -> dict[str, Kind]:
    place = folder / "work"
    place.mkdir()
    (source,) = SOURCES["bag-none"](place, scene("bayer_rggb8", frames=6))
    engine = InlineEngine(lambda name: name == "00001-0")
    with suppress(Mp4dsError):
        _pack(source, place / "drive", engine)
    work = ".drive.mp4ds-part"
    part = f"{work}/parts/00000-0"
    if not (place / part).is_dir():
        raise RuntimeError("no part was made")
    # in its copies, the job names this very recording
    files = {"job": f"{work}/job.json", "part": f"{part}/part.json"}
    others = [f"{part}/{p.name}" for p in (place / part).iterdir() if p.name != "part.json"]
    read = partial(_read_work, source=source)
    return {
        **{name: Kind(place, [path], read) for name, path in files.items()},
        "part-files": Kind(place, others, read),
    }


def _sign_yaml(data: bytes) -> bytes:
    body = data[: data.rfind(b"checksum:")]
    return body + b'checksum: "xxh64:%s"\n' % xxhash.xxh64(body).hexdigest().encode()


# ---------------------------------------------------------------- reading


def _read_recording(folder: Path, rng: random.Random, *, name: str) -> None:
    path = folder / name
    salvage = rng.random() < 0.3
    with open_sources([path], salvage=salvage) as reader:
        list(reader.channels), reader.skipped, reader.stats()
        if rng.random() < 0.5:
            for channel in reader.channels:
                reader.first(channel)
            reader.times()
        times = [r.log_time for r in reader.records() if isinstance(r, Message)]
        list(reader.unused_schemas)
        if times:
            low, high = sorted(rng.choices(times, k=2))
            topics = frozenset(c.topic for c in reader.channels if rng.random() < 0.5)
            for _ in reader.records(Excerpt(start=low, end=high, topics=topics)):
                pass


def _read_dataset(folder: Path, rng: random.Random) -> None:
    path = folder / "drive"
    problems = mp4ds.validate(path, deep=rng.random() < 0.3)
    for document in path.glob("*.yaml"):
        with suppress(Mp4dsError):
            yamlio.load(document.read_bytes(), str(document))
        with suppress(Mp4dsError):
            load_stream(document)
        with suppress(Mp4dsError):
            load_manifest(document)
    with mp4ds.open(path) as dataset:
        for stream in dataset.streams:
            _ = stream[-1]
        for _ in dataset.records():
            pass
    del problems


def _read_work(folder: Path, rng: random.Random, *, source: Path) -> None:
    place = Workplace(folder / ".drive.mp4ds-part")
    with suppress(Mp4dsError):
        job = place.job()
        if job is not None:
            [place.is_done(task) for task in job.tasks]
    with suppress(Mp4dsError):
        Part.load(place.parts / "00000-0")
    if rng.random() < 0.25:
        _pack(source, folder / "drive", InlineEngine())


def _pack(source: Path, target: Path, engine: InlineEngine) -> None:
    packing: Any = mp4ds.packing
    packing._engine = lambda *_: engine
    mp4ds.pack(source, target, _PACK)


# ---------------------------------------------------------------- damage


def damaged(data: bytes, rng: random.Random) -> bytes:
    """One to four injuries."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = rng.choice(_INJURIES)(data, rng) or b"\0"
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data))
    return _put(data, place, bytes([data[place] ^ 1 << rng.randrange(8)]))


def _byte(data: bytes, rng: random.Random) -> bytes:
    return _put(data, rng.randrange(len(data)), bytes([rng.choice((0, 1, 0x7F, 0x80, 0xFF, 10))]))


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _range(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data))
    return start, min(len(data), start + rng.choice((1, 4, 9, 64, 512, 4096)))


def _remove(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    return data[:start] + data[end:]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    return data[:end] + data[start:end] * rng.choice((1, 1, 2, 50)) + data[end:]


def _splice(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    place = rng.randrange(len(data))
    return _put(data, place, data[start:end])[: len(data)]


def _zero(data: bytes, rng: random.Random) -> bytes:
    start, end = _range(data, rng)
    return _put(data, start, bytes(end - start))


def _length(data: bytes, rng: random.Random) -> bytes:
    """A number of 2, 4 or 8 bytes that may be a length gets another value."""
    form = rng.choice(("<H", "<I", "<Q", ">H", ">I", ">Q"))
    size = struct.calcsize(form)
    if len(data) < size:
        return data
    likely = [rng.randrange(len(data) - size + 1) for _ in range(16)]
    place = min(likely, key=lambda at: struct.unpack_from(form, data, at)[0] or 2**64)
    old = struct.unpack_from(form, data, place)[0]
    new = rng.choice((*_LENGTHS, old + 1, old - 1, old * 2, len(data), len(data) - place))
    return _put(data, place, struct.pack(form, new % 2 ** (8 * size)))


def _header(data: bytes, rng: random.Random) -> bytes:
    """A field of a bag's record, or the opcode or length of an MCAP record."""
    words: tuple[bytes, ...] = (
        b"op=",
        b"conn=",
        b"size=",
        b"count=",
        b"ver=",
        b"index_pos=",
        b"chunk_count=",
    )
    words += (b"chunk_pos=", b"conn_count=", b"time=", b"start_time=", b"end_time=")
    places = _places(data, words)
    if data.startswith(b"\x89MCAP0\r\n"):
        places = _mcap_places(data)
    if not places:
        return _length(data, rng)
    place = rng.choice(places)
    value = struct.pack("<Q", rng.choice(_LENGTHS))[: rng.choice((1, 4, 8))]
    return _put(data, place, value)[: len(data)]


def _places(data: bytes, words: tuple[bytes, ...]) -> list[int]:
    found = []
    for word in words:
        place = data.find(word)
        while place >= 0:
            found.append(place + len(word))
            place = data.find(word, place + 1)
    return found


def _mcap_places(data: bytes) -> list[int]:
    found, at = [], 8
    while at + 9 < len(data):
        (size,) = struct.unpack_from("<Q", data, at + 1)
        found += [at, at + 1, *range(at + 9, min(at + 9 + size, at + 49), 2)]
        at += 9 + size
    return [place for place in found if place < len(data)]


def _token(data: bytes, rng: random.Random) -> bytes:
    """A value of a text gets another one; of other files, a word."""
    lines = data.split(b"\n")
    number = rng.randrange(len(lines))
    key, colon, _ = lines[number].partition(b":")
    if not colon or len(key) > 60:
        return _byte(data, rng)
    values: tuple[bytes, ...] = (
        b"-1",
        b"9999999999999999999999",
        b"null",
        b"[]",
        b"{}",
        b"true",
        b'""',
        b"1e999",
    )
    values += (b"../../etc/passwd", b"'" + b"x" * 5000 + b"'", b"&a [*a]", b"!!python/none x", b".")
    comma = b"," if lines[number].rstrip().endswith(b",") else b""
    lines[number] = key + b": " + rng.choice(values) + comma
    return b"\n".join(lines)


_INJURIES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *(_flip, _flip, _byte, _cut, _remove, _repeat, _splice, _zero),
    *(_length, _length, _header, _header, _token, _token),
)


def _put(data: bytes, place: int, new: bytes) -> bytes:
    return data[:place] + new + data[place + len(new) :]


# ---------------------------------------------------------------- running


@dataclass(frozen=True)
class Finding:
    """Something that may not come of any input.

    Attributes:
        kind: What was damaged.
        seed: Makes the input again.
        what: What came of it.
    """

    kind: str
    seed: str
    what: str


class _TookTooLongError(BaseException):
    pass


def make_input(kind: Kind, seed: str, sandbox: Path) -> random.Random:
    """Put a damaged copy of the files into an empty folder."""
    rng = random.Random(seed)
    shutil.copytree(kind.folder, sandbox, dirs_exist_ok=True)
    victim = sandbox / rng.choice(sorted(kind.victims))
    data = damaged(victim.read_bytes(), rng)
    if kind.sign and rng.random() < 0.5:
        data = kind.sign(data)
    victim.write_bytes(data)
    return rng


def try_input(kind: Kind, seed: str, around: Path) -> tuple[str, str]:
    """Read one input: ``read``, ``refused`` or what a finding is, and its traceback."""
    sandbox = around / "sandbox"
    sandbox.mkdir()
    rng = make_input(kind, seed, sandbox)

    def ring(*_: object) -> None:
        raise _TookTooLongError

    signal.signal(signal.SIGALRM, ring)
    signal.alarm(SECONDS)
    result, text = "read", ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(sandbox, rng)
    except Mp4dsError:
        result = "refused"
    except BaseException as error:
        result, text = f"{type(error).__name__}: {error}"[:200], traceback.format_exc()
    finally:
        signal.alarm(0)
    if sorted(path.name for path in around.iterdir()) != ["sandbox"]:
        result = "wrote beside its folder"
    shutil.rmtree(sandbox, ignore_errors=True)
    return result, text


def _batch(kind: Kind, seeds: list[str], around: Path) -> Iterator[tuple[str, str, str]]:
    """Seed, result and traceback of inputs that one forked process reads."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _limit()
        with os.fdopen(writing, "w") as pipe:
            for seed in seeds:
                pipe.write(json.dumps([seed, ""]) + "\n")
                pipe.flush()
                pipe.write(json.dumps([seed, *try_input(kind, seed, around)]) + "\n")
                pipe.flush()
        os._exit(0)
    os.close(writing)
    begun, ended = "", ""
    with os.fdopen(reading) as pipe:
        for line in pipe:
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


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    # for one that does not hear the alarm
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS * _BATCH, SECONDS * _BATCH))
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)


def run(
    kinds: dict[str, Kind], *, count: int, seed: int, seconds: float, around: Path
) -> tuple[dict[str, Counter[str]], list[tuple[Finding, str]]]:
    """Read damaged files of all kinds in turn.

    Args:
        kinds: From `make_kinds`.
        count: Inputs in all.
        seed: Of the first of them.
        seconds: After which no further batch is begun.
        around: An empty folder, in which nothing may be written but by us.

    Returns:
        Results by kind, and the findings with their tracebacks.
    """
    counts: dict[str, Counter[str]] = {name: Counter() for name in kinds}
    findings: list[tuple[Finding, str]] = []
    end = time.monotonic() + seconds
    size = max(1, min(_BATCH, count // len(kinds)))
    number = 0
    while number < count and time.monotonic() < end:
        for name, kind in kinds.items():
            batch = [f"{seed}:{name}:{number + at}" for at in range(size)]
            number += size
            for one, result, text in _batch(kind, batch, around):
                known = result in ("read", "refused")
                counts[name][result if known else "found"] += 1
                if not known:
                    findings.append((Finding(name, one, result), text))
            if time.monotonic() > end:
                break
    return counts, findings


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--kind", action="append", help="only this one; may be repeated")
    parser.add_argument("--only", help="read the input of this seed alone, with --kind")
    parser.add_argument("--keep", type=Path, help="a folder for inputs that are findings")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "good").mkdir()
        (folder / "around").mkdir()
        kinds = make_kinds(folder / "good")
        kinds = {key: kinds[key] for key in options.kind or kinds}
        if options.only:
            (kind,) = kinds.values()
            print(*try_input(kind, options.only, folder / "around"), sep="\n")
            return
        counts, findings = run(
            kinds,
            count=options.count,
            seed=options.seed,
            seconds=options.seconds,
            around=folder / "around",
        )
        for key, results in counts.items():
            print(f"{key:32}", *(f"{what} {n}" for what, n in sorted(results.items())))
        print("all", sum(sum(results.values()) for results in counts.values()))
        for finding, text in findings:
            _tell(finding, text, kinds[finding.kind], options.keep)
    sys.exit(bool(findings))


def _tell(finding: Finding, text: str, kind: Kind, keep: Path | None) -> None:
    print(finding.kind, finding.seed, finding.what)
    if keep is None:
        return
    place = keep / hashlib.sha256(finding.seed.encode()).hexdigest()[:12]
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    make_input(kind, finding.seed, place)
    (place / "finding.txt").write_text(f"{finding.seed}\n{finding.what}\n{text}")


if __name__ == "__main__":
    main()
