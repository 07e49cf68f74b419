"""How a folder of images is read."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class ImageFolder:
    """How a folder of images is read as a recording.

    Attributes:
        layout: ``euroc``, ``kitti``, ``tum`` or ``plain``; None: the one that the folder has.
        stamps: Of plain folders, the file with the times of the images.
        rate: Of plain folders without times, images per second, such as ``20`` or ``30000/1001``;
            of each camera, where the names tell several.
        unit: Of times that are whole numbers: ``s``, ``ms``, ``us`` or ``ns``; None: nanoseconds,
            if they have enough digits to be.
        calibration: A YAML file of ROS's camera_calibration, for all cameras of a folder that
            tells no calibrations.
        topic: Of the images of a plain folder.
        frame_id: Coordinate frame of the images of a plain folder.
        encoding: ROS image encoding of a plain folder's images, such as ``bayer_rggb8`` or
            ``16UC1``; None: the one that the files tell.
    """

    layout: str | None = None
    stamps: str | None = None
    rate: str | None = None
    unit: str | None = None
    calibration: str | None = None
    topic: str | None = None
    frame_id: str | None = None
    encoding: str | None = None

    def absolute(self) -> ImageFolder:
        """The same with absolute paths, for processes elsewhere."""
        stamps, calibration = (
            None if path is None else os.path.abspath(path)  # noqa: PTH100 - keeps links
            for path in (self.stamps, self.calibration)
        )
        return replace(self, stamps=stamps, calibration=calibration)
