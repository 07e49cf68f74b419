"""The model of the scores that a video's frames were measured to have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from mp4ds.plan import TOLERANCES, Target
from mp4ds.sidecar.columns import Column
from mp4ds.sidecar.fields import Count, Model
from mp4ds.stamps import encode_column

SCORE_STEPS = {"vmaf": 100, "psnr": 100, "ssim": 10_000}
"""Metric -> how many steps of the column of scores are 1."""

_DIGITS = 4  # after the point of what is told of all scores
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
            raise ValueError("more windows are told of than there are")
        return self

    @classmethod
    def from_scores(
        cls,
        target: Target,
        scores: NDArray[np.int64],
        *,
        worst_window: float,
        windows: int,
        reencoded: int,
        limited: int,
    ) -> Quality:
        """The model of scores.

        Args:
            target: What was asked for.
            scores: Of each frame, in steps of the metric (`SCORE_STEPS`), shape (frames,).
            worst_window: Least mean of a window.
            windows: How many there are.
            reencoded: How many of them were encoded again.
            limited: How many have originals that score too little themselves.
        """
        mean, p5, least = _told(scores, target.metric)
        values = {
            "metric": target.metric,
            "target": target.score,
            "mean": mean,
            "p5": p5,
            "min": least,
            "worst_window": round(worst_window, _DIGITS),
            "windows": windows,
            "reencoded": reencoded,
            "limited": limited,
            "scores": encode_column(scores),
        }
        return cls.model_validate(values)

    @classmethod
    def joined(cls, parts: Sequence[tuple[Quality, int]]) -> Quality:
        """What holds of consecutive videos together.

        Args:
            parts: Of each what holds of it, and its frames; at least one, all of one target.

        Raises:
            ValueError: A column does not have a score for each frame.
        """
        first = parts[0][0]
        return cls.from_scores(
            Target(first.metric, first.target),
            np.concatenate([part.scores.decode(frames) for part, frames in parts]),
            worst_window=min(part.worst_window for part, _ in parts),
            windows=sum(part.windows for part, _ in parts),
            reencoded=sum(part.reencoded for part, _ in parts),
            limited=sum(part.limited for part, _ in parts),
        )

    def decode(self, frames: int) -> NDArray[np.float64]:
        """The score of each frame, shape (frames,).

        Raises:
            ValueError: There are not that many, or they do not come to what is told of them.
        """
        steps = self.scores.decode(frames)
        for name, due in zip(("mean", "p5", "min"), _told(steps, self.metric), strict=True):
            if abs(due - getattr(self, name)) > _ROUNDED:
                raise ValueError(f"has scores whose {name} is {due:g}, not {getattr(self, name):g}")
        return steps / SCORE_STEPS[self.metric]

    def __str__(self) -> str:
        text = (
            f"{self.metric} {self.mean:g} (asked for: {self.target:g}), 5 % of the frames below "
            f"{self.p5:g}, least {self.min:g}; worst of {self.windows} windows "
            f"{self.worst_window:g}"
        )
        if self.reencoded:
            text += f"; {self.reencoded} encoded again"
        if self.limited:
            text += (
                f"; {self.limited} that were to have {TOLERANCES[self.metric]:g} less than the "
                "originals beside themselves, which is less than was asked for"
            )
        return text


def _told(steps: NDArray[np.int64], metric: str) -> tuple[float, float, float]:
    """Mean, 5th percentile and least of scores."""
    found = (np.mean(steps), np.percentile(steps, 5), np.min(steps))
    mean, p5, least = (round(float(value) / SCORE_STEPS[metric], _DIGITS) for value in found)
    return mean, p5, least
