"""Datasets of the conformance suite that break a rule of a whole dataset, one each."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from conformance_files import Document, both, replacing, setting, without
from mp4ds import yamlio

Edit = Callable[[Document], None]
MESSAGES = "messages.mcap"
_GARBAGE = b"no MCAP file\n" * 7


@dataclass(frozen=True)
class DatasetCase:
    """A dataset that is broken: a good one with a change.

    Attributes:
        shows: What is wrong, in words.
        codes: Of its problems.
        edit: Changes the manifest.
        write: The manifest's bytes.
        files: Files that are added or replaced; None: removed.
    """

    shows: str
    codes: tuple[str, ...]
    edit: Edit = lambda document: None
    write: Callable[[Document], bytes] = lambda document: yamlio.dump(document)
    files: Mapping[str, bytes | None] = field(default_factory=dict)


def _entry(name: str, **values: Any) -> Edit:
    """Says something else of a file."""

    def edit(document: Document) -> None:
        next(entry for entry in document["files"] if entry["name"] == name).update(values)

    return edit


def _unlisted(name: str) -> Edit:
    def edit(document: Document) -> None:
        document["files"] = [entry for entry in document["files"] if entry["name"] != name]

    return edit


def broken(manifest: Document) -> dict[str, DatasetCase]:
    """All of them.

    Args:
        manifest: Of the good dataset, a topic of which has two streams.
    """
    first, second = manifest["streams"][:2]
    stream_lost = both(
        lambda document: document["streams"].remove(document["streams"][1]),
        _unlisted(second["sidecar"]),
        _unlisted(second["video"]),
    )
    twice = lambda document: document["files"].append(document["files"][0])  # noqa: E731
    return {
        "file-missing": DatasetCase(
            "messages.mcap is not there", ("file-missing",), files={MESSAGES: None}
        ),
        "file-unlisted": DatasetCase(
            "a video that the manifest does not list",
            ("file-unlisted",),
            files={"left_over.mp4": b"?"},
        ),
        "other-files": DatasetCase(
            "a file of another kind, which may be there", (), files={"notes.txt": b"windy\n"}
        ),
        "size-mismatch": DatasetCase(
            "another size of messages.mcap", ("size-mismatch",), _entry(MESSAGES, size=1)
        ),
        "hash-mismatch": DatasetCase(
            "another SHA-256 of messages.mcap",
            ("hash-mismatch",),
            _entry(MESSAGES, sha256="0" * 64),
        ),
        "frames": DatasetCase(
            "another number of frames than the sidecar says",
            ("manifest-inconsistent",),
            setting("streams.0.frames", first["frames"] + 1),
        ),
        "topic": DatasetCase(
            "another topic than the sidecar says",
            ("manifest-inconsistent",),
            setting("streams.0.topic", "/elsewhere"),
        ),
        "video-not-listed": DatasetCase(
            "a stream's video is not among the files",
            ("file-unlisted", "manifest-inconsistent"),
            _unlisted(first["video"]),
        ),
        "messages-missing": DatasetCase(
            "a stream was taken away: its ordinals are a gap",
            ("messages-missing",),
            stream_lost,
            files={second["sidecar"]: None, second["video"]: None},
        ),
        "messages-unreadable": DatasetCase(
            "messages.mcap is no MCAP file",
            ("messages-unreadable",),
            _entry(MESSAGES, size=len(_GARBAGE), sha256=hashlib.sha256(_GARBAGE).hexdigest()),
            files={MESSAGES: _GARBAGE},
        ),
        "message-count": DatasetCase(
            "more messages than there are",
            ("message-count",),
            setting("messages", manifest["messages"] + 1),
        ),
        "manifest-listed-twice": DatasetCase(
            "a file that is listed twice", ("model-invalid",), twice
        ),
        "manifest-key": DatasetCase(
            "a manifest without sources", ("schema-invalid",), without("sources")
        ),
        "manifest-name": DatasetCase(
            "a sidecar that leaves the folder",
            ("schema-invalid",),
            setting("streams.0.sidecar", "/etc/passwd"),
        ),
        "manifest-version": DatasetCase(
            "a newer major version", ("version-unsupported",), setting("mp4ds", "2.0")
        ),
        "manifest-kind": DatasetCase(
            "a sidecar's kind in a manifest", ("kind-unknown",), setting("kind", "stream")
        ),
        "manifest-yaml": DatasetCase(
            "an alias in a manifest",
            ("yaml-invalid",),
            write=replacing(b"kind: dataset", b"kind: &a dataset\nlibrary: *a"),
        ),
        "manifest-checksum": DatasetCase(
            "a manifest that was damaged",
            ("checksum-mismatch",),
            write=lambda document: yamlio.dump(document).replace(b"ros1", b"ros2", 1),
        ),
    }
