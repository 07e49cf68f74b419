"""Files from strangers: refused with a code, in bounded time and memory, and without a trace.

Every reading is done in a `Jail`. The cases change a good sidecar and manifest; most write them
with a fitting checksum, as whoever means harm would.
"""

from __future__ import annotations

import base64
import copy
import io
import os
import random
import shutil
import socket
import warnings
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import av
import pytest

import jail
import mp4ds
from coded_scenes import CODED
from edits import Change, Document, agreed, changed, load
from foxglove_scenes import FOXGLOVE, FOXGLOVE_SOURCES
from mp4ds import Mp4dsError, VersionError, yamlio
from mp4ds.format.fields import FORMAT_VERSION, MAX_CAMERA_INFOS, MAX_FRAMES
from scenes import Scene
from sources import SOURCES, scene

STEM = "cam_image_raw"
WIDTH, HEIGHT, FRAMES = 64, 48, 8
BAD_DOCUMENT = {"schema-invalid", "model-invalid"}
COLUMNS = ("log_time", "stamp", "seq")


@pytest.fixture
def pair(packed_bag: Path, tmp_path: Path) -> Path:
    """A video with its sidecar, without the rest of their dataset."""
    for suffix in (".mp4", ".yaml"):
        shutil.copy(packed_bag / f"{STEM}{suffix}", tmp_path)
    return tmp_path / f"{STEM}.yaml"


@pytest.fixture
def dataset(packed_bag: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(packed_bag, tmp_path / "dataset"))


def edited(path: Path, old: bytes, new: bytes) -> None:
    """Change a file as text, without its checksum."""
    text = path.read_bytes()
    text = text[: text.rindex(b"checksum:")]
    assert old in text
    path.write_bytes(text.replace(old, new, 1))


def put(*place: str | int, value: Any) -> Change:
    """A change of one value."""

    def change(document: Document) -> None:
        node: Any = document
        for key in place[:-1]:
            node = node[key]
        node[place[-1]] = copy.deepcopy(value)

    return change


def drop(*place: str | int) -> Change:
    def change(document: Document) -> None:
        node: Any = document
        for key in place[:-1]:
            node = node[key]
        del node[place[-1]]

    return change


def both(*changes: Change) -> Change:
    def change(document: Document) -> None:
        for one in changes:
            one(document)

    return change


def column(start: int, step: int, values: str) -> Document:
    return {"start": start, "step": step, "values": values}


def claiming(count: int) -> Change:
    """A sidecar of a few bytes that claims to have many frames, each with its values."""
    runs = column(0, 0, f"0*{count - 1}")
    return both(put("frames", value=count), *(put("columns", name, value=runs) for name in COLUMNS))


# the video may be another one; there is no digest that would tell
UNSEALED = both(drop("video", "size"), drop("video", "sha256"))
LOSSY = both(UNSEALED, drop("digests"), put("profile", value="visual"))


def refused(path: Path, *codes: str, by_reading: bool = True) -> str:
    """Both ways of reading refuse, one with a problem of these codes, one with an error.

    Args:
        path: What to read.
        codes: Codes of which one must be found, and all others may not.
        by_reading: Whether opening or reading must fail, too.

    Returns:
        All problems as text.
    """
    validated = jail.validate(path)
    assert not validated.error, validated.text
    assert validated.codes, "no problem was found"
    assert set(validated.codes) <= set(codes), validated.problems
    read = jail.read(path)
    if by_reading:
        assert read.ours, read.text or "it could be read"
        assert any(f"[{code}]" in read.text for code in codes), read.text
    return "\n".join(validated.problems)


def accepted(path: Path) -> None:
    for outcome in (jail.validate(path), jail.read(path)):
        assert not outcome.error, outcome.text
        assert outcome.problems == []


def test_the_good_ones_are_accepted(pair: Path, dataset: Path) -> None:
    accepted(pair)
    accepted(dataset)
    assert jail.read(pair).frames == FRAMES


# ---------------------------------------------------------------- names of files


def test_no_file_outside_is_touched(dataset: Path, tmp_path: Path) -> None:
    outside = shutil.copy(dataset / f"{STEM}.mp4", tmp_path / "x.mp4")
    os.utime(outside, (1, 1))
    changed(dataset / f"{STEM}.yaml", put("video", "file", value="../x.mp4"))
    agreed(dataset)
    refused(dataset, *BAD_DOCUMENT)
    assert Path(outside).stat().st_atime == 1


@pytest.mark.parametrize("name", ["dataset.yaml", f"{STEM}.yaml", "messages.mcap"])
def test_a_video_that_is_another_file_of_the_dataset(name: str, dataset: Path) -> None:
    changed(dataset / f"{STEM}.yaml", both(LOSSY, put("video", "file", value=name)))
    agreed(dataset)
    refused(dataset, "video-unreadable", "manifest-inconsistent")


@pytest.mark.parametrize("name", ["dataset.yaml", "messages.mcap", "none.yaml"])
def test_a_sidecar_that_is_another_file(name: str, dataset: Path) -> None:
    changed(dataset / "dataset.yaml", put("streams", 0, "sidecar", value=name))
    refused(
        dataset,
        *("kind-unknown", "yaml-invalid", "file-missing", "manifest-inconsistent", "model-invalid"),
    )


# ---------------------------------------------------------------- links and special files


@pytest.mark.parametrize("inside", [True, False], ids=["inside", "outside"])
@pytest.mark.parametrize("suffix", [".mp4", ".yaml"])
def test_links_are_followed(suffix: str, inside: bool, dataset: Path, tmp_path: Path) -> None:
    # git-annex, DVC and the caches of data hubs hold every file as a link to a store
    path = dataset / f"{STEM}{suffix}"
    path.rename((dataset if inside else tmp_path) / "blob")
    path.symlink_to("blob" if inside else "../blob")
    accepted(dataset)


@pytest.mark.parametrize("suffix", [".mp4", ".yaml"])
def test_links_in_a_circle(suffix: str, pair: Path) -> None:
    path = pair.with_suffix(suffix)
    path.unlink()
    path.symlink_to(path.name)
    if suffix == ".yaml":
        for outcome in (jail.validate(pair), jail.read(pair)):
            assert outcome.ours or outcome.codes == ["file-missing"], outcome.text
    else:
        refused(pair, "file-missing")


@pytest.mark.parametrize("kind", ["zero", "fifo", "folder"])
@pytest.mark.parametrize("name", [f"{STEM}.yaml", f"{STEM}.mp4", "messages.mcap", "dataset.yaml"])
def test_not_a_regular_file(name: str, kind: str, dataset: Path) -> None:
    path = dataset / name
    path.unlink()
    if kind == "zero":
        path.symlink_to("/dev/zero")
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.mkdir()
    for outcome in (jail.validate(dataset), jail.read(dataset)):
        assert outcome.ours or outcome.codes, outcome.text


# ---------------------------------------------------------------- YAML

TEXTS: dict[str, bytes] = {
    "laughs": b'a: &a ["lol"]\n'
    + b"".join(
        b"%c: &%c [%s]\n" % (98 + i, 98 + i, b",".join([b"*%c" % (97 + i)] * 9)) for i in range(9)
    ),
    "alias-of-itself": b"a: &a [*a]\n",
    "brackets": b"a: " + b"[" * 100_000,
    "closed-brackets": b"a: " + b"[" * 100_000 + b"]" * 100_000,
    "braces": b"{a: " * 100_000,
    "dashes": b"- " * 100_000,
    "questions": b"? " * 100_000,
    "indents": b"\n".join(b" " * n + b"a:" for n in range(1500)),
    "python-object": b'a: !!python/object/apply:os.system ["touch pwned"]\n',
    "lone-surrogate": b'a: "\\ud800"\n',
    "many-digits": b"a: 1" + b"0" * 10_000_000 + b"\n",
    "structure": b"a: [" + b"x" * (17 * 2**20) + b"]\n",
}


@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("to", ["sidecar", "manifest"])
def test_yaml_beyond_the_subset(to: str, name: str, dataset: Path) -> None:
    path = dataset / (f"{STEM}.yaml" if to == "sidecar" else "dataset.yaml")
    head = b'mp4ds: "2.0"\nkind: stream\n' if TEXTS[name].startswith(b"a:") else b""
    path.write_bytes(head + TEXTS[name])
    refused(path if to == "sidecar" else dataset, "yaml-invalid")
    assert not list(dataset.glob("pwned"))


def test_a_sidecar_larger_than_any(pair: Path) -> None:
    os.truncate(pair, 8 * 2**30)  # takes no room on the disk
    refused(pair, "yaml-invalid")


def test_many_unknown_keys(pair: Path) -> None:
    edited(pair, b"frames: 8", b"frames: 8" + b"".join(b"\nk%d: 1" % n for n in range(20_000)))
    text = refused(pair, *BAD_DOCUMENT)
    assert len(text) < 10_000


# ---------------------------------------------------------------- versions


@pytest.mark.parametrize("version", ["3.0", "3.7", "10.0", "99999999999.0"])
def test_a_newer_major_version_is_refused(version: str, pair: Path) -> None:
    changed(pair, put("mp4ds", value=version))
    text = refused(pair, "version-unsupported")
    assert version in text
    assert FORMAT_VERSION in text
    with pytest.raises(VersionError, match=version):
        mp4ds.open(pair)


@pytest.mark.parametrize(
    "version",
    [b"1", b"1.0", b'"1"', b'"1.0.0"', b'"01.0"', b'"0.9"', b'"1.0 "', b'"-1.0"', b'"1.\xd9\xa1"',
     b"null", b"[1]", b"{}", b"true", b'"' + b"9" * 5000 + b'.0"'],
)  # fmt: skip
def test_not_a_version(version: bytes, pair: Path) -> None:
    edited(pair, b'mp4ds: "2.0"', b"mp4ds: " + version)
    refused(pair, "version-unsupported")


# ---------------------------------------------------------------- numbers that ask for memory

GEOMETRY: dict[str, tuple[Change, set[str]]] = {
    "billion-by-billion": (
        both(*(put("image", key, value=10**9) for key in ("width", "height", "step"))),
        BAD_DOCUMENT,
    ),
    "largest": (
        both(*(put("image", key, value=16384) for key in ("width", "height", "step"))),
        BAD_DOCUMENT,
    ),
    "largest-video": (
        both(
            *(put("image", key, value=16384) for key in ("width", "height", "step")),
            *(put("video", key, value=16384) for key in ("width", "height")),
        ),
        {"geometry-mismatch"},
    ),
    "frames-most": (claiming(MAX_FRAMES), {"frame-count"}),
    "frames-2**62": (claiming(2**62), BAD_DOCUMENT),
}


def test_as_many_frames_as_a_hollow_video_has_bytes(pair: Path) -> None:
    os.truncate(pair.with_suffix(".mp4"), MAX_FRAMES)  # takes no room on the disk
    changed(pair, both(LOSSY, claiming(MAX_FRAMES)))
    refused(pair, "frame-count")


def test_millions_of_camera_infos_in_a_few_bytes(pair: Path) -> None:
    runs = column(0, 0, f"0*{MAX_CAMERA_INFOS - 1}")
    changed(
        pair,
        both(
            put("camera_info", "messages", value=MAX_CAMERA_INFOS),
            *(put("camera_info", "columns", name, value=runs) for name in COLUMNS),
        ),
    )
    jail.validate(pair)


# ---------------------------------------------------------------- columns

WHOLE = f"0*{FRAMES - 1}"
RESIDUALS: dict[str, str] = {
    "run-beyond": "0*" + "9" * 30,
    "run-of-digits": "0*" + "9" * 5000,
    "many-runs-of-none": "0*0 " * 100_000 + WHOLE,
    "unlimited-spaces": "0 " + " " * 2**17 + "*",
    "like-a-column-cut-out": "mp4ds column 0",
}


COLUMN_CHANGES: dict[str, tuple[Change, set[str]]] = {
    **GEOMETRY,
    **{
        name: (put("columns", "stamp", "values", value=text), {"column-invalid", "yaml-invalid"})
        for name, text in RESIDUALS.items()
    },
    **{
        name: (put(*place, value=value), {"column-invalid"})
        for name, (*place, value) in {
            "stamp-negative": ("columns", "stamp", "start", -1),
            "stamp-beyond": ("columns", "stamp", "start", 2**62),
            "seq-negative": ("columns", "seq", "start", -1),
            "seq-beyond": ("columns", "seq", "start", 2**32),
            "variant-beyond": ("columns", "variant", column(1, 0, WHOLE)),
            "variant-negative": ("columns", "variant", column(-1, 0, WHOLE)),
            "ordinal-repeated": ("columns", "ordinal", column(0, 0, WHOLE)),
            "ordinal-falling": ("columns", "ordinal", column(9, -1, WHOLE)),
            "ordinal-negative": ("columns", "ordinal", column(-1, 1, WHOLE)),
            "ordinal-wrapped": ("columns", "ordinal", column(0, 2**62, WHOLE)),
            "info-stamp-negative": ("camera_info", "columns", "stamp", "start", -1),
            "info-seq-beyond": ("camera_info", "columns", "seq", "start", 2**32),
        }.items()
    },
    **{
        f"template-{name}": (put(*place, "template", value=value), {"header-mismatch"})
        for name, (*place, value) in {
            "no-base64": ("headers", 0, "A"),
            "short": ("headers", 0, "AAAA"),
            "empty": ("headers", 0, ""),
            "long": ("headers", 0, "AAAA" * 2**15),
            "of-info-no-base64": ("camera_info", "calibrations", 0, "A"),
            "of-info-short": ("camera_info", "calibrations", 0, "AAAA"),
        }.items()
    },
    "digests-wrong": (put("digests", "values", value="00" * 8 * FRAMES), {"digest-mismatch"}),
    "info-no-columns": (drop("camera_info", "columns"), {"column-invalid", *BAD_DOCUMENT}),
    "info-no-calibrations": (
        put("camera_info", "calibrations", value=[]),
        {"column-invalid", *BAD_DOCUMENT},
    ),
    "wire-other": (put("wire", value="cdr-le"), {"digest-mismatch", "model-invalid"}),
    "schema-no-base64": (
        put("channel", "schema", value={"name": "a", "encoding": "b", "base64": "A"}),
        {"model-invalid", "header-mismatch", "stream-invalid"},
    ),
    "codec-other": (put("video", "codec", value="av1"), {"codec-mismatch"}),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", COLUMN_CHANGES)
def test_a_sidecar_that_contradicts_itself_or_its_video(name: str, pair: Path) -> None:
    change, codes = COLUMN_CHANGES[name]
    changed(pair, change)
    refused(pair, *codes)


@pytest.mark.parametrize(("start", "step"), [(3, 1), (0, 2), (2**62, 1)])
def test_places_of_messages_that_are_nowhere(start: int, step: int, dataset: Path) -> None:
    changed(dataset / f"{STEM}.yaml", put("columns", "ordinal", value=column(start, step, WHOLE)))
    agreed(dataset)
    refused(dataset, "messages-missing")


# ---------------------------------------------------------------- videos


def video(
    path: Path,
    codec: str = "libx264",
    pixel_format: str = "gray",
    *,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    frames: int = FRAMES,
    container: str = "mp4",
) -> None:
    """A black video."""
    options = {"qp": "0", "preset": "ultrafast"} if codec.startswith("libx264") else {}
    with av.open(str(path), "w", format=container) as output:
        stream = output.add_stream(codec, rate=30, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = pixel_format
        for number in range(frames):
            output.mux(stream.encode(black(size, pixel_format, number)))
        output.mux(stream.encode(None))


def black(size: tuple[int, int], pixel_format: str, number: int) -> av.VideoFrame:
    frame = av.VideoFrame(*size, pixel_format)
    for plane in frame.planes:
        plane.update(bytes(plane.buffer_size))
    frame.pts = number
    return frame


def h264(size: tuple[int, int], frames: int) -> bytes:
    """A bare H.264 stream of key frames, each with the size in front."""
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height = size
    context.pix_fmt, context.time_base = "gray", Fraction(1, 30)
    parameters = "repeat-headers=1:keyint=1"
    context.options = {"qp": "0", "preset": "ultrafast", "x264-params": parameters}
    packets = [p for n in range(frames) for p in context.encode(black(size, "gray", n))]
    return b"".join(bytes(packet) for packet in [*packets, *context.encode(None)])


def video_that_changes(path: Path, *parts: bytes) -> None:
    """A video of bare streams, one after the other."""
    with (
        av.open(io.BytesIO(b"".join(parts)), format="h264") as source,
        av.open(str(path), "w", format="mp4") as output,
    ):
        stream = output.add_stream_from_template(source.streams.video[0])
        packets = [packet for packet in source.demux() if packet.size]
        for number, packet in enumerate(packets):
            packet.stream, packet.time_base = stream, Fraction(1, 30)
            packet.pts = packet.dts = number
            output.mux(packet)


OTHER_VIDEOS: dict[str, tuple[Callable[[Path], object], set[str]]] = {
    **{
        name: (partial(video, **options), {code})
        for name, code, options in [
            ("mpeg4", "codec-mismatch", {"codec": "mpeg4", "pixel_format": "yuv420p"}),
            ("ffv1", "codec-mismatch", {"codec": "ffv1"}),
            ("yuv444p", "codec-mismatch", {"pixel_format": "yuv444p"}),
            ("rgb24", "codec-mismatch", {"codec": "libx264rgb", "pixel_format": "rgb24"}),
            ("fewer-frames", "frame-count", {"frames": FRAMES - 1}),
            ("more-frames", "frame-count", {"frames": FRAMES + 1}),
            ("larger", "geometry-mismatch", {"size": (128, 96)}),
            ("very-large", "geometry-mismatch", {"size": (8192, 8192), "frames": 1}),
            ("very-wide", "geometry-mismatch", {"size": (16384, 16)}),
            ("matroska", "video-unreadable", {"container": "matroska"}),
            ("avi", "video-unreadable", {"container": "avi"}),
            ("nut", "video-unreadable", {"codec": "ffv1", "container": "nut"}),
        ]
    },
    "h264": (lambda path: path.write_bytes(h264((WIDTH, HEIGHT), FRAMES)), {"video-unreadable"}),
    "empty": (lambda path: path.write_bytes(b""), {"frame-count", "video-unreadable"}),
    "text": (lambda path: path.write_bytes(b"hello\n" * 99), {"video-unreadable"}),
    "half": (lambda path: os.truncate(path, path.stat().st_size // 2), {"video-unreadable"}),
    "missing": (lambda path: path.unlink(), {"file-missing"}),
}


@pytest.mark.parametrize("name", OTHER_VIDEOS)
def test_another_video(name: str, pair: Path) -> None:
    make, codes = OTHER_VIDEOS[name]
    path = pair.with_suffix(".mp4")
    if name not in ("half", "missing"):
        path.unlink()
    make(path)
    changed(pair, LOSSY)
    refused(pair, *codes)


@pytest.mark.parametrize("size", [(32, 48), (128, 48), (64, 96), (4096, 4096)])
def test_a_video_that_changes_its_size_half_way(size: tuple[int, int], pair: Path) -> None:
    start = h264((WIDTH, HEIGHT), FRAMES // 2)
    video_that_changes(pair.with_suffix(".mp4"), start, h264(size, FRAMES // 2))
    changed(pair, LOSSY)
    refused(pair, "geometry-mismatch", "decode-failed")


@pytest.mark.parametrize("text", [b"avc1", b"Lavf", b"VideoHandler"])
def test_a_video_with_other_bytes_in_its_headers(text: bytes, pair: Path) -> None:
    """A size that nothing allocates, since the one in the stream counts; and no UTF-8."""
    path = pair.with_suffix(".mp4")
    data = bytearray(path.read_bytes())
    place = data.index(text, data.index(b"stsd") if text == b"avc1" else 0)
    if text == b"avc1":
        data[place + 28 : place + 32] = (16384).to_bytes(2, "big") * 2
    else:
        data[place] |= 0x80
    path.write_bytes(data)
    changed(pair, UNSEALED)
    for outcome in (jail.validate(pair), jail.read(pair)):
        assert not outcome.error or outcome.ours


@pytest.mark.parametrize("form", ["hls", "sdp", "concat", "dash", "file"])
def test_nothing_is_fetched_from_elsewhere(form: str, pair: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.05)
        url = f"http://127.0.0.1:{server.getsockname()[1]}/x.mp4"
        text = {
            "hls": f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{url}\n#EXT-X-ENDLIST\n",
            "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\n"
            "m=video 5004 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
            "concat": f"ffconcat version 1.0\nfile {url}\n",
            "file": "ffconcat version 1.0\nfile other.mp4\n",
            "dash": '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011">'
            f"<Period><AdaptationSet><BaseURL>{url}</BaseURL></AdaptationSet></Period></MPD>",
        }[form]
        path = pair.with_suffix(".mp4")
        path.rename(pair.with_name("other.mp4")).with_name(path.name).write_text(text)
        changed(pair, LOSSY)
        refused(pair, "video-unreadable")
        with pytest.raises(TimeoutError):
            server.accept()


@pytest.mark.parametrize("folder", ["a:b", "run-12:00:00", "http:", "pipe:0", "100%d", "-x", "é è"])
def test_a_folder_whose_name_looks_like_something_else(
    folder: str, packed_bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(packed_bag, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    assert mp4ds.validate(folder, deep=True) == []
    with mp4ds.open(folder) as dataset:
        assert len(list(next(iter(dataset)))) == FRAMES


# ---------------------------------------------------------------- coded pictures and packets

KINDS: dict[str, tuple[str, Scene]] = {
    "h264": ("mcap-ros2-none", CODED["video-h264"](frames=6)),
    "av1": ("mcap-ros2-none", CODED["video-av1"](frames=6)),
    "ffmpeg": ("bag-none", CODED["ffmpeg-libx264"](frames=6)),
    "jpeg": ("bag-none", CODED["jpeg-rgb"](frames=6)),
    "jpeg-grey": ("bag-none", CODED["jpeg-gray"](frames=6)),
    "png": ("bag-none", CODED["png-gray-cv2"](frames=6)),
    "png16": ("bag-none", CODED["png-16-bit-pillow"](frames=6)),
    "depth": ("bag-none", CODED["depth-16UC1-png"](frames=6)),
    "rvl": ("mcap-ros2-none", CODED["depth-32FC1-rvl"](frames=6)),
    "bits": ("bag-none", scene("rgb16", content="12-bit-high", frames=6)),
    "table": ("bag-none", scene("mono16", content="few-values", frames=6)),
    "metres": ("bag-none", scene("32FC1", content="millimetres", frames=6)),
    "yuv": ("bag-none", scene("nv12", frames=6)),
    "protobuf": ("mcap-protobuf", FOXGLOVE["jpeg-rgb"](frames=6)),
    "transcoded": ("bag-none", CODED["jpeg-rgb"](frames=6)),
}


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Sidecars of every kind, each made once; not to be changed."""
    made: dict[str, Path] = {}

    def make(kind: str) -> Path:
        if kind not in made:
            folder = tmp_path_factory.mktemp(kind)
            source, recorded = KINDS[kind]
            write = {**SOURCES, **FOXGLOVE_SOURCES}[source]
            lossy = {"quality": "visual", "transcode": True} if kind == "transcoded" else {}
            options = mp4ds.PackOptions(**lossy)
            mp4ds.pack(write(folder, recorded), folder / "dataset", options)
            with mp4ds.open(folder / "dataset") as dataset:
                (made[kind],) = (stream.path for stream in dataset.streams)
        return made[kind]

    return make


def copied(sidecar: Path, folder: Path) -> Path:
    for path in sidecar.parent.glob(f"{sidecar.stem}.*"):
        shutil.copy(path, folder)
    return folder / sidecar.name


@pytest.mark.one_in(3)
@pytest.mark.parametrize("kind", KINDS)
def test_the_good_ones_of_every_kind_are_accepted(
    kind: str, pairs: Callable[[str], Path], tmp_path: Path
) -> None:
    pair = copied(pairs(kind), tmp_path)
    accepted(pair)
    assert jail.read(pair).frames == 6


def header(**values: Any) -> Change:
    """A change of all headers; dots lead into them."""

    def change(document: Document) -> None:
        for one in document["headers"]:
            for key, value in values.items():
                *places, last = key.split("__")
                node = one[places[0]] if places else one
                node[last] = copy.deepcopy(value)

    return change


def video_of(**values: Any) -> Change:
    return both(*(put("video", key, value=value) for key, value in values.items()))


def image_of(encoding: str, bytes_per_pixel: int, **more: Any) -> Change:
    """Another encoding of the same size."""

    def change(document: Document) -> None:
        image = document["image"]
        image |= {"encoding": encoding, "step": image["width"] * bytes_per_pixel, **more}

    return change


def layout(name: str, **parameters: Any) -> Change:
    change = put("video", "layout", value=name)
    return both(change, put("video", "parameters", value=parameters)) if parameters else change


def twice_as_large(document: Document) -> None:
    for key in ("width", "height", "step"):
        document["image"][key] *= 2


NOT_AS_RECORDED = {"digest-mismatch", "decode-failed", "header-mismatch"}
BAD_YAML = BAD_DOCUMENT | {"yaml-invalid"}
BAD = BAD_DOCUMENT | NOT_AS_RECORDED | {"geometry-mismatch", "codec-mismatch"}
FORGED: dict[str, tuple[str, Change, set[str]]] = {
    # framing
    **{
        f"framing-{name}": ("h264", header(framing=value), BAD_DOCUMENT | NOT_AS_RECORDED)
        for name, value in {
            "none": "",
            "zeros": "0 0 0",
            "beyond": "4 " * 100_000 + "4",
            "long-zeros": "4096 4096 4096 4096",
            "too-long": "4097 4 4 4",
            "trailing-beyond": "4 4 3 3 +9999",
            "trailing-twice": "4 4 3 3 +1 +1",
            "signs": "-4 4 3 3",
            "huge": "9" * 4000 + " 4",
        }.items()
    },
    "framing-av1-none": ("av1", header(framing=""), NOT_AS_RECORDED),
    "framing-jpeg": ("jpeg", header(framing="td"), NOT_AS_RECORDED),
    # what stands before a picture
    "prefix-long": ("depth", header(prefix="00" * 33), BAD_DOCUMENT),
    "prefix-none": ("depth", header(prefix=""), NOT_AS_RECORDED),
    "prefix-most": ("rvl", header(prefix="ab" * 32), NOT_AS_RECORDED),
    # recipes of PNG files
    "png-larger": ("png", twice_as_large, BAD_DOCUMENT),
    "png-larger-video": (
        "png",
        both(twice_as_large, video_of(width=128, height=96)),
        {"model-invalid"},
    ),
    "png-smaller": (
        "png",
        both(put("image", "width", value=8), put("image", "step", value=8)),
        NOT_AS_RECORDED,
    ),
    **{
        f"png-{name}": ("png", header(**{f"png__{key}": value}), BAD_DOCUMENT | NOT_AS_RECORDED)
        for name, key, value in [
            ("filters-long", "filters", "sub " * 2**20),
            ("strategy-fixed", "strategy", 4),
            ("memory-1", "memory_level", 1),
            ("chunks-1", "chunk_bytes", 1),
            ("before", "before", "A" * 4 * 2**20),
            ("before-broken", "before", "A"),
        ]
    },
    "png-none": ("png", header(png=None), BAD),
    "png-of-packets": ("h264", header(png={}), BAD_DOCUMENT),
    "png-yuv": ("png", both(image_of("yuyv", 2), layout("planar422")), BAD),
    "png-two-channels": ("png", both(image_of("8UC2", 2), layout("stack8")), BAD),
    "png-signed": ("png", image_of("8SC1", 1), BAD),
    "png-bayer": ("png16", both(image_of("bayer_rggb8", 1), layout("mosaic8")), BAD),
    # RVL of what it has no form for
    "rvl-colours": ("rvl", both(image_of("rgb8", 3), layout("rgb24")), BAD),
    "rvl-of-png": ("png16", both(put("body", value="rvl"), header(png=None)), BAD),
    # new JPEG files of what JPEG does not hold
    **{
        f"jpeg-{encoding}": (
            "transcoded",
            both(image_of(encoding, size), layout(name)),
            BAD,
        )
        for encoding, size, name in [
            ("16UC1", 2, "gray16"),
            ("nv12", 1, "planar420"),
            ("bayer_rggb8", 1, "demosaic8"),
        ]
    },
    "jpeg-of-pixels": ("bits", put("body", value="jpeg"), BAD),
    # bodies and codecs that do not belong together
    **{
        f"codec-{codec}-of-{kind}": (
            kind,
            video_of(codec=codec),
            {"model-invalid" if codec == "ffv1" else "codec-mismatch"},
        )
        for kind, codec in [
            *(("h264", codec) for codec in ("ffv1", "mjpeg", "av1", "vp9", "h265")),
            *(("jpeg", codec) for codec in ("ffv1", "h264")),
            *(("bits", codec) for codec in ("mjpeg", "vp9")),
        ]
    },
    "codec-png": ("jpeg", video_of(codec="png"), BAD_DOCUMENT),
    "packets-of-pixels": ("bits", put("body", value="packet"), BAD),
    "pixels-of-jpeg": ("jpeg", put("body", value="pixels"), BAD),
    "jpeg-of-packets": ("h264", put("body", value="jpeg"), BAD),
    "body-unknown": ("h264", put("body", value="tiff"), BAD_DOCUMENT),
    # layouts of packets
    "packets-in-a-table": (
        "jpeg-grey",
        both(image_of("16UC1", 2), layout("table", table=[1, 2])),
        BAD,
    ),
    "packets-of-few-bits": (
        "jpeg",
        both(image_of("mono16", 2), layout("gray_bits", bits=12, shift=0)),
        BAD,
    ),
    "packets-without-a-layout": ("jpeg", layout("planar422"), BAD_DOCUMENT),
    # parameters
    "bits-fewer": ("bits", layout("gbr_bits", bits=10, shift=4), {"codec-mismatch"}),
    "bits-shifted": ("bits", layout("gbr_bits", bits=12, shift=3), {"digest-mismatch"}),
    **{
        f"table-{name}": ("table", layout("table", table=table), BAD_DOCUMENT)
        for name, table in {
            "beyond-64-bits": [0, 2**64],
            "huge": list(range(60_000)),
        }.items()
    },
    "table-short": ("table", layout("table", table=[7]), {"digest-mismatch"}),
    **{
        f"metres-{name}": ("metres", put("video", "parameters", value=value), BAD_YAML)
        for name, value in {
            "hole-nan": {"hole": float("nan"), "scale": "product"},
            "scale-long": {"hole": 0, "scale": "x" * 2**20},
        }.items()
    },
    "metres-hole": (
        "metres",
        put("video", "parameters", "hole", value=0x7F800000),
        {"digest-mismatch"},
    ),
    "nv12-odd": (
        "yuv",
        both(put("image", "width", value=63), put("image", "height", value=47)),
        BAD_DOCUMENT,
    ),
    # columns of packets
    "pts-beyond": (
        "ffmpeg",
        put("columns", "pts", value=column(2**63 - 1, 1, "0*5")),
        {"column-invalid"},
    ),
    "pts-none": ("ffmpeg", drop("columns", "pts"), BAD | {"column-invalid"}),
    # formats and templates
    "format-none": ("jpeg", header(format=None), NOT_AS_RECORDED),
    "format-huge": ("jpeg", header(format="x" * 2**22), NOT_AS_RECORDED),
    **{
        f"template-{kind}-{name}": (kind, header(template=value), BAD_YAML | NOT_AS_RECORDED)
        for kind in ("h264", "protobuf")
        for name, value in {
            "empty": "",
            "large": "A" * 2**20,
            "json": base64.b64encode(b'{"timestamp":{"sec":0,"nsec":0}}').decode(),
            "nested": base64.b64encode(b"[" * 100_000).decode(),
        }.items()
    },
    # definitions that are read to find the fields
    **{
        f"schema-protobuf-{name}": (
            "protobuf",
            put("channel", "schema", "base64", value=base64.b64encode(value).decode()),
            BAD_DOCUMENT | NOT_AS_RECORDED,
        )
        for name, value in {
            "empty": b"",
            "nested": b"\x0a\x7f" * 2000,
            "large": bytes(2**21),
        }.items()
    },
    "wire-of-another": ("protobuf", put("wire", value="json"), BAD),
    "wire-foreign": ("jpeg", put("wire", value="protobuf"), BAD),
}


@pytest.mark.one_in(16)
@pytest.mark.parametrize("name", FORGED)
def test_a_forged_sidecar_of_coded_pictures(
    name: str, pairs: Callable[[str], Path], tmp_path: Path
) -> None:
    kind, change, codes = FORGED[name]
    pair = copied(pairs(kind), tmp_path)
    changed(pair, change)
    refused(pair, *codes)


# ---------------------------------------------------------------- manifests


@pytest.mark.parametrize(
    "content",
    [b"", b"x" * 4096, b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"],
    ids=["empty", "junk", "git-lfs"],
)
def test_messages_that_are_no_mcap(content: bytes, dataset: Path) -> None:
    (dataset / "messages.mcap").write_bytes(content)
    agreed(dataset)
    outcome = jail.validate(dataset)
    assert outcome.codes == ["messages-unreadable"]
    outcome = jail.read(dataset)
    assert outcome.ours, outcome.text


# ---------------------------------------------------------------- anything else

ODD_VALUES: list[Any] = [
    None, True, False, -1, 0, 1, 255, 2**31, 2**32, 2**63 - 1, -(2**63), 2**64, 0.5, -0.0, 1e308,
    "", "x", "0", "\0", "\ud7ff", "A", "AAAA", "0*7", "ros1", "cdr-be", "mono16", [], [0], [[]], {},
    {"a": 1},
]  # fmt: skip


def _leaves(node: Any, place: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    if place:
        yield place
    children: Any = node.items() if isinstance(node, dict) else ()
    if isinstance(node, list):
        children = enumerate(node)
    for key, child in children:
        yield from _leaves(child, (*place, key))


def _mutated(document: Document, rng: random.Random) -> tuple[Document, str]:
    place = rng.choice(list(_leaves(document)))
    result = copy.deepcopy(document)
    if rng.random() < 0.2:
        drop(*place)(result)
        return result, f"without {place}"
    value = rng.choice(ODD_VALUES)
    put(*place, value=value)(result)
    return result, f"{place} = {value!r}"


def _use(path: Path) -> list[str]:
    """Validate and read; returns what was raised that is not meant for users."""
    foreign = []
    for task in (_validate_all, _read_all):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                task(path)
        except Mp4dsError:
            continue
        except Exception as error:
            foreign.append(f"{task.__name__}: {error!r}")
    return foreign


def _validate_all(path: Path) -> None:
    mp4ds.validate(path, deep=True)


def _read_all(path: Path) -> None:
    with mp4ds.open(path) as dataset:
        for _ in dataset.records():
            pass
        for topic in dataset:
            _ = topic[-1].intrinsics


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", [f"{STEM}.yaml", "dataset.yaml"])
def test_no_change_of_a_value_raises_anything_foreign(name: str, seed: int, dataset: Path) -> None:
    path, rng = dataset / name, random.Random(seed)
    document, found = load(path), []
    for _ in range(60):
        mutant, what = _mutated(document, rng)
        path.write_bytes(yamlio.dump(mutant))
        found += [f"{what}: {text}" for text in _use(dataset)]
    assert found == []
