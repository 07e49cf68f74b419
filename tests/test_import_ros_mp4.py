"""The video and YAML of the tool published with the paper, and what is read of them.

``fixtures/ros_mp4`` was written by `write_pair` below and is never written again: its bytes are
what `mp4ds import ros-mp4` has to take.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from decimal import ROUND_HALF_EVEN, Context, Decimal
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import mp4ds
from mp4ds.plugins.importing.ros_mp4 import read_pair

steady = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])

FIXTURE = Path(__file__).parent / "fixtures" / "ros_mp4"
SHA256 = {
    "drive.yaml": "919d5d08c3a7ffc54d502ee703d51ea2deca670d51215a4a9fa30a141b17f24e",
    "drive.mp4": "ca20341cfe972db74862bf3d496a125513790a65d964cc6cf5140ebcf130801a",
}
TOPICS = ["/GS3_left_L/camera_info", "/GS3_left_L/image_raw"]
WIDTH, HEIGHT = 64, 48
# record times as that tool wrote them: float seconds, with all the digits of their repr
STAMPS = [
    *(1712647128.0274732, 1712647128.0405197, 1712647128.0561225, 1712647128.0882678),
    *(1712647128.1037846, 1712647128.1209877, 1712647128.1367397, 1712647128.153577),
    *(1712647128.1717517, 1712647128.1876662, 1712647128.2038922, 1712647129.0),
]
Document = dict[str, Any]


# ---------------------------------------------------------------- what wrote the fixture


def document(stamps: Sequence[float] = STAMPS) -> Document:
    """What that tool put into its YAML: the first camera_info, and a time per image."""
    return {
        "bagname": "GS3_left_L_0409_1_2024-04-09-15-18-27.bag",
        "topic_name": list(TOPICS),
        "camera_info": {
            "frameid": "GS3_left_L",
            "height": HEIGHT,
            "width": WIDTH,
            "distortion_model": "plumb_bob",
            "D": [-0.31389, 0.088223, -0.000123, -0.001852, 0.0],
            "K": [1785.24046, 0.0, 1272.60392, 0.0, 1780.48369, 1033.187, 0.0, 0.0, 1.0],
            "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "P": [
                *(1473.48999, 0.0, 1284.80534, 0.0),
                *(0.0, 1570.55713, 1035.05291, 0.0),
                *(0.0, 0.0, 1.0, 1e-05),
            ],
        },
        "img_timestamp": list(stamps),
    }


def image(number: int) -> NDArray[np.uint8]:
    """A bgr8 image: slopes of colour, and a square that moves."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    planes = [x * 3 + number, y * 4, 220 - x * 2 - number * 2]
    bgr = np.stack(planes, axis=-1).clip(0, 255).astype(np.uint8)
    bgr[8:24, 2 + 4 * number : 14 + 4 * number] = (20, 200, 90)
    return bgr


def write_text(path: Path, content: Document) -> None:
    with path.open("w") as file:
        yaml.dump(content, file, default_flow_style=False, sort_keys=False)


def write_video(path: Path, frames: int) -> None:
    """As ffmpeg made it of raw bgr24: a constant rate, colours converted and not tagged."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libsvtav1", rate=30, options={"crf": "22", "preset": "6"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(image(number), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def write_pair(folder: Path, content: Document | None = None, *, frames: int = 12) -> Path:
    """A pair as that tool wrote it; returns the YAML."""
    write_text(folder / "drive.yaml", document() if content is None else content)
    write_video(folder / "drive.mp4", frames)
    return folder / "drive.yaml"


def nanoseconds(seconds: float) -> int:
    """The exact value of the float, to the nearest nanosecond, ties to even."""
    exact = Decimal(seconds) * Decimal(10**9)
    return int(exact.to_integral_value(ROUND_HALF_EVEN, Context(prec=400)))


# ---------------------------------------------------------------- the fixture


def test_the_fixture_is_the_one_that_is_kept() -> None:
    for name, sha256 in SHA256.items():
        assert hashlib.sha256((FIXTURE / name).read_bytes()).hexdigest() == sha256
    assert yaml.safe_load((FIXTURE / "drive.yaml").read_text()) == document()


@pytest.fixture(params=["kept", "new"])
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The YAML of the fixture, and of one made by the encoder of today."""
    return FIXTURE / "drive.yaml" if request.param == "kept" else write_pair(tmp_path)


@pytest.mark.parametrize("suffix", [".yaml", ".mp4"])
def test_it_has_to_be_imported(suffix: str, pair: Path) -> None:
    with pytest.raises(mp4ds.FormatError, match="`mp4ds import ros-mp4 VIDEO drive") as caught:
        mp4ds.open(pair.with_suffix(suffix))
    assert caught.value.code == "version-unsupported"
    problems = mp4ds.validate(pair.with_suffix(suffix))
    assert [problem.code for problem in problems] == ["version-unsupported"]


def by_bt601(frame: av.VideoFrame) -> NDArray[np.float64]:
    """B, G, R of limited-range samples, by the formulas of BT.601."""
    planes = [
        np.frombuffer(bytes(plane), np.uint8).reshape(-1, plane.line_size)[:, : plane.width]
        for plane in frame.planes
    ]
    y = (planes[0].astype(float) - 16) * 255 / 219
    cb, cr = (
        np.kron((plane.astype(float) - 128) * 255 / 224, np.ones((2, 2))) for plane in planes[1:]
    )
    r, b = y + 1.402 * cr, y + 1.772 * cb
    g = (y - 0.299 * r - 0.114 * b) / 0.587
    return np.stack([b, g, r], axis=-1).clip(0, 255)


def test_its_frames_decode_with_their_colours(pair: Path, tmp_path: Path) -> None:
    """Untagged, so as ffmpeg converts by default: BT.601, limited range."""
    with av.open(str(pair.with_suffix(".mp4"))) as container:
        shown = [by_bt601(frame) for frame in container.decode(video=0)]
    mp4ds.import_ros_mp4(pair.with_suffix(".mp4"), pair, tmp_path / "dataset")
    with mp4ds.open(tmp_path / "dataset") as dataset:
        frames = list(dataset[TOPICS[1]])
        for number, frame in enumerate(frames):
            assert (frame.encoding, frame.frame_id) == ("bgr8", "GS3_left_L")
            assert frame.data.shape == (HEIGHT, WIDTH, 3)
            bias = (frame.data - shown[number]).mean(axis=(0, 1))
            assert np.abs(bias).max() < 0.5
            assert np.abs(frame.data.astype(float) - image(number)).mean() < 4
        for number in (7, 0, 11, 3):
            assert np.array_equal(dataset[TOPICS[1]][number].data, frames[number].data)


# ---------------------------------------------------------------- times


@steady
@given(st.lists(st.floats(0, 2**32 - 1), min_size=1, max_size=30))
@example(STAMPS)
@example([0.0, 5e-10, 1.5e-9, 2.5e-9, 0.1, 1e-300, 4294967294.9999995])
@example([1712647128.0274732] * 3)
def test_times_are_rounded_exactly(stamps: list[float]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drive.yaml")
        write_text(path, document(stamps))
        stream = read_pair(path)
    expected = [nanoseconds(stamp) for stamp in stamps]
    for column in (stream.columns.stamp, stream.columns.log_time):
        assert column.decode(stream.frames).tolist() == expected


# ---------------------------------------------------------------- broken files


def broken(**changes: Any) -> Document:
    """A document with other values at its top, ``...`` removes a key."""
    content = {**document(), **changes}
    return {key: value for key, value in content.items() if value is not ...}


def camera(**changes: Any) -> Document:
    content = {**document()["camera_info"], **changes}
    return broken(camera_info={key: value for key, value in content.items() if value is not ...})


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (broken(camera_info=...), "camera_info: "),
        (broken(camera_info={}), "camera_info has no 'frameid'"),
        (camera(distortion_model=...), "distortion_model"),
        (camera(K=["x"] * 9), "k.0: "),
        (camera(width={}), "width: "),
        (camera(width=0), "width: "),
        (broken(topic_name=TOPICS[:1]), "topic_name: "),
        (broken(topic_name=[1, 2]), "topic_name.0: "),
        (broken(img_timestamp=[]), "img_timestamp: "),
        (broken(img_timestamp=[True]), "img_timestamp.0: "),
        (broken(img_timestamp=["1/0"]), "img_timestamp.0: "),
        (broken(img_timestamp=[1e300]), "outside the range"),
        (broken(img_timestamp=[-1.5]), "outside the range"),
        (broken(surprise=1), "surprise: "),
    ],
)
def test_broken_files_are_refused_in_a_sentence(
    content: Document, word: str, tmp_path: Path
) -> None:
    path = tmp_path / "drive.yaml"
    write_text(path, content)
    with pytest.raises(mp4ds.SourceError) as caught:
        mp4ds.import_ros_mp4(FIXTURE / "drive.mp4", path, tmp_path / "dataset")
    sentence = str(caught.value)
    assert sentence.startswith(f"{path}: is not a complete YAML file of the tool published")
    assert word in sentence
    assert "\n" not in sentence
    assert list(tmp_path.iterdir()) == [path]
