"""Compare two recordings message by message, without any code of mp4ds.

Usage::

    python tools/compare.py A B [--ignore-pixels TOPIC_GLOB] [--start NS --end NS]

A and B are a ROS 1 ``.bag``, a rosbag2 folder, an ``.mcap`` or a ``.db3``; a split recording is
given as ``a1.bag,a2.bag``. Exit code: 0 equal, 1 different, 2 unreadable.

Equal means: for each channel the sequence of (topic, type, definition, message encoding, log
time, publish time, sequence, payload bytes), in log-time order with ties in source order, is the
same; and so are channel metadata, attachments, metadata records and the profile. Channels that
nothing tells apart are compared as one. What only one of two formats can hold is not compared,
and the notes say so. Messages of ROS 1 against ROS 2 are compared field by field after
deserialisation, apart from ``header.seq``, which ROS 2 does not have.

Message numbers count from 0 in log-time order. Only digests and times are kept in memory.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from compare_digest import Channel, Digester, ros2_name
from compare_read import HASH_KEY, QOS_KEY, ROS1_FORMAT, Recording, UnreadableError, read

POLICIES: Mapping[str, Sequence[str]] = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown",
                   "best_available"),
}  # fmt: skip
# RMW implementations spelled an infinite duration in three ways before they agreed on the first.
INFINITE = [("9223372036", "854775807"), ("2147483647", "4294967295"), ("2147483647", "2147483647")]


@dataclass
class Row:
    """One line of the table."""

    topic: str
    a: int = 0
    b: int = 0
    equal: int = 0
    differences: int = 0


@dataclass
class Report:
    """The outcome: equal when there are no differences."""

    rows: dict[str, Row] = field(default_factory=dict)
    differences: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Add a note once."""
        if text not in self.notes:
            self.notes.append(text)


def qos_meaning(value: object) -> object:
    """QoS profiles with policies by name and one spelling of infinity; else the value itself."""
    try:
        profiles = yaml.load(value, yaml.BaseLoader) if isinstance(value, str) else value
        profiles = [dict(profile) for profile in profiles or ()]  # type: ignore[union-attr]
    except (yaml.YAMLError, TypeError, ValueError):
        return value
    for profile in profiles:
        for key, inner in profile.items():
            names = POLICIES.get(key, ())
            if isinstance(inner, str) and inner.isdigit() and int(inner) < len(names):
                profile[key] = names[int(inner)]
            elif isinstance(inner, dict) and (inner.get("sec"), inner.get("nsec")) in INFINITE:
                profile[key] = "infinite"
    return profiles


def properties(channel: Channel, one: Recording, other: Recording) -> dict[str, str]:
    """What of a channel both formats can hold, in words."""
    if channel.topic in one.digester.crossed:
        return {"topic": channel.topic, "type": ros2_name(channel.type)}
    found = {"topic": channel.topic, "type": channel.type, "message encoding": channel.encoding}
    holds, same = one.holds & other.holds, one.kind == other.kind
    exact = same and one.kind != "sqlite3"  # there an empty definition is none
    if "definition" in holds and channel.definition and (exact or channel.definition[1]):
        form, text = channel.definition
        digest = hashlib.sha256(text).hexdigest()[:32]
        found["definition"] = f"{form}, {len(text)} bytes, sha256 {digest}"
    for key, value in channel.metadata:
        if key == QOS_KEY:
            if "QoS" in holds and (same or value):
                found[key] = json.dumps(qos_meaning(value), sort_keys=True)
        elif key == HASH_KEY:
            if "type hash" in holds and (same or value):
                found[key] = value
        elif same:
            found[f"metadata {key}"] = value
        elif "connection header" in holds and key not in ROS1_FORMAT:
            if key == "latching":  # MCAP's registry says true and false
                value = {"true": "1", "false": "0", "": "0"}.get(value, value)
            found[f"metadata {key}"] = value
    return found


Key = tuple[tuple[str, str], ...]
Columns = list[NDArray[np.uint64]]


def merged(one: Recording, other: Recording) -> dict[Key, Columns]:
    """Messages by what tells channels apart, in log-time order with ties in source order."""
    groups: dict[Key, list[Columns]] = defaultdict(list)
    for channel, series in one.series.items():
        key = tuple(properties(channel, one, other).items())
        groups[tuple(sorted(key))].append(series.columns())
    result = {}
    for key, parts in groups.items():
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.lexsort((columns[0], columns[1]))  # its last key is the first to count
        result[key] = [column[order] for column in columns]
    return result


def pair(a: Mapping[Key, Columns], b: Mapping[Key, Columns]) -> Iterator[tuple[Key, Key]]:
    """Channels that belong together, equal ones first; an empty key where there is none."""
    yield from ((key, key) for key in a if key in b)
    others = [key for key in b if key not in a]
    for key in a:
        if key not in b:
            topic = dict(key)["topic"]
            found: Key = next((other for other in others if dict(other)["topic"] == topic), ())
            others = [other for other in others if other != found]
            yield key, found
    yield from (((), key) for key in others)


def _more(found: list[str], topic: str, limit: int) -> list[str]:
    if len(found) > limit:
        return [*found[:limit], f"{topic}: {len(found) - limit} more differences of this kind"]
    return found


def _missing(topic: str, mine: Columns, theirs: Columns, side: str) -> list[str]:
    """Messages of one recording that the other one has not got with this time and payload."""
    entries, others = (
        list(zip(x[1].tolist(), x[4].tolist(), x[5].tolist(), strict=True)) for x in (mine, theirs)
    )
    extra = Counter(entries) - Counter(others)
    found = []
    for number, entry in enumerate(entries):
        if extra[entry] > 0:
            extra[entry] -= 1
            found.append(f"{topic} message {number}: log time {entry[0]}, missing in {side}")
    return found


def differing_messages(
    topic: str, a: Columns, b: Columns, holds: frozenset[str], limit: int
) -> list[str]:
    """Differences of two sequences of messages."""
    names = {1: "log time", 2: "publish time", 3: "sequence"}
    compared = [i for i, name in names.items() if i == 1 or name in holds]
    if len(a[0]) != len(b[0]):
        found = [f"{topic}: {len(a[0])} messages in A, {len(b[0])} in B"]
        found += _missing(topic, a, b, "B") + _missing(topic, b, a, "A")
        return _more(found, topic, limit)
    payload = (a[4] != b[4]) | (a[5] != b[5])
    wrong = np.logical_or.reduce([payload, *(a[i] != b[i] for i in compared)])
    found = []
    for n in np.flatnonzero(wrong):
        unequal = [i for i in compared if a[i][n] != b[i][n]]
        parts = [f"{names[i]} {a[i][n]} in A, {b[i][n]} in B" for i in unequal]
        found.append(
            f"{topic} message {n}: " + "; ".join(parts + ["payload differs"] * int(payload[n]))
        )
    return _more(found, topic, limit)


def silent_topics(recording: Recording) -> set[tuple[str, str]]:
    """Topics and types that metadata.yaml knows and no storage file, as nobody published."""
    topics = (recording.information or {}).get("topics_with_message_count", ())
    listed = {(t["topic_metadata"]["name"], ros2_name(t["topic_metadata"]["type"])) for t in topics}
    return listed - {(channel.topic, ros2_name(channel.type)) for channel in recording.series}


def _compare_silent(a: Recording, b: Recording, report: Report) -> None:
    """Two folders list their topics themselves; here one of them is a file."""
    for one, other, side in ((a, b, "B"), (b, a, "A")):
        held = {(channel.topic, ros2_name(channel.type)) for channel in other.series}
        for topic, name in sorted(silent_topics(one) - held) if not other.information else ():
            text = f"{topic}: listed without messages ({name}), missing in {side}"
            if other.kind == "bag":  # needs a definition, which nobody has
                report.note(f"not compared: {text}")
            else:
                report.differences.append(text)


def _compare_channels(a: Recording, b: Recording, report: Report, limit: int) -> None:
    messages = merged(a, b), merged(b, a)
    holds = a.holds & b.holds
    for key_a, key_b in pair(*messages):
        mine, theirs = dict(key_a), dict(key_b)
        topic = (mine or theirs)["topic"]
        row = report.rows.setdefault(topic, Row(topic))
        left, right = messages[0].get(key_a), messages[1].get(key_b)
        row.a += len(left[0]) if left else 0
        row.b += len(right[0]) if right else 0
        found = []
        if left is None or right is None:
            side, other, there = ("B", b, left) if right is None else ("A", a, right)
            name = (mine or theirs)["type"]
            count = len(there[0]) if there else 0
            if count or (topic, ros2_name(name)) not in silent_topics(other):
                found.append(f"{topic}: a channel ({name}, {count} messages) is missing in {side}")
        else:
            for name in sorted(mine.keys() | theirs.keys()):
                if mine.get(name) != theirs.get(name):
                    values = [repr(value) for value in (mine.get(name), theirs.get(name))]
                    found.append(f"{topic}: {name} {values[0]} in A, {values[1]} in B")
            found += differing_messages(topic, left, right, holds, limit)
            row.equal += _equal_payloads(left, right)
        row.differences += len(found)
        report.differences += found


def _equal_payloads(a: Columns, b: Columns) -> int:
    if len(a[0]) == len(b[0]):
        return int(np.count_nonzero((a[4] == b[4]) & (a[5] == b[5])))
    counts = [Counter(zip(x[4].tolist(), x[5].tolist(), strict=True)) for x in (a, b)]
    return (counts[0] & counts[1]).total()


def _compare_sets(name: str, a: Sequence[str], b: Sequence[str], report: Report) -> None:
    for missing, side in ((Counter(a) - Counter(b), "B"), (Counter(b) - Counter(a), "A")):
        report.differences += [f"{name} {item} is missing in {side}" for item in missing.elements()]


def bookkeeping(name: str) -> bool:
    """Whether a metadata record describes the file rather than what was recorded."""
    return name == "rosbag2" or name.startswith("mp4ds:")


def _compare_extras(a: Recording, b: Recording, report: Report) -> None:
    holds = a.holds & b.holds
    if "attachments" in holds:
        _compare_sets("attachment", a.attachments, b.attachments, report)
    if "metadata records" in holds:
        plain = not a.folder and not b.folder

        def kept(recording: Recording) -> list[str]:
            return [
                f"{name!r} {text}"
                for name, text in recording.records
                if plain or not bookkeeping(name)
            ]

        _compare_sets("metadata record", kept(a), kept(b), report)
        if not plain:
            report.note("not compared: metadata records rosbag2 and mp4ds:* (bookkeeping)")
    if "profile" in holds and set(a.profiles) != set(b.profiles):
        profiles = [sorted(set(x.profiles)) for x in (a, b)]
        text = f"profile: {profiles[0]} in A, {profiles[1]} in B"
        if _crossed(a, b):
            report.note(f"not compared, as messages were converted: {text}")
        else:
            report.differences.append(text)
    for side, holder, other in (("B", a, b), ("A", b, a)):
        if absent := sorted(holder.holds - other.holds):
            report.note(f"not compared, as {side} ({other.kind}) holds none: {', '.join(absent)}")
            records = [name for name, _ in holder.records if not bookkeeping(name)]
            if "attachments" in absent and (extras := len(holder.attachments) + len(records)):
                report.note(f"{extras} attachments or metadata records have no place in {side}")


def _listed(information: Mapping[str, Any], hashed: bool) -> list[str]:
    """The topics of a metadata.yaml; some are in no storage file because nobody published."""
    listed = []
    for entry in information["topics_with_message_count"]:
        topic = entry["topic_metadata"]
        qos = json.dumps(qos_meaning(topic.get(QOS_KEY, "")), sort_keys=True)
        text = f"{topic['name']} ({topic['type']}, {topic['serialization_format']}, QoS {qos}"
        listed.append(text + (f", {topic.get('type_description_hash', '')})" if hashed else ")"))
    return listed


def _compare_information(a: Recording, b: Recording, report: Report) -> None:
    """What metadata.yaml holds apart from bookkeeping, between two rosbag2 folders."""
    if a.information is None or b.information is None:
        return
    version = min(int(x.information.get("version", 0)) for x in (a, b) if x.information)
    hashed = version >= 7
    listed = [_listed(x.information, hashed) for x in (a, b) if x.information is not None]
    _compare_sets("metadata.yaml: topic", listed[0], listed[1], report)
    custom = [x.information.get("custom_data", {}) for x in (a, b) if x.information is not None]
    custom = [value if isinstance(value, dict) else {} for value in custom]
    if version < 6:
        report.note("not compared: custom_data of metadata.yaml (from version 6 on)")
    elif custom[0] != custom[1]:
        report.differences.append(f"metadata.yaml: custom_data {custom[0]} in A, {custom[1]} in B")
    report.note("not compared: bookkeeping of metadata.yaml (files, counts, versions, distro)")


def _crossed(a: Recording, b: Recording) -> frozenset[str]:
    one, two = a.encodings(), b.encodings()
    pairs = ({"ros1"}, {"cdr"}), ({"cdr"}, {"ros1"})
    return frozenset(topic for topic in one if (one[topic], two.get(topic)) in pairs)


def examine(
    a: Path | Sequence[Path],
    b: Path | Sequence[Path],
    *,
    ignore_pixels: Sequence[str] = (),
    limit: int = 5,
    start: int = -(2**63),
    end: int = 2**64,
) -> Report:
    """Compare two recordings.

    Args:
        a: The first recording, or the files of a split one in order.
        b: The second one.
        ignore_pixels: Globs of topics whose pixels may differ; all else of them must be equal.
        limit: How many differing messages are listed per channel.
        start: Messages of A from this log time on, ns, are compared.
        end: Messages of A before this log time, ns, are compared.

    Raises:
        UnreadableError: One of them cannot be read.
    """
    files = [[x] if isinstance(x, Path) else list(x) for x in (a, b)]
    one = read(files[0], Digester(ignore_pixels), start, end)
    two = read(files[1], Digester(ignore_pixels))
    if crossed := _crossed(one, two):  # known only when both were read: read them once more
        one = read(files[0], Digester(ignore_pixels, crossed), start, end)
        two = read(files[1], Digester(ignore_pixels, crossed))
    report = Report(notes=one.notes + two.notes)
    _compare_channels(one, two, report, limit)
    _compare_silent(one, two, report)
    _compare_extras(one, two, report)
    _compare_information(one, two, report)
    if crossed:
        report.note(
            f"{len(crossed)} topics of ROS 1 against ROS 2 compared by field values: not compared "
            "are header.seq, definitions, channel metadata and serialised bytes"
        )
    for topic in sorted(one.digester.undecodable | two.digester.undecodable):
        report.note(f"{topic}: messages that could not be deserialised count as different")
    if ignore_pixels:
        report.note(f"not compared: pixels of topics {', '.join(ignore_pixels)}")
    return report


def compare(a: Path | Sequence[Path], b: Path | Sequence[Path], **options: Any) -> list[str]:
    """Differences of two recordings, one sentence each; none when they are equal.

    See `examine` for the options and errors.
    """
    return examine(a, b, **options).differences


def table(report: Report) -> str:
    """The report as text."""
    lines = [("topic", "in A", "in B", "equal payloads", "result")]
    for row in report.rows.values():
        result = "equal" if not row.differences else f"DIFFERS ({row.differences})"
        lines.append((row.topic, str(row.a), str(row.b), str(row.equal), result))
    widths = [max(len(line[i]) for line in lines) for i in range(5)]
    text = [
        f"{t:<{widths[0]}}  {a:>{widths[1]}}  {b:>{widths[2]}}  {e:>{widths[3]}}  {result}"
        for t, a, b, e, result in lines
    ]
    text += [""] + [f"- {difference}" for difference in report.differences]
    text += [f"note: {note}" for note in report.notes]
    text.append("DIFFERENT" if report.differences else "EQUAL")
    return "\n".join(text)


def _paths(argument: str) -> list[Path]:
    if Path(argument).exists() or "," not in argument:
        return [Path(argument)]
    return [Path(part) for part in argument.split(",")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 equal, 1 different, 2 unreadable.
    """
    parser = argparse.ArgumentParser(description="Compare two recordings message by message.")
    parser.add_argument("a", metavar="A", help="bag, rosbag2 folder, mcap, db3; split: a1,a2")
    parser.add_argument("b", metavar="B")
    parser.add_argument("--ignore-pixels", metavar="TOPIC_GLOB", action="append", default=[])
    parser.add_argument("--limit", type=int, default=5, help="messages listed per channel")
    parser.add_argument("--start", type=int, default=-(2**63), help="of A, log time in ns")
    parser.add_argument("--end", type=int, default=2**64, help="of A, log time in ns; not included")
    options = parser.parse_args(arguments)
    try:
        report = examine(
            _paths(options.a),
            _paths(options.b),
            ignore_pixels=options.ignore_pixels,
            limit=options.limit,
            start=options.start,
            end=options.end,
        )
    except UnreadableError as error:
        print(error, file=sys.stderr)
        return 2
    print(table(report))
    return 1 if report.differences else 0


if __name__ == "__main__":
    sys.exit(main())
