"""How frames become tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from torch import Tensor

from mp4ds.errors import OptionError

Resize = float | tuple[int, int]
Crop = tuple[int, int, int, int]
Dtype = Literal["native", "uint8", "float32"]
Backend = Literal["mp4ds", "torchcodec"]

_T = TypeVar("_T")
_FORMATS = ("native", "rgb", "bgr", "gray")
_DTYPES = ("native", "uint8", "float32")
_BACKENDS = ("mp4ds", "torchcodec")


@dataclass(frozen=True, slots=True)
class View:
    """What of a camera's frames is wanted.

    Attributes:
        format: ``native``, ``rgb``, ``bgr`` or ``gray``.
        resize: Factor, or width and height, pixels.
        crop: x, y, width, height before that, pixels.
    """

    format: str = "rgb"
    resize: Resize | None = None
    crop: Crop | None = None


@dataclass(frozen=True, slots=True)
class Pictures:
    """How the frames of all cameras become tensors.

    Attributes:
        views: What of each camera, in the order of the topics.
        dtype: ``native``, ``uint8`` or ``float32``.
        channels_first: (C, H, W) instead of (H, W, C).
        fast_colour: See `mp4ds.Dataset`.
        backend: Who decodes.
        device: Where the tensors are.
    """

    views: tuple[View, ...]
    dtype: str
    channels_first: bool
    fast_colour: bool
    backend: str
    device: str

    def tensor(self, pixels: Tensor, topic: str, format_name: str) -> Tensor:
        """The tensor of frames: a view where nothing is to be computed.

        Args:
            pixels: Shape (N, H, W) or (N, H, W, C).
            topic: For errors.
            format_name: What the pixels are.

        Returns:
            Shape (N, C, H, W), or (N, H, W, C).

        Raises:
            OptionError: They are no bytes, where ``uint8`` was asked for.
        """
        if pixels.ndim == 3:
            pixels = pixels.unsqueeze(-1)
        if self.dtype == "uint8" and pixels.dtype != torch.uint8:
            kind = str(pixels.dtype).removeprefix("torch.")
            raise OptionError(
                f"topic {topic}: has frames of {kind}, not uint8. Give dtype='native' to have "
                "them as they are, or dtype='float32'."
            )
        if self.dtype == "float32":
            pixels = _floats(pixels, scaled=format_name != "native")
        return pixels.permute(0, 3, 1, 2) if self.channels_first else pixels


def _floats(pixels: Tensor, *, scaled: bool) -> Tensor:
    if not scaled or pixels.dtype.is_floating_point:
        return pixels.to(torch.float32)
    return pixels.to(torch.float32).div_(torch.iinfo(pixels.dtype).max)


def pictures_from(
    topics: Sequence[str],
    *,
    format_: str | Mapping[str, str],
    resize: Resize | Mapping[str, Resize] | None,
    crop: Crop | Mapping[str, Crop] | None,
    dtype: str,
    channels_first: bool,
    fast_colour: bool,
    backend: str,
    device: str,
) -> Pictures:
    """The choices of a user.

    Raises:
        OptionError: One is unknown, or for a topic that is not there.
    """
    dtype = str(dtype).removeprefix("torch.")
    _one_of("dtype", dtype, _DTYPES)
    _one_of("backend", backend, _BACKENDS)
    formats = _each("format", format_, topics, "rgb")
    sizes = _each("resize", resize, topics, None)
    crops = _each("crop", crop, topics, None)
    for name in formats:
        _one_of("format", name, _FORMATS)
    views = tuple(map(View, formats, sizes, crops))
    if backend == "mp4ds" and device != "cpu":
        raise OptionError(f"device={device!r} needs backend='torchcodec'.")
    if backend == "torchcodec":
        for view in views:
            if view.format != "rgb" or view.resize is not None:
                raise OptionError(
                    "backend='torchcodec' gives format='rgb' without resize; use a transform."
                )
    return Pictures(views, dtype, channels_first, fast_colour, backend, device)


def _one_of(name: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise OptionError(f"{name} is {value!r}, and not one of {', '.join(known)}.")


def _each(name: str, given: _T | Mapping[str, _T], topics: Sequence[str], default: _T) -> list[_T]:
    """A value for each topic, of one for all or a mapping."""
    if not isinstance(given, Mapping):
        return [given] * len(topics)
    unknown = [topic for topic in given if topic not in topics]
    if unknown:
        raise OptionError(
            f"{name} is given for {unknown[0]!r}, which is not among the topics: "
            f"{', '.join(topics)}."
        )
    return [given.get(topic, default) for topic in topics]
