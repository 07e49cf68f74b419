"""Cameras of more than 8 bits, whose views show them by a curve, and pixels without an alpha."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mp4ds
from compare import compare
from mp4ds.format.models import StreamSidecar
from mp4ds.format.sidecars import load_stream
from mp4ds.packing.options import PackOptions
from mp4ds.unpacking.unpack import UnpackOptions
from pictures import sample_format
from round_trips import journey, own_target
from scenes import Scene, scene
from sources import SOURCES

CAMERA = "/cam/image_raw"


def recorded(encoding: str, bits: int = 8, shift: int = 0, *, big_endian: bool = False) -> Scene:
    """A camera whose noise, as that of a real one, is most of what its pixels say."""
    made = scene(encoding, width=160, height=120, big_endian=big_endian, pad=4)
    dtype, samples = sample_format(encoding)
    rng = np.random.default_rng(bits)
    images = [message for message in made.messages if message.topic == CAMERA]
    for number, message in enumerate(images):
        y, x = np.mgrid[:120, :160]
        plane = 0.45 + 0.2 * np.sin((x + number) / 31) + 0.1 * np.cos(y / 23)
        light = plane[..., None] * np.linspace(0.9, 1.1, samples)
        light += rng.normal(0, 0.015, light.shape)
        pixels = np.clip(light * 2**bits, 0, 2**bits - 1).astype(dtype) << shift
        if encoding.endswith("a8"):
            pixels[..., 3] = 255
        pixels = pixels.byteswap() if big_endian else pixels
        rows = pixels.view(np.uint8).reshape(120, -1)
        message.values["data"].reshape(120, -1)[:, :-4] = rows
    return made


def sidecar(dataset: Path) -> StreamSidecar:
    return load_stream(dataset / "cam_image_raw.yaml")


CAMERAS = {
    "mono16-12": ("bag-none", "mono16", (12, 0), False),
    "mono16-12-high": ("mcap-ros2-none", "mono16", (12, 4), False),
    "mono16-16": ("mcap-ros1-zstd", "mono16", (16, 0), False),
    "mono16-10-big-endian": ("bag-none", "mono16", (10, 6), True),
    "bayer_gbrg16-12": ("mcap-ros2-none", "bayer_gbrg16", (12, 0), False),
    "bayer_rggb16-14": ("bag-none", "bayer_rggb16", (14, 2), False),
    "rgb16-12": ("bag-none", "rgb16", (12, 0), False),
    "bgr16-16-big-endian": ("mcap-ros2-none", "bgr16", (16, 0), True),
    "rgba8": ("bag-none", "rgba8", (8, 0), False),
    "bgra8": ("mcap-ros2-none", "bgra8", (8, 0), False),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", CAMERAS)
def test_a_deep_camera_has_a_view(case: str, tmp_path: Path) -> None:
    """All of it comes back; without the exact video, what the view shows."""
    source, encoding, bits, big_endian = CAMERAS[case]
    made = recorded(encoding, *bits, big_endian=big_endian)
    done = journey(tmp_path, SOURCES[source], made, own_target(source))
    stored = sidecar(done.dataset)
    assert stored.view is not None
    assert stored.view.layout == ("opaque" if encoding.endswith("8") else "tone")
    assert "uv" in str(stored.view.pixel_format)
    with mp4ds.open(done.dataset) as dataset:
        exact = np.stack([frame.data for frame in dataset[CAMERA]])
        shown = np.stack([frame.data for frame in dataset[CAMERA].in_layer("view")])
        again = [dataset[CAMERA][n].data for n in (5, 0, 6)]
    assert np.array_equal(again, exact[[5, 0, 6]])
    far = np.abs(shown.astype(int) - exact).mean()
    assert 0 < far < np.ptp(exact) / 20
    (done.dataset / "cam_image_raw.exact.mp4").unlink()
    with mp4ds.open(done.dataset) as dataset:
        assert np.array_equal(shown, [frame.data for frame in dataset[CAMERA]])
    output = tmp_path / "visual.bag"
    mp4ds.unpack(done.dataset, "bag", output, UnpackOptions(quality="visual"))
    assert compare(done.sources, [output], ignore_pixels=[CAMERA]) == []


def test_what_may_be_depth_stays_exact(tmp_path: Path) -> None:
    """Of mono16, whatever quality is asked for; other cameras are copied as their views."""
    made = recorded("mono16", 12)
    images = [one for one in recorded("rgb16", 12).messages if one.topic == CAMERA]
    made.messages += [replace(one, topic="/eye") for one in images]
    done = journey(tmp_path, SOURCES["bag-none"], made, "bag")
    for number, source in enumerate((done.dataset, *done.sources)):
        small = tmp_path / f"small-{number}"
        summary = mp4ds.pack(source, small, PackOptions(quality="visual"))
        assert sorted(path.name for path in small.glob("*.mp4")) == [
            "cam_image_raw.exact.mp4",
            "cam_image_raw.mp4",
            "eye.mp4",
        ]
        output = tmp_path / f"again-{number}.bag"
        mp4ds.unpack(small, "bag", output)
        assert compare(done.sources, [output], ignore_pixels=["/eye"]) == []
    assert any("mono16 is kept lossless" in str(one) for one in summary.topics)


def test_brighter_images_are_stored_beside_those_with_a_view(tmp_path: Path) -> None:
    """The bits in use are seen on the first images; others have no view."""
    made = recorded("mono16", 12)
    (*_, last) = (message for message in made.messages if message.topic == CAMERA)
    last.values["data"].view("<u2")[:-2:7] |= 0x8000
    done = journey(tmp_path, SOURCES["bag-none"], made, "bag")
    found = sorted(path.name for path in done.dataset.glob("*.mp4"))
    assert found == ["cam_image_raw-2.mp4", "cam_image_raw.exact.mp4", "cam_image_raw.mp4"]
