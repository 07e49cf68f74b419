"""The options of an evaluation, and the resulting grid of settings."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass

from mp4ds.errors import OptionError
from mp4ds.options import Options, cluster, option, parse_words
from mp4ds.video.codecs import AV1, LOSSY_GOP, MAX_CRF, check_codec, codec_name
from mp4ds.video.scores import METRICS

ENCODER_NAMES = {"svtav1": "av1", "x264": "h264", "x265": "h265"}
"""Encoder names -> codec names of `mp4ds pack`."""

_DEFAULT_PRESETS = {
    **dict.fromkeys(AV1, ("6", "8")),
    "h264": ("medium",),
    "h265": ("medium",),
}
_MOST_CELLS = 10_000
_LEAST, _MOST = 0.001, 1_000_000  # of seconds, hours and hertz
_CRF = re.compile(r"(?P<first>[0-9]{1,4})(:(?P<last>[0-9]{1,4})(:(?P<step>[0-9]{1,4}))?)?")


@dataclass(frozen=True, slots=True)
class Setting:
    """How to encode a clip, in the terms of ``mp4ds pack``.

    Attributes:
        codec: ``av1``, ``av1-10bit``, ``h264`` or ``h265``.
        preset: Of its encoder.
        crf: Constant rate factor.
        gop: Most frames between key frames.
    """

    codec: str
    preset: str
    crf: int
    gop: int = LOSSY_GOP

    @property
    def name(self) -> str:
        """A short name, unique within a grid."""
        return f"{self.codec} {self.preset} crf {self.crf}"

    @property
    def pack_options(self) -> str:
        """The corresponding options of ``mp4ds pack``."""
        gop = f" --gop {self.gop}" if self.gop != LOSSY_GOP else ""
        return f"--quality crf={self.crf} --codec {self.codec} --preset {self.preset}{gop}"


@dataclass(frozen=True, slots=True)
class ScoreGoal:
    """The score that a setting has to reach.

    Attributes:
        metric: One of `mp4ds.video.scores.METRICS`.
        score: Required mean over the frames.
    """

    metric: str = "vmaf"
    score: float = 99.5


def _rates(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in parse_words(text))
    except ValueError:
        raise OptionError(f"`rates` {text!r} is not a list of numbers, such as 2,5,10.") from None


@dataclass(frozen=True)
class EvaluateOptions(Options):
    """How to evaluate."""

    codecs: Sequence[str] = option(
        "Comma-separated: svtav1, x264, x265, or codec names of `mp4ds pack`.",
        ("svtav1", "x264", "x265"),
        parse=parse_words,
        default_text="svtav1,x264,x265",
    )
    crf: Sequence[str] = option(
        "crf values to try, such as 16:25, 16:25:3 or 16,20,24.",
        ("16:25:3",),
        parse=parse_words,
        default_text="16:25:3",
    )
    presets: Sequence[str] = option(
        "Presets, such as 6,8,medium; each is tried with the codecs that have it.",
        (),
        parse=parse_words,
    )
    topics: Sequence[str] = option("Only matching cameras.", (), "-t", metavar="GLOB")
    exclude: Sequence[str] = option("Leave out matching cameras.", (), "-x", metavar="GLOB")
    start: float | None = option(
        "Where the clips start; default: in the middle.", metavar="SECONDS", least=0, most=_MOST
    )
    duration: float | None = option(
        "Length of the clips, instead of `frames`.", metavar="SECONDS", least=_LEAST, most=_MOST
    )
    frames: int = option("Frames per clip.", 150, least=1)
    fps: float = option("Frame rate of a folder of images.", 30.0, least=_LEAST, most=_MOST)
    target: str = option("Score to reach, such as vmaf=99.5, psnr_y=42 or ssim=0.98.", "vmaf=99.5")
    rates: Sequence[float] = option(
        "Also find the crf that reaches the target at these frame rates, such as 2,5,10,20,30,60.",
        (),
        metavar="HZ",
        parse=_rates,
    )
    streams: int | None = option("Number of cameras, to estimate the size of a dataset.", least=1)
    hours: float | None = option(
        "Hours of recording, to estimate the size of a dataset.", least=_LEAST, most=_MOST
    )
    gop: int = option("Maximum key frame interval in frames.", LOSSY_GOP, least=1, most=100_000)
    threads: int | None = option(
        "Threads per encoder; default: all cores, or one on a cluster.", least=1, most=1024
    )
    jobs: int = option(
        "Settings tried in parallel; use 1 for accurate times.", 1, "-j", least=1, most=1024
    )
    cluster: str | None = cluster()

    def __post_init__(self) -> None:
        super().__post_init__()
        for rate in self.rates:
            if not _LEAST <= rate <= _MOST:
                raise OptionError(f"`rates` {rate:g} is not from {_LEAST} to {_MOST}.")
        if self.cluster and self.jobs != 1:
            raise OptionError(
                "`jobs` is for this machine; a `cluster` decides how many run at once."
            )

    @property
    def encoder_threads(self) -> int:
        """Threads of an encoder."""
        if self.cluster:
            return self.threads or 1  # its workers have one core each
        return self.threads or max(1, (os.cpu_count() or 1) // self.jobs)

    @property
    def wanted(self) -> ScoreGoal:
        """The score to reach.

        Raises:
            OptionError: `target` is not valid.
        """
        return parse_target(self.target)


def settings_of(options: EvaluateOptions) -> list[Setting]:
    """The requested grid; a codec is not tried with a crf that it does not have.

    Raises:
        OptionError: There is no such codec, preset or crf, or too many of them.
    """
    codecs = list(dict.fromkeys(map(_codec, options.codecs)))
    if not codecs:
        raise OptionError("`codecs` is empty.")
    crfs = parse_crfs(options.crf)
    presets: dict[str, Sequence[str]] = {}
    for codec in codecs:
        own = [preset for preset in dict.fromkeys(options.presets) if _has(codec, preset)]
        presets[codec] = own or _DEFAULT_PRESETS[codec]
    for preset in options.presets:
        if not any(preset in own for own in presets.values()):
            raise OptionError(f"`presets` {preset!r} is not a preset of {', '.join(codecs)}.")
    settings = [
        Setting(codec, preset, crf, options.gop)
        for codec in codecs
        for preset in presets[codec]
        for crf in crfs
        if crf <= MAX_CRF[codec]
    ]
    if not 0 < len(settings) <= _MOST_CELLS:
        raise OptionError(
            f"{len(settings)} settings were asked for; give `codecs`, `presets` and `crf` "
            f"that make 1 to {_MOST_CELLS}."
        )
    return settings


def _codec(name: str) -> str:
    codec = codec_name(ENCODER_NAMES.get(name, name))
    if codec not in MAX_CRF:
        names = [f"{encoder} ({codec})" for encoder, codec in ENCODER_NAMES.items()]
        known = ", ".join([*names, AV1[1]])
        raise OptionError(f"`codecs` {name!r} is not one of {known}.")
    return codec


def _has(codec: str, preset: str) -> bool:
    try:
        check_codec(codec, preset, lossless=False)
    except OptionError:
        return False
    return True


def parse_crfs(texts: Sequence[str]) -> tuple[int, ...]:
    """The values of ``18``, ``16:25`` and ``16:25:3``.

    Raises:
        OptionError: One is not valid.
    """
    found: set[int] = set()
    for text in texts:
        match = _CRF.fullmatch(text.strip())
        step = int(match["step"] or 1) if match else 0
        if match is None or step == 0:
            raise OptionError(
                f"`crf` {text!r} is not valid. Use a value such as 18, 16:25 or 16:25:3."
            )
        first = int(match["first"])
        found.update(range(first, int(match["last"] or first) + 1, step))
    if not found or min(found) < 1 or max(found) > max(MAX_CRF.values()):
        raise OptionError(
            f"`crf` {', '.join(texts)} has values outside 1 to {max(MAX_CRF.values())}."
        )
    return tuple(sorted(found))


def parse_target(text: str) -> ScoreGoal:
    """The target of ``vmaf=99.5``, ``psnr_y=42`` or ``ssim=0.98``; a bare number means VMAF.

    Raises:
        OptionError: It is not valid.
    """
    metric, has_metric, score = text.rpartition("=")
    metric = metric if has_metric else "vmaf"
    try:
        value = float(score)
    except ValueError:
        value = -1.0
    if metric not in METRICS or not 0 < value <= 100:
        raise OptionError(
            f"`target` {text!r} is not valid. Use METRIC=SCORE, such as vmaf=99.5; metrics: "
            f"{', '.join(METRICS)}."
        )
    return ScoreGoal(metric, value)
