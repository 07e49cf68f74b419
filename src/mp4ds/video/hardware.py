"""Encoders that graphics cards and processors have: what they are given, and if they are there.

None of them has been tried on a real device by the project yet: what they are given follows
ffmpeg's and PyAV's sources, and the tests compare it with what the encoders declare.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import av
import av.logging
from av.codec.hwaccel import HWAccel
from av.error import FFmpegError

from mp4ds.errors import Mp4dsError

CHROMA_PLACE = "chroma_sample_location"
"""Option that tags where the chroma is; of these encoders, those of VAAPI go by it."""

_LAMBDA = 118  # FF_QP2LAMBDA, the unit of ffmpeg's -q:v
_USUAL_SIZE = (640, 480)  # which every device takes
_UPLOADS_SINCE = 18  # PyAV that brings pictures to a device on its own


class HardwareError(Mp4dsError):
    """An encoder of the hardware cannot be used here.

    Args:
        name: As ``--codec`` has it.
        problem: What was tried, and why it failed, without a full stop.
        remedy: What the user can do, without a full stop.
    """

    def __init__(self, name: str, problem: str, remedy: str = "") -> None:
        self.name = name
        found = HARDWARE[name]
        remedy = remedy or f"It needs {found.needs}"
        super().__init__(
            f"--codec {name}: {problem}. {remedy}; --codec {found.codec} needs no device."
        )


@dataclass(frozen=True, slots=True)
class HardwareEncoder:
    """An encoder of the hardware.

    Attributes:
        codec: What a reader needs.
        encoder: ffmpeg's name.
        needs: What it needs on the machine; a phrase.
        given: Options for every stream.
        scale: Its option for the quality.
        first: What a crf of 0 would be in that option.
        step: What a crf of one more adds to it.
        most: The largest crf; the smallest is 1, since 0 leaves the choice to most of them.
        presets: That it has.
        default_preset: One of them, or empty.
        device: Kind of device whose memory has to hold the pictures; empty: it takes them as
            they are.
    """

    codec: str
    encoder: str
    needs: str
    given: Mapping[str, str]
    scale: str
    most: int
    first: int = 0
    step: int = 1
    presets: tuple[str, ...] = ()
    default_preset: str = ""
    device: str = ""

    def options(self, crf: int) -> dict[str, str]:
        """The options for a quality."""
        return {**self.given, self.scale: str(self.first + crf * self.step)}


# all without B-frames, so that frames are coded in the order shown, and without a bit rate
_NVIDIA = "an NVIDIA graphics card that encodes {}, with its driver"
_NVENC = MappingProxyType({"rc": "vbr", "b": "0", "bf": "0", "no-scenecut": "1"})
_NVENC_PRESETS = tuple(f"p{number}" for number in range(1, 8))
_RENDERS = "a graphics processor that encodes {} by VAAPI, its driver, and access to /dev/dri"
_VAAPI = MappingProxyType({"rc_mode": "CQP", "bf": "0"})
_VAAPI_CENTRED = MappingProxyType({**_VAAPI, CHROMA_PLACE: "center"})
_APPLE = "a Mac with Apple silicon"
_TOOLBOX = MappingProxyType({"bf": "0", "flags": "+qscale+cgop"})
# its scale is from 1 to 100, and more is better: -q:v 100 - 2 * crf
_TOOLBOX_SCALE: Any = MappingProxyType(
    {"scale": "global_quality", "first": 100 * _LAMBDA, "step": -2 * _LAMBDA, "most": 49}
)


def _nvenc(codec: str, encoder: str, most: int, **given: str) -> HardwareEncoder:
    return HardwareEncoder(
        codec, encoder, _NVIDIA.format(codec), {**_NVENC, **given}, "cq", most,
        presets=_NVENC_PRESETS, default_preset="p4",
    )  # fmt: skip


HARDWARE: Mapping[str, HardwareEncoder] = MappingProxyType(
    {
        "h264-nvenc": _nvenc("h264", "h264_nvenc", 51, profile="high"),
        "h265-nvenc": _nvenc("h265", "hevc_nvenc", 51),
        "av1-nvenc": _nvenc("av1", "av1_nvenc", 63),
        "h264-vaapi": HardwareEncoder(
            "h264", "h264_vaapi", _RENDERS.format("h264"), _VAAPI_CENTRED, "qp", 51, device="vaapi"
        ),
        "h265-vaapi": HardwareEncoder(
            "h265", "hevc_vaapi", _RENDERS.format("h265"), _VAAPI_CENTRED, "qp", 51, device="vaapi"
        ),
        # 0 to 255, of which other AV1 encoders make 63 steps
        "av1-vaapi": HardwareEncoder(
            "av1", "av1_vaapi", _RENDERS.format("av1"), _VAAPI, "global_quality", 63,
            step=4, device="vaapi",
        ),
        "h264-videotoolbox": HardwareEncoder(
            "h264", "h264_videotoolbox", _APPLE, {**_TOOLBOX, "profile": "high"}, **_TOOLBOX_SCALE
        ),
        "h265-videotoolbox": HardwareEncoder(
            "h265", "hevc_videotoolbox", _APPLE, _TOOLBOX, **_TOOLBOX_SCALE
        ),
    }
)  # fmt: skip
"""Name of ``--codec`` -> encoder."""


def check_hardware(codec: str | None) -> None:
    """Open an encoder for a moment, if it is one of the hardware.

    Args:
        codec: As ``--codec`` has it.

    Raises:
        HardwareError: It cannot be used here; says why, and what to do.
    """
    if codec is not None and codec in HARDWARE:
        _open_once(codec, *_USUAL_SIZE)


def refuse_if_unusable(codec: str, width: int, height: int) -> None:
    """Tell a device that fails from one that does not take pictures of a size.

    To be called after an encoder of the hardware could not be opened.

    Args:
        codec: As ``--codec`` has it.
        width: Columns of the pictures.
        height: Rows of the pictures.

    Raises:
        HardwareError: It is the device.
    """
    check_hardware(codec)
    try:
        _open_once(codec, width, height)
    except HardwareError:
        return
    raise HardwareError(
        codec,
        "the device refused an encoder, and took one a moment later: there were too many at a time",
        "Give fewer --jobs",
    )


def device_for(codec: str) -> HWAccel | None:
    """The device that an encoder's pictures have to be on, for PyAV to bring them there.

    Args:
        codec: As ``--codec`` has it.
    """
    kind = HARDWARE[codec].device if codec in HARDWARE else ""
    return HWAccel(kind) if kind else None


def surface_format(codec: str) -> str:
    """The pixel format of pictures on an encoder's device; empty: it takes them as they are.

    Args:
        codec: As ``--codec`` has it.
    """
    return "nv12" if codec in HARDWARE and HARDWARE[codec].device else ""


def _open_once(codec: str, width: int, height: int) -> None:
    found = HARDWARE[codec]
    if found.encoder not in av.codecs_available:
        raise HardwareError(
            codec,
            f"PyAV {av.__version__} was built without {found.encoder}",
            f"It needs {found.needs}, and a PyAV whose ffmpeg has {found.encoder}",
        )
    if found.device and int(av.__version__.split(".")[0]) < _UPLOADS_SINCE:
        raise HardwareError(
            codec,
            f"PyAV {av.__version__} cannot bring pictures to {found.encoder}",
            f"Install PyAV {_UPLOADS_SINCE}, whose ffmpeg has to have it",
        )
    with _told() as lines:
        try:
            context: Any = av.CodecContext.create(found.encoder, "w", device_for(codec))
            context.width, context.height = width, height
            context.pix_fmt = surface_format(codec) or "yuv420p"
            context.time_base = Fraction(1, 30)
            context.options = found.options(min(20, found.most))
            context.open()
        except (FFmpegError, ValueError, NotImplementedError) as error:
            reason = error
        else:
            return
    why = "; ".join(dict.fromkeys(lines)) or getattr(reason, "strerror", None) or str(reason)
    raise HardwareError(codec, f"{found.encoder} could not be opened: {why}")


@contextmanager
def _told() -> Iterator[list[str]]:
    """What ffmpeg says of its errors in here, without full stops."""
    lines: list[str] = []
    level, skips = av.logging.get_level(), av.logging.get_skip_repeated()
    av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    try:
        with av.logging.Capture() as logs:
            yield lines
            lines += (message.strip().rstrip(".") for _, _, message in logs if message.strip())
    finally:
        av.logging.set_skip_repeated(skips)
        av.logging.set_level(level)
