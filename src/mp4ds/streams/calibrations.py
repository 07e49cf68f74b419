"""Calibrations for images as they are, and for parts of them in another size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mp4ds.sidecar import Calibration, Roi
from mp4ds.streams.camera_info import fields_of
from mp4ds.wire import CalibrationFields

Matrix = list[list[float]]


def effective(calibration: CalibrationFields) -> tuple[Matrix, Matrix]:
    """K and P for the images as they are, rather than for the full resolution.

    The principal point moves by the offset of the region of interest, then all that is in pixels
    is divided by the binning, as REP 104 has it and image_geometry's PinholeCameraModel does.

    Args:
        calibration: K and P of the full resolution, with ROI and binning.

    Returns:
        K, 3 x 3, and P, 3 x 4.
    """
    x_offset, y_offset, _, _ = calibration.roi
    scales = [1.0 / max(1, binning) for binning in (calibration.binning_x, calibration.binning_y)]
    matrices = []
    for values in (calibration.k, calibration.p):
        matrix = np.array(values).reshape(3, -1)
        matrix[0, 2] -= x_offset
        matrix[1, 2] -= y_offset
        matrix[:2] *= np.array(scales)[:, None]
        matrices.append(matrix.tolist())
    return matrices[0], matrices[1]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a picture was cut out of an image, and its size after that.

    Attributes:
        crop: x, y, width and height in pixels of the image.
        size: Width and height of the picture.
    """

    crop: tuple[int, int, int, int]
    size: tuple[int, int]

    def calibration(self, image: Calibration) -> Calibration:
        """The calibration of the picture; without binning, and without a region of interest.

        The middle of a pixel has whole coordinates, so that a picture scaled by s has its
        principal point at ``(cx + 0.5) * s - 0.5``.

        Args:
            image: The calibration of the image, as recorded.
        """
        x, y, width, height = self.crop
        k, p = (np.array(matrix) for matrix in effective(fields_of(image)))
        for row, offset, scale in (
            (0, x, self.size[0] / width),
            (1, y, self.size[1] / height),
        ):
            for matrix in (k, p):
                # by the third row, which is 0 in the matrices of a camera that is not calibrated
                matrix[row] = scale * (matrix[row] - offset * matrix[2])
                matrix[row] += (0.5 * scale - 0.5) * matrix[2]
        rectify = image.roi.do_rectify if image.roi else 0
        return image.model_copy(
            update={
                "width": self.size[0],
                "height": self.size[1],
                "k": k.ravel().tolist(),
                "p": p.ravel().tolist(),
                "binning_x": 0,
                "binning_y": 0,
                "roi": _whole(rectify) if rectify else None,
                "template": None,  # the recorded message is another
            }
        )


def _whole(do_rectify: int) -> Roi:
    return Roi(x_offset=0, y_offset=0, height=0, width=0, do_rectify=do_rectify)
