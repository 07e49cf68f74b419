"""The table of codecs: which encoder, pixel format and options make which stream.

Chosen by measurement; spec/registry.md, "Codecs", has the reasons, benchmarks/lossless.py
the figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from types import MappingProxyType
from typing import Any

from mp4ds.errors import OptionError
from mp4ds.video.depths import TEN_BITS
from mp4ds.video.hardware import CHROMA_PLACE, HARDWARE

# most frames between key frames, chosen by what they cost (spec/notes.md)
LOSSLESS_GOP, LOSSY_GOP = 30, 60
GOPS = {"archive": 120, "training": 10}

_X264 = MappingProxyType({"bf": "0"})  # without B-frames, frames are coded in the order shown
_X265 = "bframes=0:open-gop=0"  # an open GOP cannot be sought exactly
_QUIET = "log-level=error"


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a stream is encoded.

    Attributes:
        codec: Name in the registry: what a reader needs.
        encoder: ffmpeg's name of the encoder.
        pixel_format: Pixel format given to the encoder.
        lossless: Whether every sample returns as it was.
        options: Options of the encoder.
        matrix: Matrix coefficients to tag, by ffmpeg's name: bt709, gbr or smpte170m.
        full_range: Whether to tag the samples as using their full range.
        hardware: Its name among `HARDWARE`, or empty for an encoder that runs on processors.
    """

    codec: str
    encoder: str
    pixel_format: str
    lossless: bool
    options: Mapping[str, str] = field(default_factory=dict)
    matrix: str = "bt709"
    full_range: bool = True
    hardware: str = ""


@dataclass(frozen=True, slots=True)
class _Coding:
    encoder: str
    pixel_format: str
    options: Mapping[str, str]
    default_preset: str = ""
    tuning: str = ""  # further x264 parameters of the default preset
    tried: bool = True  # without being asked for
    codec: str = ""  # name in the registry, where that is another one


_SAME_HEADERS = "stitchable=1"  # parameter sets that do not depend on the crf
# the converter sites chroma in the middle; untagged, decoders take it for left
_CENTRED = "chromaloc=1"
_FFV1 = MappingProxyType({"level": "3", "slicecrc": "1", "slices": "4"})
_FFV1_8BIT = MappingProxyType({**_FFV1, "coder": "range_tab", "context": "1"})
_YUV = ("yuv420p", "yuv422p", "yuv444p")


# as small as x264's default preset without loss, at half its time (benchmarks/RESULTS.md)
_TUNING = "ref=3:mixed-refs=1:subme=5:me=dia:weightp=0:scenecut=0"


def _x264_lossless(pixel_format: str) -> _Coding:
    return _Coding("libx264", pixel_format, {**_X264, "qp": "0"}, "veryfast", _TUNING)


def _x264_rgb(pixel_format: str) -> _Coding:
    tuning = f"{_TUNING}:8x8dct=0:partitions=p8x8"
    return _Coding("libx264rgb", pixel_format, {**_X264, "qp": "0"}, "veryfast", tuning)


def _x265_lossless(pixel_format: str) -> _Coding:
    # what it takes for another scene in noise differs by version: key frames without need
    options = {"x265-params": f"{_X265}:scenecut=0:lossless=1:{_QUIET}"}
    # several times slower than the others, and hardly ever smaller than they with folded bits
    return _Coding("libx265", pixel_format, options, "veryfast", tried=False)


# picture format -> codec -> coding; the first is the default
_LOSSLESS: dict[str, dict[str, _Coding]] = {
    "gray": {"h264": _x264_lossless("gray"), "ffv1": _Coding("ffv1", "gray", _FFV1_8BIT)},
    "gray10le": {
        "h264": _x264_lossless("gray10le"),
        "ffv1": _Coding("ffv1", "gray10le", _FFV1),
        "h265": _x265_lossless("gray10le"),
    },
    "gray12le": {
        "ffv1": _Coding("ffv1", "gray12le", _FFV1),
        "h265": _x265_lossless("gray12le"),
    },
    "gray14le": {"ffv1": _Coding("ffv1", "gray14le", _FFV1)},
    "gray16le": {"ffv1": _Coding("ffv1", "gray16le", _FFV1)},
    **{
        packed: {
            "ffv1": _Coding("ffv1", "bgr0", _FFV1_8BIT),
            "h264": _x264_rgb(packed),
        }
        for packed in ("rgb24", "bgr24")
    },
    **{packed: {"ffv1": _Coding("ffv1", "bgra", _FFV1_8BIT)} for packed in ("rgba", "bgra")},
    **{
        planar: {"ffv1": _Coding("ffv1", planar, _FFV1)}
        for bits in (10, 12, 14, 16)
        for planar in (f"gbrp{bits}le", f"gbrap{bits}le")
    },
    **{
        planar: {"h264": _x264_lossless(planar), "ffv1": _Coding("ffv1", planar, _FFV1_8BIT)}
        for planar in _YUV
    },
}
_SMALL = "hierarchical-levels=3:enable-qm=1:qm-min=8:ac-bias=1.0"
_LOSSY: dict[str, _Coding] = {
    "av1": _Coding("libsvtav1", "yuv420p", {}, "6"),
    # a sixth fewer bits for 1.3 times the time (benchmarks/RESULTS.md)
    "av1-10bit": _Coding("libsvtav1", TEN_BITS, {"svtav1-params": _SMALL}, "6", codec="av1"),
    "h264": _Coding("libx264", "yuv420p", {**_X264, "x264-params": _CENTRED}, "medium"),
    "h265": _Coding(
        "libx265", "yuv420p", {"x265-params": f"{_X265}:{_CENTRED}:{_QUIET}"}, "medium"
    ),
}
_DEFAULT_LOSSY = "av1"

AV1 = ("av1", "av1-10bit")
"""The names of SVT-AV1's two forms."""

MAX_CRF = {
    "av1": 63,
    "av1-10bit": 63,
    "h264": 51,
    "h265": 51,
    **{name: found.most for name, found in HARDWARE.items()},
}
"""The largest crf of each lossy codec, and of each encoder of the hardware."""

# with 1, SVT-AV1's presets from 11 on were seen to make frames that do not look like the pictures,
# and videos that do not decode
_AV1_FAST = 11
LEAST_CRF = {"av1": 2, "h264": 1, "h265": 1}
"""The smallest crf that is chosen for each lossy codec without being asked for."""

_X26X_PRESETS = (
    *("ultrafast", "superfast", "veryfast", "faster", "fast"),
    *("medium", "slow", "slower", "veryslow"),
)
_AV1_PRESETS = [str(number) for number in range(14)]
_PRESETS: dict[str, Sequence[str]] = {
    "h264": _X26X_PRESETS,
    "h265": _X26X_PRESETS,
    "av1": _AV1_PRESETS,
    "av1-10bit": _AV1_PRESETS,
    "ffv1": (),
    **{name: found.presets for name, found in HARDWARE.items()},
}


def lossless_codecs(pixel_format: str) -> Sequence[str]:
    """The codecs that hold pictures of a format exactly, the default first."""
    return tuple(_LOSSLESS[pixel_format])


def codecs_to_try(pixel_format: str) -> Sequence[str]:
    """Those of `lossless_codecs` that are worth their time."""
    return tuple(name for name, coding in _LOSSLESS[pixel_format].items() if coding.tried)


def check_codec(
    codec: str | None,
    preset: str | None,
    *,
    lossless: bool,
    crf: int | None = None,
    varied: bool = False,
) -> None:
    """Refuse a codec that could make no stream of a profile, or what it does not have.

    Args:
        codec: As ``--codec`` has it, or None for the default.
        preset: The encoder's preset, or None for the default.
        lossless: Whether every sample must return as it was.
        crf: Constant rate factor, where there is one.
        varied: Whether videos with several crf are to be joined to one.

    Raises:
        OptionError: Names those that can.
    """
    software = {name for codings in _LOSSLESS.values() for name in codings} if lossless else _LOSSY
    able = software if lossless else {*software, *HARDWARE}
    if varied and codec is not None and codec in HARDWARE:
        raise OptionError(
            f"--codec {codec} goes with --quality visual or crf=N. A score is kept by joining "
            "pieces of several crf to one video, which the headers that hardware encoders write "
            f"are not known to allow: use --codec {HARDWARE[codec].codec}, or find the crf by "
            "mp4ds evaluate."
        )
    if codec is not None and codec not in able:
        kind = "lossless" if lossless else "lossy"
        raise OptionError(
            f"--codec {codec!r} is not one for {kind} packing. Use {', '.join(sorted(able))}."
        )
    name = codec or (lossless_codecs("gray")[0] if lossless else _DEFAULT_LOSSY)
    if preset is not None and preset not in _PRESETS[name]:
        known = ", ".join(_PRESETS[name])
        raise OptionError(
            f"--preset {preset!r} is not one of {name}. "
            + (f"Use one of {known}." if known else "It has no presets.")
        )
    if crf is not None:
        _check_crf(name, preset, crf)


def _check_crf(codec: str, preset: str | None, crf: int) -> None:
    least = 1 if codec in HARDWARE else 0
    if codec in AV1:  # ffmpeg takes 0 for none
        is_fast = preset is not None and int(preset) >= _AV1_FAST
        least = LEAST_CRF["av1"] if is_fast else 1
    if not least <= crf <= MAX_CRF[codec]:
        of = f"{codec} with preset {preset}" if preset else codec
        raise OptionError(
            f"--quality crf={crf} is not one of {of}. Use {least} to {MAX_CRF[codec]}."
        )


def recipe_for(
    pixel_format: str,
    *,
    lossless: bool,
    codec: str | None = None,
    crf: int | None = None,
    preset: str | None = None,
    varied: bool = False,
) -> Recipe:
    """The recipe for pictures of a pixel format.

    Args:
        pixel_format: Of the pictures, as a layout gives them.
        lossless: Whether every sample must return as it was.
        codec: ``h264``, ``h265``, ``av1``, ``av1-10bit``, ``ffv1``, a name among `HARDWARE`, or
            None for the default.
        crf: Constant rate factor of a lossy recipe.
        preset: The encoder's preset, or None for the default; encoders without ignore it.
        varied: Whether videos with several crf are to be joined to one.

    Raises:
        OptionError: The codec is unknown or cannot do it; names those that can.
    """
    if lossless:
        codings = _LOSSLESS[pixel_format]
        name = codec or next(iter(codings))
        coding = codings.get(name)
        if coding is None:
            raise OptionError(
                f"codec {name} has no lossless form for {pixel_format} pictures; "
                f"use one of {', '.join(sorted(codings))}"
            )
        options = dict(coding.options)
    else:
        name = codec or _DEFAULT_LOSSY
        coding, options = _lossy(name, crf)
        if pixel_format in _YUV:
            options = _sited_left(options)
        if varied and name == "h264":
            parameters = options.get("x264-params")
            options["x264-params"] = ":".join(filter(None, (parameters, _SAME_HEADERS)))
    if coding.default_preset:
        options["preset"] = preset or coding.default_preset
    if coding.tuning and preset is None:
        options["x264-params"] = coding.tuning
    is_yuv = pixel_format in _YUV
    is_rgb = coding.pixel_format.startswith(("rgb", "bgr", "gbr"))
    return Recipe(
        coding.codec or name,
        coding.encoder,
        coding.pixel_format,
        lossless,
        options=options,
        # a camera's own YUV is kept, and tagged as what ROS and OpenCV take it for
        matrix="smpte170m" if is_yuv else "gbr" if is_rgb else "bt709",
        full_range=not is_yuv,
        hardware=name if name in HARDWARE else "",
    )


def remade(pixel_format: str, values: Mapping[str, Any]) -> Recipe:
    """The recipe that a file tells, made again: an encoder's options may write files, too.

    Args:
        pixel_format: Of the pictures.
        values: The fields of a `Recipe`.

    Raises:
        ValueError: This version makes none that is the same.
    """
    lossless = bool(values["lossless"])
    preset, crf = (values["options"].get(name) for name in ("preset", "crf"))
    for name in _LOSSLESS[pixel_format] if lossless else (*_LOSSY, *HARDWARE):
        known = preset if preset in _PRESETS[name] else None
        if name in HARDWARE:
            crfs: Iterable[int | None] = range(1, MAX_CRF[name] + 1)
        else:
            crfs = [None if crf is None else int(crf)]
        for choice in product(crfs, {known, None}, (False, True)):
            recipe = recipe_for(
                pixel_format,
                lossless=lossless,
                codec=name,
                crf=choice[0],
                preset=choice[1],
                varied=choice[2],
            )
            if asdict(recipe) == values:
                return recipe
    raise ValueError(f"{values['encoder']!r} is not used with such options")


def _lossy(name: str, crf: int | None) -> tuple[_Coding, dict[str, str]]:
    """How pictures are coded with a crf, and all options but the preset."""
    if name in HARDWARE:
        device = HARDWARE[name]
        options = device.options(crf or 1)
        preset, codec = device.default_preset, device.codec
        return _Coding(device.encoder, "yuv420p", options, preset, codec=codec), options
    if name not in _LOSSY:
        known = ", ".join((*_LOSSY, *HARDWARE))
        raise OptionError(f"codec {name} is lossless only; use one of {known}")
    return _LOSSY[name], {**_LOSSY[name].options, "crf": str(crf)}


def _sited_left(options: Mapping[str, str]) -> dict[str, str]:
    """Options that leave the chroma where cameras and decoders take it to be."""
    parts = {
        key: ":".join(part for part in value.split(":") if part != _CENTRED)
        for key, value in options.items()
        if key != CHROMA_PLACE
    }
    return {key: value for key, value in parts.items() if value}
