"""Decoding by torchcodec, on a CPU or GPU."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mp4ds.dataset.stream import Stream
from mp4ds.dataset.topic import Topic
from mp4ds.dataset.views import Crop
from mp4ds.errors import OptionError, VideoError
from mp4ds.files.urls import remote
from mp4ds.messages.layouts import LAYOUTS
from mp4ds.video.codecs import TEN_BITS


class TorchcodecReader:
    """Decodes a stream's video by ``torchcodec.decoders.VideoDecoder``.

    Args:
        topic: The stream's frames.
        crop: x, y, width, height, pixels; None: all.
        device: Such as ``cpu`` or ``cuda``.

    Raises:
        OptionError: torchcodec is missing or misinterprets the video's range or beginning, or the
            video's pictures are not the images.
        VideoError: It cannot open the video.
    """

    def __init__(self, topic: Topic, crop: Crop | None, device: str) -> None:
        self._path = topic.parts[0].video_path
        for stream in topic.streams:
            _check_layout(stream)
            if stream.hidden_frames:
                raise OptionError(
                    f"topic {stream.topic}: torchcodec returns wrong frames at the beginning of a "
                    "video cut out of another. Use backend='mp4ds', or a dataset packed with a "
                    "`codec`."
                )
        if remote(self._path):
            raise OptionError(f"{self._path}: backend='torchcodec' only reads local files.")
        columns, rows = topic.image_size
        x, y, width, height = crop or (0, 0, columns, rows)
        if not (0 <= x < x + width <= columns and 0 <= y < y + height <= rows):
            raise OptionError(f"topic {topic.topic}: crop {crop} is not inside {columns}x{rows}.")
        self._rows, self._columns = slice(y, y + height), slice(x, x + width)
        self._decoder = self._opened(device)
        self._check_range(topic)

    def _opened(self, device: str) -> Any:
        if find_spec("torchcodec") is None:
            raise OptionError(
                "backend='torchcodec' needs torchcodec. Install it with: pip install torchcodec"
            )
        try:
            module = import_module("torchcodec.decoders")
        except (ImportError, OSError, RuntimeError) as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise OptionError(
                f"torchcodec is installed but cannot be used: {reason} If it finds no FFmpeg, "
                "install it, or use the one in PyAV: LD_LIBRARY_PATH=$(python -m "
                "mp4ds.torch.ffmpeg) python ..."
            ) from None
        try:
            # with exact seeking, frame n is the n-th shown, whatever its presentation time
            return module.VideoDecoder(
                str(self._path), dimension_order="NHWC", device=device, seek_mode="exact"
            )
        except (RuntimeError, ValueError) as error:
            raise self._refused(error) from None

    def _check_range(self, topic: Topic) -> None:
        """Refuse a video whose range torchcodec misinterprets.

        On a CPU, torchcodec 0.13 treats full-range AV1 as limited: contrast is then too high by 255
        / 219, and dark and bright details are clipped.
        """
        with closing(topic):  # it reopens its video when needed
            first = topic.read([0], format="rgb")[0]
        ours = first[self._rows, self._columns].astype(np.int16)
        mistaken = ((ours - 16) * (255 / 219)).clip(0, 255)
        theirs = self.read([0])[0].cpu().numpy()
        if np.abs(theirs - mistaken).mean() < np.abs(theirs - ours).mean():
            raise OptionError(
                f"topic {topic.topic}: torchcodec decodes its full-range video as limited-range, "
                "so the contrast would be wrong. Use backend='mp4ds', or a dataset packed with "
                "`codec` h264."
            )

    def _refused(self, error: Exception) -> VideoError:
        reason = " ".join(str(error).split()[:40])
        return VideoError("decode-failed", self._path, f"torchcodec cannot decode it: {reason}")

    def read(self, frames: Sequence[int]) -> Tensor:
        """Frames in the requested order, with repetitions; shape (N, H, W, 3), uint8.

        Raises:
            VideoError: One cannot be decoded.
        """
        try:
            pixels: Tensor = self._decoder.get_frames_at(
                torch.tensor(frames, dtype=torch.int64)
            ).data
        except (RuntimeError, IndexError, ValueError) as error:
            raise self._refused(error) from None
        return pixels[:, self._rows, self._columns]


def _check_layout(stream: Stream) -> None:
    """Refuse pictures that are not the images, or that have more than 8 bits.

    In lossy videos, 10-bit pictures hold 8-bit images.
    """
    image, video = stream.sidecar.image, stream.sidecar.video
    is_8_bits = video.pixel_format in (None, TEN_BITS) or not video.pixel_format.endswith("le")
    if not LAYOUTS[video.layout].is_shown or not is_8_bits:
        raise OptionError(
            f"topic {stream.topic}: {image.encoding} images are stored in the layout "
            f"{video.layout}, which torchcodec cannot convert to colour. Use backend='mp4ds'."
        )
