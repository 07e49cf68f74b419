"""Images in another form than recorded: raw, as files, or as packets of video; smaller, fewer."""

from __future__ import annotations

from mp4ds.republish.pictures import holds_files, image_files
from mp4ds.republish.reduction import Reduction
from mp4ds.republish.republisher import Republished, Republisher, check_kind
from mp4ds.republish.topics import KINDS

__all__ = [
    "KINDS",
    "Reduction",
    "Republished",
    "Republisher",
    "check_kind",
    "holds_files",
    "image_files",
]
