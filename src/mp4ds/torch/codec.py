"""Decoding by torchcodec, on the CPU or a GPU; its colours are converted by itself."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from torch import Tensor

from mp4ds.dataset import Stream, Video
from mp4ds.errors import OptionError, VideoError
from mp4ds.layouts import LAYOUTS
from mp4ds.remote import remote
from mp4ds.torch.pictures import Crop


class TorchcodecReader:
    """Decodes a stream's video by ``torchcodec.decoders.VideoDecoder``.

    Args:
        stream: The stream.
        crop: x, y, width, height, pixels; None: all.
        device: Such as ``cpu`` or ``cuda``.

    Raises:
        OptionError: torchcodec is missing, or the video's pictures are not the images.
        VideoError: It cannot open the video.
    """

    def __init__(self, stream: Stream | Video, crop: Crop | None, device: str) -> None:
        self._path = stream.video_path
        if isinstance(stream, Stream):
            _check_layout(stream)
        if remote(self._path):
            raise OptionError(f"{self._path}: backend='torchcodec' reads local files alone.")
        columns, rows = stream.image_size
        x, y, width, height = crop or (0, 0, columns, rows)
        if not (0 <= x < x + width <= columns and 0 <= y < y + height <= rows):
            raise OptionError(f"topic {stream.topic}: crop {crop} is not within {columns}x{rows}.")
        self._rows, self._columns = slice(y, y + height), slice(x, x + width)
        self._decoder = self._opened(device)

    def _opened(self, device: str) -> Any:
        if find_spec("torchcodec") is None:
            raise OptionError(
                "backend='torchcodec' needs torchcodec. Install it with: pip install torchcodec"
            )
        try:
            module = import_module("torchcodec.decoders")
        except (ImportError, OSError, RuntimeError) as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise OptionError(f"torchcodec is installed but cannot be used: {reason}") from None
        try:
            # with exact seeking, frame n is the n-th shown, whatever its presentation time
            return module.VideoDecoder(
                str(self._path), dimension_order="NHWC", device=device, seek_mode="exact"
            )
        except (RuntimeError, ValueError) as error:
            raise self._refused(error) from None

    def _refused(self, error: Exception) -> VideoError:
        reason = " ".join(str(error).split()[:40])
        return VideoError("decode-failed", self._path, f"torchcodec cannot decode it: {reason}")

    def read(self, frames: list[int]) -> Tensor:
        """Frames in the order asked for, repeated as asked; shape (N, H, W, 3), uint8.

        Raises:
            VideoError: One does not decode.
        """
        try:
            pixels: Tensor = self._decoder.get_frames_at(frames).data
        except (RuntimeError, IndexError, ValueError) as error:
            raise self._refused(error) from None
        return pixels[:, self._rows, self._columns]

    def close(self) -> None:
        """Let the decoder go."""
        self._decoder = None


def _check_layout(stream: Stream) -> None:
    """Refuse pictures that are not the images, or that have more than 8 bits."""
    image, video = stream.sidecar.image, stream.sidecar.video
    is_8_bits = video.pixel_format is None or not video.pixel_format.endswith("le")
    if not LAYOUTS[video.layout].is_shown or not is_8_bits:
        raise OptionError(
            f"topic {stream.topic}: {image.encoding} images are stored in the layout "
            f"{video.layout}, which torchcodec does not turn into colours. Use backend='mp4ds'."
        )
