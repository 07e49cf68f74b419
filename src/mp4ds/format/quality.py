"""The scores of a video, as its sidecar has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mp4ds.format.fields import Column, Count, Model
from mp4ds.times import encode_column
from mp4ds.video.codecs import TOLERANCES, QualityTarget

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
