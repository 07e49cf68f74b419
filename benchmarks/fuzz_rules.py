"""What is changed, and what has to hold of it, whoever made or damaged it; see fuzz.py."""

from __future__ import annotations

import random
import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import pytest
import zstandard

import mp4ds
from fuzz_changes import (
    MANIFEST,
    Document,
    changed_bag,
    changed_bag_records,
    changed_dataset,
    changed_mcap,
    changed_mcap_records,
    changed_metadata,
    changed_sqlite,
    damaged,
    read_dataset,
)
from in_parts import InlineExecutor, use
from mp4ds import Mp4dsError
from mp4ds.bags.formats import open_sources
from mp4ds.packing.options import PackOptions
from mp4ds.packing.parts import PartsFolder, part_facts
from mp4ds.plugins.info import info
from mp4ds.records import Channel, Excerpt, Loss, Message
from scenes import Scene
from sources import SOURCES, scene

_ZSTD = zstandard.ZstdDecompressor()
_PACK = PackOptions(window=3, codec="h264")
_RECORDINGS = (
    *("bag-none", "bag-bz2", "bag-lz4", "mcap-ros2-none", "mcap-ros2-lz4", "mcap-ros2-zstd"),
    *("mcap-unchunked", "mcap-unindexed", "rosbag2-sqlite3-v9", "rosbag2-mcap-v9"),
    *("rosbag2-sqlite3-zstd-file", "rosbag2-sqlite3-zstd-message"),
)
_DATASETS = ("bag-none", "mcap-ros2-zstd", "rosbag2-sqlite3-v9")

Make = Callable[[Path, random.Random], None]
"""Fills an empty folder with what is read."""

Check = Callable[[Path, Path, random.Random], str]
"""Checks what is in a folder, with another one for outputs, and says what became of it."""


@dataclass(frozen=True)
class Kind:
    """What is changed, and how it is checked.

    Attributes:
        make: Puts a changed copy into a folder.
        check: Holds mp4ds to its rules.
        weight: How many of its inputs there are beside those of other kinds.
    """

    make: Make
    check: Check
    weight: int = 1


# ---------------------------------------------------------------- what is changed


def make_kinds(folder: Path) -> dict[str, Kind]:
    """Good recordings and datasets of every kind, and how they are changed.

    Args:
        folder: Where they are made, empty.
    """
    kinds: dict[str, Kind] = {}
    for name in _RECORDINGS:
        place = folder / name
        place.mkdir()
        (path,) = SOURCES[name](place, _scene(len(kinds)))

        def check(folder: Path, out: Path, rng: random.Random, name: str = path.name) -> str:
            return check_recording(folder / name, out, rng)

        if path.is_dir():
            files = {p.name: p.read_bytes() for p in path.iterdir()}
            kinds[name] = Kind(partial(_make_rosbag2, name=path.name, files=files), check)
        else:
            make = partial(_make_file, name=path.name, data=path.read_bytes())
            kinds[name] = Kind(make, check, 3)
    for name in _DATASETS:
        place = folder / f"dataset-{name}"
        place.mkdir()
        (place / "source").mkdir()
        images = scene("bayer_rggb8", frames=4, width=32, height=16)
        images = Scene([m for m in images.messages if m.topic not in ("/tf", "/imu")])
        (source,) = SOURCES[name](place / "source", images)
        mp4ds.pack(source, place / "drive", PackOptions(codec="h264"))
        files, documents = read_dataset(place / "drive")
        for part in ("manifest", "sidecar", "columns", "video", "messages"):
            make = partial(_make_dataset, files=files, documents=documents, part=part)
            kinds[f"{part}-{name}"] = Kind(make, check_dataset, 1 if part == "video" else 2)
    return kinds | {"work": _work_kind(folder)}


def _scene(number: int) -> Scene:
    """A camera and two other topics; for most of the recordings these alone, which is faster."""
    made = scene("mono8", frames=3, width=32, height=16)
    topics = ("/imu", "/chatter") if number % 3 else ("/imu", "/chatter", "/cam/image_raw")
    return Scene([message for message in made.messages if message.topic in topics])


def _make_file(folder: Path, rng: random.Random, *, name: str, data: bytes) -> None:
    is_bag = name.endswith(".bag")
    content, records = (
        (changed_bag, changed_bag_records) if is_bag else (changed_mcap, changed_mcap_records)
    )
    change = rng.choice((content, content, records, records, damaged))
    data = change(data, rng)
    if rng.random() < 0.1:
        data = damaged(data, rng)
    (folder / name).write_bytes(data)


def _make_rosbag2(folder: Path, rng: random.Random, *, name: str, files: dict[str, bytes]) -> None:
    place = folder / name
    place.mkdir()
    for file, data in files.items():
        (place / file).write_bytes(data)
    storage = place / next(file for file in files if not file.endswith(".yaml"))
    kind = rng.random()
    if kind < 0.25:
        path = place / "metadata.yaml"
        change = rng.choice((damaged, changed_metadata, changed_metadata))
        path.write_bytes(change(path.read_bytes(), rng))
    elif kind < 0.35:
        storage.write_bytes(damaged(storage.read_bytes(), rng))
    elif storage.suffix == ".db3":
        changed_sqlite(storage, rng)
    elif storage.suffix == ".mcap":
        change = rng.choice((changed_mcap, changed_mcap_records))
        storage.write_bytes(change(storage.read_bytes(), rng))
    else:
        plain = folder / "plain.db3"
        plain.write_bytes(_ZSTD.decompressobj().decompress(storage.read_bytes()))
        changed_sqlite(plain, rng)
        storage.write_bytes(zstandard.compress(plain.read_bytes(), 1))
        plain.unlink()


def _make_dataset(
    folder: Path,
    rng: random.Random,
    *,
    files: dict[str, bytes],
    documents: dict[str, Document],
    part: str,
) -> None:
    place = folder / "drive"
    place.mkdir()
    if rng.random() < 0.1:
        files = dict(files)
        chosen = {"manifest": MANIFEST, "video": ".mp4", "messages": ".mcap"}.get(
            part, "image_raw.yaml"
        )
        name = next(file for file in files if file.endswith(chosen))
        files[name] = damaged(files[name], rng)
        if name.endswith(".yaml") and rng.random() < 0.5:
            files[name] = files[name].rpartition(b"checksum:")[0]  # so that it is not told first
    else:
        files = changed_dataset(files, documents, part, rng)
    for name, data in files.items():
        (place / name).write_bytes(data)


def _work_kind(folder: Path) -> Kind:
    """What a pack in parts leaves that was ended, and how it goes on."""
    place = folder / "work"
    place.mkdir()
    (source,) = SOURCES["bag-none"](place, scene("bayer_rggb8", frames=6))
    with suppress(Mp4dsError):
        _pack(source, place / "drive", InlineExecutor(lambda name: name == "00001"))
    work = ".drive.mp4ds-part"
    part = f"{work}/00000"
    if not (place / part).is_dir():
        raise RuntimeError("no part was made")
    victims = [f"{part}/{p.name}" for p in sorted((place / part).iterdir())]
    # in its copies, the note of the plan names this very recording
    victims += [f"{work}/plan.json", f"{part}/part.json"] * 5

    def make(folder: Path, rng: random.Random) -> None:
        shutil.copytree(place, folder, dirs_exist_ok=True)
        victim = folder / rng.choice(victims)
        victim.write_bytes(damaged(victim.read_bytes(), rng))

    def check(folder: Path, out: Path, rng: random.Random) -> str:
        shutil.copytree(folder, out, dirs_exist_ok=True)
        parts = PartsFolder(out / "drive")
        # let it be one that was begun there
        inode, path = parts.path.lstat().st_ino, parts.path / "plan.json"
        path.write_bytes(re.sub(rb'"inode": \d+', b'"inode": %d' % inode, path.read_bytes()))
        with suppress(Mp4dsError):
            parts.note()
        part_facts(parts.path / "00000")
        if rng.random() < 0.25:
            _pack(source, out / "drive", InlineExecutor())
            if problems := mp4ds.validate(out / "drive", deep=True):
                raise BrokenRuleError(f"what was packed has a problem: {problems[0]}")
            return "packed"
        return "read"

    return Kind(make, check, 3)


def _pack(source: Path, target: Path, executor: InlineExecutor) -> None:
    with pytest.MonkeyPatch.context() as patch:
        use(patch, executor)
        mp4ds.pack(source, target, _PACK)


# ---------------------------------------------------------------- rules

Key = tuple[Any, ...]
"""A message: its channel, log time, publish time, sequence number, payload."""

_NAMES = {"bag": "drive.bag", "mcap": "drive.mcap", "rosbag2": "drive"}
_T = TypeVar("_T")


class BrokenRuleError(Exception):
    """A rule does not hold; says which."""


def _attempt(action: Callable[[], _T]) -> tuple[_T | None, str]:
    try:
        return action(), ""
    except Mp4dsError as error:
        return None, f"{type(error).__name__}: {error}"


@contextmanager
def _must(what: str) -> Iterator[None]:
    """What is done here has to succeed."""
    try:
        yield
    except Mp4dsError as error:
        raise BrokenRuleError(f"{what}: {type(error).__name__}: {error}") from error


def _key(message: Message) -> Key:
    identity = _identity(message.channel)
    times = message.log_time, message.publish_time, message.sequence
    return identity, *times, bytes(message.data)


def _identity(channel: Channel) -> Key:
    schema = channel.schema
    return channel.topic, channel.message_encoding, schema.name if schema else None


def read(path: Path, *, salvage: bool = False) -> list[Key]:
    """All messages of a recording."""
    with open_sources([path], salvage=salvage) as reader:
        return [_key(record) for record in reader.records() if isinstance(record, Message)]


def _losses(path: Path) -> Sequence[Loss]:
    with open_sources([path], salvage=True) as reader:
        for _ in reader.records():
            pass
        return reader.losses


def _by_channel(keys: Sequence[Key], *, times: bool = True) -> dict[Key, list[Key]]:
    """Messages of each channel by log time, ties in their order."""
    found: dict[Key, list[Key]] = defaultdict(list)
    for identity, log_time, publish_time, sequence, data in keys:
        others = (publish_time, sequence) if times else ()
        found[identity].append((log_time, *others, data))
    return {key: sorted(items, key=lambda item: item[0]) for key, items in found.items()}


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def check_recording(path: Path, out: Path, rng: random.Random) -> str:
    """What has to hold of a recording; `rng` says which of the costly rules are tried.

    Returns:
        ``refused``, ``read``, or ``packed``.
    """
    strict, refusal = _attempt(lambda: read(path))
    saved, problem = _attempt(lambda: read(path, salvage=True))
    if strict is not None:
        if saved is None:
            raise BrokenRuleError(f"salvage refuses what can be read: {problem}")
        # of which topic they are may be told twice, and differently
        one, other = (Counter(key[1:] for key in keys) for keys in (strict, saved))
        if fewer := one - other:
            raise BrokenRuleError(f"salvage does not find {_told(fewer)} of {len(strict)}")
        more = other - one
        if more and not _losses(path):  # else it is what a stretch of damage held
            raise BrokenRuleError(f"salvage finds {_told(more)} more than {len(strict)}")
    if rng.random() < 0.3:
        _look_around(path, strict, rng)
    result = "refused" if strict is None else "read"
    if _check_pack(path, out, strict, refusal, salvage=False, deep=rng.random() < 0.3):
        result = "packed"
    if saved is not None and rng.random() < 0.2:
        _check_pack(path, out, saved, "", salvage=True, deep=True)
    return result


def _told(keys: Counter[Key]) -> str:
    return f"{sum(keys.values())} messages, such as one at {next(iter(keys))[0]} ns"


def _look_around(path: Path, strict: list[Key] | None, rng: random.Random) -> None:
    with suppress(Mp4dsError):
        info(path)
    with suppress(Mp4dsError), open_sources([path]) as reader:
        _ = reader.skipped, reader.stats(), list(reader.unused_schemas)
        for channel in reader.channels:
            reader.first(channel)
        reader.times()
        if not strict:
            return
        low, high = sorted(rng.choices([key[1] for key in strict], k=2))
        topics = frozenset(channel.topic for channel in reader.channels if rng.random() < 0.7)
        excerpt = Excerpt(start=low, end=high, topics=topics)
        found = [_key(r) for r in reader.records(excerpt) if isinstance(r, Message)]
        due = [key for key in strict if low <= key[1] < high and key[0][0] in topics]
        if Counter(found) != Counter(due):
            raise BrokenRuleError(f"an excerpt has {len(found)} messages instead of {len(due)}")


def _check_pack(
    path: Path, out: Path, keys: list[Key] | None, refusal: str, *, salvage: bool, deep: bool
) -> bool:
    """What is packed is all that can be read, validates, and unpacks; else nothing is left."""
    target = out / "dataset"
    options = PackOptions(codec="ffv1", salvage=salvage)
    summary, _ = _attempt(lambda: mp4ds.pack(path, target, options))
    if summary is None:
        if _names(out):
            raise BrokenRuleError(f"a pack that failed left {_names(out)}")
        return False
    if keys is None:
        raise BrokenRuleError(f"packed what cannot be read: {refusal}")
    with _must("what was packed is not unpacked"):
        if deep and (problems := mp4ds.validate(target, deep=True)):
            raise BrokenRuleError(f"what was packed has a problem: {problems[0]}")
        with mp4ds.open(target) as dataset:
            kind = dataset.manifest.format  # type: ignore[union-attr]
        again = _unpacked(target, kind, out)
    if _by_channel(again) != _by_channel(keys):
        raise BrokenRuleError(f"{len(keys)} messages were packed, and {len(again)} others unpacked")
    for made in out.iterdir():
        shutil.rmtree(made) if made.is_dir() else made.unlink()
    return True


def _unpacked(dataset: Path, kind: str, out: Path) -> list[Key]:
    target = out / _NAMES[kind]
    mp4ds.unpack(dataset, kind, target)
    return read(target)


def check_dataset(folder: Path, out: Path, rng: random.Random) -> str:
    """What has to hold of a dataset; `rng` says which of the costly rules are tried.

    Returns:
        ``refused``, or ``valid`` where deep validation finds nothing.
    """
    path = folder / "drive"
    with _must("validation ends"):
        deep = mp4ds.validate(path, deep=True)
        plain = mp4ds.validate(path) if rng.random() < 0.3 else []
    if missing := set(plain) - set(deep):
        raise BrokenRuleError(f"deep does not find what plain does: {next(iter(missing))}")
    if rng.random() < 0.3:
        _look_into(path)
    if not deep:
        _check_valid(path, out, rng)
        return "valid"
    if rng.random() < 0.3:
        kind = rng.choice([*_NAMES])
        unpacked, _ = _attempt(lambda: _unpacked(path, kind, out))
        if unpacked is None and _names(out):
            raise BrokenRuleError(f"unpacking failed and left {_names(out)}")
    return "refused"


def _check_valid(path: Path, out: Path, rng: random.Random) -> None:
    """What passes deep validation unpacks to its own format, message for message."""
    with _must("what passes deep validation is not unpacked"):
        with mp4ds.open(path) as dataset:
            kind = dataset.manifest.format  # type: ignore[union-attr]
            total = dataset.manifest.messages  # type: ignore[union-attr]
            keys = []
            if rng.random() < 0.3:
                keys = [_key(r) for r in dataset.records() if isinstance(r, Message)]
        again = _unpacked(path, kind, out)
    if len(again) != total:
        raise BrokenRuleError(f"{len(again)} messages are unpacked of {total}")
    if keys and _by_channel(again, times=False) != _by_channel(keys, times=False):
        raise BrokenRuleError(f"{len(again)} other messages are unpacked than {len(keys)}")


def _look_into(path: Path) -> None:
    with suppress(Mp4dsError):
        info(path)
    with suppress(Mp4dsError), mp4ds.open(path) as dataset:
        dataset.times()
        for topic in dataset.topics:
            with suppress(Mp4dsError):
                _ = dataset[topic][-1]
        with suppress(Mp4dsError):
            times = [record.log_time for record in dataset.records() if isinstance(record, Message)]
            for _ in dataset.records(start=times[len(times) // 2] if times else 0):
                pass
        with suppress(Mp4dsError):
            for message in dataset.messages():
                with suppress(Mp4dsError):
                    _ = message.decoded
