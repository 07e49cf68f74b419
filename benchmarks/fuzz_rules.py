"""What has to hold of any recording and of any dataset, whoever made or damaged it; see fuzz.py."""

from __future__ import annotations

import random
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import mp4ds
from mp4ds import Mp4dsError
from mp4ds.bags.formats import open_sources
from mp4ds.packing.options import PackOptions
from mp4ds.plugins.info import info
from mp4ds.records import Channel, Excerpt, Loss, Message

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
    """What has to hold of a recording.

    Args:
        path: The recording.
        out: An empty folder.
        rng: Which of the costly rules are tried.

    Returns:
        ``refused``, ``read``, or ``packed``.

    Raises:
        BrokenRuleError: One does not hold.
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


def check_dataset(path: Path, out: Path, rng: random.Random) -> str:
    """What has to hold of a dataset.

    Args:
        path: The dataset.
        out: An empty folder.
        rng: Which of the costly rules are tried.

    Returns:
        ``refused``, or ``valid`` where deep validation finds nothing.

    Raises:
        BrokenRuleError: One does not hold.
    """
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
        for stream in dataset.streams:
            with suppress(Mp4dsError):
                _ = stream[-1]
        with suppress(Mp4dsError):
            times = [record.log_time for record in dataset.records() if isinstance(record, Message)]
            for _ in dataset.records(start=times[len(times) // 2] if times else 0):
                pass
        with suppress(Mp4dsError):
            for message in dataset.messages():
                with suppress(Mp4dsError):
                    _ = message.decoded
