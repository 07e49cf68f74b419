"""The scores of a clip: of every frame, and what they come to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

METRICS = ("vmaf", "psnr_y", "psnr_cb", "psnr_cr", "ssim")
"""What is scored: VMAF 0 to 100, PSNR of each plane in dB, SSIM of the luma."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What the scores of a clip's frames come to.

    Attributes:
        mean: Arithmetic mean.
        harmonic_mean: As libvmaf has it, of the scores plus 1, minus 1: bad frames count more.
        percentile_5: 5 of 100 frames are worse.
        minimum: Of the worst frame.
    """

    mean: float
    harmonic_mean: float
    percentile_5: float
    minimum: float


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Scores of each frame of a clip, float64, shape (frames,).

    Attributes:
        vmaf: 0 to 100; None where there is no libvmaf.
        psnr_y: Of luma, dB.
        psnr_cb: Of blue chroma, dB.
        psnr_cr: Of red chroma, dB.
        ssim: Of luma, at most 1.
    """

    vmaf: NDArray[np.float64] | None
    psnr_y: NDArray[np.float64]
    psnr_cb: NDArray[np.float64]
    psnr_cr: NDArray[np.float64]
    ssim: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.psnr_y)

    def summaries(self) -> dict[str, Summary]:
        """What each of `METRICS` comes to; VMAF is left out where there is none."""
        found = {name: getattr(self, name) for name in METRICS}
        return {name: summary_of(values) for name, values in found.items() if values is not None}


def summary_of(values: NDArray[np.float64]) -> Summary:
    """What the scores of frames come to.

    Args:
        values: One for each frame, at least one; none of them below -1.
    """
    return Summary(
        mean=float(np.mean(values)),
        harmonic_mean=float(1 / np.mean(1 / (values + 1)) - 1),
        percentile_5=float(np.percentile(values, 5)),
        minimum=float(np.min(values)),
    )
