"""YUV of cameras, packed and semi-planar, as planes of Y, U and V (spec/index.md, "Layouts").

The byte orders are those of the FourCC codes UYVY, YUY2, NV12, NV21 and NV24.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mp4ds.layouts.arrangements import Picture
from mp4ds.layouts.values import Samples

CHROMA_SHIFTS = {"yuv420p": (1, 1), "yuv422p": (1, 0), "yuv444p": (0, 0)}
"""Planar pixel formats: how often width and height of the chroma planes are halved."""


@dataclass(frozen=True, slots=True)
class Packed422:
    """Planes of Y, U and V, from pixels of two bytes that share U and V with a neighbour.

    Attributes:
        luma: Which of the two bytes is Y; in the other, U and V alternate.
    """

    luma: int

    def pixel_format(self, bits: int) -> str:
        """Chroma of half the width."""
        return "yuv422p"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """The same."""
        return width, height

    def luma_rows(self, samples: Samples) -> int:
        """Rows of the image."""
        return int(samples.shape[0])

    def arrange(self, samples: Samples) -> Picture:
        """Views."""
        chroma = samples[..., 1 - self.luma]
        return samples[..., self.luma], chroma[:, 0::2], chroma[:, 1::2]

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        for plane, target in zip(picture, self.arrange(samples), strict=True):
            target[...] = plane


@dataclass(frozen=True, slots=True)
class SemiPlanar:
    """Planes of Y, U and V, from a plane of Y over one of U and V in turn.

    Attributes:
        halved: Whether chroma has half the width and height (nv12, nv21), or all (nv24).
        first: Which comes first, ``u`` or ``v``.
    """

    halved: bool
    first: str

    def pixel_format(self, bits: int) -> str:
        """By the chroma's size."""
        return "yuv420p" if self.halved else "yuv444p"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """The same."""
        return width, height

    def arrange(self, samples: Samples) -> Picture:
        """Views where rows follow each other."""
        height = self.luma_rows(samples)
        both = samples[height:].reshape(height >> self.halved, -1, 2)
        u = 0 if self.first == "u" else 1
        return samples[:height], both[..., u], both[..., 1 - u]

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy."""
        height = self.luma_rows(samples)
        u = 0 if self.first == "u" else 1
        both = np.empty((*picture[1].shape, 2), samples.dtype)
        both[..., u], both[..., 1 - u] = picture[1], picture[2]
        samples[:height] = picture[0]
        samples[height:] = both.reshape(-1, samples.shape[1])

    def luma_rows(self, samples: Samples) -> int:
        """Rows of the image."""
        return int(samples.shape[0] * 2 // 3 if self.halved else samples.shape[0] // 3)


@dataclass(frozen=True, slots=True)
class Halved:
    """Chroma averaged to half the width and height; not exact.

    The picture's sides are even; what is odd repeats its last row and column.

    Attributes:
        full: The exact arrangement of the same encoding.
    """

    full: Packed422 | SemiPlanar

    def pixel_format(self, bits: int) -> str:
        """What every lossy encoder takes."""
        return "yuv420p"

    def picture_size(self, width: int, height: int) -> tuple[int, int]:
        """Even."""
        return width + width % 2, height + height % 2

    @property
    def _shifts(self) -> tuple[int, int]:
        """How often the chroma of the encoding itself is halved."""
        return CHROMA_SHIFTS[self.full.pixel_format(8)]

    def arrange(self, samples: Samples) -> Picture:
        """A copy."""
        luma, *chroma = self.full.arrange(samples)
        height, width = luma.shape
        across, down = (not shift for shift in self._shifts)
        return (
            np.pad(luma, ((0, height % 2), (0, width % 2)), mode="edge"),
            *(_mean(plane, down=down, across=across) for plane in chroma),
        )

    def restore(self, picture: Picture, samples: Samples) -> None:
        """Copy; chroma samples are repeated."""
        height, width = self.full.luma_rows(samples), samples.shape[1]
        across, down = self._shifts
        planes = [picture[0][:height, :width]]
        for plane in picture[1:]:
            tall = plane if down else np.repeat(plane, 2, axis=0)
            wide = tall if across else np.repeat(tall, 2, axis=1)
            planes.append(wide[: height >> down, : width >> across])
        self.full.restore(tuple(planes), samples)


def _mean(plane: Samples, *, down: bool, across: bool) -> Samples:
    """The rounded mean of two rows, two columns or both; what is odd repeats its neighbour."""
    pad = ((0, down and plane.shape[0] % 2), (0, across and plane.shape[1] % 2))
    total = np.pad(plane, pad, mode="edge").astype(np.uint16)
    if down:
        total = total[0::2] + total[1::2]
    if across:
        total = total[:, 0::2] + total[:, 1::2]
    halvings = down + across
    return ((total + halvings) >> halvings).astype(np.uint8)
