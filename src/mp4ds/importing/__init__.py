"""Folders of images, read as if they were recordings: the messages are made when they are read.

A layout (`layouts.LAYOUTS`) finds the cameras, times, calibrations and other sensors of a folder
and gives a `Scene`; `ImagesReader` makes the messages of ROS 2 that a driver would have published.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mp4ds.lazily import names_of

if TYPE_CHECKING:
    from mp4ds.importing.layouts import open_images
    from mp4ds.importing.options import ImageFolder
else:
    __getattr__ = names_of(
        __name__,
        layouts="open_images",
        options="ImageFolder",
    )

__all__ = ["ImageFolder", "open_images"]
