"""What a track says of its colours, for decoders that get its packets without it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mp4ds.video.sample_entry import SampleEntry

_UNSPECIFIED = 2
_LIMITED, _FULL = 1, 2  # ffmpeg's AVColorRange
_WORDS = 6  # bytes of three numbers, behind the four letters of the box's kind
# the numbers of ITU-T H.273 that ffmpeg knows
_PRIMARIES = frozenset((1, *range(4, 13), 22))
_TRANSFERS = frozenset((1, *range(4, 19)))
_MATRICES = frozenset((0, 1, *range(4, 18)))


@dataclass(frozen=True, slots=True)
class TrackColour:
    """The box ``colr`` (ISO/IEC 14496-12, 12.1.5), numbers as in ITU-T H.273.

    Attributes:
        primaries: Colour primaries.
        transfer: Transfer characteristics.
        matrix: Matrix coefficients.
        full_range: Whether samples use their full range; None if nothing is said of it.
    """

    primaries: int
    transfer: int
    matrix: int
    full_range: bool | None

    def apply(self, context: Any) -> None:
        """Tell PyAV's context of a decoder; what the packets say outweighs it."""
        context.color_primaries = self.primaries
        context.color_trc = self.transfer
        context.colorspace = self.matrix
        if self.full_range is not None:
            context.color_range = _FULL if self.full_range else _LIMITED


def track_colour(entry: SampleEntry) -> TrackColour | None:
    """The colours of a track, as ffmpeg reads them; None if it says nothing of them.

    QuickTime's ``nclc`` has no range. What nobody defined is unspecified, and profiles are not
    looked at.
    """
    found = None
    for kind, body in entry.boxes:
        if kind != "colr" or body[:4] not in (b"nclx", b"nclc") or len(body) < 4 + _WORDS:
            continue
        primaries, transfer, matrix = (int.from_bytes(body[at : at + 2], "big") for at in (4, 6, 8))
        full_range = bool(body[10] & 0x80) if body[:4] == b"nclx" and len(body) > 10 else None
        found = TrackColour(
            primaries if primaries in _PRIMARIES else _UNSPECIFIED,
            transfer if transfer in _TRANSFERS else _UNSPECIFIED,
            matrix if matrix in _MATRICES else _UNSPECIFIED,
            full_range,
        )
    return found
