"""How much decoded frames differ from their originals: VMAF, PSNR and SSIM of each frame.

PSNR and SSIM are computed here. VMAF is computed by libvmaf within an ffmpeg, which is run as a
process: the optional package imageio-ffmpeg brings one, or one on the PATH is taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mp4ds.lazily import names_of

if TYPE_CHECKING:
    from mp4ds.scoring.errors import ScoringError
    from mp4ds.scoring.ffmpeg import VMAF_MODEL, Ffmpeg, find_ffmpeg, vmaf_bytes
    from mp4ds.scoring.measures import MAX_PSNR, psnr, ssim
    from mp4ds.scoring.scorer import (
        SMALLEST,
        Scorer,
        YuvFrame,
        psnr_scores,
        ssim_scores,
        vmaf_scores,
    )
    from mp4ds.scoring.scores import METRICS, Scores, Summary, summary_of
    from mp4ds.scoring.search import largest_crf
else:
    __getattr__ = names_of(
        __name__,
        errors="ScoringError",
        ffmpeg="VMAF_MODEL Ffmpeg find_ffmpeg vmaf_bytes",
        measures="MAX_PSNR psnr ssim",
        scorer="SMALLEST Scorer YuvFrame psnr_scores ssim_scores vmaf_scores",
        scores="METRICS Scores Summary summary_of",
        search="largest_crf",
    )

__all__ = [
    "MAX_PSNR",
    "METRICS",
    "SMALLEST",
    "VMAF_MODEL",
    "Ffmpeg",
    "Scorer",
    "Scores",
    "ScoringError",
    "Summary",
    "YuvFrame",
    "find_ffmpeg",
    "largest_crf",
    "psnr",
    "psnr_scores",
    "ssim",
    "ssim_scores",
    "summary_of",
    "vmaf_bytes",
    "vmaf_scores",
]
