"""The table of codecs, and the encoder, pixel format and options for each kind of stream.

To add a codec, add an entry to `CODECS`, and to the tables of encodings below if it is encoded.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import av

from mp4ds.errors import Mp4dsError, OptionError, Refused
from mp4ds.video.av1 import Av1
from mp4ds.video.coded import Ffv1, Jpeg, StreamParser
from mp4ds.video.h264 import H264
from mp4ds.video.h265 import H265

AV_VERSION = tuple(map(int, re.findall(r"\d+", av.__version__)[:2]))
"""Of PyAV: major and minor."""

WRITING = (17, 1)
"""The oldest PyAV that writes videos: 17.0 damages joined ones, older ones take no JPEG packets."""

TEN_BITS = "yuv420p10le"
"""The pixel format of 4:2:0 with 10 bits."""


@dataclass(frozen=True, slots=True)
class Codec:
    """Properties of a codec in the registry, whatever the encoder.

    Attributes:
        ffmpeg: Its name in ffmpeg.
        parser: Of its packets.
        entries: Four letters of the sample entries of an mp4 whose packets the parser knows.
        names: In messages: of the codec, or of an encoder that makes it; none: no message has it.
        is_free: Whether a frame may be independent of the one before it, which is worth recording.
        is_split: Whether a packet may hold several coded frames.
    """

    ffmpeg: str
    parser: type[StreamParser]
    entries: tuple[str, ...]
    names: tuple[str, ...] = ()
    is_free: bool = False
    is_split: bool = False


CODECS: Mapping[str, Codec] = {
    "h264": Codec(
        "h264", H264, ("avc1", "avc3"), ("h264", "avc", "libx264", "libopenh264"), is_free=True
    ),
    "h265": Codec("hevc", H265, ("hvc1", "hev1"), ("h265", "hevc", "libx265"), is_free=True),
    "av1": Codec(
        "av1", Av1, ("av01",), ("av1", "libsvtav1", "libaom-av1", "librav1e"),
        is_free=True, is_split=True,
    ),
    "vp9": Codec("vp9", StreamParser, ()),  # of datasets of version 1: it is not parsed
    "ffv1": Codec("ffv1", Ffv1, ("FFV1",)),
    "png": Codec("png", StreamParser, ("mp4v", "png ")),
    "mjpeg": Codec("mjpeg", Jpeg, ("mp4v", "jpeg"), ("mjpeg", "jpeg", "jpg")),
}  # fmt: skip
"""By the name in the registry."""

COPIED_CODECS = tuple(name for name, codec in CODECS.items() if codec.names)
"""Codecs whose packets are stored in a video track as they are."""

PACKET_CODECS = (*COPIED_CODECS, "vp9")
"""Those that a track may have as recorded."""


def packet_codec(message_format: str) -> str:
    """The codec of the packets of a message.

    Args:
        message_format: `format` of Foxglove's CompressedVideo, or `encoding` of an
            FFMPEGPacket, whose first part names the codec or its encoder
            (``libx264``, ``hevc_nvenc``, ``h264;yuv420p;bgr8;bgr8``).

    Raises:
        Refused: No video here has that codec.
    """
    name = message_format.partition(";")[0].strip().lower()
    for codec, found in CODECS.items():
        # hardware encoders are called h264_nvenc, hevc_vaapi ...
        if name in found.names or name.partition("_")[0] in found.names:
            return codec
    raise Refused(f"its codec {message_format[:40]!r} is not one that becomes a video")


# ---------------------------------------------------------------- encoders

# maximum distance of key frames, chosen by cost (spec/notes.md)
LOSSLESS_GOP, LOSSY_GOP, DIFFERENCES_GOP = 10, 30, 3
ARCHIVE_GOP, LOSSY_TRAINING_GOP, VIEW_TRAINING_GOP = 120, 2, 15
PURPOSE_PRESET = "4"
"""Preset of SVT-AV1 when the purpose of a dataset is known."""
TRAINING_CRF, TRAINING_PRESET = 33, "6"
"""Of SVT-AV1 for lossy videos with key frames so close, all of which it codes as the crf says."""

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
        lossless: Whether every sample is restored exactly.
        options: Options of the encoder.
        matrix: Matrix coefficients to tag, by ffmpeg's name: bt709, gbr or smpte170m.
        full_range: Whether to tag the samples as using their full range.
    """

    codec: str
    encoder: str
    pixel_format: str
    lossless: bool
    options: Mapping[str, str] = field(default_factory=dict)
    matrix: str = "bt709"
    full_range: bool = True


@dataclass(frozen=True, slots=True)
class _Coding:
    encoder: str
    pixel_format: str
    options: Mapping[str, str]
    default_preset: str = ""
    tuning: str = ""  # further x264 parameters of the default preset
    tried: bool = True  # without being asked for
    codec: str = ""  # name in the registry, where that is another one
    presets: tuple[str, ...] = ()  # of a lossy encoder
    most: int = 51  # its largest crf
    least: int = 1  # the smallest crf chosen automatically


_X26X_PRESETS = (
    *("ultrafast", "superfast", "veryfast", "faster", "fast"),
    *("medium", "slow", "slower", "veryslow"),
)
_AV1_PRESETS = tuple(str(number) for number in range(14))
_SAME_HEADERS = "stitchable=1"  # parameter sets that do not depend on the crf
# the converter sites chroma in the middle; untagged, decoders take it for left
_CENTRED = "chromaloc=1"
_FFV1 = MappingProxyType({"level": "3", "slicecrc": "1", "slices": "4"})
_FFV1_8BIT = MappingProxyType({**_FFV1, "coder": "range_tab", "context": "1"})
_YUV = ("yuv420p", "yuv422p", "yuv444p")


# as small as x264's default preset without loss, at half its time (spec/notes.md)
_TUNING = "ref=3:mixed-refs=1:subme=5:me=dia:weightp=0:scenecut=0"
# of differences to a view: within 0.5 % of that, at 0.6 of its time; intra blocks of 8x8 are free
_OF_NOISE = {"preset": "ultrafast", "x264-params": "cabac=1:8x8dct=1:partitions=i8x8"}


def _x264_lossless(pixel_format: str, encoder: str = "libx264", tuning: str = _TUNING) -> _Coding:
    return _Coding(encoder, pixel_format, {**_X264, "qp": "0"}, "veryfast", tuning)


def _ffv1_8bit(pixel_format: str) -> _Coding:
    return _Coding("ffv1", pixel_format, _FFV1_8BIT)


def _x265_lossless(pixel_format: str) -> _Coding:
    # what it takes for another scene in noise differs by version: key frames without need
    options = {"x265-params": f"{_X265}:scenecut=0:lossless=1:{_QUIET}"}
    # several times slower than the others, and hardly ever smaller than they with folded bits
    return _Coding("libx265", pixel_format, options, "veryfast", tried=False)


# picture format -> codec -> coding; the first is the default
_LOSSLESS: dict[str, dict[str, _Coding]] = {
    "gray": {
        "h264": _x264_lossless("gray"),
        "ffv1": _ffv1_8bit("gray"),
        "png": _Coding("png", "gray", {}, tried=False),
    },
    "gray10le": {
        "h264": _x264_lossless("gray10le"),
        "ffv1": _Coding("ffv1", "gray10le", _FFV1),
        "h265": _x265_lossless("gray10le"),
    },
    "gray12le": {"ffv1": _Coding("ffv1", "gray12le", _FFV1), "h265": _x265_lossless("gray12le")},
    "gray14le": {"ffv1": _Coding("ffv1", "gray14le", _FFV1)},
    "gray16le": {"ffv1": _Coding("ffv1", "gray16le", _FFV1)},
    **{
        packed: {
            "ffv1": _ffv1_8bit("bgr0"),
            "h264": _x264_lossless(packed, "libx264rgb", f"{_TUNING}:8x8dct=0:partitions=p8x8"),
        }
        for packed in ("rgb24", "bgr24")
    },
    **{packed: {"ffv1": _ffv1_8bit("bgra")} for packed in ("rgba", "bgra")},
    **{
        planar: {"ffv1": _Coding("ffv1", planar, _FFV1)}
        for bits in (10, 12, 14, 16)
        for planar in (f"gbrp{bits}le", f"gbrap{bits}le")
    },
    **{planar: {"h264": _x264_lossless(planar), "ffv1": _ffv1_8bit(planar)} for planar in _YUV},
}
# with a crf of 1, SVT-AV1's presets from 11 on were seen to make frames that do not look like the
# pictures, and videos that cannot be decoded
_AV1_FAST = 11
_SMALL = "hierarchical-levels=3:enable-qm=1:qm-min=8:ac-bias=1.0"
_LOSSY: Mapping[str, _Coding] = {
    "av1": _Coding("libsvtav1", "yuv420p", {}, "6", presets=_AV1_PRESETS, most=63, least=2),
    # a sixth fewer bits for 1.3 times the time (spec/notes.md)
    "av1-10bit": _Coding(
        "libsvtav1", TEN_BITS, {"svtav1-params": _SMALL}, "6", codec="av1",
        presets=_AV1_PRESETS, most=63, least=2,
    ),
    "h264": _Coding(
        "libx264", "yuv420p", {**_X264, "x264-params": _CENTRED}, "medium", presets=_X26X_PRESETS
    ),
    "h265": _Coding(
        "libx265", "yuv420p", {"x265-params": f"{_X265}:{_CENTRED}:{_QUIET}"}, "medium",
        presets=_X26X_PRESETS,
    ),
}  # fmt: skip
"""By what ``--codec`` names."""

DEFAULT_LOSSY = "av1"
"""The lossy codec if none is asked for."""

_PRESETS: Mapping[str, Sequence[str]] = {
    "ffv1": (),
    "png": (),
    **{name: found.presets for name, found in _LOSSY.items()},
}

AV1 = ("av1", "av1-10bit")
"""The names of SVT-AV1's two forms."""

MAX_CRF = {name: found.most for name, found in _LOSSY.items()}
"""The largest crf of each lossy codec."""

LEAST_CRF = {found.codec or name: found.least for name, found in _LOSSY.items()}
"""The smallest crf chosen automatically for each codec."""


def lossless_codecs(pixel_format: str) -> Sequence[str]:
    """The codecs that hold pictures of a format exactly, the default first."""
    return tuple(_LOSSLESS[pixel_format])


def codecs_to_try(pixel_format: str, is_noise: bool = False) -> Sequence[str]:
    """Those of `lossless_codecs` that are worth trying.

    Args:
        pixel_format: Of the pictures.
        is_noise: As for `recipe_for`; of grey noise, FFV1 is never the smallest.
    """
    left_out = "ffv1" if is_noise and pixel_format == "gray" else ""
    tried = (name for name, coding in _LOSSLESS[pixel_format].items() if coding.tried)
    return tuple(name for name in tried if name != left_out)


def codec_name(name: str) -> str:
    """A codec as the registry names it: H.265 is also called HEVC."""
    return f"h265{name[4:]}" if name.startswith("hevc") else name


def fastest_preset(codec: str) -> str | None:
    """The preset of an encoder that takes the least time; None for one without presets."""
    name = codec_name(codec)
    return str(_AV1_FAST) if name in AV1 else next(iter(_PRESETS.get(name, ())), None)


def check_pyav() -> None:
    """Refuse to write videos with a PyAV that is only good for reading.

    Raises:
        Mp4dsError: It is older than `WRITING`.
    """
    if AV_VERSION < WRITING:
        least = ".".join(map(str, WRITING))
        raise Mp4dsError(
            f"PyAV {av.__version__} is installed, which is enough to read datasets. To write "
            f"videos, mp4ds needs {least} or newer: run pip install 'av>={least}', in an "
            "environment of its own if this one has a package that does not allow it, as LeRobot."
        )


def check_codec(
    codec: str | None,
    preset: str | None,
    *,
    lossless: bool,
    crf: int | None = None,
    fast: bool = False,
) -> str | None:
    """Refuse a codec that cannot encode any stream of a profile, or options it does not have.

    Args:
        codec: As given to ``--codec``, or None for the default.
        preset: The encoder's preset, or None for the default.
        lossless: Whether every sample must be restored exactly.
        crf: Constant rate factor, where there is one.
        fast: Whether the preset is the fastest by default.

    Returns:
        The codec by its `codec_name`.

    Raises:
        OptionError: Names those that can.
        Mp4dsError: As for `check_pyav`.
    """
    check_pyav()
    codec = codec and codec_name(codec)
    able = {name for codings in _LOSSLESS.values() for name in codings} if lossless else _LOSSY
    if codec is not None and codec not in able:
        problem = f"does not support {'lossless' if lossless else 'lossy'} packing"
        if codec not in _PRESETS:
            problem = "is not one that mp4ds can encode"
        raise OptionError(f"`codec` {codec!r} {problem}. Use {', '.join(sorted(able))}.")
    name = codec or (lossless_codecs("gray")[0] if lossless else DEFAULT_LOSSY)
    if preset is not None and preset not in _PRESETS[name]:
        known = ", ".join(_PRESETS[name])
        remedy = f"Use one of {known}." if known else "It has no presets."
        raise OptionError(f"`preset` {preset!r} is not one of {name}. {remedy}")
    if crf is not None:
        preset = preset or (fastest_preset(name) if fast else None)
        least = 1 if name in AV1 else 0  # ffmpeg takes 0 of SVT-AV1 for none
        if name in AV1 and preset is not None and int(preset) >= _AV1_FAST:
            least = LEAST_CRF["av1"]
        if not least <= crf <= MAX_CRF[name]:
            of = f"{name} with preset {preset}" if preset else name
            raise OptionError(
                f"`quality` crf={crf} is out of range for {of}. Use {least} to {MAX_CRF[name]}."
            )
    return codec


def recipe_for(
    pixel_format: str,
    *,
    lossless: bool,
    codec: str | None = None,
    crf: int | None = None,
    preset: str | None = None,
    varied: bool = False,
    is_noise: bool = False,
) -> Recipe:
    """The recipe for pictures of a pixel format.

    Args:
        pixel_format: Of the pictures, as a layout gives them.
        lossless: Whether every sample must be restored exactly.
        codec: ``h264``, ``h265``, ``av1``, ``av1-10bit``, ``ffv1``, or None for the
            default.
        crf: Constant rate factor of a lossy recipe.
        preset: The encoder's preset, or None for the default; encoders without ignore it.
        varied: Whether videos with several crf will be joined into one.
        is_noise: Whether lossless pictures are the differences of images to those of a view.

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
        name = codec or DEFAULT_LOSSY
        if name not in _LOSSY:
            known = ", ".join(_LOSSY)
            raise OptionError(f"codec {name} is lossless only; use one of {known}")
        coding = _LOSSY[name]
        options = {**coding.options, "crf": str(crf)}
        if pixel_format in _YUV:
            options = _sited_left(options)
        if varied and name == "h264":
            parameters = options.get("x264-params")
            options["x264-params"] = ":".join(filter(None, (parameters, _SAME_HEADERS)))
    if coding.default_preset:
        options["preset"] = preset or coding.default_preset
    if coding.tuning and preset is None:
        options |= _OF_NOISE if is_noise else {"x264-params": coding.tuning}
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
    )


def _sited_left(options: Mapping[str, str]) -> dict[str, str]:
    """Options that keep the chroma location that cameras and decoders assume."""
    parts = {
        key: ":".join(part for part in value.split(":") if part != _CENTRED)
        for key, value in options.items()
    }
    return {key: value for key, value in parts.items() if value}


# ---------------------------------------------------------------- what is asked of them

LOSSLESS = "lossless"
"""The quality at which nothing is lost."""

VISUAL = "visual"
"""The quality at which nothing is seen to be lost, and that of views."""

MAX_GOP = 100_000
"""Maximum key frame interval that may be asked for, frames."""

VISUAL_TABLE: tuple[tuple[float, int, int], ...] = (
    (2.0, 18, 7),
    (5.0, 17, 7),
    (10.0, 17, 7),
    (20.0, 18, 7),
    (30.0, 18, 7),
    (60.0, 22, 6),
)
"""Frame rate in Hz, crf and preset of SVT-AV1 for VMAF 99.5: the paper's rates and crf."""

VIEW_CRF, VIEW_PRESET, BESIDE_PRESET = 22, "8", "9"
"""Of SVT-AV1 for views: what they lack costs about as much in the other video (spec/notes.md); the
last of those that predict nothing."""
VIEW_LEVELS = "hierarchical-levels=3"
"""Of AV1 views: groups of 8 frames fit between their key frames, and what is noisy gets smaller."""

_UNKNOWN_RATE = 30.0

TOLERANCES = {"vmaf": 0.5, "psnr": 0.5, "ssim": 0.005}
"""Metric of a target -> how far below it the mean of a single window may be."""

_BOUNDS = {"vmaf": 100.0, "psnr": 60.0, "ssim": 1.0}  # of PSNR, dB: identical planes have it


@dataclass(frozen=True, slots=True)
class QualityTarget:
    """The score that packed frames have to reach.

    Attributes:
        metric: ``vmaf`` (0 to 100), or of the luma ``psnr`` (dB) or ``ssim`` (0 to 1).
        score: Required mean over the frames.
    """

    metric: str
    score: float

    @property
    def tolerance(self) -> float:
        """How far below the score the mean of a single window may be."""
        return TOLERANCES[self.metric]

    def __str__(self) -> str:
        return f"{self.metric}={self.score:g}"


@dataclass(frozen=True, slots=True)
class QualitySetting:
    """What ``--quality`` asked for.

    Attributes:
        name: ``lossless``, ``visual``, ``crf`` or ``target``.
        crf: The constant rate factor, for ``crf`` only.
        target: The score to reach, for ``target`` only.
    """

    name: str
    crf: int | None = None
    target: QualityTarget | None = None

    @property
    def lossless(self) -> bool:
        """Whether every pixel must be restored exactly."""
        return self.name == LOSSLESS

    def __str__(self) -> str:
        if self.target is not None:
            return str(self.target)
        return self.name if self.crf is None else f"crf={self.crf}"


def parse_quality(value: str | QualitySetting) -> QualitySetting:
    """Parse ``lossless``, ``visual``, ``crf=N``, ``vmaf=SCORE``, ``psnr=DB`` or ``ssim=SCORE``.

    Raises:
        OptionError: Anything else.
    """
    if isinstance(value, QualitySetting):
        return value
    if value in (LOSSLESS, VISUAL):
        return QualitySetting(value)
    match = re.fullmatch(r"crf=([0-9]{1,2})", value)
    if match and int(match.group(1)) <= 63:
        return QualitySetting("crf", int(match.group(1)))
    match = re.fullmatch(r"(vmaf|psnr|ssim)=([0-9]{1,3}(?:\.[0-9]{1,4})?)", value)
    if match:
        target = QualityTarget(match.group(1), float(match.group(2)))
        if 0 < target.score < _BOUNDS[target.metric]:
            return QualitySetting("target", target=target)
    raise OptionError(
        f"{value!r} is not known. Use lossless, visual, crf=N with N from 0 to 63, or a score to "
        "reach: vmaf=99.5 (below 100), psnr=42 (dB, below 60) or ssim=0.98 (below 1)."
    )


TRAINING, ARCHIVE, SPEED = "training", "archive", "speed"
"""What a dataset may be for."""


def visual_setting(rate: float | None) -> tuple[int, int]:
    """The crf and preset of the table row nearest to a frame rate.

    Args:
        rate: Frames per second, or None if no index gives it; then 30 is assumed.
    """
    wanted = rate or _UNKNOWN_RATE
    _, crf, preset = min(VISUAL_TABLE, key=lambda row: abs(row[0] - wanted))
    return crf, preset
