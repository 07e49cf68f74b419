"""The table of codecs: which encoder, pixel format and options make which stream.

Chosen by measurement; spec/registry.md, "Codecs", has the reasons, benchmarks/lossless.py
the figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from mp4ds.errors import OptionError

DEFAULT_GOP = 60

_X264 = MappingProxyType({"bf": "0"})  # without B-frames, frames are coded in the order shown


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a stream is encoded.

    Attributes:
        codec: Name in the registry.
        encoder: ffmpeg's name of the encoder.
        pixel_format: Pixel format given to the encoder.
        lossless: Whether every sample returns as it was.
        options: Options of the encoder.
    """

    codec: str
    encoder: str
    pixel_format: str
    lossless: bool
    options: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Coding:
    encoder: str
    pixel_format: str
    options: Mapping[str, str]
    default_preset: str = ""


# the converter sites chroma in the middle; untagged, decoders take it for left
_CENTRED = "chromaloc=1"
_FFV1 = MappingProxyType({"level": "3", "slicecrc": "1", "slices": "4"})
_FFV1_8BIT = MappingProxyType({**_FFV1, "coder": "range_tab", "context": "1"})

# (codec, pixel format of the picture) -> coding
_LOSSLESS: dict[tuple[str, str], _Coding] = {
    ("h264", "gray"): _Coding("libx264", "gray", {**_X264, "qp": "0"}, "veryfast"),
    ("h264", "rgb24"): _Coding("libx264rgb", "rgb24", {**_X264, "qp": "0"}, "veryfast"),
    ("h264", "bgr24"): _Coding("libx264rgb", "bgr24", {**_X264, "qp": "0"}, "veryfast"),
    ("ffv1", "gray"): _Coding("ffv1", "gray", _FFV1_8BIT),
    ("ffv1", "gray16le"): _Coding("ffv1", "gray16le", _FFV1),
    ("ffv1", "rgb24"): _Coding("ffv1", "bgr0", _FFV1_8BIT),
    ("ffv1", "bgr24"): _Coding("ffv1", "bgr0", _FFV1_8BIT),
}
_LOSSY: dict[str, _Coding] = {
    "av1": _Coding("libsvtav1", "yuv420p", {}, "6"),
    "h264": _Coding("libx264", "yuv420p", {**_X264, "x264-params": _CENTRED}, "medium"),
    "h265": _Coding(
        "libx265",
        "yuv420p",
        {"x265-params": f"bframes=0:open-gop=0:{_CENTRED}:log-level=error"},
        "medium",
    ),
}
_DEFAULT_LOSSLESS = {"gray": "h264", "rgb24": "ffv1", "bgr24": "ffv1", "gray16le": "ffv1"}
_DEFAULT_LOSSY = "av1"


_X26X_PRESETS = (
    *("ultrafast", "superfast", "veryfast", "faster", "fast"),
    *("medium", "slow", "slower", "veryslow"),
)
_PRESETS: dict[str, Sequence[str]] = {
    "h264": _X26X_PRESETS,
    "h265": _X26X_PRESETS,
    "av1": [str(number) for number in range(14)],
    "ffv1": (),
}


def check_codec(codec: str | None, preset: str | None, *, lossless: bool) -> None:
    """Refuse a codec that could make no stream of a profile, or a preset that it does not have.

    Raises:
        OptionError: Names those that can.
    """
    able = {name for name, _ in _LOSSLESS} if lossless else set(_LOSSY)
    if codec is not None and codec not in able:
        kind = "lossless" if lossless else "lossy"
        raise OptionError(
            f"--codec {codec!r} is not one for {kind} packing. Use {', '.join(sorted(able))}."
        )
    name = codec or (_DEFAULT_LOSSLESS["gray"] if lossless else _DEFAULT_LOSSY)
    if preset is not None and preset not in _PRESETS[name]:
        known = ", ".join(_PRESETS[name])
        raise OptionError(
            f"--preset {preset!r} is not one of {name}. "
            + (f"Use one of {known}." if known else "It has no presets.")
        )


def recipe_for(
    pixel_format: str,
    *,
    lossless: bool,
    codec: str | None = None,
    crf: int | None = None,
    preset: str | None = None,
) -> Recipe:
    """The recipe for pictures of a pixel format.

    Args:
        pixel_format: Of the pictures, as a layout gives them.
        lossless: Whether every sample must return as it was.
        codec: ``h264``, ``h265``, ``av1``, ``ffv1``, or None for the default.
        crf: Constant rate factor of a lossy recipe.
        preset: The encoder's preset, or None for the default.

    Raises:
        OptionError: The codec is unknown or cannot do it; names those that can.
    """
    if lossless:
        name = codec or _DEFAULT_LOSSLESS[pixel_format]
        coding = _LOSSLESS.get((name, pixel_format))
        if coding is None:
            able = sorted({c for c, p in _LOSSLESS if p == pixel_format})
            raise OptionError(
                f"codec {name} has no lossless form for {pixel_format} pictures; "
                f"use one of {', '.join(able)}"
            )
        options = dict(coding.options)
    else:
        name = codec or _DEFAULT_LOSSY
        found = _LOSSY.get(name)
        if found is None:
            raise OptionError(f"codec {name} is lossless only; use one of {', '.join(_LOSSY)}")
        coding = found
        options = {**coding.options, "crf": str(crf)}
    if coding.default_preset:
        options["preset"] = preset or coding.default_preset
    return Recipe(name, coding.encoder, coding.pixel_format, lossless, options=options)
