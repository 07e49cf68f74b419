"""Images in another form than recorded: raw, as JPEG or PNG files, or as packets of video."""

from __future__ import annotations

from mp4ds.republish.pictures import files_of, holds_files
from mp4ds.republish.republisher import Republished, Republisher
from mp4ds.republish.topics import KINDS

__all__ = ["KINDS", "Republished", "Republisher", "files_of", "holds_files"]
