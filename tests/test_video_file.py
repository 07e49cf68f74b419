"""Videos of others, which have no sidecar: their frames by number and time."""

from __future__ import annotations

import re
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray

import mp4ds
from conftest import real
from pictures import CAREFUL, picture
from sources import SOURCES, scene

FRAMES = 40
TICKS = np.cumsum([0, *(1001 * (1 + n % 3) for n in range(FRAMES - 1))])  # of 1/30000 s

KINDS: dict[str, tuple[str, str, dict[str, str]]] = {
    # encoder, pixel format, options
    "h264": ("libx264", "yuv420p", {"bf": "0", "g": "10"}),
    "h264-bframes": ("libx264", "yuv420p", {"bf": "3", "b_strategy": "0", "g": "10"}),
    "h264-open-gop": (
        "libx264",
        "yuv420p",
        {"x264-params": "bframes=3:open-gop=1:keyint=8:scenecut=0"},
    ),
    "h264-444": ("libx264", "yuv444p", {"g": "12"}),
    "h264-gray": ("libx264", "gray", {"g": "12"}),
    "h265": ("libx265", "yuv420p", {"x265-params": "log-level=none:keyint=9"}),
    "h265-10-bit": ("libx265", "yuv420p10le", {"x265-params": "log-level=none"}),
    "av1": ("libsvtav1", "yuv420p", {"preset": "12", "g": "16"}),
    "vp9": ("libvpx-vp9", "yuv420p", {"g": "10", "cpu-used": "8"}),
    "mpeg4": ("mpeg4", "yuv420p", {"g": "8", "bf": "2"}),
}


def write_video(
    path: Path,
    kind: str,
    *,
    size: tuple[int, int] = (64, 48),
    title: str = "",
    muxer: dict[str, str] | None = None,
) -> None:
    """Frames at uneven times, as phones and screen recorders write them."""
    encoder, pixel_format, options = KINDS[kind]
    with av.open(str(path), "w", format="mp4", options=muxer or {}) as container:
        container.metadata["title"] = title
        stream: Any = container.add_stream(encoder, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = *size, pixel_format
        stream.time_base = stream.codec_context.time_base = Fraction(1, 30_000)
        rng = np.random.default_rng(0)
        for number, tick in enumerate(TICKS.tolist()):
            pixels = picture("rgb8", frame=number, width=size[0], height=size[1], rng=rng)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts, frame.time_base = tick, Fraction(1, 30_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def decoded(path: Path) -> tuple[list[int], list[NDArray[Any]]]:
    """Times in nanoseconds and pixels of all frames, one after the other."""
    times, pixels = [], []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            assert frame.pts is not None
            assert frame.time_base is not None
            times.append(int(frame.pts * frame.time_base * 10**9))
            matrix = "itu709" if frame.colorspace == 1 else "itu601"
            rgb = frame.reformat(format="rgb24", src_colorspace=matrix, interpolation=CAREFUL)
            pixels.append(rgb.to_ndarray())
    return times, pixels


def near(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """The same frame, whatever was rounded."""
    return int(np.abs(one.astype(int) - other).max()) <= 2


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_every_kind(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a walk.mp4"
    write_video(path, kind)
    times, pixels = decoded(path)
    assert len(times) == FRAMES
    with mp4ds.open(path) as dataset:
        assert (dataset.topics, dataset.streams, dataset.manifest) == (["a walk"], [], None)
        assert "a walk" in dataset
        assert len(dataset) == 1
        (video,) = dataset
        assert dataset["a walk"] is video
        assert isinstance(video, mp4ds.Topic)
        assert (video.topic, video.encoding, len(video)) == ("a walk", "rgb8", FRAMES)
        assert (video.shape, video.dtype) == ((48, 64, 3), np.uint8)
        assert video.stamps.tolist() == video.log_times.tolist() == times
        every = list(video)
        for number, frame in enumerate(every):
            assert (frame.index, frame.stamp_ns, frame.encoding) == (number, times[number], "rgb8")
            assert (frame.frame_id, frame.intrinsics) == ("", None)
            assert near(frame.data, pixels[number])
        order = [33, 3, 12, 11, 13, -1, 0, 7, 8, 9, 39, 33]
        for found, number in zip(video.get(order), order, strict=True):
            assert np.array_equal(found.data, every[number].data)
        for number in (20, 5, 6, 31, 30, 5, 15, 23):
            assert np.array_equal(video[number].data, every[number].data)
        assert [frame.index for frame in video[30:5:-7]] == [30, 23, 16, 9]


def test_times_and_sizes(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", "h264-bframes")
    with mp4ds.open(tmp_path / "clip.mp4") as dataset:
        clip = dataset["clip"]
        times = clip.stamps.tolist()
        assert clip.at(times[7] + 1000).index == 7
        with pytest.raises(mp4ds.FrameNotFoundError, match="clip has no frame"):
            clip.at(-1, mode="before")
        found = list(clip.between(times[4], times[9]))
        assert [frame.index for frame in found] == [4, 5, 6, 7, 8]
        assert clip.read([1, 2], format="gray", resize=0.5, crop=(0, 0, 32, 32)).shape == (
            2,
            16,
            16,
        )
        assert dataset.sync(tolerance_ns=0).indices[:, 0].tolist() == list(range(FRAMES))
        assert list(dataset.messages()) == []
        assert dataset.channels == []
        assert dataset.profile == ""


VIDEOS = ["var_fps_video", "h264_10bits", "lerobot_aloha_insertion_human_yuv444", "sam2_02_cups"]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", VIDEOS)
def test_real_videos(name: str) -> None:
    path = real("video") / f"{name}.mp4"
    times, pixels = decoded(path)
    with mp4ds.open(path) as dataset:
        video = dataset[path.stem]
        assert video.stamps.tolist() == times
        for number in (len(times) - 1, len(times) // 2, 0, len(times) // 3):
            assert near(video[number].data, pixels[number])


# ---------------------------------------------------------------- what is no such video


def test_videos_of_a_dataset_need_their_sidecars(tmp_path: Path) -> None:
    mp4ds.pack(SOURCES["bag-none"](tmp_path / "source", scene("rgb8")), tmp_path / "drive")
    shutil.copy(tmp_path / "drive" / "cam_image_raw.mp4", tmp_path / "alone.mp4")
    with mp4ds.open(tmp_path / "alone.mp4") as dataset:
        assert len(dataset["alone"]) == 8
    (tmp_path / "drive" / "cam_image_raw.yaml").rename(tmp_path / "alone.yaml")
    with pytest.raises(mp4ds.FormatError, match=r"sidecar, cam_image_raw\.yaml"):
        mp4ds.open(tmp_path / "drive" / "cam_image_raw.mp4")
    with mp4ds.open(tmp_path / "alone.mp4") as dataset:
        assert len(dataset.streams) == 1
        with pytest.raises(mp4ds.FormatError, match=r"cam_image_raw\.mp4.* \[file-missing\]"):
            dataset["/cam/image_raw"][0]


def test_videos_that_ffmpeg_writes_anew(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    write_video(path, "h264", muxer={"movflags": "frag_keyframe+empty_moov"})
    with pytest.raises(mp4ds.VideoError, match=r"in fragments.*`ffmpeg -i FILE -c copy NEW\.mp4`"):
        mp4ds.open(path)
    with av.open(str(path), "w") as container:
        for encoder in ("libx264", "mpeg4"):
            stream: Any = container.add_stream(encoder, rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for stream in container.streams.video:
            container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
            container.mux(stream.encode(None))
    listed = "2 video tracks, not one (h264 64x48, mpeg4 64x48); `ffmpeg -i FILE -map 0:v:0 -c copy"
    with pytest.raises(mp4ds.VideoError, match=re.escape(listed)):
        mp4ds.open(path)


@pytest.mark.parametrize(
    "content", [b"", b"no video at all", b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom" + bytes(64)]
)
def test_not_a_video(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(content)
    with pytest.raises(mp4ds.VideoError, match=r"clip\.mp4.*\[video-unreadable\]"):
        mp4ds.open(tmp_path / "clip.mp4")


def test_damage_is_told(tmp_path: Path) -> None:
    """A wrong byte gives an error, or a picture: never a wrong number of frames, nor a hang."""
    write_video(tmp_path / "clip.mp4", "h264-bframes")
    data = (tmp_path / "clip.mp4").read_bytes()
    rng = np.random.default_rng(0)
    raised = 0
    for _ in range(150):
        changed = bytearray(data)
        for at in rng.integers(0, len(data), 4):
            changed[at] = int(rng.integers(256))
        (tmp_path / "bad.mp4").write_bytes(changed)
        try:
            with mp4ds.open(tmp_path / "bad.mp4") as dataset:
                video = dataset["bad"]
                assert len(video.read([0, len(video) // 2, -1])) == 3
        except mp4ds.Mp4dsError:
            raised += 1
    assert raised
