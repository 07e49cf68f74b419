"""Which topics are packed, what their streams are called, and how they are encoded. Pure.

File names follow spec/index.md, "File names"; the visual table is that of the paper
(Li, Xu, Schwertfeger, 2024).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import xxhash

from mp4ds.errors import OptionError, Refused

LOSSLESS = "lossless"
"""The quality at which nothing is lost."""

MAX_GOP = 100_000
"""Maximum key frame interval that may be asked for, frames."""

_MAX_NAME = 100
_STEM = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,119}")
_RESERVED = {"dataset", "messages", "con", "prn", "aux", "nul"} | {
    f"{port}{number}" for port in ("com", "lpt") for number in range(10)
}

VISUAL_TABLE: tuple[tuple[float, int, int], ...] = (
    (2.0, 18, 7),
    (5.0, 17, 7),
    (10.0, 17, 7),
    (20.0, 18, 7),
    (30.0, 18, 7),
    (60.0, 22, 6),
)
"""Frame rate in Hz, crf and preset of SVT-AV1 for VMAF 99.5: the paper's rates and crf."""

_UNKNOWN_RATE = 30.0

TOLERANCES = {"vmaf": 0.5, "psnr": 0.5, "ssim": 0.005}
"""Metric of a target -> how far below it the mean of a single window may be."""

_BOUNDS = {"vmaf": 100.0, "psnr": 60.0, "ssim": 1.0}  # of PSNR, dB: identical planes have it


@dataclass(frozen=True, slots=True)
class QualityTarget:
    """The score that packed frames have to reach.

    Attributes:
        metric: ``vmaf`` (0 to 100), or of the luma ``psnr`` (dB) or ``ssim`` (0 to 1).
        score: Required mean over the frames.
    """

    metric: str
    score: float

    @property
    def tolerance(self) -> float:
        """How far below the score the mean of a single window may be."""
        return TOLERANCES[self.metric]

    def __str__(self) -> str:
        return f"{self.metric}={self.score:g}"


@dataclass(frozen=True, slots=True)
class QualitySetting:
    """What ``--quality`` asked for.

    Attributes:
        name: ``lossless``, ``visual``, ``crf`` or ``target``.
        crf: The constant rate factor, for ``crf`` only.
        target: The score to reach, for ``target`` only.
    """

    name: str
    crf: int | None = None
    target: QualityTarget | None = None

    @property
    def lossless(self) -> bool:
        """Whether every pixel must be restored exactly."""
        return self.name == LOSSLESS

    def __str__(self) -> str:
        if self.target is not None:
            return str(self.target)
        return self.name if self.crf is None else f"crf={self.crf}"


def parse_quality(value: str | QualitySetting) -> QualitySetting:
    """Parse ``lossless``, ``visual``, ``crf=N``, ``vmaf=SCORE``, ``psnr=DB`` or ``ssim=SCORE``.

    Raises:
        OptionError: Anything else.
    """
    if isinstance(value, QualitySetting):
        return value
    if value in (LOSSLESS, "visual"):
        return QualitySetting(value)
    match = re.fullmatch(r"crf=([0-9]{1,2})", value)
    if match and int(match.group(1)) <= 63:
        return QualitySetting("crf", int(match.group(1)))
    match = re.fullmatch(r"(vmaf|psnr|ssim)=([0-9]{1,3}(?:\.[0-9]{1,4})?)", value)
    if match:
        target = QualityTarget(match.group(1), float(match.group(2)))
        if 0 < target.score < _BOUNDS[target.metric]:
            return QualitySetting("target", target=target)
    raise OptionError(
        f"{value!r} is not known. Use lossless, visual, crf=N with N from 0 to 63, or a score to "
        "reach: vmaf=99.5 (below 100), psnr=42 (dB, below 60) or ssim=0.98 (below 1)."
    )


TRAINING, ARCHIVE, SPEED = "training", "archive", "speed"
_LARGER = 15  # percent that faster reading may cost


@dataclass(frozen=True, slots=True)
class Purpose:
    """What a dataset is for.

    Attributes:
        name: ``archive``, ``training`` or ``speed``.
        larger: For training, percent by which lossless videos may be larger than the smallest.
    """

    name: str
    larger: int = 0

    @property
    def is_training(self) -> bool:
        """Whether fast reading matters."""
        return self.name == TRAINING

    @property
    def is_speed(self) -> bool:
        """Whether fast packing matters; what is packed in parts then fits together untried."""
        return self.name == SPEED

    def __str__(self) -> str:
        return f"{self.name}={self.larger}" if self.is_training else self.name


def parse_purpose(value: str | Purpose) -> Purpose:
    """Parse ``archive``, ``training``, ``training=PERCENT`` or ``speed``.

    Raises:
        OptionError: Anything else.
    """
    if isinstance(value, Purpose):
        return value
    match = re.fullmatch(rf"{ARCHIVE}|{SPEED}|{TRAINING}(?:=([0-9]{{1,4}}))?", value)
    if not match:
        raise OptionError(
            f"{value!r} is not known. Use archive, speed, training, or training=PERCENT: how much "
            f"larger lossless videos may be, {_LARGER} by default."
        )
    if value in (ARCHIVE, SPEED):
        return Purpose(value)
    return Purpose(TRAINING, int(match[1] or _LARGER))


def visual_setting(rate: float | None) -> tuple[int, int]:
    """The crf and preset of the table row nearest to a frame rate.

    Args:
        rate: Frames per second, or None if no index gives it; then 30 is assumed.
    """
    wanted = rate or _UNKNOWN_RATE
    _, crf, preset = min(VISUAL_TABLE, key=lambda row: abs(row[0] - wanted))
    return crf, preset


class Selection:
    """Topics chosen by globs.

    Args:
        topics: Globs, at least one of which must match; empty for all topics.
        exclude: Globs, none of which may match.
    """

    def __init__(self, topics: Sequence[str] = (), exclude: Sequence[str] = ()) -> None:
        self._topics = tuple(topics)
        self._exclude = tuple(exclude)

    def __call__(self, topic: str) -> bool:
        """Whether the topic is chosen."""
        if self._topics and not _matches(topic, self._topics):
            return False
        return not _matches(topic, self._exclude)

    def check(self, topics: Iterable[str]) -> None:
        """Refuse a pattern that matches nothing: it is a typing error, or data would be missed.

        Raises:
            OptionError: Names the pattern and the topics there are.
        """
        known = sorted(set(topics))
        for option, patterns in (("topics", self._topics), ("exclude", self._exclude)):
            for pattern in patterns:
                if not any(_matches(topic, (pattern,)) for topic in known):
                    listed = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
                    raise OptionError(
                        f"`{option}` {pattern!r} matches no topic. Topics: {listed or 'none'}."
                    )


def _matches(topic: str, patterns: Iterable[str]) -> bool:
    return any(
        fnmatchcase(topic, pattern) or fnmatchcase("/" + topic.lstrip("/"), pattern)
        for pattern in patterns
    )


INFO_NAMES = ("camera_info", "calibration")
"""Last words of calibration topics, in ROS and in Foxglove's examples."""


TRANSPORTS = frozenset({"compressed", "compressedDepth", "ffmpeg", "foxglove"})
"""Last words of topics that transport the images of the topic before it."""


def calibration_topics(topic: str) -> list[str]:
    """Usual topics for the calibrations of a topic of images.

    They are next to that of the images: ``/cam/image_raw`` or ``/cam/image_raw/compressed`` has
    them on ``/cam/camera_info``.
    """
    base, _, last = topic.rpartition("/")
    parent = (base if last in TRANSPORTS else topic).rpartition("/")[0]
    return [f"{parent}/{name}" for name in INFO_NAMES]


class FileNames:
    """Gives each stream a file name that no topic can turn into a path or take from another."""

    def __init__(self) -> None:
        self._taken: set[str] = set()

    def name_for(self, topic: str) -> str:
        """A stem for the stream's files."""
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", topic.strip("/")).strip("._-") or "topic"
        if len(stem) > _MAX_NAME:
            stem = f"{stem[: _MAX_NAME - 17]}-{xxhash.xxh64(topic.encode()).hexdigest()}"
        if stem.casefold().split(".")[0] in _RESERVED:
            stem = f"topic_{stem}"
        name, number = stem, 1
        while name.casefold() in self._taken:
            number += 1
            name = f"{stem}-{number}"
        self._taken.add(name.casefold())
        return name

    def claim(self, stem: str) -> None:
        """Take a stem that a file says another run gave a stream.

        Raises:
            Refused: No run gives such a stem, or it is taken.
        """
        key = stem.casefold()
        is_plain = _STEM.fullmatch(stem) and key.split(".")[0] not in _RESERVED
        if not is_plain or key in self._taken:
            raise Refused(f"{stem[:_MAX_NAME]!r} is not a name for the files of a stream")
        self._taken.add(key)
