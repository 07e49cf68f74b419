"""A software encoder that stands in for one of the hardware, which few machines have."""

from __future__ import annotations

from mp4ds.video import codecs, encoder
from mp4ds.video.codecs import HARDWARE, HardwareEncoder

NAME = "h264-vaapi"  # it has no presets
STAND_IN = HardwareEncoder("h264", "libx264", "nothing", {"bf": "0"}, "crf", 51)
KNOWN = {**HARDWARE, NAME: STAND_IN}


def stand_in_here() -> None:
    """Take it for the device in this process, from now on."""
    encoder.HARDWARE = codecs.HARDWARE = KNOWN  # type: ignore[misc]
