"""The base of all models of the format, the types of their fields, columns and scores."""

from __future__ import annotations

import base64
import binascii
import re
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from mp4ds.errors import FormatError
from mp4ds.messages.encodings import MAX_SIDE
from mp4ds.messages.wire import Slots
from mp4ds.records import Excerpt
from mp4ds.times import INT64_MAX, INT64_MIN, decode_column, encode_column
from mp4ds.video.codecs import MAX_GOP, TOLERANCES, QualityTarget

T = TypeVar("T")

FORMAT_VERSION = "2.0"
MESSAGES_NAME = "messages.mcap"
MAX_FRAMES = 2 * 10**7  # 92 hours at 60 Hz; bounds what a sidecar can make a reader allocate
MAX_CAMERA_INFOS = 10**7
MAX_VARIANTS = 256
"""Headers or calibrations of a stream: a topic with more is not modelled any further."""
MAX_PADDING = 4 * 2**20
"""Characters of all paddings of a stream: its headers are in the part of a YAML file that is
parsed as a whole."""

Int64 = Annotated[int, Field(ge=INT64_MIN, le=INT64_MAX)]
Time = Annotated[int, Field(ge=INT64_MIN, le=2**64 - 1)]
Uint32 = Annotated[int, Field(ge=0, le=2**32 - 1)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Count = Annotated[int, Field(ge=0, le=MAX_FRAMES)]
Size = Annotated[int, Field(ge=0, le=INT64_MAX)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
FileName = Annotated[
    str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,127}$", description="A plain file name.")
]
Base64 = Annotated[str, Field(pattern=r"^[A-Za-z0-9+/]*={0,2}$")]
Version = Annotated[str, Field(pattern=r"^(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)$")]
Gop = Annotated[int, Field(ge=1, le=MAX_GOP)]
Body = Literal["pixels", "packet", "png", "rvl", "jpeg"]
Profile = Annotated[
    str,
    Field(
        pattern=r"^(lossless|visual|crf=[0-9]{1,2}"
        r"|(vmaf|psnr|ssim)=[0-9]{1,3}(\.[0-9]{1,4})?)$"
    ),
]


class Model(BaseModel):
    """Base of all models: nothing is converted, added or changed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def decode_base64(text: str) -> bytes:
    """Decode base64.

    Raises:
        ValueError: It is not base64.
    """
    try:
        data = base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise ValueError(f"{text[:20]!r} is not base64: {error}") from None
    if base64.b64encode(data).decode() != text:
        raise ValueError(f"{text[:20]!r} is not canonical base64")
    return data


def exceeds_padding(paddings: Iterable[str | None]) -> bool:
    """Whether headers have more of it than one stream may."""
    return sum(len(padding or "") for padding in paddings) > MAX_PADDING


def parse_version(text: str) -> tuple[int, int]:
    """Major and minor.

    Raises:
        ValueError: Not of the form MAJOR.MINOR.
    """
    match = re.fullmatch(r"(0|[1-9]\d*)\.(0|[1-9]\d*)", text)
    if not match:
        raise ValueError(f"version {text!r} is not of the form MAJOR.MINOR")
    return int(match.group(1)), int(match.group(2))


def document_of(model: BaseModel) -> dict[str, Any]:
    """JSON-like values of a model, without the keys that have their default."""
    return model.model_dump(mode="json", by_alias=True, exclude_defaults=True)


def json_parser(shape: Any) -> Callable[[bytes], Any]:
    """Reads JSON of one shape, such as ``tuple[str, Size]``; raises ValueError for any other."""
    return partial(TypeAdapter(shape).validate_json, strict=True)


# ---------------------------------------------------------------- columns


class Column(Model):
    """A column of 64-bit integers: ``value[i] = value[i-1] + step + residual[i-1]``."""

    start: Int64 = Field(description="The first value.")
    step: Int64 = Field(description="The common difference.")
    values: str = Field(
        description="Residuals of the differences, separated by white space; r*n is n times r."
    )

    def decode(self, count: int) -> NDArray[np.int64]:
        """The values, shape (count,).

        Raises:
            ValueError: The column does not have that length; says why.
        """
        return decode_column(self.start, self.step, self.values, count)


class Columns(Model):
    """One value per message, in the order of the video's frames."""

    log_time: Column = Field(description="When each message was recorded, ns.")
    publish_time: Column | None = Field(None, description="ns; absent: the log times.")
    sequence: Column | None = Field(None, description="MCAP sequence; absent: all 0.")
    stamp: Column = Field(description="Header stamps, ns.")
    seq: Column | None = Field(None, description="ROS 1 header sequence numbers.")
    pts: Column | None = Field(None, description="Presentation times that packets tell.")
    variant: Column | None = Field(
        None, description="Number of the header or calibration of each; absent: all 0."
    )
    ordinal: Column | None = Field(
        None, description="Place of each among the channel's messages; absent: 0, 1, 2 ..."
    )


class Digests(Model):
    """A digest of each original message payload, in frame order."""

    algorithm: Literal["xxh64"] = Field(description="XXH64 with seed 0.")
    values: str = Field(description="16 hexadecimal digits each, separated by white space.")

    def decode(self, count: int) -> NDArray[np.uint64]:
        """The digests, shape (count,).

        Raises:
            ValueError: There are not that many; says so.
        """
        try:
            raw = bytes.fromhex(self.values)
        except ValueError:
            raise ValueError("holds something other than hexadecimal digits") from None
        if len(raw) != 8 * count:
            raise ValueError(f"holds {len(raw) / 8:g} digests, not {count}")
        return np.frombuffer(raw, dtype=">u8").astype(np.uint64)


# ---------------------------------------------------------------- as arrays

_DIGESTS_PER_LINE = 12


@dataclass(frozen=True)
class DecodedColumns:
    """The columns of a stream as int64 arrays of shape (messages,); times in nanoseconds."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    stamp: NDArray[np.int64]
    variant: NDArray[np.int64]
    ordinal: NDArray[np.int64]
    seq: NDArray[np.int64] | None = None
    pts: NDArray[np.int64] | None = None

    @classmethod
    def of_frames(
        cls, stamp: NDArray[np.int64], log_time: NDArray[np.int64], **others: NDArray[np.int64]
    ) -> DecodedColumns:
        """Columns of which some may be left out: those that follow from the log times."""
        return cls(**{**_implied(log_time), "stamp": stamp, "log_time": log_time, **others})

    def slots(self, index: int) -> Slots:
        """The values that fill a message's blank."""
        return Slots(
            stamp=int(self.stamp[index]),
            seq=None if self.seq is None else int(self.seq[index]),
            pts=None if self.pts is None else int(self.pts[index]),
        )


def _implied(log_time: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """What the columns hold that a sidecar leaves out."""
    zeros = np.broadcast_to(np.int64(0), log_time.shape)
    numbers = np.arange(len(log_time), dtype=np.int64)
    return {"publish_time": log_time, "sequence": zeros, "variant": zeros, "ordinal": numbers}


def decode_columns(columns: Columns, count: int, variants: int, place: str) -> DecodedColumns:
    """Decode all columns and check what they refer to.

    Raises:
        FormatError: ``column-invalid``, naming the column.
    """
    arrays: dict[str, NDArray[np.int64]] = {}
    for name, column in columns:
        try:
            if column is not None:
                arrays[name] = column.decode(count)
        except ValueError as error:
            raise FormatError("column-invalid", f"{place} at columns.{name}", str(error)) from None
    decoded = DecodedColumns.of_frames(**arrays)
    if decoded.variant.min() < 0 or decoded.variant.max() >= variants:
        raise FormatError(
            "column-invalid",
            f"{place} at columns.variant",
            f"refers to number {int(decoded.variant.max())} of {variants}",
        )
    if decoded.ordinal[0] < 0 or (decoded.ordinal[1:] <= decoded.ordinal[:-1]).any():
        raise FormatError("column-invalid", f"{place} at columns.ordinal", "does not increase")
    return decoded


# ---------------------------------------------------------------- as a sidecar has them


def columns_model(values: Mapping[str, NDArray[np.int64]]) -> Columns:
    """Columns as the sidecar stores them, without those that follow from others.

    Args:
        values: All that `Columns` has by name, shape (messages,); ``seq`` and ``pts`` if the
            messages have them.
    """
    implied = _implied(values["log_time"])
    return Columns.model_validate(
        {
            name: encode_column(column)
            for name, column in values.items()
            if not np.array_equal(column, implied.get(name, ()))
        }
    )


def digests_model(digests: Iterable[int]) -> Digests:
    """XXH64 digests of messages, as the sidecar holds them."""
    words = [f"{value:016x}" for value in digests]
    lines = (
        " ".join(words[start : start + _DIGESTS_PER_LINE])
        for start in range(0, len(words), _DIGESTS_PER_LINE)
    )
    return Digests(algorithm="xxh64", values="\n".join(lines) + "\n")


# ---------------------------------------------------------------- scores

SCORE_STEPS = {"vmaf": 100, "psnr": 100, "ssim": 10_000}
"""Metric -> how many steps of the column of scores are 1."""

_DIGITS = 4  # after the decimal point of figures for all frames
_ROUNDED = 2 * 10.0**-_DIGITS

Score = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]


class Quality(Model):
    """The scores that were asked for, and those that were measured while packing."""

    metric: Literal["vmaf", "psnr", "ssim"] = Field(
        description="What was measured (registry, Profiles)."
    )
    target: Score = Field(description="What was asked for.")
    mean: Score = Field(description="Of all frames.")
    p5: Score = Field(description="5th percentile of the frames.")
    min: Score = Field(description="Of the worst frame.")
    worst_window: Score = Field(description="Least mean of the frames of a window.")
    windows: Annotated[Count, Field(ge=1)] = Field(
        description="Windows that were measured each by itself."
    )
    reencoded: Count = Field(0, description="Of these, encoded more than once.")
    limited: Count = Field(
        0, description="Of these, with originals that themselves score too little."
    )
    scores: Column = Field(description="Of each frame, in steps of 0.01; SSIM: of 0.0001.")

    @model_validator(mode="after")
    def _counted(self) -> Quality:
        if max(self.reencoded, self.limited) > self.windows:
            raise ValueError("more windows are listed than there are")
        return self

    @classmethod
    def from_scores(
        cls, target: QualityTarget, scores: NDArray[np.int64], **windows: Any
    ) -> Quality:
        """The model of scores.

        Args:
            target: What was asked for.
            scores: Of each frame, in steps of the metric (`SCORE_STEPS`), shape (frames,).
            **windows: The fields of this model about windows.
        """
        mean, p5, least = _told(scores, target.metric)
        figures = {"mean": mean, "p5": p5, "min": least, "scores": encode_column(scores)}
        asked = {"metric": target.metric, "target": target.score}
        return cls.model_validate({**asked, **figures, **windows})

    @classmethod
    def joined(cls, parts: Sequence[tuple[Quality, int]]) -> Quality:
        """The scores of consecutive videos together.

        Args:
            parts: Of each what holds of it, and its frames; at least one, all of one target.

        Raises:
            ValueError: A column does not have a score for each frame.
        """
        first = parts[0][0]
        counts = ("windows", "reencoded", "limited")
        return cls.from_scores(
            QualityTarget(first.metric, first.target),
            np.concatenate([part.scores.decode(frames) for part, frames in parts]),
            worst_window=min(part.worst_window for part, _ in parts),
            **{name: sum(getattr(part, name) for part, _ in parts) for name in counts},
        )

    def of(self, numbers: NDArray[np.int64], frames: int) -> Quality:
        """The scores of some frames; figures of windows stay those of the whole video.

        Args:
            numbers: Of the frames, at least one.
            frames: How many there are.

        Raises:
            ValueError: There is no score for each of them.
        """
        scores = self.scores.decode(frames)[numbers]
        windows = self.model_dump(include={"worst_window", "windows", "reencoded", "limited"})
        return self.from_scores(QualityTarget(self.metric, self.target), scores, **windows)

    def decode(self, frames: int) -> NDArray[np.float64]:
        """The score of each frame, shape (frames,).

        Raises:
            ValueError: There are not that many, or they do not add up to the stated figures.
        """
        steps = self.scores.decode(frames)
        for name, due in zip(("mean", "p5", "min"), _told(steps, self.metric), strict=True):
            if abs(due - getattr(self, name)) > _ROUNDED:
                raise ValueError(
                    f"its scores have a {name} of {due:g}, not {getattr(self, name):g}"
                )
        return steps / SCORE_STEPS[self.metric]

    def __str__(self) -> str:
        text = (
            f"{self.metric} {self.mean:g} (target: {self.target:g}), 5 % of frames below "
            f"{self.p5:g}, minimum {self.min:g}; worst of {self.windows} windows "
            f"{self.worst_window:g}"
        )
        if self.reencoded:
            text += f"; {self.reencoded} re-encoded"
        if self.limited:
            text += (
                f"; {self.limited} limited to {TOLERANCES[self.metric]:g} below the score of the "
                "originals against themselves, which is below the target"
            )
        return text


def _told(steps: NDArray[np.int64], metric: str) -> tuple[float, float, float]:
    """Mean, 5th percentile and least of scores."""
    found = (np.mean(steps), np.percentile(steps, 5), np.min(steps))
    mean, p5, least = (round(float(value) / SCORE_STEPS[metric], _DIGITS) for value in found)
    return mean, p5, least


# ---------------------------------------------------------------- choices

Choice = Callable[[DecodedColumns], Iterator[int]]
"""Yields the numbers of the wanted messages, increasing.

The next number is requested only when the previous message has been made, so that it can skip those
for which it is too late by then.
"""


def everything(columns: DecodedColumns) -> Iterator[int]:
    """All messages."""
    return iter(range(len(columns.log_time)))


def within(excerpt: Excerpt, choice: Choice = everything) -> Choice:
    """Restrict the wanted messages to a span of log time."""

    def choose(columns: DecodedColumns) -> Iterator[int]:
        times = columns.log_time
        return (index for index in choice(columns) if excerpt.has_time(int(times[index])))

    return choose


def last_of(end: int, count: int) -> Choice:
    """The last messages before a log time, nanoseconds, as many as there are."""
    return lambda columns: iter(np.flatnonzero(columns.log_time < end)[-count:].tolist())


def marked(is_wanted: NDArray[np.bool_]) -> Choice:
    """The marked messages: for each whether it is, shape (messages,)."""
    return lambda _: iter(np.flatnonzero(is_wanted).tolist())


def unbroken(
    indices: Iterable[int], keys: Sequence[int], *, from_key: bool = False
) -> Iterator[int]:
    """Packets of a video, including those between that must be decoded first.

    Args:
        indices: Numbers of the wanted packets, increasing.
        keys: Numbers of the key frames, increasing.
        from_key: Start with the key frame before the first one.
    """
    due: int | None = None
    for index in indices:
        at = bisect_right(keys, index)
        key = keys[at - 1] if at else 0
        if due is None:
            due = key if from_key else index
        yield from range(max(due, key), index + 1)
        due = index + 1
