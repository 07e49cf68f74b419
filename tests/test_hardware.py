"""Encoders of graphics cards: what they are given, what is said where they are not there.

Where there is one it encodes; where there is none, a software encoder stands in for it, so that
all but the device itself is run.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.error import FFmpegError
from typer.testing import CliRunner

import mp4ds
from each import each
from in_parts import InlineEngine, leftovers
from mp4ds.cli import app_for
from mp4ds.errors import EncoderRefusedError, HardwareError, OptionError
from mp4ds.packing.options import PackOptions
from mp4ds.packing.pack import _checked
from mp4ds.plugins.evaluating.evaluate import evaluate
from mp4ds.plugins.evaluating.options import EvaluateOptions, Setting, first_guess, grid_of
from mp4ds.video import codecs, encoder
from mp4ds.video.codecs import HARDWARE, check_codec, recipe_for
from mp4ds.video.encoder import VideoEncoder, check_hardware, hardware_error
from mp4ds.video.packets import join_segments
from mp4ds.video.trial import encoder_bytes
from round_trips import unpacked
from scenes import scene
from sources import SOURCES
from stand_in import KNOWN, NAME
from test_video import TAGS, decode, encode, ffprobe, psnr, scene_pictures

TOPIC = "/cam/image_raw"
NVENC = [name for name in HARDWARE if name.endswith("nvenc")]


def why_not(name: str) -> str:
    """Why an encoder cannot be used here; empty where it can."""
    try:
        check_hardware(name)
    except HardwareError as error:
        return str(error)
    return ""


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> str:
    for module in (encoder, codecs):
        monkeypatch.setattr(module, "HARDWARE", KNOWN)
    return NAME


def recording(folder: Path) -> list[Path]:
    (folder / "source").mkdir()
    return SOURCES["mcap-ros2-none"](folder / "source", scene("rgb8", width=64, height=48))


# ---------------------------------------------------------------- what they are given


@each("picture_format", ["gray", "rgb24", "bgr24", "yuv420p"])
@each("name", HARDWARE)
def test_a_reader_sees_what_the_software_encoder_makes(name: str, picture_format: str) -> None:
    own = recipe_for(picture_format, lossless=False, codec=name, crf=20)
    other = recipe_for(picture_format, lossless=False, codec=name.split("-")[0], crf=20)
    for fact in ("codec", "pixel_format", "matrix", "full_range", "lossless"):
        assert getattr(own, fact) == getattr(other, fact)
    assert own.hardware == name
    assert own.encoder.replace("hevc", "h265").replace("_", "-") == name
    assert own.options["bf"] == "0"
    assert own.options.get("preset", "") == HARDWARE[name].default_preset
    centred = name in ("h264-vaapi", "h265-vaapi") and picture_format != "yuv420p"
    assert own.options.get("chroma_sample_location") == ("center" if centred else None)


@each("name", HARDWARE)
def test_a_larger_crf_is_less_quality(name: str) -> None:
    found = HARDWARE[name]
    values = [int(found.options(crf)[found.scale]) for crf in range(1, found.most + 1)]
    assert values == sorted(set(values), reverse="videotoolbox" in name)
    assert min(values) > 0  # nothing, or the encoder's own choice
    if "videotoolbox" in name:
        assert {value % 118 for value in values} == {0}
        assert (max(values) // 118, min(values) // 118) == (98, 2)
    else:
        assert max(values) == {"av1-vaapi": 252, "av1-nvenc": 63}.get(name, 51)


def test_what_is_refused() -> None:
    for name, found in HARDWARE.items():
        check_codec(name, None, lossless=False, crf=1)
        check_codec(name, None, lossless=False, crf=found.most)
        for crf in (0, found.most + 1):
            with pytest.raises(
                OptionError, match=rf"is out of range for {name}\. Use 1 to {found.most}"
            ):
                check_codec(name, None, lossless=False, crf=crf)
        with pytest.raises(OptionError, match=r"lossless packing\. Use ffv1, h264, h265"):
            check_codec(name, None, lossless=True)
        with pytest.raises(OptionError, match="works with `quality` visual or crf=N"):
            check_codec(name, None, lossless=False, varied=True)
    check_codec("h265-nvenc", "p7", lossless=False)
    with pytest.raises(OptionError, match="Use one of p1, p2, p3, p4, p5, p6, p7"):
        check_codec("h264-nvenc", "medium", lossless=False)
    with pytest.raises(OptionError, match="It has no presets"):
        check_codec("h264-vaapi", "p4", lossless=False)
    with pytest.raises(OptionError, match="h264-nvenc"):
        check_codec("h264_nvenc", None, lossless=False)


def ffmpeg_libraries() -> tuple[Any, Any]:
    """The libavcodec and libavutil that PyAV has loaded."""
    maps = Path("/proc/self/maps")
    if not maps.is_file():
        pytest.skip("reads /proc")
    av.CodecContext.create("libx264", "w")
    paths = {line.split()[-1] for line in maps.read_text().splitlines() if "/libav" in line}
    found = []
    for name in ("libavcodec", "libavutil"):
        named = [path for path in paths if Path(path).name.startswith(name)]
        # others may have loaded their own beside those of PyAV's wheel
        path = next((path for path in named if "av.libs" in path), named[0])
        found.append(ctypes.CDLL(path))
    return found[0], found[1]


@pytest.fixture(scope="module")
def declares() -> Callable[[str, dict[str, str]], list[str]]:
    """Says which of an encoder's options it does not declare, or not with such values."""
    codec, util = ffmpeg_libraries()
    codec.avcodec_find_encoder_by_name.restype = ctypes.c_void_p
    codec.avcodec_alloc_context3.restype = ctypes.c_void_p
    codec.avcodec_alloc_context3.argtypes = [ctypes.c_void_p]
    util.av_opt_set.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_int]
    with_those_of_the_encoder = 1  # AV_OPT_SEARCH_CHILDREN

    def wrong(encoder: str, options: dict[str, str]) -> list[str]:
        found = codec.avcodec_find_encoder_by_name(encoder.encode())
        context = codec.avcodec_alloc_context3(found)
        return [
            f"{key}={value}"
            for key, value in options.items()
            if util.av_opt_set(context, key.encode(), value.encode(), with_those_of_the_encoder)
        ]

    return wrong


@each("name", HARDWARE)
def test_the_encoder_declares_every_option(
    name: str, declares: Callable[[str, dict[str, str]], list[str]]
) -> None:
    found = HARDWARE[name]
    if found.encoder not in av.codecs_available:
        pytest.skip(f"PyAV has no {found.encoder}")
    for crf in (1, found.most):
        for preset in (None, *found.presets):
            recipe = recipe_for("rgb24", lossless=False, codec=name, crf=crf, preset=preset)
            assert declares(found.encoder, {**recipe.options, "g": "60"}) == []
    wrong = {"preset": "p8", "no-such": "1", found.scale: "-2"}
    assert len(declares(found.encoder, wrong)) == 3
    if name in NVENC:  # the scale ends there
        assert declares(found.encoder, {found.scale: str(found.most + 1)}) != []
        formats = av.Codec(found.encoder, "w").video_formats or []
        assert "yuv420p" in [item.name for item in formats]


def test_pictures_for_a_device_are_the_same_samples() -> None:
    """PyAV converts yuv420p to nv12 before it uploads it."""
    frame = av.VideoFrame(66, 46, "yuv420p")
    rng = np.random.default_rng(0)
    for plane in frame.planes:
        plane.update(rng.integers(0, 256, plane.buffer_size, dtype=np.uint8).tobytes())
    frame.color_range = 2
    other = frame.reformat(format="nv12").reformat(format="yuv420p")
    assert np.array_equal(frame.to_ndarray(), other.to_ndarray())


@each("name", HARDWARE)
def test_memory_grows_with_pictures(name: str) -> None:
    recipe = recipe_for("rgb24", lossless=False, codec=name, crf=20)
    small, large = (encoder_bytes(recipe, *size, 1) for size in ((640, 480), (1920, 1080)))
    assert 3 * 640 * 480 < small < large


# ---------------------------------------------------------------- where they are not there


@each("name", HARDWARE)
def test_one_sentence_says_what_is_missing(name: str) -> None:
    found = HARDWARE[name]
    if not (said := why_not(name)):
        pytest.skip(f"{name} is there")
    end = f"; `codec` {found.codec} needs no device."
    assert said.endswith(end)
    assert "\n" not in said
    assert found.needs in said
    if found.encoder not in av.codecs_available:
        assert said == (
            f"`codec` {name}: PyAV {av.__version__} was built without {found.encoder}. It needs "
            f"{found.needs}, and a PyAV whose FFmpeg has {found.encoder}{end}"
        )
    else:
        assert said.startswith(f"`codec` {name}: {found.encoder} could not be opened: ")
    assert said == why_not(name)  # ffmpeg is silent about what it said before


@pytest.mark.parametrize("name", NVENC)
def test_the_sentence_without_a_driver_of_nvidia(name: str) -> None:
    found, said = HARDWARE[name], why_not(name)
    if "libcuda" not in said:
        pytest.skip(said or f"{name} is there")
    assert said == (
        f"`codec` {name}: {found.encoder} could not be opened: Cannot load libcuda.so.1. "
        f"It needs an NVIDIA GPU that encodes {found.codec}, with its driver; "
        f"`codec` {found.codec} needs no device."
    )


def test_the_log_is_left_as_it_was() -> None:
    before = av.logging.get_level(), av.logging.get_skip_repeated()
    for name in HARDWARE:
        why_not(name)
    assert (av.logging.get_level(), av.logging.get_skip_repeated()) == before


def test_a_pyav_that_uploads_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", {"h264_vaapi"})
    monkeypatch.setattr(av, "__version__", "17.1.0")
    with pytest.raises(HardwareError, match=r"PyAV 17\.1\.0 cannot upload .* Install PyAV 18"):
        check_hardware("h264-vaapi")


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> str:
    """An encoder that is not there, on whatever machine."""
    monkeypatch.setattr(av, "codecs_available", {"libx264", "libsvtav1"})
    return "h264-nvenc"


def test_nothing_is_begun_without_it(absent: str, tmp_path: Path) -> None:
    paths = recording(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    command = ["pack", *map(str, paths), "-o", str(tmp_path / "d"), "--quality", "visual"]
    done = CliRunner().invoke(app_for(), [*command, "--codec", absent])
    assert done.exit_code == 1
    assert done.stderr.startswith(f"mp4ds: --codec {absent}: PyAV ")
    assert done.stderr.count("\n") == 1
    command = ["evaluate", str(paths[0]), "-o", str(tmp_path / "e"), "--codecs", f"x264,{absent}"]
    done = CliRunner().invoke(app_for(), command)
    assert done.exit_code == 1
    assert done.stderr.startswith(f"mp4ds: --codec {absent}: PyAV ")
    assert sorted(tmp_path.rglob("*")) == before


def test_other_machines_may_have_it(absent: str) -> None:
    options = PackOptions(quality="crf=20", codec=absent)
    with pytest.raises(HardwareError):
        _checked(options, [])
    _checked(replace(options, cluster="tcp://there:8786"), [])
    _checked(replace(options, join=True), [])


def test_a_score_is_not_kept_with_it(tmp_path: Path) -> None:
    options = PackOptions(quality="psnr=40", codec="h264-nvenc")
    with pytest.raises(OptionError, match="use `codec` h264, or find a crf with `mp4ds evaluate`"):
        mp4ds.pack(tmp_path / "none.bag", tmp_path / "d", options)


# ---------------------------------------------------------------- devices that fail


def opened(path: Path, name: str) -> VideoEncoder:
    recipe = recipe_for("gray", lossless=False, codec=name, crf=20)
    return VideoEncoder(
        path, recipe, picture_format="gray", width=64, height=48, gop=10, threads=1, rate=30.0
    )


def refusing(sizes: list[tuple[int, int]], tried: list[Any]) -> Callable[..., None]:
    def open_once(codec: str, width: int, height: int) -> None:
        tried.append((width, height))
        if (width, height) in sizes:
            raise hardware_error(codec, "refused")

    return open_once


@pytest.mark.parametrize(
    ("refused", "error", "said"),
    [
        ([(64, 48)], EncoderRefusedError, "does not take pictures of 64x48"),
        ([(64, 48), (640, 480)], HardwareError, "refused"),
        (
            [],
            HardwareError,
            "too many were open at once. Use fewer `jobs`; `codec` h264 needs no device",
        ),
    ],
)
def test_pictures_and_devices_are_told_apart(
    refused: list[tuple[int, int]], error: type, said: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, stand_in: str,
) -> None:  # fmt: skip
    """Pictures that it does not take are kept otherwise; a device that fails ends the pack."""

    def fail(*_: Any, **__: Any) -> None:
        raise FFmpegError(5, "no")

    monkeypatch.setattr("mp4ds.video.encoder.open_encoder", fail)
    monkeypatch.setattr(encoder, "_open_once", refusing(refused, []))
    with pytest.raises(error, match=said):
        opened(tmp_path / "v.mp4", stand_in)


def test_a_device_that_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand_in: str
) -> None:
    class Lost:
        def encode(self, frame: Any) -> Iterator[Any]:
            raise FFmpegError(5, "gone")

    encoder = opened(tmp_path / "v.mp4", stand_in)
    monkeypatch.setattr(encoder, "_stream", Lost())
    with pytest.raises(HardwareError, match=r"failed at frame 0: .*gone.*; `codec` h264 needs no"):
        encoder.write((np.zeros((48, 64), np.uint8),), 0)
    encoder.abandon()


# ---------------------------------------------------------------- the way, with a stand-in


@pytest.mark.parametrize("window", [None, 5])
def test_packing_and_unpacking(
    window: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    stand_in: str, compare: Callable[..., list[str]],
) -> None:  # fmt: skip
    inline = InlineEngine()
    monkeypatch.setattr("mp4ds.packing.pack._engine", lambda *_: inline)
    paths = recording(tmp_path)
    options = PackOptions(quality="crf=12", codec=stand_in, gop=5, window=window)
    mp4ds.pack(paths, tmp_path / "dataset", options)
    assert (len(inline.ran) > 1) == (window is not None)
    assert mp4ds.validate(tmp_path / "dataset", deep=True) == []
    assert compare(paths, unpacked(tmp_path, "mcap"), ignore_pixels=[TOPIC]) == []
    with mp4ds.open(tmp_path / "dataset") as dataset:
        video = dataset[TOPIC].sidecar.video
    assert (video.codec, video.encoder) == ("h264", "libx264")
    assert video.options == {"bf": "0", "crf": "12", "g": "5"}
    assert leftovers(tmp_path) == []


@pytest.mark.slow
def test_evaluating(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand_in: str) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import stand_in; stand_in.stand_in_here()\n"
        "from mp4ds.plugins.evaluating import trials; trials._main()"
    )
    monkeypatch.setattr(
        "mp4ds.plugins.evaluating.trials.command", lambda task: [sys.executable, "-c", code, *task]
    )
    options = EvaluateOptions(codecs=[stand_in], crf=["30"], frames=6, target="psnr_y=20")
    (camera,) = evaluate(recording(tmp_path)[0], options, output=tmp_path / "out").cameras
    assert [cell.setting.name for cell in camera.cells] == [f"{NAME} crf 30"]
    assert camera.recommended[0].options == f"--quality crf=30 --codec {NAME}"


def test_grids_and_names() -> None:
    options = EvaluateOptions(codecs=["h264-nvenc", "av1-vaapi"], crf=["20"], presets=["p1", "p7"])
    assert [item.name for item in grid_of(options).settings()] == [
        "h264-nvenc p1 crf 20", "h264-nvenc p7 crf 20", "av1-vaapi crf 20",
    ]  # fmt: skip
    assert Setting("h264-nvenc", "p4", 20, 45).pack_options == (
        "--quality crf=20 --codec h264-nvenc --preset p4 --gop 45"
    )
    with pytest.raises(OptionError, match=r"svtav1 \(av1\), .*h264-nvenc, .*h265-videotoolbox\."):
        grid_of(EvaluateOptions(codecs=["h264-qsv"]))
    for name, found in HARDWARE.items():
        settings = grid_of(EvaluateOptions(codecs=[name], crf=["45:63"])).settings()
        assert max(item.crf for item in settings) == found.most
        assert 1 <= first_guess(name, 30.0) <= found.most


# ---------------------------------------------------------------- on a device


@each("name", HARDWARE)
def test_on_a_device(name: str, tmp_path: Path) -> None:
    if said := why_not(name):
        pytest.skip(said)
    pictures = scene_pictures("rgb8", 640, 480, 25)
    recipe = recipe_for("rgb24", lossless=False, codec=name, crf=12)
    path = tmp_path / "v.mp4"
    told = encode(path, recipe, pictures, "rgb24", gop=10)
    for found, expected in zip(decode(path, told), pictures, strict=True):
        assert psnr(found, expected) > 30
    tags = ffprobe(path, "-show_streams")["streams"][0]
    assert [tags.get(tag) for tag in TAGS] == ["pc", "bt709", "bt709", "bt709"]
    packets = ffprobe(path, "-show_packets")["packets"]
    assert [packet["pts"] for packet in packets] == [packet["dts"] for packet in packets]
    keys = [number for number, packet in enumerate(packets) if packet["flags"].startswith("K")]
    assert keys == [0, 10, 20]
    encode(tmp_path / "again.mp4", recipe, pictures[:10], "rgb24", gop=10)
    ticks = [number * 33_333 for number in range(35)]
    assert join_segments([path, tmp_path / "again.mp4"], ticks, tmp_path / "both.mp4") == 35
